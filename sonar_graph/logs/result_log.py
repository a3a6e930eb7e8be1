"""The outcome of several estimators as one MCAP file for viewers (Foxglove, Lichtblick, RViz 2) and evo.

For each estimator ``NAME`` (as `source_names` spells it), in the frame ``map``:

=========================  ==============================================================================
``/NAME/odometry``         ``nav_msgs/Odometry``: the causal estimate with its covariance
``/NAME/pose``             ``geometry_msgs/PoseWithCovarianceStamped``: the same, for viewers without Odometry
``/NAME/pose_ellipsoid``   ``visualization_msgs/MarkerArray``: its 95 % ellipsoid of position
``/NAME/smoothed``         the same type: what is known at the end about each instant; equal to it for a filter
``/NAME/path``             ``nav_msgs/Path``: the causal estimate so far, now and then; at the end the smoothed
``/NAME/landmarks``        ``visualization_msgs/MarkerArray`` at the end: 95 % ellipsoids and identities
``/NAME/landmark_cloud``   ``sensor_msgs/PointCloud2`` at the end: position, identity, covariance
``/tf``                    ``map`` to ``NAME/base_link``, and to ``base_link``, which follows the first estimator
``/tf_static``             ``base_link`` to the sensors
``/ground_truth/...``      ``odometry``, ``path``, ``landmarks``, ``landmark_cloud`` from the start, and its
                           frame in ``/tf``, where known
``/sonar/recognised``      ``sensor_msgs/CompressedImage``: sonar images with the recognised identities drawn in
=========================  ==============================================================================

``/tf``: where several estimates of one body are, as one tree below the world frame.

Every body frame has one parent, the world. The transforms of one instant share a message, because a viewer that jumps
in time gets only the last message of a topic.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from collections.abc import Sequence as List
from pathlib import Path

import numpy as np

from sonar_graph.logs import writing as encoding
from sonar_graph.logs.cdr import Value
from sonar_graph.logs.mcap import Attachment, Outgoing, write_recording
from sonar_graph.logs.roles import TF
from sonar_graph.logs.vehicle_setup import encode_mountings
from sonar_graph.logs.viewer_messages import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PATH,
    PICTURES,
    PURPLE,
    Colour,
    Layer,
    Picture,
    Scene,
    landmark_cloud,
    landmark_markers,
    picture_messages,
    position_ellipsoids,
    write_layouts,
)
from sonar_graph.measurements import Ints
from sonar_graph.sequence import Sequence
from sonar_graph.states import LandmarkMap, Trajectory


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


RESULT_RECORD = "sonar_graph_result"
TRUTH = "ground_truth"
_PATH_PERIOD_NS = 30 * 10**9
_MOST_CAUSAL_PATHS = 20
_CAUSAL_PATH_STEP_NS = 10**9
_MOST_CAUSAL_POSES = 1000
_PATH_STEP_NS = 10**8
_MOST_POSES = 5000
_COLOURS: tuple[Colour, ...] = (BLUE, ORANGE, PURPLE, GREEN)
Estimates = tuple[Trajectory, Trajectory, LandmarkMap]
"""Causal trajectory, smoothed trajectory, landmarks; any of them may be empty."""


def write_result(
    path: Path,
    sequence: Sequence,
    estimates: Mapping[str, Estimates],
    about: Mapping[str, str] | None = None,
    attachments: List[Attachment] = (),
    pictures: List[Picture] = (),
) -> None:
    """Write what the estimators said, and the truth where there is one; beside it the layouts of `write_layouts`.

    Parameters
    ----------
    path
        The MCAP file; one that exists is replaced.
    sequence
        What the estimators were given.
    estimates
        By the estimator's name.
    about
        Settings and versions, for the metadata record ``sonar_graph_result``.
    attachments
        Files to go into it.
    pictures
        Sonar images with what was recognised in them.

    Raises
    ------
    LogError
        When a file cannot be written, or a stamp does not fit into a ROS 2 message.
    """
    sources = dict(zip(source_names(estimates), estimates.values(), strict=True))
    scene = Scene.around([*_positions(sequence, estimates.values())])
    colours = {name: _COLOURS[i % len(_COLOURS)] for i, name in enumerate(sources)} | {TRUTH: GREY}
    messages = [encoding.static_message("/tf_static", TF, sequence.start_ns, encode_mountings(sequence.calibration))]
    messages += _truth(sequence, scene)
    for name, estimate in sources.items():
        messages += _estimator(name, estimate, colours[name], scene)
    messages += picture_messages(PICTURES, pictures)
    messages += body_transforms("/tf", _bodies(sequence, sources))
    messages = [entry for entry in messages if len(entry.log_times_ns)]
    record = {"sequence": sequence.name, "estimators": ",".join(estimates), "topics": ",".join(sources)}
    write_recording(Path(path), messages, {RESULT_RECORD: record | dict(about or {})}, attachments)
    write_layouts(Path(path), _layers(messages, colours), scene)


def source_names(estimators: Iterable[str]) -> list[str]:
    """How estimators are called in topics and frames.

    ROS allows letters, digits and single underscores, and no digit first. Names that would be alike get a number.
    """
    taken = {TRUTH, "tf", "tf_static"}
    names = []
    for estimator in estimators:
        plain = re.sub(r"[^0-9A-Za-z]+", "_", estimator).strip("_")
        plain = plain if plain[:1].isalpha() else f"estimator_{plain}".rstrip("_")
        candidates = (plain if i == 1 else f"{plain}_{i}" for i in range(1, len(taken) + 2))
        names.append(next(name for name in candidates if name not in taken))
        taken.add(names[-1])
    return names


def _positions(sequence: Sequence, estimates: Iterable[Estimates]) -> Iterable[np.ndarray]:
    """Everything that is somewhere."""
    for causal, smoothed, landmarks in estimates:
        yield from (causal.positions, smoothed.positions, landmarks.positions)
    if sequence.truth is not None:
        yield sequence.truth.positions
    if sequence.true_landmarks is not None:
        yield sequence.true_landmarks.positions


def _truth(sequence: Sequence, scene: Scene) -> list[Outgoing]:
    """The truth, of which path and landmarks are there from the start."""
    messages = []
    if sequence.truth is not None and len(sequence.truth):
        messages.append(encoding.odometry_messages(f"/{TRUTH}/odometry", sequence.truth, f"{TRUTH}/base_link"))
        messages.append(_path(f"/{TRUTH}/path", _drawable(sequence.truth), sequence.start_ns))
    if sequence.true_landmarks is not None:
        messages += _landmarks(TRUTH, sequence.true_landmarks, sequence.start_ns, GREY, scene)
    return messages


def _estimator(name: str, estimate: Estimates, colour: Colour, scene: Scene) -> list[Outgoing]:
    causal, smoothed, landmarks = estimate
    messages = []
    if len(causal):
        messages.append(encoding.odometry_messages(f"/{name}/odometry", causal, _frame(name)))
        messages.append(encoding.pose_messages(f"/{name}/pose", causal))
        messages.append(position_ellipsoids(f"/{name}/pose_ellipsoid", causal, colour))
        messages += _causal_paths(f"/{name}/path", causal)
    ends = [int(t.stamps_ns[-1]) for t in (causal, smoothed) if len(t)]
    if len(smoothed):
        messages.append(encoding.pose_messages(f"/{name}/smoothed", smoothed))
        messages.append(_path(f"/{name}/path", _drawable(smoothed), max(ends)))
    return messages + (_landmarks(name, landmarks, max(ends), colour, scene) if ends else [])


def _landmarks(name: str, landmarks: LandmarkMap, stamp_ns: int, colour: Colour, scene: Scene) -> list[Outgoing]:
    if not len(landmarks):
        return []
    markers = landmark_markers(f"/{name}/landmarks", landmarks, stamp_ns, colour, scene.text_height_m)
    return [markers, landmark_cloud(f"/{name}/landmark_cloud", landmarks, stamp_ns)]


def _frame(name: str) -> str:
    return f"{name}/{encoding.BODY_FRAME}"


def _bodies(sequence: Sequence, sources: Mapping[str, Estimates]) -> dict[str, Trajectory]:
    """Body frames: one of each causal estimate, that of the sensors, and the truth at the instants of the estimates."""
    bodies = {_frame(name): causal for name, (causal, _, _) in sources.items() if len(causal)}
    owner = next(iter(bodies.values()), sequence.truth)
    truth = sequence.truth
    if truth is not None and len(truth):
        instants_ns = np.unique(np.concatenate([b.stamps_ns for b in bodies.values()] or [_drawable(truth).stamps_ns]))
        within = (instants_ns >= truth.stamps_ns[0]) & (instants_ns <= truth.stamps_ns[-1])
        bodies[_frame(TRUTH)] = truth.at(instants_ns[within]) if len(truth) > 1 else truth
    return {encoding.BODY_FRAME: owner, **bodies} if owner is not None and len(owner) else bodies


def _layers(messages: Iterable[Outgoing], colours: Mapping[str, Colour]) -> list[Layer]:
    """What a viewer may draw: every topic once."""
    topics = {entry.topic: entry for entry in messages}
    return [
        Layer(topic, entry.type_name, colours.get(topic.split("/")[1], GREY), is_latched=entry.is_latched)
        for topic, entry in topics.items()
    ]


def _causal_paths(topic: str, causal: Trajectory) -> list[Outgoing]:
    """The path so far, now and then, thinned: all of them together would grow with the square of time."""
    first_ns, last_ns = int(causal.stamps_ns[0]), int(causal.stamps_ns[-1])
    period_ns = max(_PATH_PERIOD_NS, (last_ns - first_ns) // _MOST_CAUSAL_PATHS)
    thinned = _thinned(causal, max(_CAUSAL_PATH_STEP_NS, (last_ns - first_ns) // _MOST_CAUSAL_POSES))
    ends_ns = np.arange(first_ns + period_ns, last_ns, period_ns)
    counts = np.searchsorted(thinned.stamps_ns, ends_ns, side="right")
    pairs = zip(counts.tolist(), ends_ns.tolist(), strict=True)
    return [_path(topic, thinned.rows(slice(count)), end_ns) for count, end_ns in pairs]


def _drawable(trajectory: Trajectory) -> Trajectory:
    """As many poses as a line needs."""
    duration_ns = int(trajectory.stamps_ns[-1] - trajectory.stamps_ns[0])
    return _thinned(trajectory, max(_PATH_STEP_NS, duration_ns // _MOST_POSES))


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
    return encoding.outgoing(topic, PATH, at_ns, values, {"poses": len(trajectory)}, is_latched=True)
