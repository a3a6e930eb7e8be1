"""Depth: from pressure, or from anything that gives a height or a depth in metres."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from pydantic import Field, model_validator

from sonar_graph.logs.adapters.adapter import Adapter, Scale
from sonar_graph.logs.adapters.covariance import CovarianceFields
from sonar_graph.logs.table import NOT_FINITE, Dropped, Table, fit_rows, not_finite
from sonar_graph.measurements import Depth


class DepthAdapter(Adapter):
    """Height of the pressure port: ``z = -(p - atmosphere) / (density g)``, or a field's own metres."""

    pressure: str | None = None
    """Field with a pressure."""
    height: str | None = None
    """Field with a height, instead: metres, upwards; with scale = -1 a depth, downwards."""
    scale: Scale = 1.0
    """Turns the field into Pa or into metres upwards; 100 from hPa and mbar."""
    atmosphere_pa: float = Field(101_325.0, ge=0)
    """Pressure at the surface; 0 where the driver gives the pressure above it."""
    water_density_kg_m3: float = Field(1000.0, gt=0)
    """1000 for fresh water, 1025 for the sea."""
    variance: CovarianceFields | None = None
    """One field, before `scale`; without it, or where it is not above 0, the calibration's noise holds."""

    @model_validator(mode="after")
    def _has_one_source(self) -> DepthAdapter:
        if (self.pressure is None) == (self.height is None):
            raise ValueError("give either pressure or height")
        return self

    def fields(self) -> Iterator[str]:
        """Paths that a message must have."""
        yield from filter(None, (self.pressure, self.height))
        yield from self.variance.fields if self.variance else ()

    def read(self, table: Table, gravity_m_s2: float) -> tuple[Depth | None, Dropped]:
        """Heights with variances; NaN: unknown."""
        variance_m2 = self.variance.read_variance(table) if self.variance else np.full(len(table), np.nan)
        if self.scale != 1:
            variance_m2 = variance_m2 * self.scale**2
        if self.pressure is not None:
            pascals_per_metre = self.water_density_kg_m3 * gravity_m_s2
            z_m = (self.atmosphere_pa - table.column(self.pressure) * self.scale) / pascals_per_metre
            variance_m2 = variance_m2 / pascals_per_metre**2
        else:
            z_m = table.column(str(self.height)) * self.scale
        rows, dropped = fit_rows(table.stamps_ns, {NOT_FINITE: not_finite(z_m)}, unique=True)
        return (Depth(table.stamps_ns[rows], z_m[rows], variance_m2[rows]) if rows.size else None), dropped

    def assumption(self, gravity_m_s2: float) -> str | None:
        """How heights were got from pressure, for the notes; None where they were not."""
        if self.pressure is None:
            return None
        water = f"{self.water_density_kg_m3:g} kg/m3 x {gravity_m_s2:g} m/s2"
        fresh = ", fresh water assumed" if self.water_density_kg_m3 == 1000 else ""
        return f"z = -(p - {self.atmosphere_pa:g} Pa) / ({water}){fresh}"

    def warnings(self, table: Table) -> Iterator[str]:
        """What makes a pressure an unlikely one."""
        if self.pressure is None:
            return
        typical_pa = float(np.nanmedian(table.column(self.pressure))) * self.scale
        if typical_pa < 0.5 * self.atmosphere_pa:
            yield (
                f"{self.pressure} is typically {typical_pa:.4g} Pa, less than the atmosphere's: give scale (100 for "
                f"hPa or mbar), or atmosphere_pa = 0 where it is counted from the surface"
            )
