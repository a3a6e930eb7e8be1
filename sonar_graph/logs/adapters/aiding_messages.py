"""Adapters for heading and for position fixes: AHRS, compass, satellite receiver, acoustic positioning.

A heading is the yaw of ``world_R_body = world_R_driver driver_R_body`` (Rz Ry Rx). A bearing β clockwise from north is
a yaw of ``90° - β`` in a world with x east. Fixes in latitude and longitude become metres east, north and up of an
origin (`sonar_graph.logs.adapters.geodesy`).
"""

from collections.abc import Iterator
from typing import Literal, NamedTuple

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation as SpatialRotation

from sonar_graph.logs.adapters.adapter import (
    Adapter,
    AngleScale,
    CovarianceFields,
    FieldPath,
    FieldPaths,
    LengthScale,
    PathSection,
    Setup,
    axes_matrix,
    variances,
)
from sonar_graph.logs.adapters.geodesy import Origin, east_north_up, turned
from sonar_graph.logs.adapters.message_table import (
    NOT_FINITE,
    FieldTable,
    Fit,
    Mask,
    fit_block,
    not_finite,
    share,
)
from sonar_graph.logs.mcap import Keep, Topic
from sonar_graph.measurements import (
    FARTHEST_FIX_M,
    FULL_TURN_RAD,
    UNMEASURED_M2,
    Floats,
    Heading,
    PositionFixes,
)

ENU_R_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
World = Literal["enu", "ned"]
ENU_R = {"enu": np.eye(3), "ned": ENU_R_NED}
"""``enu_R_world`` of each kind of world."""
DEGREES_IN = {"degE7": 1e-7, "rad": float(np.degrees(1.0))}
STEEPEST_RAD = np.radians(80.0)
"""Pitch above which roll and yaw are hardly distinct."""
NO_MEASUREMENT = "whose orientation is no measurement"
_WHOLE_CIRCLE = 2 * np.pi + 0.1


