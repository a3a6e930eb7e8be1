"""Adapters for heading and for position fixes: AHRS, compass, satellite receiver, acoustic positioning.

A heading is the yaw of ``world_R_body = world_R_driver driver_R_body`` (Rz Ry Rx). A bearing β clockwise from north is
a yaw of ``90° - β`` in a world with x east. Fixes in latitude and longitude become metres east, north and up of an
origin (`sonar_graph.logs.adapters.geodesy`).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator
from scipy.spatial.transform import Rotation as SpatialRotation

from sonar_graph.logs.adapters.adapter import (
    Adapter,
    AngleScale,
    CovarianceFields,
    LengthScale,
    PathSection,
    axes_matrix,
    variances,
)
from sonar_graph.logs.adapters.geodesy import Origin, east_north_up
from sonar_graph.logs.adapters.message_table import (
    NOT_FINITE,
    Dropped,
    FieldTable,
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
STEEPEST_RAD = np.radians(80.0)
"""Pitch above which roll and yaw are hardly told apart."""
NO_MEASUREMENT = "whose orientation is no measurement"
_WHOLE_CIRCLE = 2 * np.pi + 0.1


class HeadingAdapter(Adapter):
    """Yaw of the body, from an orientation or from one angle."""

    PATHS = ("orientation", "yaw", "variance", "status")
    NEEDS = ("body_R_sensor",)

    orientation: tuple[str, str, str, str] | None = None
    """Fields of the quaternion's x, y, z, w: the sensor in the world."""
    yaw: str | None = None
    """Field with an angle instead: of the body, positive to the left from the world's x."""
    scale: AngleScale = 1.0
    """Turns the angle into rad; 0.017453292519943295 or "deg" from degrees."""
    world: Literal["enu", "ned"] = "enu"
    """"enu" (any world with z up), or "ned": an angle then is a bearing, clockwise from north."""
    yaw_offset_rad: float = Field(0.0, allow_inf_nan=False)
    """Added to every yaw: minus the declination (positive to the east) where north is magnetic."""
    variance: CovarianceFields | None = None
    """One field with the yaw's variance, rad²; without it, or where not above 0, the calibration's noise holds."""
    needs_variance: bool = False
    """Messages that state no variance are no measurements: drivers fill an orientation that is none."""
    status: str | None = None
    """Field that is -1 where the orientation was not measured."""

    @model_validator(mode="after")
    def _has_one_source(self) -> HeadingAdapter:
        if (self.orientation is None) == (self.yaw is None):
            raise ValueError("give either orientation = [x, y, z, w] or yaw")
        return self

    def accepts(self, fault: str) -> str | None:
        """Setting with which messages that are left out for a fault are used; None: there is none."""
        return (
            "needs_variance = false, status = false"
            if fault == NO_MEASUREMENT
            else super().accepts(fault)
        )

    def refusal(self, topic: Topic) -> str | None:
        """Reason why no message has a heading, which completes "/imu ..."."""
        if (
            topic.keep is not Keep.ALL
            or not topic.messages()
            or self.is_measured(self.table(topic)).any()
        ):
            return None
        field = (
            self.variance.fields[0]
            if self.variance and self.needs_variance
            else self.status
        )
        return (
            f"says of no orientation that it is measured ({field}); to use it all the same: needs_variance = false and "
            "status = false under [heading] in a log configuration"
        )

    def is_measured(self, table: FieldTable) -> NDArray[np.bool_]:
        """Mask of messages that say that yaw is measured, shape (n,)."""
        measured = (
            np.ones(len(table), bool)
            if self.status is None
            else table.column(self.status) != -1
        )
        if self.variance is not None and self.needs_variance:
            measured &= np.isfinite(self.variance.read_variance(table))
        return measured

    def read(
        self, table: FieldTable, body_R_sensor: Floats
    ) -> tuple[Heading | None, Dropped]:
        """Yaw of the body with its sigma; NaN: unknown. ``body_R_sensor``, shape (3, 3), counts for an orientation."""
        faults = {NO_MEASUREMENT: ~self.is_measured(table)}
        if self.orientation is not None:
            # drivers without an attitude send zeros
            quaternions = table.beside(self.orientation).astype(float)
            lengths = np.linalg.norm(quaternions, axis=1)
            is_rotation = np.isfinite(lengths) & (lengths > 0.5)
            sensor = SpatialRotation.from_quat(
                np.where(is_rotation[:, None], quaternions, [0.0, 0.0, 0.0, 1.0])
            )
            enu_R_world = ENU_R_NED if self.world == "ned" else np.eye(3)
            R = (
                enu_R_world
                @ sensor.as_matrix()
                @ (body_R_sensor @ axes_matrix(self.rotation)).T
            )
            yaw_rad = np.arctan2(R[:, 1, 0], R[:, 0, 0])
            faults |= {
                "without an orientation": ~is_rotation,
                "with the nose too steep for a heading": np.abs(R[:, 2, 0])
                > np.sin(STEEPEST_RAD),
            }
        else:
            yaw_rad = table.column(str(self.yaw)) * self.scale
            # a bearing turns clockwise from north
            yaw_rad = np.pi / 2 - yaw_rad if self.world == "ned" else yaw_rad
            faults[NOT_FINITE] = not_finite(yaw_rad)
        variance = variances(self.variance, table)
        yaw_rad = yaw_rad + self.yaw_offset_rad if self.yaw_offset_rad else yaw_rad
        return fit_block(Heading, table.stamps_ns, faults, yaw_rad, np.sqrt(variance))

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
            angles = np.abs(table.column(self.yaw) * self.scale)
            largest = float(np.max(angles, initial=0.0, where=np.isfinite(angles)))
            if largest > _WHOLE_CIRCLE:
                yield (
                    f"{self.yaw} is up to {largest:.4g}, more than a whole circle in rad: degrees? "
                    f"`scale = {self.scale * np.pi / 180:.6g}` under [heading] in the log configuration"
                )


