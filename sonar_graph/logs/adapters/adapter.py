"""Adapters: the fields of a message type that hold the values of one role, with their units, axes and covariances.

A role is a part that a topic plays: IMU, Doppler log, depth, detections, truth, sonar. Each has one subclass of
`Adapter` (`vehicle_messages`, `dvl_messages`, `landmark_messages`, `sonar_messages`), whose attributes are field paths
and conventions. A message type is added without code, as an instance of that subclass: for everybody in
``drivers.toml``, for one log in a table of a TOML file (`log_config`, docs/tutorials/04_your_own_log.md).
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from difflib import get_close_matches
from typing import (
    Annotated,
    Any,
    ClassVar,
    Literal,
    NamedTuple,
    NewType,
    Self,
    get_args,
)

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    Field,
    model_validator,
)
from scipy.spatial.transform import Rotation as SpatialRotation

from sonar_graph.calibration import Calibration, Section
from sonar_graph.logs.adapters.geodesy import Origin, turned
from sonar_graph.logs.adapters.message_table import (
    SAME_STAMP,
    FieldTable,
    Mask,
    MessageTable,
    field_of,
    share,
)
from sonar_graph.logs.cdr import Messages, Struct
from sonar_graph.logs.mcap import Topic
from sonar_graph.measurements import Floats

Axis = Literal["x", "y", "z", "-x", "-y", "-z"]


def _each_axis_once(axes: tuple[Axis, Axis, Axis]) -> tuple[Axis, Axis, Axis]:
    if {axis[-1] for axis in axes} != {"x", "y", "z"}:
        raise ValueError('expected each axis once, such as ["x", "-y", "z"]')
    return axes


SignedAxes = Annotated[tuple[Axis, Axis, Axis], AfterValidator(_each_axis_once)]
Rotation = Annotated[
    Literal["flu", "frd"] | tuple[float, float, float] | SignedAxes, Field()
]
"""Axes of a driver: ``flu`` (x forward, y left, z up, as here), ``frd`` (y right, z down), roll, pitch, yaw in degrees
of ``ours_R_driver = Rz(yaw) Ry(pitch) Rx(roll)``, or the driver's axis along each of ours, ``["x", "-y", "z"]``, also
mirrored."""


_ALONG = dict(zip(get_args(Axis), [*np.eye(3), *-np.eye(3)], strict=True))


def axes_matrix(rotation: Rotation) -> Floats:
    """``ours_R_driver``, shape (3, 3)."""
    if isinstance(rotation, str):
        signs = [1.0, 1.0, 1.0] if rotation == "flu" else [1.0, -1.0, -1.0]
        return np.diag(signs)
    # written as rows of a matrix, a mirrored driver needs no angles
    if isinstance(rotation[0], str):
        return np.array([_ALONG[axis] for axis in rotation])
    angles = np.array(rotation, float)
    return SpatialRotation.from_euler("xyz", angles, degrees=True).as_matrix()


def turn(rotation: Rotation, vectors: Floats) -> Floats:
    """Vectors along the axes of this package, shape (n, 3); those that need no rotation keep every bit."""
    return vectors if rotation == "flu" else turned(axes_matrix(rotation), vectors)


def turn_covariances(rotation: Rotation, covariances: Floats) -> Floats:
    """Covariances along the axes of this package, shape (n, 3, 3)."""
    if rotation == "flu":
        return covariances
    R = axes_matrix(rotation)
    return R @ covariances @ R.T


def _not_zero(scale: float) -> float:
    if scale == 0:
        raise ValueError("expected a factor, 1 where nothing is to be scaled")
    return scale


RATES = {"rad/s": 1.0, "deg/s": np.pi / 180, "mrad/s": 1e-3}
FORCES = {"m/s2": 1.0, "g": 9.80665, "mg": 9.80665e-3, "cm/s2": 1e-2, "mm/s2": 1e-3}
SPEEDS = {"m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3, "km/h": 1 / 3.6, "kn": 1852 / 3600}
LENGTHS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "ft": 0.3048}
PRESSURES = {
    "Pa": 1.0,
    "hPa": 100.0,
    "mbar": 100.0,
    "kPa": 1e3,
    "dbar": 1e4,
    "bar": 1e5,
    "psi": 6894.757293168,
}
ANGLES = {"rad": 1.0, "deg": np.pi / 180}
TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0}
"""Units by name, for a scale instead of its number."""
UNITS = RATES | FORCES | SPEEDS | LENGTHS | PRESSURES | ANGLES | TIMES


def did_you_mean(name: str, known: Iterable[str], form: str = "{}") -> str:
    """Question about a misspelt name, for the middle of a refusal; empty where no known one is close."""
    close = get_close_matches(name, list(known), 1)
    return f"did you mean {form.format(close[0])}? " if close else ""


def _from_units(units: Mapping[str, float]) -> BeforeValidator:
    """Validator that takes the name of a unit for its factor."""

    def factor(value: object) -> object:
        if not isinstance(value, str):
            return value
        if value not in units:
            known = ", ".join(units)
            meant = did_you_mean(value, units)
            raise ValueError(f"{meant}expected a factor or one of the units {known}")
        return units[value]

    return BeforeValidator(factor)


Scale = Annotated[float, Field(allow_inf_nan=False), AfterValidator(_not_zero)]
"""Factor for the numbers of a driver."""
RateScale = Annotated[Scale, _from_units(RATES)]
ForceScale = Annotated[Scale, _from_units(FORCES)]
SpeedScale = Annotated[Scale, _from_units(SPEEDS)]
LengthScale = Annotated[Scale, _from_units(LENGTHS)]
DepthScale = Annotated[Scale, _from_units(LENGTHS | PRESSURES)]
AngleScale = Annotated[Scale, _from_units(ANGLES)]
TimeUnit = Annotated[float, Field(gt=0, allow_inf_nan=False), _from_units(TIMES)]
"""A scale, or the name of a unit such as "deg/s"."""


class Setup(NamedTuple):
    """Quantities that reading needs beside the messages."""

    calibration: Calibration = Calibration()
    body_R_sensor: Floats = np.eye(3)
    """Axes of the sensor of an orientation, shape (3, 3)."""
    origin: Origin | None = None
    """Latitude and longitude (degrees) and height (m) of the world's origin, for positions on the Earth."""


