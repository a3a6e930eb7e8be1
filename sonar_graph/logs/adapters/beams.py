"""The geometry of a Doppler log's beams: from velocities along them to a velocity, and what drivers get wrong in it.

A beam that leaves the instrument at a tilt t from its vertical and an azimuth a (from x towards y) has the direction

    d = [sin t cos a, sin t sin a, cos t]    with z along the instrument's vertical, down

and sees the velocity d . v. Three beams or more give v by least squares; fewer give what they measured of it
(`sonar_graph.doppler_beams`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from sonar_graph.calibration import Section
from sonar_graph.doppler_beams import velocity_of_beams
from sonar_graph.logs.table import Table
from sonar_graph.measurements import Floats

LARGEST_TILT_DEG = 45.0
"""No Doppler log in use points its beams further outwards; 20 to 30 degrees are usual."""
TOLERANCE_DEG = 3.0
"""By which published and configured directions may differ."""
FEWEST_BEAMS = 3
"""That make a velocity."""


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
    sigma_m_s: float | None = Field(None, gt=0)
    """White noise of the velocity along one beam. With it one or two valid beams are used
    too, and every covariance follows from the beams; none: three beams are needed, and the adapter's `covariance` or
    the calibration says how good they are."""

    def directions(self) -> Floats:
        """Unit vectors, shape (beams, 3), z down."""
        tilt, azimuth = np.radians(self.tilt_deg), np.radians(self.azimuth_deg)
        across = np.sin(tilt)
        return np.column_stack(
            [across * np.cos(azimuth), across * np.sin(azimuth), np.full(azimuth.shape, np.cos(tilt))]
        )

    def velocities(self, table: Table, scale: float) -> tuple[Floats, Floats, NDArray[np.int64]]:
        """What the valid beams of each row say, along the driver's axes.

        Parameters
        ----------
        scale
            Turns the velocity field into m/s.

        Returns
        -------
        Velocity, shape (n, 3), NaN with too few beams; covariance, shape (n, 3, 3), NaN without `sigma_m_s`; number of
        valid beams, shape (n,).
        """
        along = table.column(str(self.velocity)).astype(float)
        if along.shape[1:] != (len(self.azimuth_deg),):
            table.refuse(str(self.velocity), f"has {along.shape[1:]} beams; azimuth_deg has {len(self.azimuth_deg)}")
        valid = np.isfinite(along)
        if self.valid is not None:
            said = table.column(self.valid)
            if said.shape != along.shape:
                table.refuse(self.valid, f"has {said.shape[1:]} elements; there are {along.shape[1]} beams")
            valid &= said.astype(bool)
        velocity, covariance = velocity_of_beams(self.directions(), along * scale, valid, self.sigma_m_s or 1.0)
        count = valid.sum(axis=1)
        velocity[count < self.fewest] = np.nan
        return velocity, covariance if self.sigma_m_s else np.full_like(covariance, np.nan), count

    @property
    def fewest(self) -> int:
        """Beams that are needed."""
        return 1 if self.sigma_m_s else FEWEST_BEAMS


def unit_vector_warning(vectors: Floats, geometry: BeamGeometry | None) -> str | None:
    """What is wrong with published beam directions, shape (beams, 3), or None.

    One driver, and one that copies it, publish z = sin(22.5°) where a beam tilted by 22.5° has cos(22.5°). Whatever is
    wrong, published directions are not used; where velocities come from beams, the configured ones are.
    """
    if not np.isfinite(vectors).all() or not vectors.any():
        return None
    across, down = np.hypot(vectors[:, 0], vectors[:, 1]), np.abs(vectors[:, 2])
    if np.allclose(across, down, atol=1e-3) and across.max() < np.sin(np.radians(LARGEST_TILT_DEG)) - 1e-2:
        tilt_deg = float(np.degrees(np.arcsin(down)).mean())
        return _not_used(
            f"have z = {down.mean():.3f}, the sine of the tilt of {tilt_deg:.1f}°, where its cosine "
            f"{np.cos(np.radians(tilt_deg)):.3f} should be"
        )
    lengths = np.linalg.norm(vectors, axis=1)
    if np.any(np.abs(lengths - 1) > 1e-2):
        return _not_used(f"are no unit vectors (length {lengths.min():.3f} to {lengths.max():.3f})")
    found = float(np.degrees(np.arccos(np.clip(down, 0, 1))).max())
    if found > LARGEST_TILT_DEG:
        return _not_used(
            f"are tilted by {found:.1f}°, which no Doppler log is: the driver seems to publish the sine of "
            f"{90 - found:.1f}° as z, where its cosine should be"
        )
    return None if geometry is None else _disagreement(vectors, found, geometry)


def _disagreement(vectors: Floats, tilt_deg: float, geometry: BeamGeometry) -> str | None:
    """Between published unit vectors and the configuration; z may point up or down."""
    if abs(tilt_deg - geometry.tilt_deg) > TOLERANCE_DEG:
        return _not_used(f"are tilted by {tilt_deg:.1f}°, the configured beams by {geometry.tilt_deg:g}°")
    if geometry.velocity is None:
        return None
    if len(vectors) != len(geometry.azimuth_deg):
        return _not_used(f"are {len(vectors)}, the configured beams {len(geometry.azimuth_deg)}")
    configured = geometry.directions() * np.sign(vectors[:, 2:]) ** np.array([0, 0, 1])
    off = np.degrees(np.arccos(np.clip((configured * vectors).sum(axis=1), -1, 1)))
    beam = int(off.argmax())
    if off[beam] <= TOLERANCE_DEG:
        return None
    return _not_used(f"and the configured ones differ by up to {off[beam]:.0f}° (beam {beam}); check azimuth_deg")


def _not_used(fault: str) -> str:
    return f"beam directions {fault}; they are not used"
