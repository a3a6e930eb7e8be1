"""Doppler velocity logs, and other messages whose velocity stands for one."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray
from pydantic import model_validator

from sonar_graph.logs.adapters.adapter import Adapter, Scale
from sonar_graph.logs.adapters.axes import turn, turn_covariances
from sonar_graph.logs.adapters.beams import BeamGeometry, unit_vector_warning
from sonar_graph.logs.adapters.covariance import CovarianceFields
from sonar_graph.logs.table import NOT_FINITE, Dropped, Table, fit_rows, not_finite
from sonar_graph.measurements import Dvl, Floats

Number = bool | int | float
SAID_INVALID = "with a covariance that says invalid"


class DvlAdapter(Adapter):
    """Velocity over the bottom in the instrument's frame."""

    velocity: tuple[str, str, str] | None = None
    """Fields of the velocity along x, y, z; not used where `beams` have a velocity."""
    scale: Scale = 1.0
    """Turns it into m/s; 0.001 from mm/s, -1 where the driver gives the bottom's velocity."""
    covariance: CovarianceFields | None = None
    """Of the velocity, before `scale`; without it the calibration's noise holds."""
    valid_where: Mapping[str, Number] = {}
    """Fields and the value that each has in messages to be used: {velocity_mode = 1}."""
    good_beams: str | None = None
    """Field that counts good beams; messages with none are left out, where the driver counts at all."""
    beams: BeamGeometry | None = None
    """Where the beams point."""
    beam_unit_vectors: tuple[str, str, str] | None = None
    """Array fields with x, y, z of each beam's direction: only checked, because drivers get them wrong. Velocities come
    from the directions of `beams`."""
    beam_ranges: str | None = None
    """Array field with a range for each beam: only checked."""
    beam_ranges_valid: str | None = None
    """Field that says whether ranges are valid: only checked, because drivers leave it true."""
    sound_speed: str | None = None
    """Field with the speed of sound, m/s: only checked, because drivers leave it 0."""

    @model_validator(mode="after")
    def _has_a_velocity(self) -> DvlAdapter:
        if self.velocity is None and (self.beams is None or self.beams.velocity is None):
            raise ValueError("give velocity = [x, y, z] fields, or beams with a velocity field")
        return self

    def fields(self) -> Iterator[str]:
        """Paths that a message must have."""
        yield from self.velocity or ()
        yield from self.covariance.fields if self.covariance else ()
        yield from self.valid_where
        yield from filter(None, (self.good_beams, self.beam_ranges, self.beam_ranges_valid, self.sound_speed))
        yield from self.beam_unit_vectors or ()
        if self.beams:
            yield from filter(None, (self.beams.velocity, self.beams.valid))

    def read(self, table: Table) -> tuple[Dvl | None, Dropped]:
        """The rows with a valid velocity, or with part of one from beams; a covariance that is not known is NaN."""
        velocity, covariance, faults = self._by_beams(table) if self._is_by_beams else self._by_velocity(table)
        faults |= {
            f"with {path} not {_toml(value)}": table.column(path) != value for path, value in self.valid_where.items()
        }
        if self.good_beams is not None:
            beams = table.column(self.good_beams)
            faults["without a good beam"] = (beams == 0) & beams.any()
        faults[NOT_FINITE] = not_finite(velocity)
        rows, dropped = fit_rows(table.stamps_ns, faults, unique=True)
        velocity, covariance = (
            turn(self.rotation, velocity[rows]),
            turn_covariances(self.rotation, covariance[rows]),
        )
        return (Dvl(table.stamps_ns[rows], velocity, covariance) if rows.size else None), dropped

    def warnings(self, table: Table) -> Iterator[str]:
        """What in the messages contradicts itself, although it can be read."""
        if self.covariance is not None and not (self._is_by_beams and self.beams and self.beams.sigma_m_s):
            yield from self.covariance.warnings(table)
        if self.beam_unit_vectors is not None:
            vectors = np.stack([table.column(path)[0] for path in self.beam_unit_vectors], axis=-1)
            fault = unit_vector_warning(vectors, self.beams)
            if fault:
                yield f"topic {table.topic.name}: {self.beam_unit_vectors[0].rpartition('.')[0]}: {fault}"
        if self.sound_speed is not None and not table.column(self.sound_speed).any():
            yield f"{self.sound_speed} is 0 in every message: the driver does not fill it"
        if self.beam_ranges is not None and self.beam_ranges_valid is not None:
            ranges, said = table.column(self.beam_ranges), table.column(self.beam_ranges_valid).astype(bool)
            wrong = said & ~(np.isfinite(ranges) & (ranges > 0)).all(axis=1)
            if wrong.any():
                yield f"{self.beam_ranges_valid} is true in {wrong.sum()} messages that have a range of 0 or less"

    @property
    def _is_by_beams(self) -> bool:
        return self.beams is not None and self.beams.velocity is not None

    def _by_velocity(self, table: Table) -> tuple[Floats, Floats, dict[str, NDArray[np.bool_]]]:
        """The driver's own velocity and covariance, and rows with a fault."""
        assert self.velocity is not None  # by the validator
        velocity = table.beside(self.velocity)
        covariance, invalid = self._covariances(table)
        return velocity if self.scale == 1 else velocity * self.scale, covariance, {SAID_INVALID: invalid}

    def _by_beams(self, table: Table) -> tuple[Floats, Floats, dict[str, NDArray[np.bool_]]]:
        """The same from single beams; what a driver says of their sum holds where nothing is said of them."""
        assert self.beams is not None
        velocity, covariance, count = self.beams.velocities(table, self.scale)
        fewest = self.beams.fewest
        faults = {"without a valid beam" if fewest == 1 else f"with fewer than {fewest} valid beams": count < fewest}
        if self.beams.sigma_m_s is None:
            covariance, faults[SAID_INVALID] = self._covariances(table)
        return velocity, covariance, faults

    def _covariances(self, table: Table) -> tuple[Floats, NDArray[np.bool_]]:
        if self.covariance is None:
            return np.full((len(table), 3, 3), np.nan), np.zeros(len(table), bool)
        covariance, invalid = self.covariance.read(table)
        return covariance if self.scale == 1 else covariance * self.scale**2, invalid


def _toml(value: Number) -> str:
    return str(value).lower()
