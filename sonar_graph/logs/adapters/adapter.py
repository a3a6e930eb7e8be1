"""What every adapter says: topic, type, where the stamp is, and along which axes a driver measures.

Axes of drivers turned into those of this package: body x forward, y left, z up; world x east, y north, z up.

What drivers mean by a covariance: variances or standard deviations, and which numbers say that it is not known.

Pose covariances in this package's order and in ROS's.

Here the perturbation is ``[theta, rho]`` in the body frame; in ``geometry_msgs/PoseWithCovariance`` it is translation
and then rotation about the fixed axes of the header's frame. With ``R = world_R_body`` the first becomes the second by

    [rho_world; theta_world] = [[0, R], [R, 0]] [theta; rho]
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field
from scipy.spatial.transform import Rotation as SpatialRotation

from sonar_graph.calibration import Section
from sonar_graph.logs.cdr import Messages, Struct
from sonar_graph.logs.mcap import Topic
from sonar_graph.logs.message_table import MessageTable, field_of
from sonar_graph.measurements import Floats

Rotation = Annotated[Literal["flu", "frd"] | tuple[float, float, float], Field()]
"""``flu`` (x forward, y left, z up: nothing to turn), ``frd`` (y right, z down), or roll, pitch, yaw in degrees of
``ours_R_driver = Rz(yaw) Ry(pitch) Rx(roll)``."""
World = Literal["enu", "ned"]
_FLU_R_FRD = np.diag([1.0, -1.0, -1.0])
_ENU_R_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


def axes_matrix(rotation: Rotation) -> Floats:
    """``ours_R_driver``, shape (3, 3)."""
    if rotation == "flu":
        return np.eye(3)
    if rotation == "frd":
        return _FLU_R_FRD
    return np.asarray(SpatialRotation.from_euler("xyz", rotation, degrees=True).as_matrix())


def world_matrix(world: World) -> Floats:
    """``enu_R_world``, shape (3, 3)."""
    return _ENU_R_NED if world == "ned" else np.eye(3)


def turn(rotation: Rotation, vectors: Floats) -> Floats:
    """Vectors along our axes, shape (n, 3); those that need no turning stay as they are to the bit."""
    return vectors if rotation == "flu" else vectors @ axes_matrix(rotation).T


def turn_covariances(rotation: Rotation, covariances: Floats) -> Floats:
    """Covariances along our axes, shape (n, 3, 3)."""
    if rotation == "flu":
        return covariances
    R = axes_matrix(rotation)
    return R @ covariances @ R.T


def _not_zero(scale: float) -> float:
    if scale == 0:
        raise ValueError("expected a factor, 1 where nothing is to be scaled")
    return scale


Scale = Annotated[float, Field(allow_inf_nan=False), AfterValidator(_not_zero)]
"""What numbers of a driver are multiplied by."""


class Adapter(Section):
    """Where the values of one role are in messages of one type; fields are named by their paths, such as ``a.b[2]``."""

    type: str
    """Message type, such as sensor_msgs/msg/Imu."""
    topic: str | None = None
    """Found by type where it is not given."""
    use: bool = True
    """false: nothing plays this role, whatever the log has."""
    stamp: str = "header.stamp"
    """Field with the time of validity (a Time or a number), or "log": when the message was recorded."""
    stamp_unit_s: float = Field(1.0, gt=0, allow_inf_nan=False)
    """What one unit of the stamp is, where it is a number; 1e-6 for microseconds."""
    stamp_offset_s: float = Field(0.0, allow_inf_nan=False)
    """Added to every stamp: minus the delay of a driver that stamps when a message arrives."""
    frame_id_field: str | None = "header.frame_id"
    """Field with the name of the sensor's frame in /tf_static."""
    frame_id: str | None = None
    """That name itself, where the message has none or a wrong one."""
    rotation: Rotation = "flu"
    """Axes of the driver: "flu", "frd", or [roll, pitch, yaw] in degrees of ours_R_driver."""

    def fields(self) -> Iterator[str]:
        """Paths that a message must have, except for the stamp's."""
        yield from ()

    def missing_in(self, definition: Struct) -> list[str]:
        """Which of `fields` a message type does not have."""
        known = dict(leaf_fields(definition))
        return [path for path in self.fields() if field_of(path)[0] not in known]

    def table(self, topic: Topic) -> MessageTable:
        """The messages of a topic, with their stamps."""
        return MessageTable(topic, self.stamp, self.stamp_unit_s, self.stamp_offset_s)

    def frame_in(self, messages: Sequence[Messages]) -> str:
        """The sensor's frame; empty where the messages do not name one."""
        if self.frame_id is not None or self.frame_id_field is None:
            return self.frame_id or ""
        return messages[0].first_string(self.frame_id_field)

    def warnings(self, table: MessageTable) -> Iterator[str]:  # noqa: ARG002  # adapters with something to check use it
        """What in the messages contradicts itself or is unlikely, although it can be read."""
        yield from ()


def leaf_fields(definition: Struct, prefix: str = "", size: str = "") -> Iterator[tuple[str, str]]:
    """Paths of all fields that hold values, through nested messages, each with ``[n]`` or ``[]`` for its arrays."""
    for entry in definition.fields:
        own = size + (f"[{entry.length or ''}]" if entry.is_array else "")
        if isinstance(entry.kind, Struct):
            yield from leaf_fields(entry.kind, f"{prefix}{entry.name}.", own)
        else:
            yield prefix + entry.name, own


