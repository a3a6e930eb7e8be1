"""What every adapter says: topic, type, where the stamp is, and along which axes a driver measures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Annotated

from pydantic import AfterValidator, Field

from sonar_graph.calibration import Section
from sonar_graph.logs.adapters.axes import Rotation
from sonar_graph.logs.cdr import Messages
from sonar_graph.logs.container import Topic
from sonar_graph.logs.schema import Struct
from sonar_graph.logs.table import Table, field_of


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

    def table(self, topic: Topic) -> Table:
        """The messages of a topic, with their stamps."""
        return Table(topic, self.stamp, self.stamp_unit_s, self.stamp_offset_s)

    def frame_in(self, messages: Sequence[Messages]) -> str:
        """The sensor's frame; empty where the messages do not name one."""
        if self.frame_id is not None or self.frame_id_field is None:
            return self.frame_id or ""
        return messages[0].first_string(self.frame_id_field)

    def warnings(self, table: Table) -> Iterator[str]:  # noqa: ARG002  # adapters with something to check use it
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
