"""The outcome of several estimators as one MCAP file for a viewer (RViz, Foxglove, Lichtblick, evo).

For each estimator ``NAME`` (with ``_`` for what ROS does not allow in a topic), in the frame ``map``:

==========================  ===============================================================================
``/NAME/odometry``          ``nav_msgs/Odometry``: the causal estimate with its covariance
``/NAME/pose``              ``geometry_msgs/PoseWithCovarianceStamped``: the same, for viewers without Odometry
``/NAME/path``              ``nav_msgs/Path``: the causal estimate so far, now and then; at the end the smoothed one
``/NAME/landmarks``         ``visualization_msgs/MarkerArray`` at the end: 95 % ellipsoids and identities
``/tf``                     ``map`` to ``base_link`` of the first estimator
``/ground_truth/...``       ``odometry``, ``path``, ``landmarks``, where known
==========================  ===============================================================================
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from sonar_graph.logs import encoding
from sonar_graph.logs.cdr import Value
from sonar_graph.logs.markers import BLUE, GREEN, GREY, ORANGE, PURPLE, Colour, landmark_markers
from sonar_graph.logs.mountings import encode_mountings
from sonar_graph.logs.recorder import Outgoing, write_recording
from sonar_graph.logs.roles import POSE_WITH_COVARIANCE, TF
from sonar_graph.sequence import Sequence
from sonar_graph.states import LandmarkMap, Trajectory

PATH = "nav_msgs/msg/Path"
_PATH_PERIOD_NS = 30 * 10**9
_MOST_CAUSAL_PATHS = 20
_CAUSAL_PATH_STEP_NS = 10**9
_MOST_CAUSAL_POSES = 1000
_TRUE_PATH_STEP_NS = 10**8
_COLOURS: tuple[Colour, ...] = (BLUE, ORANGE, PURPLE, GREEN)


def write_result(
    path: Path, sequence: Sequence, estimates: Mapping[str, tuple[Trajectory, Trajectory, LandmarkMap]]
) -> None:
    """Write what the estimators said, and the truth where there is one.

    Parameters
    ----------
    path
        The MCAP file; one that exists is replaced.
    sequence
        What the estimators were given.
    estimates
        By the estimator's name: causal trajectory, smoothed trajectory, landmarks. Any of them may be empty.

    Raises
    ------
    LogError
        When the file cannot be written, or a stamp does not fit into a ROS 2 message.
    """
    messages = [encoding.static_message("/tf_static", TF, sequence.start_ns, encode_mountings(sequence.calibration))]
    messages += _truth(sequence)
    for i, (name, (causal, smoothed, landmarks)) in enumerate(estimates.items()):
        messages += _estimator(name, causal, smoothed, landmarks, _COLOURS[i % len(_COLOURS)])
    if estimates:
        first, _, _ = next(iter(estimates.values()))
        messages += [_transforms(first)] if len(first) else []
    record = {"sequence": sequence.name, "estimators": ",".join(estimates)}
    write_recording(Path(path), messages, {"sonar_graph_result": record})


def _truth(sequence: Sequence) -> list[Outgoing]:
    """The truth, of which path and landmarks are there from the start."""
    messages = []
    if sequence.truth is not None and len(sequence.truth):
        messages.append(encoding.odometry_messages("/ground_truth/odometry", sequence.truth))
        messages.append(_path("/ground_truth/path", _thinned(sequence.truth, _TRUE_PATH_STEP_NS), sequence.start_ns))
    if sequence.true_landmarks is not None and len(sequence.true_landmarks):
        messages.append(landmark_markers("/ground_truth/landmarks", sequence.true_landmarks, sequence.start_ns, GREY))
    return messages


def _estimator(
    name: str, causal: Trajectory, smoothed: Trajectory, landmarks: LandmarkMap, colour: Colour
) -> list[Outgoing]:
    name = re.sub(r"\W", "_", name)
    messages = []
    if len(causal):
        messages.append(encoding.odometry_messages(f"/{name}/odometry", causal))
        messages.append(_poses(f"/{name}/pose", causal))
        messages += _causal_paths(f"/{name}/path", causal)
    ends = [int(t.stamps_ns[-1]) for t in (causal, smoothed) if len(t)]
    if len(smoothed):
        messages.append(_path(f"/{name}/path", smoothed, max(ends)))
    if len(landmarks) and ends:
        messages.append(landmark_markers(f"/{name}/landmarks", landmarks, max(ends), colour))
    return messages


def _poses(topic: str, trajectory: Trajectory) -> Outgoing:
    values = encoding.header(trajectory.stamps_ns, encoding.WORLD_FRAME) | encoding.pose_columns(trajectory)
    return encoding.outgoing(topic, POSE_WITH_COVARIANCE, trajectory.stamps_ns, values)


def _causal_paths(topic: str, causal: Trajectory) -> list[Outgoing]:
    """The path so far, now and then, thinned: all of them together would grow with the square of time."""
    first_ns, last_ns = int(causal.stamps_ns[0]), int(causal.stamps_ns[-1])
    period_ns = max(_PATH_PERIOD_NS, (last_ns - first_ns) // _MOST_CAUSAL_PATHS)
    thinned = _thinned(causal, max(_CAUSAL_PATH_STEP_NS, (last_ns - first_ns) // _MOST_CAUSAL_POSES))
    ends_ns = np.arange(first_ns + period_ns, last_ns, period_ns)
    counts = np.searchsorted(thinned.stamps_ns, ends_ns, side="right")
    pairs = zip(counts.tolist(), ends_ns.tolist(), strict=True)
    return [_path(topic, thinned.rows(slice(count)), end_ns) for count, end_ns in pairs]


def _thinned(trajectory: Trajectory, step_ns: int) -> Trajectory:
    """The first pose of each step of time."""
    _, kept = np.unique(trajectory.stamps_ns // step_ns, return_index=True)
    return trajectory.rows(kept)


def _path(topic: str, trajectory: Trajectory, stamp_ns: int) -> Outgoing:
    """One ``nav_msgs/Path`` published at an instant."""
    at_ns = np.array([stamp_ns])
    poses = encoding.header(trajectory.stamps_ns, encoding.WORLD_FRAME, "poses.header")
    poses |= encoding.fields("poses.pose.position", "xyz", trajectory.positions)
    poses |= encoding.fields("poses.pose.orientation", "xyzw", trajectory.quaternions_xyzw)
    values = encoding.header(at_ns, encoding.WORLD_FRAME) | poses
    return encoding.outgoing(topic, PATH, at_ns, values, {"poses": len(trajectory)})


def _transforms(trajectory: Trajectory) -> Outgoing:
    """``map`` to ``base_link``, one ``tf2_msgs/TFMessage`` a pose."""
    columns = encoding.header(trajectory.stamps_ns, encoding.WORLD_FRAME, "transforms.header")
    columns |= encoding.fields("transforms.transform.translation", "xyz", trajectory.positions)
    columns |= encoding.fields("transforms.transform.rotation", "xyzw", trajectory.quaternions_xyzw)
    one_each: dict[str, Value] = {
        path: value[:, None] if isinstance(value, np.ndarray) else value for path, value in columns.items()
    }
    one_each["transforms.child_frame_id"] = encoding.BODY_FRAME
    return encoding.outgoing("/tf", TF, trajectory.stamps_ns, one_each, {"transforms": 1})
