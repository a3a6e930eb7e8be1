"""Adapters for landmarks in tables with one row each: detections with range and azimuth, and true positions."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import model_validator

from sonar_graph.logs.adapters.adapter import (
    Adapter,
    AngleScale,
    LengthScale,
)
from sonar_graph.logs.adapters.aiding_messages import ENU_R_NED
from sonar_graph.logs.adapters.landmark_messages import NO_POSTERIOR
from sonar_graph.logs.adapters.message_table import (
    NOT_FINITE,
    Dropped,
    FieldTable,
    fit_block,
    not_finite,
)
from sonar_graph.measurements import (
    FIRST_TOO_LARGE_ID,
    ID_ADVICE,
    NO_TRACK,
    Floats,
    Ints,
    LandmarkDetections,
    no_posterior,
)
from sonar_graph.states import LandmarkMap


class DetectionRowsAdapter(Adapter):
    """Range, azimuth and identity of one detection a row; rows of one sonar frame share a stamp."""

    PATHS = (
        "range",
        "azimuth",
        "ids",
        "probabilities",
        "range_sigma",
        "azimuth_sigma",
        "track",
    )

    range: str
    """Field with the slant range."""
    range_scale: LengthScale = 1.0
    """Turns it into metres; 0.001 or "mm" from millimetres."""
    azimuth: str
    """Field with the azimuth in the sonar's frame, positive to the left; with rotation = "frd" to the right."""
    azimuth_scale: AngleScale = 1.0
    """Turns it into rad; 0.017453292519943295 or "deg" from degrees."""
    ids: tuple[str, ...] | None
    """Fields with the identities that the recogniser considers: integers; empty, or -1: unknown; false: no field."""
    probabilities: tuple[str, ...] = ()
    """Fields with the posterior of each identity, at most 1 in sum; without it, or where empty, 1 for the first."""
    range_sigma: str | None = None
    """Field with the range's standard deviation, before its scale; without it the calibration's noise holds."""
    azimuth_sigma: str | None = None
    """The same of the azimuth."""
    track: str | None = None
    """Field with the number of the track; none, or -1: no track."""

    @model_validator(mode="after")
    def _has_pairs(self) -> DetectionRowsAdapter:
        if self.ids is not None and not self.ids:
            raise ValueError("give ids = [...], at least one field, or ids = false")
        if self.probabilities and len(self.probabilities) != len(self.ids or ()):
            raise ValueError(
                f"give as many probabilities as ids: {len(self.ids or ())}, not {len(self.probabilities)}"
            )
        if (self.range_sigma is None) != (self.azimuth_sigma is None):
            raise ValueError("give range_sigma and azimuth_sigma, or neither")
        if self.rotation not in ("flu", "frd"):
            raise ValueError(
                'give rotation = "flu" (azimuth to the left) or "frd" (to the right)'
            )
        return self

    def read(self, table: FieldTable) -> tuple[LandmarkDetections | None, Dropped]:
        """Detections in the order of their stamps."""
        range_m = table.column(self.range) * self.range_scale
        azimuth_rad = (
            table.column(self.azimuth)
            * self.azimuth_scale
            * (-1.0 if self.rotation == "frd" else 1.0)
        )
        columns = [_whole(table, path, -1) for path in self.ids or ()]
        ids = np.column_stack(columns or [np.full(len(table), -1)])
        if (ids >= FIRST_TOO_LARGE_ID).any():
            table.refuse(
                ", ".join(self.ids or ()),
                f"has an identity of 2^56 or more; {ID_ADVICE}",
            )
        probability = np.zeros(ids.shape)
        # without probabilities the recogniser is sure
        probability[:, 0] = 1.0
        if self.probabilities:
            given = table.beside(self.probabilities)
            probability = np.where(
                np.isnan(given).all(axis=1)[:, None], probability, np.nan_to_num(given)
            )
        probability = np.where(ids < 0, 0.0, probability)
        covariance = np.full((len(table), 2, 2), np.nan)
        if self.range_sigma is not None and self.azimuth_sigma is not None:
            sigmas = table.beside((self.range_sigma, self.azimuth_sigma)) * [
                self.range_scale,
                self.azimuth_scale,
            ]
            known = np.asarray((sigmas > 0).all(axis=1))
            covariance = np.where(
                known[:, None, None], (sigmas**2)[:, :, None] * np.eye(2), np.nan
            )
        track = (
            np.full(len(table), NO_TRACK, np.int64)
            if self.track is None
            else _whole(table, self.track, NO_TRACK)
        )
        faults = {
            NOT_FINITE: not_finite(range_m, azimuth_rad),
            NO_POSTERIOR: no_posterior(probability),
        }
        measured = (range_m, azimuth_rad, covariance, ids, probability, track)
        return fit_block(
            LandmarkDetections, table.stamps_ns, faults, *measured, unique=False
        )


class LandmarkRowsAdapter(Adapter):
    """Identity and true position of one landmark a row; without stamps."""

    PATHS = ("id", "position")

    id: str
    """Field with the identity, an integer."""
    position: tuple[str, str, str]
    """Fields of x, y, z in the world."""
    scale: LengthScale = 1.0
    """Turns them into metres; 0.001 or "mm" from millimetres."""
    world: Literal["enu", "ned"] = "enu"
    """"enu" (any world with z up), or "ned"."""

    def read(self, table: FieldTable) -> tuple[LandmarkMap | None, Dropped]:
        """Map of the rows, of which each has another identity."""
        ids = _whole(table, self.id, -1)
        positions = table.beside(self.position) * self.scale
        positions = positions @ ENU_R_NED.T if self.world == "ned" else positions
        fit = (ids >= 0) & ~not_finite(positions)
        dropped: Dropped = (
            {"without identity or position": int(np.count_nonzero(~fit))}
            if not fit.all()
            else {}
        )
        names, counts = np.unique(ids[fit], return_counts=True)
        if (counts > 1).any():
            table.refuse(
                self.id,
                f"has {names[counts > 1][0]} more than once; a landmark has one place",
            )
        if not fit.any():
            return None, dropped
        order = np.flatnonzero(fit)[np.argsort(ids[fit], kind="stable")]
        return LandmarkMap(
            ids[order], positions[order], np.full((len(order), 3, 3), np.nan)
        ), dropped


def _whole(table: FieldTable, path: str, filling: int) -> Ints:
    """A column of integers; ``filling`` where there is none."""
    values: Floats = np.where(np.isnan(table.column(path)), filling, table.column(path))
    if (values != np.floor(values)).any():
        wrong = values[values != np.floor(values)][0]
        table.refuse(
            path, f"has {wrong:g}, and identities and tracks are integers; {ID_ADVICE}"
        )
    return values.astype(np.int64)