FieldPath = NewType("FieldPath", str)
"""Name of a field with values in every message."""
FieldPaths = tuple[FieldPath, FieldPath, FieldPath]
"""Fields of x, y and z."""


class PathSection(Section):
    """Section with paths of fields, an adapter or a part of one; those of type `FieldPath` a message must have."""

    EITHER: ClassVar[tuple[tuple[str, str, str], ...]] = ()
    """Pairs of attributes of which one must be given, with the words for both."""

    @model_validator(mode="after")
    def _has_one_of_each(self) -> Self:
        for one, other, both in self.EITHER:
            if (getattr(self, one) is None) == (getattr(self, other) is None):
                raise ValueError(f"give either {both}")
        return self

    def fields_used(self) -> Iterator[str]:
        """Paths that a message must have, except for the stamp's; their fields have the same size in all messages."""
        for name, field in type(self).model_fields.items():
            value = getattr(self, name)
            if isinstance(value, PathSection):
                yield from value.fields_used()
            elif "FieldPath" in str(field.annotation):
                yield from field_paths(value)


def field_paths(value: str | Iterable[str] | None) -> Iterable[str]:
    """Paths in an attribute of an adapter: one path, several, or none."""
    return (value,) if isinstance(value, str) else value or ()


class Adapter(PathSection):
    """Fields of one message type for one role, named by their paths such as ``a.b[2]``.

    A subclass adds the attributes of its role, and gives the measurements, with the number of rows left out by reason,
    in ``read(table, setup)``.
    """

    LISTS: ClassVar[tuple[str, ...]] = ()
    """Further paths, whose fields differ in length from message to message."""
    type: str
    """Message type, such as sensor_msgs/msg/Imu."""
    topic: str | None = None
    """Topic; without it the topic is found by type."""
    use: bool = True
    """false: nothing plays this role, whatever the log has."""
    stamp: str = "header.stamp"
    """Field with the time of validity (a Time or a number), or "log": when the message was recorded."""
    stamp_unit_s: TimeUnit = 1.0
    """Unit of a stamp that is a number; 1e-6 or "us" for microseconds."""
    stamp_offset_s: float = Field(0.0, allow_inf_nan=False)
    """Added to every stamp: minus the delay of a driver that stamps when a message arrives."""
    frame_id_field: str | tuple[str, ...] | None = "header.frame_id"
    """Field with the name of the sensor's frame in /tf_static; of several the first that is not empty."""
    frame_id: str | None = None
    """Name of the sensor's frame, where the message has none or a wrong one."""
    rotation: Rotation = "flu"
    """Axes of the driver: "flu", "frd", or [roll, pitch, yaw] in degrees of ours_R_driver."""

    def changed(self, table: Mapping[str, Any]) -> Self:
        """The adapter with the settings of a table in TOML; pydantic's ValidationError where one cannot be."""
        values = self.model_dump() | dict(table)
        for key, value in table.items():
            old = getattr(self, key, None)
            # false takes away a field, and is a value where a switch is meant
            if value is False and not isinstance(old, bool):
                values[key] = None
            elif isinstance(old, BaseModel) and isinstance(value, Mapping):
                values[key] = {**old.model_dump(), **value}
        return self.model_validate(values)

    def missing_in(self, definition: Struct) -> list[str]:
        """Paths that a message type must have and does not."""
        known = dict(leaf_fields(definition))
        paths = (*self.fields_used(), *self.LISTS)
        return [path for path in paths if field_of(path)[0] not in known]

    def refusal(self, topic: Topic) -> str | None:  # noqa: ARG002  # for subclasses
        """Reason why messages with all fields play no role, which completes "/imu ..."; None without one."""
        return None

    def table(self, topic: Topic) -> MessageTable:
        """Messages of a topic with their stamps."""
        return MessageTable(topic, self.stamp, self.stamp_unit_s, self.stamp_offset_s)

    def frame_in(self, messages: Sequence[Messages]) -> str:
        """Frame of the sensor; empty where the messages do not name one."""
        if self.frame_id is not None:
            return self.frame_id
        # one sensor fills a topic, so that the first message is enough
        named = map(messages[0].first_string, field_paths(self.frame_id_field))
        return next(filter(None, named), "")

    def accepts(self, fault: str) -> str | None:
        """Setting with which messages that are left out for a fault are used; None without one."""
        return 'stamp = "log"' if fault == SAME_STAMP else None

    def assumption(self, gravity_m_s2: float) -> str | None:  # noqa: ARG002  # for subclasses
        """Note about what is taken for granted; None: nothing is."""
        return None

    def pinned(self, table: FieldTable) -> dict[str, Any]:  # noqa: ARG002  # for subclasses
        """Settings by which single messages are read as all messages of a table are together."""
        return {}

    def warnings(self, table: FieldTable) -> Iterator[str]:  # noqa: ARG002  # for subclasses
        """Contradictions and unlikely values in messages that can be read."""
        yield from ()