Reading = Literal["unknown", "invalid"]
ROUNDING = 1e-6
"""Of the largest eigenvalue: single precision may leave the smallest this far below zero."""


class CovarianceFields(Section):
    """Where a covariance is, and how to read it."""

    fields: tuple[str, ...] = Field(min_length=1, max_length=3)
    """One field: a row-major matrix (3x3, or 6x6 of which the first three rows count), or one number for all axes.
    Three fields: one an axis, each a number or a row."""
    meaning: Literal["variance", "standard deviation"] = "variance"
    """Where drivers put standard deviations, only the diagonal is used, squared."""
    negative: Reading = "unknown"
    """What a negative first element says: the covariance is unknown, or the whole message is invalid."""
    zero: Reading = "unknown"
    """What zeros say."""

    def read(self, table: MessageTable) -> tuple[Floats, NDArray[np.bool_]]:
        """Covariances, shape (n, 3, 3) with NaN: unknown, and which rows they say are invalid, shape (n,)."""
        matrices = self._matrices(table)
        negative = matrices[:, 0, 0] < 0
        zero = ~matrices.any(axis=(1, 2))
        invalid = (negative & (self.negative == "invalid")) | (zero & (self.zero == "invalid"))
        if self.meaning == "standard deviation":
            matrices = matrices**2 * np.eye(3)
        unknown = negative | zero | ~np.isfinite(matrices).all(axis=(1, 2)) | _is_indefinite(matrices)
        return np.where(unknown[:, None, None], np.nan, matrices), invalid

    def warnings(self, table: MessageTable) -> Iterator[str]:
        """How many messages have what no errors can have."""
        if self.meaning == "standard deviation":
            return
        matrices = self._matrices(table)
        indefinite: NDArray[np.bool_] = _is_indefinite(matrices) & (matrices[:, 0, 0] >= 0)
        count = np.count_nonzero(indefinite)
        if count:
            yield (
                f"{', '.join(self.fields)}: no covariance in {count} of {len(table)} messages, since some direction's "
                f"variance is negative: the calibration's noise is taken there"
            )

    def read_variance(self, table: MessageTable) -> Floats:
        """One variance a row from one field, shape (n,); NaN: unknown (zero, negative, not finite)."""
        value = table.column(self.fields[0]).astype(float)
        known = np.isfinite(value) & (value > 0)
        return np.where(known, value**2 if self.meaning == "standard deviation" else value, np.nan)

    def _matrices(self, table: MessageTable) -> Floats:
        columns = [table.column(path).astype(float) for path in self.fields]
        if len(columns) > 1:
            stacked = np.stack(columns, axis=-1)
            if stacked.ndim == 2:
                return _diagonal(stacked)
            return stacked if stacked.shape[1:] == (3, 3) else np.full((len(stacked), 3, 3), np.nan)
        (column,) = columns
        if column.ndim == 1:
            return _diagonal(np.repeat(column[:, None], 3, axis=1))
        if column.shape[1] not in (9, 36):
            table.refuse(self.fields[0], f"has {column.shape[1]} numbers; a covariance has 1, 9 or 36")
        side = 3 if column.shape[1] == 9 else 6
        return column.reshape(-1, side, side)[:, :3, :3]


def _is_indefinite(matrices: Floats) -> NDArray[np.bool_]:
    """Matrices with a negative eigenvalue beyond rounding, shape (n,); none where a number is not finite."""
    finite = np.isfinite(matrices).all(axis=(1, 2))
    symmetric = np.where(np.asarray(finite)[:, None, None], matrices + np.swapaxes(matrices, 1, 2), 0.0)
    variances: Floats = np.linalg.eigvalsh(symmetric)
    return np.asarray(variances[:, 0] < -ROUNDING * np.abs(variances).max(axis=1))


def _diagonal(values: Floats) -> Floats:
    return values[:, :, None] * np.eye(3)


def body_to_ros(covariances: Floats, rotations: Floats) -> Floats:
    """Covariances for ROS messages.

    Parameters
    ----------
    covariances
        Of ``[theta, rho]`` in the body frame, shape (n, 6, 6); NaN: unknown.
    rotations
        ``world_R_body``, shape (n, 3, 3).

    Returns
    -------
    ndarray
        Of ``[rho, theta]`` along the world's axes, shape (n, 6, 6); zeros: unknown.
    """
    swap = _swap(rotations)
    return np.nan_to_num(swap @ covariances @ swap.transpose(0, 2, 1), nan=0.0)


def ros_to_body(covariances: Floats, rotations: Floats) -> Floats:
    """The inverse of `body_to_ros`; all zeros, or a negative variance, mean unknown and become NaN."""
    swap = _swap(rotations).transpose(0, 2, 1)
    known = np.any(covariances != 0, axis=(1, 2)) & (np.diagonal(covariances, axis1=1, axis2=2) >= 0).all(axis=1)
    return np.where(known[:, None, None], swap @ covariances @ swap.transpose(0, 2, 1), np.nan)


def _swap(rotations: Floats) -> Floats:
    swap = np.zeros((len(rotations), 6, 6))
    swap[:, :3, 3:] = rotations
    swap[:, 3:, :3] = rotations
    return swap
