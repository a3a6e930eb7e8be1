"""``/tf``: where several estimates of one body are, as one tree below the world frame.

Every body frame has one parent, the world. The transforms of one instant share a message, because a viewer that jumps
in time gets only the last message of a topic.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sonar_graph.logs import encoding
from sonar_graph.logs.cdr import Value
from sonar_graph.logs.recorder import Outgoing
from sonar_graph.logs.roles import TF
from sonar_graph.measurements import Ints
from sonar_graph.states import Trajectory


def body_transforms(topic: str, bodies: Mapping[str, Trajectory]) -> list[Outgoing]:
    """``tf2_msgs/TFMessage`` at every instant at which a body has a pose; by child frame."""
    if not bodies:
        return []
    trajectories = list(bodies.values())
    stamps_ns = np.unique(np.concatenate([t.stamps_ns for t in trajectories]))
    present = np.column_stack([np.isin(stamps_ns, t.stamps_ns) for t in trajectories])
    entries = []
    for pattern in np.unique(present, axis=0):
        at_ns = stamps_ns[(present == pattern).all(axis=1)]
        chosen = {name: body for (name, body), is_there in zip(bodies.items(), pattern, strict=True) if is_there}
        entries.append(_messages(topic, at_ns, chosen))
    return entries


def _messages(topic: str, stamps_ns: Ints, bodies: Mapping[str, Trajectory]) -> Outgoing:
    """One message a stamp, with all bodies."""
    rows = [body.rows(np.searchsorted(body.stamps_ns, stamps_ns)) for body in bodies.values()]
    columns = encoding.header(np.tile(stamps_ns[:, None], len(rows)), encoding.WORLD_FRAME, "transforms.header")
    columns |= encoding.fields("transforms.transform.translation", "xyz", np.stack([r.positions for r in rows], 1))
    quaternions = np.stack([r.quaternions_xyzw for r in rows], 1)
    columns |= encoding.fields("transforms.transform.rotation", "xyzw", quaternions)
    values: dict[str, Value] = {**columns, "transforms.child_frame_id": list(bodies)}
    return encoding.outgoing(topic, TF, stamps_ns, values, {"transforms": len(rows)})
