"""Prior knowledge of vehicle and sensors: noise, mountings, gravity, the start; sections of settings.

A `Calibration` travels inside the log (a metadata record) or comes from a TOML or JSON file; every field has a unit
in its name or docstring. Every estimator gets the same one.
"""

from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

import gtsam
import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    field_validator,
    model_validator,
)
from pydantic.fields import FieldInfo
from pydantic_core import InitErrorDetails, PydanticCustomError

from sonar_graph.errors import (
    MISFIT,
    ArgumentError,
    EstimatorError,
    SettingError,
    expectation,
)

if TYPE_CHECKING:
    from pydantic._internal._model_construction import ModelMetaclass
else:
    ModelMetaclass = type(BaseModel)  # pydantic has no public name for it

STANDARD_GRAVITY = 9.80665
HOLE_INTERVALS = 5
SHORTEST_HOLE_S = 0.05
"""Typical intervals and seconds of the IMU without a sample; a hole exceeds both: one lost sample does no harm."""
LEAST_COSINE = 0.01
"""Of a start's pitch: nearer to the vertical the sigmas of roll and yaw are those of one rotation."""
ROWS_BEFORE = 8
UNTYPICAL_S = 1.0
"""Preceding intervals that define the typical one; longest interval after the very first sample that is no hole."""


def within(lowest: float, highest: float, expected: str) -> AfterValidator:
    """Validator that a number lies between bounds; ``expected`` states them."""

    def check(value: float) -> float:
        if not lowest <= value <= highest:
            raise ValueError(f"expected {expected}")
        return value

    return AfterValidator(check)


def not_vertical(rpy_rad: tuple[float, float, float]) -> tuple[float, float, float]:
    """The angles, whose roll and yaw turn about different axes."""
    pitch = rpy_rad[1]
    if abs(np.cos(pitch)) < LEAST_COSINE:
        raise ValueError(
            f"pitch {pitch:g} is vertical, where roll and yaw turn about one axis;"
            " give another start (--start), with the vehicle not vertical"
        )
    return rpy_rad


Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
NotNegative = Annotated[Number, Field(ge=0)]
Positive = Annotated[Number, Field(gt=0)]
Angle = Annotated[
    Number, within(-2 * np.pi, 2 * np.pi, "radians between -2π and 2π (45° are 0.785)")
]
Angles = tuple[Angle, Angle, Angle]
Latitude = Annotated[
    Number,
    within(-np.pi / 2, np.pi / 2, "radians between -π/2 and π/2 (48° are 0.838)"),
]
Rate = Annotated[Number, within(-1, 1, "rad/s between -1 and 1 (1°/s are 0.0175)")]
Spread = Annotated[
    Number, within(0, 2 * np.pi, "radians between 0 and 2π (3° are 0.052)")
]
Gravity = Annotated[
    Number, within(9, 10.5, "m/s² between 9 and 10.5 (9.76 to 9.84 on Earth)")
]
Vector = tuple[Number, Number, Number]
Sigmas = tuple[NotNegative, NotNegative, NotNegative]


class SectionType(ModelMetaclass):
    """Type of the sections: making one by hand from wrong values is a `SettingError` that names each field."""

    def __call__(cls, *args: Any, **values: Any) -> Any:  # noqa: N805
        """Make a section."""
        try:
            return super().__call__(*args, **values)
        except ValidationError as error:
            faults = []
            for fault in error.errors():
                text = expectation(fault["type"], fault["msg"])
                if fault["type"] != MISFIT:
                    text += f", not {fault['input']!r:.60}"
                if fault["type"] == "extra_forbidden":
                    text = "there is no such field"
                    known = getattr(cls, "model_fields", {})
                    # the fields of an inner section are those of another class
                    if known and len(fault["loc"]) == 1:
                        text += f"; there are: {', '.join(known)}"
                faults.append(
                    f"{cls.__name__}.{'.'.join(map(str, fault['loc']))}: {text}"
                )
            raise SettingError("; ".join(faults)) from None