class HeadingAdapter(Adapter):
    """Yaw of the body, from an orientation or from one angle."""

    EITHER = (("orientation", "yaw", "orientation = [x, y, z, w] or yaw"),)

    orientation: tuple[FieldPath, FieldPath, FieldPath, FieldPath] | None = None
    """Fields of the quaternion's x, y, z, w: the sensor in the world."""
    yaw: FieldPath | None = None
    """Field with an angle instead: of the body, positive to the left from the world's x."""
    scale: AngleScale = 1.0
    """Turns the angle into rad; 0.017453292519943295 or "deg" from degrees."""
    world: World = "enu"
    """"enu" (any world with z up), or "ned": an angle then is a bearing, clockwise from north."""
    yaw_offset_rad: float = Field(0.0, allow_inf_nan=False)
    """Added to every yaw: minus the declination (positive to the east) where north is magnetic."""
    variance: CovarianceFields | None = None
    """One field with the yaw's variance, rad²; without it, or where not above 0, the calibration's noise holds."""
    needs_variance: bool = False
    """Messages that state no variance are no measurements: drivers fill orientations that nothing measured."""
    status: FieldPath | None = None
    """Field that is -1 where the orientation was not measured."""

    def accepts(self, fault: str) -> str | None:
        """Setting with which messages that are left out for a fault are used; None without one."""
        if fault == NO_MEASUREMENT:
            return "needs_variance = false` and `status = false"
        return super().accepts(fault)

    def refusal(self, topic: Topic) -> str | None:
        """Reason why no message has a heading, which completes "/imu ..."."""
        # an inspection may hold the stamps alone, which do not show it
        is_read = topic.keep is Keep.ALL and topic.messages()
        if not is_read or self.is_measured(self.table(topic)).any():
            return None
        needs = self.variance is not None and self.needs_variance
        field = self.variance.fields[0] if self.variance and needs else self.status
        return (
            f"says of no orientation that it is measured ({field}); to use it all the same: needs_variance = false and "
            "status = false under [heading] in a log configuration"
        )

    def is_measured(self, table: FieldTable) -> Mask:
        """Mask of messages that state that yaw is measured, shape (n,)."""
        is_measured = np.ones(len(table), bool)
        if self.status is not None:
            is_measured &= table.column(self.status) != -1
        if self.variance is not None and self.needs_variance:
            is_measured &= np.isfinite(self.variance.read_variance(table))
        return is_measured

    def read(self, table: FieldTable, setup: Setup) -> Fit[Heading]:
        """Yaw of the body with its sigma; NaN: unknown."""
        faults = {NO_MEASUREMENT: ~self.is_measured(table)}
        if self.orientation is not None:
            quaternions = table.beside(self.orientation).astype(float)
            # drivers without an attitude send zeros
            is_rotation = not_zero(quaternions)
            some = np.where(is_rotation[:, None], quaternions, [0.0, 0.0, 0.0, 1.0])
            world_R_sensor = SpatialRotation.from_quat(some).as_matrix()
            body_R_driver = setup.body_R_sensor @ axes_matrix(self.rotation)
            R = ENU_R[self.world] @ world_R_sensor @ body_R_driver.T  # (n, 3, 3)
            yaw_rad = np.arctan2(R[:, 1, 0], R[:, 0, 0])
            # near the vertical the yaw is that of rounding
            is_steep = np.abs(R[:, 2, 0]) > np.sin(STEEPEST_RAD)
            faults["without an orientation"] = ~is_rotation
            faults["with the nose too steep for a heading"] = is_steep
        else:
            yaw_rad = table.column(str(self.yaw)) * self.scale
            # a bearing turns clockwise from north
            yaw_rad = np.pi / 2 - yaw_rad if self.world == "ned" else yaw_rad
            faults[NOT_FINITE] = not_finite(yaw_rad)
        sigma_rad = np.sqrt(variances(self.variance, table))
        yaw_rad = yaw_rad + self.yaw_offset_rad if self.yaw_offset_rad else yaw_rad
        return fit_block(Heading, table.stamps_ns, faults, yaw_rad, sigma_rad)

    def warnings(self, table: FieldTable) -> Iterator[str]:
        """Warnings about a sigma beyond a full turn, and an angle that looks like degrees."""
        if self.variance is not None:
            # a sigma of a full turn is another unit, or means unknown
            is_beyond = self.is_measured(table) & (
                self.variance.read_variance(table) > FULL_TURN_RAD**2
            )
            if is_beyond.any():
                yield (
                    f"{share(is_beyond)} rows have a sigma beyond a full turn "
                    f"({self.variance.fields[0]}): estimators do not use them"
                )
        if self.yaw is not None:
            angles = table.column(self.yaw) * self.scale
            angles = angles[np.isfinite(angles)]
            largest = float(np.max(np.abs(angles), initial=0.0))
            if largest > _WHOLE_CIRCLE and not is_unwrapped(angles):
                yield (
                    f"{self.yaw} is up to {largest:.4g}, more than a whole circle in rad: degrees? "
                    f"`scale = {self.scale * np.pi / 180:.6g}` under [heading] in the log configuration"
                )


def is_unwrapped(angles: Floats) -> bool:
    """True for angles in rad, shape (n,), that begin within a circle and leave it in small steps, turn by turn."""
    steps = np.abs(np.diff(angles))
    return bool(abs(angles[0]) < _WHOLE_CIRCLE and np.all(steps < np.pi / 2))


def not_zero(quaternions: Floats) -> Mask:
    """Mask of quaternions that are rotations, shape (n,)."""
    lengths = np.linalg.norm(quaternions, axis=1)
    return np.isfinite(lengths) & (lengths > 0.5)


class Places(NamedTuple):
    """Positions in the world, a row each."""

    position_m: Floats
    """Shape (n, 3), z up; a height that was not measured is 0."""
    faults: dict[str, Mask]
    """Masks of rows without a position, by reason."""
    has_height: Mask