class GeodeticFields(PathSection):
    """Fields of a position on the Earth, and the origin of the world."""

    PATHS = ("latitude", "longitude", "height", "status")

    latitude: str
    """Degrees, north."""
    longitude: str
    """Degrees, east."""
    unit: Literal["deg", "ddmm.mmmm", "rad"] = "deg"
    """Of both: "ddmm.mmmm" for degrees and minutes written as one number, as receivers do (NMEA)."""
    height: str | None = None
    """Metres above the ellipsoid, or any other level; none, or not finite: not measured."""
    status: str | None = None
    """Field that is negative where there is no fix."""
    origin_deg_m: tuple[float, float, float] | None = None
    """Latitude, longitude (degrees) and height (m) of the world's origin; none: those of the first fix in the log."""

    def read(self, table: FieldTable) -> tuple[Floats, NDArray[np.bool_]]:
        """Latitude, longitude in degrees and height in metres, shape (n, 3), and a mask of fixes, shape (n,).

        Drivers without a fix send latitude and longitude 0; a height that is not measured is NaN.
        """
        place = np.column_stack(
            [table.column(self.latitude), table.column(self.longitude)]
        ).astype(float)
        if self.unit == "ddmm.mmmm":
            # 4807.038 is 48 degrees and 7.038 minutes
            degrees = np.trunc(place / 100)
            place = degrees + (place - 100 * degrees) / 60
        elif self.unit == "rad":
            place = np.degrees(place)
        height = (
            table.column(self.height).astype(float)
            if self.height
            else np.full(len(table), np.nan)
        )
        is_fix = (
            np.isfinite(place).all(axis=1)
            & place.any(axis=1)
            & (np.abs(place) <= [90.0, 360.0]).all(axis=1)
        )
        if self.status is not None:
            is_fix &= table.column(self.status) >= 0
        return np.column_stack(
            [place, np.where(np.isfinite(height), height, np.nan)]
        ), is_fix

    def beyond(self, table: FieldTable) -> str:
        """Remark about latitudes that are none, for rows without a fix; empty where there are few."""
        latitude = np.abs(table.column(self.latitude).astype(float))
        if self.unit != "deg" or not np.median(latitude) > 90.0:
            return ""
        return f' ({self.latitude} is up to {np.nanmax(latitude):.6g}: unit = "ddmm.mmmm" inside geodetic?)'

    def first_fix(self, table: FieldTable) -> Origin | None:
        """Latitude and longitude in degrees, and height in metres, of the first fix by its stamp; None without one."""
        places, is_fix = self.read(table)
        rows = np.flatnonzero(is_fix)
        if not rows.size:
            return None
        latitude, longitude, height = places[
            rows[np.argmin(table.stamps_ns[rows])]
        ].tolist()
        heights = places[is_fix & np.isfinite(places[:, 2]), 2]
        return (
            latitude,
            longitude,
            height
            if np.isfinite(height)
            else float(heights[0])
            if heights.size
            else 0.0,
        )

    def positions(
        self, table: FieldTable, origin: Origin | None
    ) -> tuple[Floats, np.ndarray, NDArray[np.bool_]]:
        """Metres east, north, up of an origin in degrees and metres, shape (n, 3), and masks of fixes and of heights.

        A height that is not measured is 0.
        """
        places, is_fix = self.read(table)
        latitude_deg, longitude_deg, height_m = origin or (0.0, 0.0, 0.0)
        has_height = np.isfinite(places[:, 2])
        heights_m = np.where(has_height, places[:, 2], height_m)
        degrees = np.where(
            is_fix[:, None], places[:, :2], [latitude_deg, longitude_deg]
        )
        origin_rad = (
            float(np.radians(latitude_deg)),
            float(np.radians(longitude_deg)),
            height_m,
        )
        metres = east_north_up(
            np.radians(degrees[:, 0]), np.radians(degrees[:, 1]), heights_m, origin_rad
        )
        return (
            np.where(has_height[:, None], metres, metres * [1.0, 1.0, 0.0]),
            is_fix,
            has_height,
        )