def leaf_fields(
    definition: Struct, prefix: str = "", size: str = ""
) -> Iterator[tuple[str, str]]:
    """Paths of all fields that hold values, through nested messages, with ``[n]`` or ``[]`` for arrays."""
    for entry in definition.fields:
        own = size + (f"[{entry.length or ''}]" if entry.is_array else "")
        if isinstance(entry.kind, Struct):
            yield from leaf_fields(entry.kind, f"{prefix}{entry.name}.", own)
        else:
            yield prefix + entry.name, own


Reading = Literal["unknown", "invalid"]
ROUNDING = 1e-6
"""Part of the largest eigenvalue by which single precision may leave the smallest below zero."""


class CovarianceFields(PathSection):
    """Fields of a covariance, and the meaning of their numbers."""

    fields: tuple[FieldPath, ...] = Field(min_length=1, max_length=3)
    """One field: a row-major matrix (3x3, or the first three rows of 6x6), or one number for all axes.
    Three fields: one an axis, each a number or a row."""
    meaning: Literal["variance", "standard deviation"] = "variance"
    """Of standard deviations only the diagonal is used, squared."""
    negative: Reading | Literal["found"] = "unknown"
    """Meaning of a negative first element: the covariance is unknown, or the whole message is invalid; "found": invalid
    where other messages have a covariance, unknown where none has."""
    zero: Reading = "unknown"
    """Meaning of a covariance of zeros."""

    def read(self, table: FieldTable) -> tuple[Floats, Mask]:
        """Covariances, shape (n, 3, 3), NaN: unknown, and a mask of rows that they call invalid, shape (n,)."""
        matrices = self._matrices(table)
        is_negative = matrices[:, 0, 0] < 0
        is_zero = ~matrices.any(axis=(1, 2))
        is_invalid = is_negative & (self.of_negative(is_negative) == "invalid")
        is_invalid |= is_zero & (self.zero == "invalid")
        is_finite = np.isfinite(matrices).all(axis=(1, 2))
        # estimators would take a matrix that is no covariance for certainty
        is_unknown = is_negative | is_zero | ~is_finite | _is_impossible(matrices)
        if self.meaning == "standard deviation":
            matrices = matrices**2 * np.eye(3)
        return np.where(is_unknown[:, None, None], np.nan, matrices), is_invalid

    def of_negative(self, is_negative: Mask) -> Reading:
        """Meaning of negative first elements, given which messages have one."""
        if self.negative != "found":
            return self.negative
        # ROS writes -1 for "not measured"; a driver that knows no covariance writes it always
        return "unknown" if is_negative.all() else "invalid"

    def pinned(self, table: FieldTable) -> "CovarianceFields":
        """Fields by which single messages are read as all messages of a table are together."""
        is_negative = self._matrices(table)[:, 0, 0] < 0
        return self.model_copy(update={"negative": self.of_negative(is_negative)})

    def warnings(self, table: FieldTable) -> Iterator[str]:
        """Number of messages whose matrix is no covariance."""
        matrices = self._matrices(table)
        # a negative first element and zeros alone are a driver's ways to send no covariance
        is_stated = (matrices[:, 0, 0] >= 0) & matrices.any(axis=(1, 2))
        is_none = _is_impossible(matrices) & is_stated
        if is_none.any():
            yield (
                f"{', '.join(self.fields)}: no covariance in {share(is_none)} messages, since some direction's "
                f"variance is negative or an axis' is zero: the calibration's noise is taken there"
            )

    def read_variance(self, table: FieldTable) -> Floats:
        """Variances from one field, shape (n,); NaN: unknown (zero, negative, not finite)."""
        value = table.column(self.fields[0]).astype(float)
        is_known = np.isfinite(value) & (value > 0)
        power = 2 if self.meaning == "standard deviation" else 1
        return np.where(is_known, value**power, np.nan)

    def _matrices(self, table: FieldTable) -> Floats:
        columns = [table.column(path).astype(float) for path in self.fields]
        numbers = np.stack(columns, axis=1).reshape(
            len(table), -1
        )  # (n, 1, 3, 9 or 36)
        count = numbers.shape[1]
        if count in (1, 3):
            return numbers[:, :, None] * np.eye(3)
        if count == 0:
            return np.full((len(table), 3, 3), np.nan)
        if count not in (9, 36):
            fault = f"has {count} numbers; a covariance has 1, 9 or 36"
            table.refuse(self.fields[0], fault)
        # of a pose the translation comes first
        side = 3 if count == 9 else 6
        return numbers.reshape(-1, side, side)[:, :3, :3]


def variances(fields: CovarianceFields | None, table: FieldTable) -> Floats:
    """Variances of all rows, shape (n,); NaN: unknown."""
    return fields.read_variance(table) if fields else np.full(len(table), np.nan)


def _is_impossible(matrices: Floats) -> Mask:
    """Matrices with a zero on the diagonal or a negative eigenvalue beyond rounding, shape (n,); False for NaN."""
    is_finite = np.all(np.isfinite(matrices), axis=(1, 2))
    finite = np.where(is_finite[:, None, None], matrices, np.eye(3))
    variances: Floats = np.linalg.eigvalsh(finite + finite.transpose(0, 2, 1))
    is_negative = variances[:, 0] < -ROUNDING * np.abs(variances).max(axis=1)
    return is_negative | (np.einsum("nii->ni", finite) == 0).any(axis=1)
