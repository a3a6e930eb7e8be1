"""The geometry of a Doppler log's beams: from velocities along them to a velocity, and what drivers get wrong in it.

A beam that leaves the instrument at a tilt t from its vertical and an azimuth a (from x towards y) has the direction

    d = [sin t cos a, sin t sin a, cos t]    with z along the instrument's vertical, down

and sees the velocity d . v. Three beams or more give v by least squares.
"""

from __future__ import annotations

import numpy as np
from pydantic import Field

from sonar_graph.calibration import Section
from sonar_graph.logs.table import Table
from sonar_graph.measurements import Floats

LARGEST_TILT_DEG = 45.0
"""No Doppler log in use points its beams further outwards; 20 to 30 degrees are usual."""
_TILT_TOLERANCE_DEG = 3.0


class BeamGeometry(Section):
    """Where the beams point, and their fields where the velocity is to be computed from them."""

    tilt_deg: float = Field(gt=0, lt=90)
    """Angle between beams and the instrument's vertical: 30 (RDI), 25 (Nortek), 22.5 (Water Linked)."""
    azimuth_deg: tuple[float, ...] = Field(min_length=3)
    """Of each beam, from x towards y of the driver's axes (z down): [45, -45, -135, 135] for a Janus turned by 45."""
    velocity: str | None = None
    """Array field with one velocity a beam, positive along the beam; none: the driver's own velocity is used."""
    valid: str | None = None
    """Array field that is 0 where a beam is not to be used."""

    def directions(self) -> Floats:
        """Unit vectors, shape (beams, 3), z down."""
        tilt, azimuth = np.radians(self.tilt_deg), np.radians(self.azimuth_deg)
        across = np.sin(tilt)
        return np.column_stack(
            [across * np.cos(azimuth), across * np.sin(azimuth), np.full(azimuth.shape, np.cos(tilt))]
        )

    def velocities(self, table: Table) -> Floats:
        """Least-squares velocity of each row along the driver's axes, shape (n, 3); NaN with less than three beams."""
        along = table.column(str(self.velocity)).astype(float)
        valid = np.isfinite(along)
        if self.valid is not None:
            valid &= table.column(self.valid).astype(bool)
        if along.shape[1:] != (len(self.azimuth_deg),):
            table.refuse(str(self.velocity), f"has {along.shape[1:]} beams; azimuth_deg has {len(self.azimuth_deg)}")
        velocities = np.full((len(table), 3), np.nan)
        for pattern in np.unique(valid, axis=0):
            rows = (valid == pattern).all(axis=1)
            if pattern.sum() >= 3:
                velocities[rows] = along[rows][:, pattern] @ np.linalg.pinv(self.directions()[pattern]).T
        return velocities


def unit_vector_warning(vectors: Floats, tilt_deg: float | None) -> str | None:
    """What is wrong with published beam directions, shape (beams, 3), or None.

    One driver, and one that copies it, publish z = sin(22.5°) where a beam tilted by 22.5° has cos(22.5°).
    """
    if not np.isfinite(vectors).all() or not vectors.any():
        return None
    lengths = np.linalg.norm(vectors, axis=1)
    if np.any(np.abs(lengths - 1) > 1e-2):
        return f"beam directions are no unit vectors (length {lengths.min():.3f} to {lengths.max():.3f})"
    found = float(np.degrees(np.arccos(np.clip(np.abs(vectors[:, 2]), 0, 1))).max())
    if tilt_deg is not None and abs(found - tilt_deg) > _TILT_TOLERANCE_DEG:
        return f"beam directions are tilted by {found:.1f}°, the configured beams by {tilt_deg:g}°; they are not used"
    if tilt_deg is None and found > LARGEST_TILT_DEG:
        return (
            f"beam directions are tilted by {found:.1f}°, which no Doppler log is: the driver seems to publish the "
            f"sine of {90 - found:.1f}° as z; they are not used"
        )
    return None
