"""Geometry of an imaging sonar: range and azimuth to points, on a level floor or with unknown elevation.

A point q of the sonar frame (x along the centre beam, y left, z up) has

    range r = |q|,    azimuth a = atan2(q_y, q_x),    elevation e = asin(q_z / r),
    q = r (cos e cos a, cos e sin a, sin e).

The image gives r and a; e is only known to lie in the aperture. On a level floor at height h below the sonar, with u
the upward direction in the sonar frame, ``u . q = -h`` gives e; of two solutions the one nearer to the centre beam.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Generic, TypeVar

import gtsam
import numpy as np
from numpy.typing import NDArray

from sonar_graph.devices import DIDSON_BEAMS, aris_azimuths, didson_azimuths
from sonar_graph.errors import CalibrationError
from sonar_graph.images import SonarFrames
from sonar_graph.measurements import Floats


@dataclass(frozen=True, eq=False)
class FloorView:
    """A sonar over a level floor.

    Level axes have their origin at the sonar, z up and x horizontal, along the centre beam or the bearing of `turned`; the
    floor is the plane ``z = -height_m``.

    Raises
    ------
    CalibrationError
        When the sonar is not above the floor, or the centre beam is vertical.

    Examples
    --------
    A metre above the floor, looking down by 30°: the centre beam meets the floor at 2 m.

    >>> import numpy as np
    >>> from sonar_graph.sonar import FloorView
    >>> view = FloorView.from_angles(1.0, 0.0, np.radians(30.0))
    >>> view.floor_point(2.0, 0.0).round(3)
    array([1.732, 0.   ])
    """

    level_R_sonar: Floats
    """From sonar axes to level ones, shape (3, 3)."""
    height_m: float
    """Of the sonar over the floor."""
    height_sigma_m: float = 0.02
    """Standard deviation of the height."""
    tilt_sigma_rad: float = 0.01
    """Standard deviation of roll and of pitch."""

    def __post_init__(self) -> None:
        if not self.height_m > 0:
            raise CalibrationError(
                f"FloorView.height_m: {self.height_m} m; the sonar must be above the floor"
            )
        if not math.hypot(self.level_R_sonar[0, 0], self.level_R_sonar[1, 0]) > 1e-6:
            raise CalibrationError(
                "FloorView: the centre beam is vertical, so that level axes have no direction"
            )

    @classmethod
    def from_angles(
        cls, height_m: float, roll_rad: float, pitch_rad: float
    ) -> FloorView:
        """View of a sonar with this roll and pitch; a positive pitch turns the centre beam down."""
        return cls(gtsam.Rot3.RzRyRx(roll_rad, pitch_rad, 0.0).matrix(), height_m)

    @classmethod
    def from_pose(cls, world_T_sonar: gtsam.Pose3, floor_z_m: float) -> FloorView:
        """View of a sonar at this pose in a world with z up; the heading drops out."""
        rotation = world_T_sonar.rotation()
        forward = rotation.matrix()[:, 0]
        heading = gtsam.Rot3.Rz(math.atan2(forward[1], forward[0]))
        return cls(
            (heading.inverse() * rotation).matrix(),
            float(world_T_sonar.translation()[2]) - floor_z_m,
        )

    def turned(self, bearing_rad: float) -> FloorView:
        """The same view with level axes whose x axis points to this bearing."""
        cos = math.cos(bearing_rad)
        sin = math.sin(bearing_rad)
        ahead_R_level = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
        return replace(self, level_R_sonar=ahead_R_level @ self.level_R_sonar)

    def floor_points(self, ranges_m: Floats, azimuths_rad: Floats) -> Floats:
        """Points in the sonar frame where rays meet the floor, shape (n, 3); NaN where they do not.

        With ``A = u1 cos a + u2 sin a``, ``B = u3``, ``k = -h / r``, ``w = sqrt(A^2 + B^2 - k^2)``, the solutions are
        ``cos e = (A k +- B w) / (A^2 + B^2)``, ``sin e = (B k -+ A w) / (A^2 + B^2)``; the larger cosine is nearer to
        the centre beam.
        """
        up = self.level_R_sonar[2]
        lift = up[2]
        across = up[0] * np.cos(azimuths_rad) + up[1] * np.sin(azimuths_rad)
        norm2 = across * across + lift * lift
        with np.errstate(divide="ignore", invalid="ignore"):
            k = -self.height_m / ranges_m
            w = math.copysign(1.0, lift) * np.sqrt(norm2 - k * k)
        cos_e = (across * k + lift * w) / norm2
        sin_e = (lift * k - across * w) / norm2
        return points(ranges_m, azimuths_rad, np.arctan2(sin_e, cos_e))

    def floor_point(self, range_m: float, azimuth_rad: float) -> Floats | None:
        """Level (x, y) of the floor point at a range and azimuth, shape (2,); None where the ray does not reach it."""
        q = self.floor_points(np.array([range_m]), np.array([azimuth_rad]))[0]
        return None if np.isnan(q[0]) else np.asarray(self.level_R_sonar @ q)[:2]

    def range_azimuth(self, xy_m: Floats) -> tuple[Floats, Floats]:
        """Ranges and azimuths of floor points, shape (n,), from level (x, y), shape (n, 2)."""
        x, y, z = (
            xy_m @ self.level_R_sonar[:2] - self.height_m * self.level_R_sonar[2]
        ).T
        return np.sqrt(x * x + y * y + z * z), np.arctan2(y, x)

    def elevation_sigmas(self, points_m: Floats) -> Floats:
        """Standard deviation of the elevation of floor points, shape (n,), given in the sonar frame, shape (n, 3).

        From ``u . q = -h``: ``de (u . dq/de) = -dh - du . q``, where a tilt about the two level axes moves u . q by
        the horizontal distance.
        """
        up = self.level_R_sonar[2]
        along = points_m @ up
        horizontal2 = np.maximum(np.sum(points_m**2, axis=1) - along**2, 0.0)
        slope = np.abs(_elevation_derivatives(points_m) @ up)
        return np.sqrt(
            self.height_sigma_m**2 + horizontal2 * self.tilt_sigma_rad**2
        ) / np.maximum(slope, 1e-9)


@dataclass(frozen=True, eq=False)
class Fan:
    """Nearest beam and bin of each pixel of a picture, range up, azimuth to the left; for display only.

    Examples
    --------
    >>> import numpy as np
    >>> from sonar_graph.sonar import Fan
    >>> fan = Fan.of(np.linspace(1.0, 3.0, 100), np.linspace(0.25, -0.25, 48))
    >>> fan.beam.shape == fan.bin.shape
    True
    """

    beam: NDArray[np.int32]
    """Shape (height, width); -1 outside of the fan."""
    bin: NDArray[np.int32]
    """Shape (height, width)."""
    pixels_per_m: float
    lowest_m: float
    """Distance ahead of the sonar at the lower edge."""
    half_width_m: float

    @classmethod
    def of(cls, ranges_m: Floats, azimuths_rad: Floats, pixels_high: int = 420) -> Fan:
        """The fan of a sonar's beams and bins."""
        r0 = float(ranges_m.min())
        r1 = float(ranges_m.max())
        widest = float(np.abs(azimuths_rad).max())
        lowest = r0 * np.cos(widest)
        half_width = r1 * np.sin(min(widest, np.pi / 2))
        scale = pixels_high / (r1 - lowest)
        ahead = lowest + (np.arange(pixels_high)[::-1, None] + 0.5) / scale
        across = (
            half_width - (np.arange(int(2 * half_width * scale))[None] + 0.5) / scale
        )
        distance = np.hypot(ahead, across)
        azimuth = np.arctan2(across, ahead)
        order = np.argsort(azimuths_rad)
        place = np.interp(azimuth, azimuths_rad[order], np.arange(len(order)), -1, -1)
        inside = (place >= 0) & (distance >= r0) & (distance <= r1)
        beam = np.where(inside, order[np.rint(np.maximum(place, 0)).astype(int)], -1)
        at = np.rint(np.interp(distance, np.sort(ranges_m), np.argsort(ranges_m)))
        return cls(
            beam.astype(np.int32),
            at.astype(np.int32),
            scale,
            float(lowest),
            float(half_width),
        )

    def pixel(self, range_m: float, azimuth_rad: float) -> tuple[int, int]:
        """Column and row of a point."""
        ahead = range_m * np.cos(azimuth_rad)
        across = range_m * np.sin(azimuth_rad)
        column = (self.half_width_m - across) * self.pixels_per_m
        return round(column), round(
            len(self.beam) - (ahead - self.lowest_m) * self.pixels_per_m
        )