class GeodeticFields(PathSection):
    """Fields of a position on the Earth, and the origin of the world."""

    latitude: FieldPath
    """Degrees, north."""
    longitude: FieldPath
    """Degrees, east."""
    unit: Literal["deg", "degE7", "ddmm.mmmm", "rad"] = "deg"
    """Of both: "degE7" for integers of 1e-7 degrees (MAVLink, u-blox), "ddmm.mmmm" for degrees and minutes (NMEA)."""
    height: FieldPath | None = None
    """Metres above the ellipsoid, or any other level; none, or not finite: not measured."""
    status: FieldPath | None = None
    """Field that is negative where there is no fix."""
    origin_deg_m: tuple[float, float, float] | None = None
    """Latitude, longitude (degrees) and height (m) of the world's origin; none: those of the first fix in the log."""

    def read(self, table: FieldTable) -> tuple[Floats, Mask]:
        """Latitude, longitude in degrees and height in metres, shape (n, 3), and a mask of fixes, shape (n,).

        Drivers without a fix send latitude and longitude 0; a height that is not measured is NaN.
        """
        place = table.beside((self.latitude, self.longitude)).astype(float)
        if self.unit == "ddmm.mmmm":
            # 4807.038 is 48 degrees and 7.038 minutes
            degrees = np.trunc(place / 100)
            place = degrees + (place - 100 * degrees) / 60
        elif self.unit != "deg":
            place = place * DEGREES_IN[self.unit]
        height = np.full(len(table), np.nan)
        if self.height:
            height = table.column(self.height).astype(float)
        # receivers without satellites send zeros
        is_fix = np.isfinite(place).all(axis=1) & place.any(axis=1)
        is_fix &= (np.abs(place) <= [90.0, 360.0]).all(axis=1)
        if self.status is not None:
            is_fix &= table.column(self.status) >= 0
        height[~np.isfinite(height)] = np.nan
        return np.column_stack([place, height]), is_fix

    def beyond(self, table: FieldTable) -> str:
        """Remark about latitudes beyond 90 degrees, for rows without a fix; empty where there are few."""
        latitude = np.abs(table.column(self.latitude).astype(float))
        if self.unit != "deg" or not np.median(latitude) > 90.0:
            return ""
        largest = float(np.nanmax(latitude))
        # 90 degrees as degrees and minutes are 9000
        unit = "ddmm.mmmm" if largest <= 9000.0 else "degE7"
        return f' ({self.latitude} is up to {largest:.6g}: unit = "{unit}" inside geodetic?)'

    def first_fix(self, table: FieldTable) -> Origin | None:
        """Place of the first fix by its stamp, with the first height that was measured; None without a fix."""
        places, is_fix = self.read(table)
        order = np.argsort(table.stamps_ns, kind="stable")
        fixes = places[order[is_fix[order]]]
        if not len(fixes):
            return None
        # some receivers give heights later than places
        heights = fixes[np.isfinite(fixes[:, 2]), 2].tolist()
        latitude, longitude, _ = fixes[0].tolist()
        return latitude, longitude, next(iter(heights), 0.0)

    def positions(self, table: FieldTable, origin: Origin | None) -> Places:
        """Metres east, north, up of an origin; without heights where its own is NaN."""
        places, is_fix = self.read(table)
        latitude_deg, longitude_deg, level_m = origin or (0.0, 0.0, 0.0)
        has_height = np.isfinite(places[:, 2]) & np.isfinite(level_m)
        start = (latitude_deg, longitude_deg, float(np.nan_to_num(level_m)))
        # rows without a fix are left out, and a height that was not measured counts as 0
        is_known = np.column_stack([is_fix, is_fix, has_height])
        latitude, longitude, height_m = np.where(is_known, places, start).T
        from_rad = (*np.radians(start[:2]).tolist(), start[2])
        position_m = east_north_up(
            np.radians(latitude), np.radians(longitude), height_m, from_rad
        )
        position_m[~has_height, 2] = 0.0
        fault = f"without a fix{self.beyond(table)}"
        return Places(position_m, {fault: ~is_fix}, has_height)