class Section(BaseModel, metaclass=SectionType):
    """A frozen group of settings that refuses names it does not know.

    Examples
    --------
    >>> class Params(Section):
    ...     gate: float = 3.0
    >>> Params(gate=2).gate
    2.0
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    def __setattr__(self, name: str, value: Any) -> None:
        """Refuse to change a setting."""
        try:
            super().__setattr__(name, value)
        except ValidationError:
            changed = f"model_copy(update={{{name!r}: ...}})"
            raise SettingError(
                f"{type(self).__name__}.{name} cannot be set; {changed} makes a changed one"
            ) from None


def require_params(params: object, kind: type[Section], name: str) -> None:
    """Raise an `EstimatorError` where an estimator's settings are neither None nor of their kind."""
    if params is not None and not isinstance(params, kind):
        given = (
            f"the class {params.__name__}"
            if isinstance(params, type)
            else type(params).__name__
        )
        raise EstimatorError(
            f"{name}: params: expected {kind.__name__} or None, not {given}; of a dict: {kind.__name__}(**params)"
        )


def tagged(tag: str, default: str) -> tuple[FieldInfo, BeforeValidator]:
    """Metadata of a union of sections that one of their fields distinguishes; it has a default.

    ``tag``: that field, with a literal text in each section; ``default``: its value where it is not given.
    """

    def with_tag(value: Any) -> Any:
        if isinstance(value, str):
            raise ValueError(f'expected a section with {tag} = "{value}"')
        # a section without its tag is of the default kind
        return {tag: default, **value} if isinstance(value, dict) else value

    return Field(discriminator=tag), BeforeValidator(with_tag)


def misfits(model: type[BaseModel], reasons: dict[str, str]) -> ValidationError:
    """Error for a model's validator to raise where fields exclude each other.

    ``reasons``: message for each field, so that the line in a file can be named.
    """
    found = [
        InitErrorDetails(
            type=PydanticCustomError(MISFIT, "{reason}", {"reason": reason}),
            loc=(name,),
            input=None,
        )
        for name, reason in reasons.items()
    ]
    return ValidationError.from_exception_data(model.__name__, found)


class Mounting(Section):
    """Where a sensor sits on the body: ``body_T_sensor``."""

    translation_m: Vector = (0.0, 0.0, 0.0)
    """Lever arm: the sensor's origin in the body frame."""
    rpy_rad: Angles = (0.0, 0.0, 0.0)
    """Roll, pitch, yaw: body_R_sensor = Rz(yaw) Ry(pitch) Rx(roll)."""

    def pose(self) -> gtsam.Pose3:
        """body_T_sensor."""
        return gtsam.Pose3(
            gtsam.Rot3.RzRyRx(*self.rpy_rad), np.array(self.translation_m)
        )

    def rotation_matrix(self) -> NDArray[np.float64]:
        """body_R_sensor, shape (3, 3)."""
        return np.asarray(self.pose().rotation().matrix())


class ImuCalibration(Section):
    """Gyroscopes and accelerometers."""

    gyro_noise_density: NotNegative = 1.2e-4
    """White noise of angular rate, rad/s/√Hz."""
    gyro_bias_sigma: NotNegative = 5e-5
    """Bias left when the run starts, rad/s; 0: no bias is estimated."""
    gyro_bias_rad_s: tuple[Rate, Rate, Rate] = (0.0, 0.0, 0.0)
    """Bias that is known, in the IMU's axes: every estimator takes it from the rows."""
    gyro_bias_walk_density: NotNegative = 1e-6
    """Random walk of the bias, rad/s²/√Hz."""
    accel_noise_density: NotNegative = 1.2e-3
    """White noise of specific force, m/s²/√Hz."""
    accel_bias_sigma: NotNegative = 1e-2
    """Bias of specific force left when the run starts, m/s²."""
    accel_bias_m_s2: Vector = (0.0, 0.0, 0.0)
    """Bias that is known, in the IMU's axes: every estimator takes it from the rows."""
    accel_bias_walk_density: NotNegative = 2e-4
    """Random walk of that bias, m/s³/√Hz."""
    turn_sigma_rad_s: Sigmas = (0.05, 0.05, 0.15)
    """Standard deviation of the vehicle's rate about each body axis, in IMU holes; 0: holes count as measured."""
    turn_time_s: tuple[Positive, Positive, Positive] = (0.5, 0.5, 1.5)
    """Time constant of these rates: their sigma over the standard deviation of angular acceleration."""
    mounting: Mounting = Mounting()