Made = TypeVar("Made")


class MadeOfWindow(Generic[Made]):
    """What is made of the ranges and azimuths of frames, and again where these change."""

    def __init__(self, make: Callable[[Floats, Floats], Made]) -> None:
        self._make = make
        self._last: tuple[SonarFrames, Made] | None = None

    def of(self, frame: SonarFrames) -> Made:
        """What is made of a frame; that of the frame before where ranges and azimuths are the same."""
        if self._last is None or not is_alike(self._last[0], frame):
            self._last = (frame, self._make(frame.ranges_m, frame.azimuths_rad))
        return self._last[1]


def is_alike(one: SonarFrames, other: SonarFrames) -> bool:
    """True for frames with the same beams and bins."""
    pairs = (one.ranges_m, other.ranges_m), (one.azimuths_rad, other.azimuths_rad)
    return all(a is b or np.array_equal(a, b) for a, b in pairs)


def with_lens(frames: SonarFrames, lens: str) -> SonarFrames:
    """Frames with the azimuths of a lens table; as-logged: unchanged.

    Raises
    ------
    CalibrationError
        When no table is known for so many beams.

    Examples
    --------
    A driver that spaced the beams of a DIDSON equally:

    >>> import numpy as np
    >>> from sonar_graph import SonarFrames
    >>> from sonar_graph.sonar import with_lens
    >>> even = np.radians(np.linspace(14.25, -14.25, 96))
    >>> frames = SonarFrames(np.array([0]), np.zeros((1, 96, 512), np.uint8), np.linspace(1.0, 3.0, 512), even)
    >>> np.degrees(with_lens(frames, "didson").azimuths_rad[:2]).round(2)
    array([14.25, 14.04])
    """
    if lens == "as-logged":
        return frames
    logged_rad = frames.azimuths_rad
    return replace(
        frames,
        azimuths_rad=lens_azimuths(
            lens, len(logged_rad), bool(logged_rad[0] < logged_rad[-1])
        ),
    )