class PlaceAdapter(Adapter):
    """Positions, in latitude and longitude or in metres of the world."""

    EITHER = (
        (
            "geodetic",
            "position",
            "position = [x, y, z] or geodetic = {latitude = ..., longitude = ...}",
        ),
    )
    geodetic: GeodeticFields | None = None
    """Fields of a position on the Earth."""
    position: FieldPaths | None = None
    """Fields of x, y, z in the world instead, metres."""
    scale: LengthScale = 1.0
    """Turns `position` into metres, and its covariance by the square; 0.001 or "mm" from millimetres."""
    world: World = "enu"
    """"enu" (any world with z up), or "ned"; of `position`."""

    def scaled(self, table: FieldTable) -> Floats:
        """Values of `position` in metres, along the driver's axes, shape (n, 3)."""
        return table.beside(self.position or ()).astype(float) * self.scale

    def places(self, table: FieldTable, origin: Origin | None) -> Places:
        """Positions of all rows; ``origin`` in degrees and metres is for positions on the Earth."""
        if self.geodetic is not None:
            return self.geodetic.positions(table, origin)
        position_m = self.scaled(table)
        faults = {NOT_FINITE: not_finite(position_m)}
        in_enu_m = turned(ENU_R[self.world], position_m)
        return Places(in_enu_m, faults, np.ones(len(table), bool))


class PositionAdapter(PlaceAdapter):
    """Fixes of an antenna or transponder, in latitude and longitude or in metres of the world."""

    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """World's origin in the scaled coordinates of `position`, such as that of a run in a map grid (UTM)."""
    covariance: CovarianceFields | None = None
    """Along the world's axes; without it the calibration's noise holds."""
    covariance_type: FieldPath | None = None
    """Field that is 0 where the covariance is unknown."""

    def scaled(self, table: FieldTable) -> Floats:
        """Values of `position` in metres from the origin, along the driver's axes, shape (n, 3)."""
        return super().scaled(table) - self.origin_m

    def read(self, table: FieldTable, setup: Setup) -> Fit[PositionFixes]:
        """Fixes with covariances, NaN: unknown; the calibration's noise counts for fixes without height and covariance."""
        places = self.places(table, setup.origin)
        C = np.full((len(table), 3, 3), np.nan)
        if self.covariance is not None:
            C, is_invalid = self.covariance.read(table)
            places.faults["with a covariance that says invalid"] = is_invalid
        if self.covariance_type is not None:
            C[table.column(self.covariance_type) == 0] = np.nan
        if self.position is not None:
            W = ENU_R[self.world]
            C = W @ (C * self.scale**2) @ W.T
        # without a height, x and y keep their noise and z gets none that counts
        is_flat = ~places.has_height
        noise = np.diag(np.square(setup.calibration.positions.sigma_m))
        flat = np.where(np.isnan(C), noise, C)[is_flat]
        flat[:, 2, :] = 0.0
        flat[:, :, 2] = 0.0
        flat[:, 2, 2] = UNMEASURED_M2
        C[is_flat] = flat
        found = (places.position_m, C)
        return fit_block(PositionFixes, table.stamps_ns, places.faults, *found)

    def warnings(self, table: FieldTable) -> Iterator[str]:
        """Warnings about matrices that are no covariances, and places that are not on the Earth."""
        if self.covariance is not None:
            yield from self.covariance.warnings(table)
        if self.position is not None:
            positions = self.scaled(table)
            is_far = np.asarray((np.abs(positions) > FARTHEST_FIX_M).any(axis=1))
            if is_far.any():
                yield (
                    f"{share(is_far)} rows have a position beyond "
                    f"{FARTHEST_FIX_M / 1e3:.0f} km: estimators do not use them"
                )