class DvlCalibration(Section):
    """Doppler velocity log."""

    velocity_sigma_m_s: Sigmas = (0.01, 0.01, 0.01)
    """White noise of one velocity sample along each axis of the DVL, where the log has no covariance."""
    mounting: Mounting = Mounting()
    gap_s: Positive = 0.35
    """Time without a sample above which the accelerometers carry the velocity; below it the velocity is linear."""
    velocity_walk_density: Positive = 0.1
    """Random walk of the vehicle's velocity, m/s/√s: for gaps of the log and the gate of outliers."""
    scale_error: Annotated[
        Number,
        within(-0.2, 0.2, "a relative error between -0.2 and 0.2 (0.5 % are 0.005)"),
    ] = 0.0
    """Known relative error of its velocities, 0.01 where they are 1 % too fast: taken from the rows."""
    scale_sigma: Annotated[
        Number, within(0, 0.2, "a relative error between 0 and 0.2 (0.5 % are 0.005)")
    ] = 0.0
    """Standard deviation of the relative error that is left; 0: it is not estimated."""


class DepthCalibration(Section):
    """Pressure sensor."""

    sigma_m: Positive = 0.01
    """White noise of one sample, where the log has no variance."""
    port_m: Vector = (0.0, 0.0, 0.0)
    """The pressure port in the body frame."""


class HeadingCalibration(Section):
    """Compass, attitude reference or gyrocompass."""

    sigma_rad: Annotated[Spread, Field(gt=0)] = 0.02
    """White noise of one sample, where the log has no variance."""
    bias_sigma_rad: Spread = 0.05
    """Error that all samples of a run share: deviation, declination, mounting; 0: it is not estimated."""


class PositionCalibration(Section):
    """Satellite receiver, or acoustic positioning (USBL)."""

    sigma_m: tuple[Positive, Positive, Positive] = (2.5, 2.5, 5.0)
    """White noise of one fix along the world's axes, where the log has no covariance."""
    antenna_m: Vector = (0.0, 0.0, 0.0)
    """The antenna or transponder in the body frame."""


class SonarImage(Section):
    """Scale of the samples of sonar images."""

    scale: Literal["decibel", "linear"] = "decibel"
    """``decibel``: samples grow with the logarithm of the echo (DIDSON, ARIS); ``linear``: with its amplitude."""
    decibel_span: Positive = 80.0
    """Span of the full scale, dB, of logarithmic samples."""
    full_scale: Positive = 255.0
    """The largest sample."""
    gamma: Positive = 1.0
    """Power to which the amplitude was raised, of linear samples (Oculus)."""


class SonarCalibration(Section):
    """Imaging sonar, or whatever else measures range and azimuth to landmarks."""

    mounting: Mounting = Mounting()
    image: SonarImage = SonarImage()
    lens: Literal["as-logged", "didson", "aris", "aris-telephoto"] = "as-logged"
    """Azimuths of beams: as logged, or by the maker's table where a driver spaced them equally."""
    range_sigma_m: Positive = 0.02
    """White noise of range, where the log has no covariance."""
    azimuth_sigma_rad: Positive = 0.009
    """White noise of azimuth, where the log has no covariance."""
    elevation_aperture_rad: Positive = 0.244
    """Full vertical aperture; elevations of detected points lie within half of it on either side of zero."""