@lru_cache(maxsize=8)
def lens_azimuths(lens: str, beams: int, is_rightmost_first: bool = True) -> Floats:
    """Azimuths of the beams of a lens, shape (beams,).

    Raises `CalibrationError` when no table is known for so many beams.
    """
    if lens == "didson":
        table = didson_azimuths(beams) if beams in DIDSON_BEAMS else None
    else:
        table = aris_azimuths(beams, telephoto=lens == "aris-telephoto")
    if table is None:
        raise CalibrationError(
            f"calibration.sonar.lens: no table of {lens} has {beams} beams; set it to as-logged"
        )
    table = table if is_rightmost_first else table[::-1].copy()
    table.flags.writeable = False
    return table


def points(ranges_m: Floats, azimuths_rad: Floats, elevations_rad: Floats) -> Floats:
    """Points in the sonar frame, shape (n, 3)."""
    level = ranges_m * np.cos(elevations_rad)
    x = level * np.cos(azimuths_rad)
    y = level * np.sin(azimuths_rad)
    return np.stack([x, y, ranges_m * np.sin(elevations_rad)], axis=-1)


def ranges_azimuths_elevations(points_m: Floats) -> tuple[Floats, Floats, Floats]:
    """Range, azimuth and elevation, each of shape (n,), of points in the sonar frame, shape (n, 3)."""
    x, y, z = np.moveaxis(np.asarray(points_m, dtype=np.float64), -1, 0)
    level = np.hypot(x, y)
    return np.hypot(level, z), np.arctan2(y, x), np.arctan2(z, level)


def point_covariances(
    points_m: Floats, range_azimuth_cov: Floats, elevation_sigmas_rad: Floats
) -> Floats:
    """Covariance of points in the sonar frame, first order, shape (n, 3, 3).

    ``J blockdiag(R, sigma_e^2) J^T``, R of shape (n, 2, 2) or (2, 2), J the derivative of q by (r, a, e).
    """
    r, _, _ = ranges_azimuths_elevations(points_m)
    by_azimuth = np.stack([-points_m[:, 1], points_m[:, 0], np.zeros(len(r))], axis=1)
    jacobian = np.stack(
        [points_m / r[:, None], by_azimuth, _elevation_derivatives(points_m)], axis=2
    )
    spherical = np.zeros((len(r), 3, 3))
    spherical[:, :2, :2] = range_azimuth_cov
    spherical[:, 2, 2] = elevation_sigmas_rad**2
    return jacobian @ spherical @ jacobian.transpose(0, 2, 1)


def _elevation_derivatives(points_m: Floats) -> Floats:
    """dq/de, shape (n, 3): ``r (-sin e cos a, -sin e sin a, cos e)``."""
    level = np.maximum(np.hypot(points_m[:, 0], points_m[:, 1]), 1e-12)
    lift = points_m[:, 2] / level
    return np.stack([-lift * points_m[:, 0], -lift * points_m[:, 1], level], axis=1)