class Places(NamedTuple):
    """Positions in the world, a row each."""

    position_m: Floats
    """Shape (n, 3), z up; a height that was not measured is 0."""
    faults: dict[str, NDArray[np.bool_]]
    """Masks of rows without a position, by reason."""
    has_height: NDArray[np.bool_]


class PlaceAdapter(Adapter):
    """Positions, in latitude and longitude or in metres of the world."""

    PATHS: ClassVar[tuple[str, ...]] = ("position", "geodetic")
    NEEDS: ClassVar[tuple[str, ...]] = ("origin",)
    geodetic: GeodeticFields | None = None
    """Fields of a position on the Earth."""
    position: tuple[str, str, str] | None = None
    """Fields of x, y, z in the world instead, metres."""
    scale: LengthScale = 1.0
    """Turns `position` into metres, and its covariance by the square; 0.001 or "mm" from millimetres."""
    world: Literal["enu", "ned"] = "enu"
    """"enu" (any world with z up), or "ned"; of `position`."""

    @model_validator(mode="after")
    def _has_one_place(self) -> PlaceAdapter:
        if (self.geodetic is None) == (self.position is None):
            raise ValueError(
                "give either position = [x, y, z] or geodetic = {latitude = ..., longitude = ...}"
            )
        return self

    def scaled(self, table: FieldTable) -> Floats:
        """Values of `position` in metres, along the driver's axes, shape (n, 3)."""
        return table.beside(self.position or ()).astype(float) * self.scale

    def places(self, table: FieldTable, origin: Origin | None) -> Places:
        """Positions of all rows; ``origin`` in degrees and metres is for positions on the Earth."""
        if self.geodetic is not None:
            position_m, is_fix, has_height = self.geodetic.positions(table, origin)
            fault = f"without a fix{self.geodetic.beyond(table)}"
            return Places(position_m, {fault: ~is_fix}, has_height)
        position_m = self.scaled(table)
        faults = {NOT_FINITE: not_finite(position_m)}
        if self.world == "ned":
            position_m = position_m @ ENU_R_NED.T
        return Places(position_m, faults, np.ones(len(table), bool))


class PositionAdapter(PlaceAdapter):
    """Fixes of an antenna or transponder, in latitude and longitude or in metres of the world."""

    PATHS = ("geodetic", "position", "covariance", "covariance_type")
    NEEDS = ("origin", "sigma_m")
    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """World's origin in the scaled coordinates of `position`, such as that of a run in a map grid (UTM)."""
    covariance: CovarianceFields | None = None
    """Along the world's axes; without it the calibration's noise holds."""
    covariance_type: str | None = None
    """Field that is 0 where the covariance is unknown."""

    def scaled(self, table: FieldTable) -> Floats:
        """Values of `position` in metres from the origin, along the driver's axes, shape (n, 3)."""
        return super().scaled(table) - self.origin_m

    def read(
        self,
        table: FieldTable,
        origin: Origin | None,
        sigma_m: tuple[float, float, float],
    ) -> tuple[PositionFixes | None, Dropped]:
        """Fixes with covariances, NaN: unknown.

        ``origin``, in degrees and metres, is for positions on the Earth, the calibration's ``sigma_m`` for fixes
        without height and covariance.
        """
        positions, faults, has_height = self.places(table, origin)
        C = np.full((len(table), 3, 3), np.nan)
        if self.covariance is not None:
            C, faults["with a covariance that says invalid"] = self.covariance.read(
                table
            )
        if self.covariance_type is not None:
            C[table.column(self.covariance_type) == 0] = np.nan
        if self.position is not None:
            C = C * self.scale**2
            if self.world == "ned":
                C = ENU_R_NED @ C @ ENU_R_NED.T
        # without a height, x and y keep their noise and z gets none that counts
        is_flat = ~has_height
        flat = np.where(np.isnan(C), np.diag(np.square(sigma_m)), C)[is_flat]
        flat[:, 2, :] = 0.0
        flat[:, :, 2] = 0.0
        flat[:, 2, 2] = UNMEASURED_M2
        C[is_flat] = flat
        return fit_block(PositionFixes, table.stamps_ns, faults, positions, C)

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