class FloorPrior(Section):
    """Landmarks lie on a floor whose height is known: landmark z ~ N(z_m, sigma_m²)."""

    z_m: Number
    sigma_m: Positive


class PlanarMotion(Section):
    """The vehicle stays on a horizontal plane: z, roll and pitch are N(0, sigma²) at every keyframe or update."""

    z_m: Number = 0.0
    z_sigma_m: Positive = 1e-3
    tilt_sigma_rad: Positive = 1e-3


UNKNOWN_HEIGHT = "height unknown, taken as 0"
"""Words of the note ``log.start`` where neither sensor nor owner tells the height of the start."""
UNKNOWN_HEIGHT_M = 5.0
"""Sigma of a height in a map that nothing tells: a sonar sees artificial landmarks from near."""


class Start(Section):
    """World pose of the body at the first instant with IMU and DVL, as a prior."""

    position_m: Vector = (0.0, 0.0, 0.0)
    rpy_rad: Annotated[Angles, AfterValidator(not_vertical)] = (0.0, 0.0, 0.0)
    position_sigma_m: Sigmas = (1e-3, 1e-3, 1e-3)
    """Along the world's axes."""
    rpy_sigma_rad: Sigmas = (1e-3, 1e-3, 1e-3)
    """Of roll, pitch and yaw: an error of yaw turns the body about the vertical, so gravity cannot correct it."""
    source: Literal["stated", "fixes", "heading", "vehicle", "map"] = "stated"
    """Where x, y and yaw come from. ``stated``: from the owner; ``fixes``: measured; ``heading``: yaw is measured, x
    and y are zero at the vehicle; ``vehicle``: all three are zero at the vehicle, which defines the world; ``map``:
    they are found in the known map."""

    def pose(self) -> gtsam.Pose3:
        """world_T_body."""
        return gtsam.Pose3(gtsam.Rot3.RzRyRx(*self.rpy_rad), np.array(self.position_m))

    def covariance(self) -> NDArray[np.float64]:
        """Covariance of small rotations and shifts of the body in its own axes, rotation first, shape (6, 6).

        A small rotation is ``W [d roll, d pitch, d yaw]``, W of docs/theory/ekf_slam.md, which takes Euler rates to body
        rates. A small shift is ``R' d``, where R is the attitude and d is along the world's axes.
        """
        roll, pitch, _ = self.rpy_rad
        W = np.array(
            [
                [1.0, 0.0, -np.sin(pitch)],
                [0.0, np.cos(roll), np.sin(roll) * np.cos(pitch)],
                [0.0, -np.sin(roll), np.cos(roll) * np.cos(pitch)],
            ]
        )
        body_R_world = self.pose().rotation().matrix().T
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = W @ np.diag(np.square(self.rpy_sigma_rad)) @ W.T
        covariance[3:, 3:] = (
            body_R_world @ np.diag(np.square(self.position_sigma_m)) @ body_R_world.T
        )
        return covariance

    def states(self, *names: str) -> bool:
        """True where the owner states these fields, instead of their defaults or measured ones."""
        return self.source == "stated" and self.model_fields_set.issuperset(names)

    def in_map(self, *, has_height: bool) -> Self:
        """The start of a run with a known map: where nothing gives its place, the place is found in the map.

        Without ``has_height`` nothing tells its height there, which is uncertain by `UNKNOWN_HEIGHT_M`.
        """
        # heading and vehicle give no place in the world
        if self.source not in ("heading", "vehicle", "map"):
            return self
        x_m, y_m, z_m = self.position_sigma_m
        sigmas_m = (x_m, y_m, z_m if has_height else UNKNOWN_HEIGHT_M)
        return self.model_copy(update={"source": "map", "position_sigma_m": sigmas_m})


class KnownMap(Section):
    """Landmarks whose places were known before the run, by a survey or by the map of an earlier run.

    All coordinates are jointly normal: ``p ~ N(positions_m, covariance_m2)``.

    Examples
    --------
    >>> surveyed = KnownMap.of([4, 9], [[5.0, 0.0, -1.7], [7.0, -3.0, -1.7]], sigma_m=0.05)
    >>> surveyed.ids, surveyed.joint().shape
    ((4, 9), (6, 6))
    """

    ids: tuple[int, ...] = Field(examples=[(4,)])
    """Identity of each of m landmarks."""
    positions_m: tuple[Vector, ...] = Field(examples=[((5.0, 0.0, -1.7),)])
    """In the world, m places."""
    covariance_m2: tuple[tuple[Number, ...], ...] = Field(
        examples=[((0.01, 0.0, 0.0), (0.0, 0.01, 0.0), (0.0, 0.0, 0.01))]
    )
    """Joint covariance of all coordinates, x, y, z of each landmark in turn, shape (3 m, 3 m)."""
    is_fixed: bool = False
    """True: estimators count the map's covariance, and report its landmarks as they were given."""
    source: str = ""
    """Origin of the map: a survey, or log and estimator of an earlier run."""
    has_own_world: bool = False
    """True: position and heading of its world are those of a vehicle at the start of a dive, which nothing else has."""
    moved: tuple[int, ...] = ()
    """Landmarks that are left out because they have moved: estimators name them, and map them again."""

    @field_validator("ids", mode="before")
    @classmethod
    def _whole(cls, ids: Any) -> Any:
        # pydantic takes true as 1, and "1" and 1.0 too
        for given in ids if isinstance(ids, list | tuple) else ():
            if type(given) is not int or given < 0:
                reason = (
                    f"ids: {given!r}: identities of landmarks are whole numbers from 0 on, "
                    "such as ids = [4, 9]"
                )
                raise PydanticCustomError(MISFIT, "{reason}", {"reason": reason})
        return ids

    @model_validator(mode="after")
    def _check(self) -> Self:
        for name, reason in self._faults():
            raise misfits(type(self), {name: reason})
        return self

    def _faults(self) -> Iterator[tuple[str, str]]:
        """Fields that do not fit, with the reason; each is looked for after those before it."""
        if not self.ids:
            yield "ids", "a map needs at least one landmark"
        # a survey with one landmark in two rows
        for landmark_id, count in Counter(self.ids).items():
            if count > 1:
                yield "ids", f"landmark {landmark_id} stands twice; keep one"
        for landmark_id in sorted({*self.moved}.intersection(self.ids)):
            yield "moved", f"landmark {landmark_id} has a place too; leave its row out"
        if len(self.positions_m) != len(self.ids):
            reason = f"expected {len(self.ids)} places, one an identity, not {len(self.positions_m)}"
            yield "positions_m", reason
        # x, y and z of each landmark
        size = 3 * len(self.ids)
        if [len(row) for row in self.covariance_m2] != [size] * size:
            reason = f"expected {size} rows of {size} numbers, three a landmark"
            yield "covariance_m2", reason
        P = self.joint()
        # tolerances scale with the map
        largest = float(np.abs(P).max())
        apart = np.abs(P - P.T)
        row, column = divmod(int(apart.argmax()), size)
        # relative to the largest entry: rounding of a text file
        if apart[row, column] > 1e-6 * largest:
            reason = (
                f"expected a symmetric matrix, not {P[row, column]:g} in row {row + 1}, column {column + 1} and "
                f"{P[column, row]:g} in row {column + 1}, column {row + 1}"
            )
            yield "covariance_m2", reason
        eigenvalues, vectors = np.linalg.eigh(P)
        if eigenvalues[0] < -1e-9 * largest:
            suspect = self.ids[int(np.abs(vectors[:, 0]).argmax()) // 3]
            reason = (
                f"landmark {suspect}: expected a covariance without negative eigenvalues, such as that of a "
                "correlation above 1"
            )
            yield "covariance_m2", reason

    def joint(self) -> NDArray[np.float64]:
        """The joint covariance as an array, shape (3 m, 3 m), m²."""
        return np.array(self.covariance_m2, dtype=np.float64)

    def without(self, ids: Collection[int]) -> Self:
        """The map without some landmarks, which have moved; at least one stays."""
        rows = [
            row for row, landmark_id in enumerate(self.ids) if landmark_id not in ids
        ]
        coordinates = np.add.outer(3 * np.array(rows), np.arange(3)).ravel()
        P = self.joint()[np.ix_(coordinates, coordinates)]
        kept = {
            "ids": tuple(self.ids[row] for row in rows),
            "positions_m": tuple(self.positions_m[row] for row in rows),
            "covariance_m2": tuple(map(tuple, P.tolist())),
            "moved": (*self.moved, *ids),
        }
        return self.model_copy(update=kept)

    @classmethod
    def of(
        cls,
        ids: Sequence[int],
        positions_m: ArrayLike,
        *,
        sigma_m: float | None = None,
        covariance_m2: ArrayLike | None = None,
        is_fixed: bool = False,
    ) -> Self:
        """Map from arrays.

        ``positions_m``: shape (m, 3). Either ``sigma_m`` of every coordinate, without correlations, or
        ``covariance_m2``, shape (3 m, 3 m).
        """
        if (sigma_m is None) == (covariance_m2 is None):
            raise SettingError("KnownMap.of: give one of sigma_m and covariance_m2")
        if sigma_m is not None and not sigma_m > 0:
            raise SettingError(
                f"KnownMap.of: sigma_m: expected more than 0 m, not {sigma_m}"
            )
        places = np.asarray(positions_m, np.float64)
        if sigma_m is not None:
            covariance_m2 = sigma_m**2 * np.eye(places.size)
        return cls(
            ids=tuple(int(i) for i in ids),
            positions_m=tuple(map(tuple, places.tolist())),
            covariance_m2=tuple(map(tuple, np.asarray(covariance_m2).tolist())),
            is_fixed=is_fixed,
        )


class Calibration(Section):
    """Prior knowledge of a run; every field has a default.

    Examples
    --------
    >>> calibration = Calibration(imu=ImuCalibration(gyro_bias_sigma=1e-4), floor=FloorPrior(z_m=-1.7, sigma_m=0.02))
    >>> calibration.dvl.mounting.pose().translation()
    array([0., 0., 0.])
    """

    imu: ImuCalibration = ImuCalibration()
    dvl: DvlCalibration = DvlCalibration()
    depth: DepthCalibration = DepthCalibration()
    heading: HeadingCalibration = HeadingCalibration()
    positions: PositionCalibration = PositionCalibration()
    sonar: SonarCalibration = SonarCalibration()
    start: Start = Start()
    floor: FloorPrior | None = None
    """None: landmark heights are known only through the sonar's vertical aperture."""
    planar: PlanarMotion | None = None
    """None: the vehicle moves in three dimensions."""
    map: KnownMap | None = None
    """Landmarks whose places are known, or None."""
    use_gravity: bool = True
    """Take roll and pitch from the accelerometers, where they measure."""
    odometry_interpolation: Literal["linear", "hold-past"] = "linear"
    """Meaning of velocity and rate samples. ``linear``: values at their stamps, linear in between (Doppler logs,
    gyros); ``hold-past``: means over the interval that ends at the stamp (wheel odometry given as displacements)."""
    gravity_m_s2: Gravity = STANDARD_GRAVITY
    earth_rate_latitude_rad: Latitude | None = None
    """Latitude for removing the Earth's rotation from the gyros (world x east, y north); None: not removed."""


def require_calibration(value: object, call: str) -> None:
    """Raise an `ArgumentError` that names the ``call`` where a value is no `Calibration`."""
    if not isinstance(value, Calibration):
        raise ArgumentError(
            f"{call}: expected a Calibration, not {type(value).__name__}; of a dict: Calibration.model_validate(values)"
        )
