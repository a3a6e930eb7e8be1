"""Result log: the estimates of several estimators in one MCAP file for viewers (Foxglove, Lichtblick, RViz 2) and evo.

For each estimator ``NAME`` (as `source_names` spells it), in the frame ``map``:

=========================  ==============================================================================
``/NAME/odometry``         ``nav_msgs/Odometry``: the causal estimate with its covariance
``/NAME/pose``             ``geometry_msgs/PoseWithCovarianceStamped``: the same, for viewers without Odometry
``/NAME/pose_ellipsoid``   ``visualization_msgs/MarkerArray``: its 95 % ellipsoid of position
``/NAME/smoothed``         the same type: what is known at the end about each instant; equal to it for a filter
``/NAME/path``             ``nav_msgs/Path``: the causal estimate so far, now and then; at the end the smoothed
``/NAME/landmarks``        ``visualization_msgs/MarkerArray`` at the end: 95 % ellipsoids and identities
``/tf``                    ``map`` to ``NAME/base_link``, and to ``base_link``, which follows the first estimator
``/tf_static``             ``base_link`` to the sensors
``/ground_truth/...``      ``odometry`` (of positions only ``point``), ``path``, ``landmarks`` from the start,
                           and its frame in ``/tf``, where known
``/sonar/recognised``      ``sensor_msgs/CompressedImage``: sonar images with the recognised identities drawn in
=========================  ==============================================================================

Every body frame has one parent, the world. The transforms of one instant share a message, because a viewer that jumps
in time gets only the last message of a topic (docs/tutorials/03_viewers.md).
"""

import re
from collections.abc import Iterable, Mapping
from collections.abc import Sequence as List
from pathlib import Path

import numpy as np

from sonar_graph.logs import viewer_messages as viewer
from sonar_graph.logs.mcap import Outgoing, write_recording
from sonar_graph.logs.roles import TF
from sonar_graph.logs.vehicle_setup import BODY_FRAME, encode_mountings
from sonar_graph.logs.writing import (
    WORLD_FRAME,
    fields,
    header,
    odometry_messages,
    outgoing,
    pose_messages,
    static_message,
    truth_messages,
)
from sonar_graph.sequence import Sequence
from sonar_graph.states import LandmarkMap, Trajectory

RESULT_RECORD = "sonar_graph_result"
TRUTH = "ground_truth"
_PATH_PERIOD_NS = 30 * 10**9
_MOST_CAUSAL_PATHS = 20
_CAUSAL_PATH_STEP_NS = 10**9
_MOST_CAUSAL_POSES = 1000
_PATH_STEP_NS = 10**8
_MOST_POSES = 5000
_COLOURS: tuple[viewer.Colour, ...] = (
    viewer.BLUE,
    viewer.ORANGE,
    viewer.PURPLE,
    viewer.GREEN,
)
Estimates = tuple[Trajectory, Trajectory, LandmarkMap]
"""Causal trajectory, smoothed trajectory, landmarks; any of them may be empty."""


def write_result(
    path: Path,
    sequence: Sequence,
    estimates: Mapping[str, Estimates],
    about: Mapping[str, str] | None = None,
    pictures: List[viewer.Picture] = (),
) -> None:
    """Write the estimates and the truth, where there is one, and beside them the layouts of `write_layouts`.

    Parameters
    ----------
    path
        The MCAP file; one that exists is replaced.
    sequence
        Sequence that the estimators were given.
    estimates
        Estimates by the name of the estimator.
    about
        Settings and versions, for the metadata record ``sonar_graph_result``.
    pictures
        Sonar images into which recognised landmarks are drawn.

    Raises
    ------
    LogError
        When a file cannot be written, or a stamp does not fit into a ROS 2 message.
    """
    sources = dict(zip(source_names(estimates), estimates.values(), strict=True))
    truth = sequence.truth
    landmarks = sequence.true_landmarks
    # the truth too: an estimate may cover a part of the run only
    drawn = [block.positions for estimate in estimates.values() for block in estimate]
    drawn += [block.positions for block in (truth, landmarks) if block is not None]
    scene = viewer.Scene.around(drawn)
    colours = {name: _COLOURS[i % len(_COLOURS)] for i, name in enumerate(sources)} | {
        TRUTH: viewer.GREY
    }
    mountings = encode_mountings(sequence.calibration)
    messages = [static_message("/tf_static", TF, sequence.start_ns, mountings)]
    if truth is not None and len(truth):
        messages.append(truth_messages(truth, f"{TRUTH}/{BODY_FRAME}"))
        messages.append(_path(f"/{TRUTH}/path", _drawable(truth), sequence.start_ns))
    if landmarks is not None:
        messages += _landmarks(TRUTH, landmarks, sequence.start_ns, viewer.GREY, scene)
    for name, estimate in sources.items():
        messages += _estimator(name, estimate, colours[name], scene)
    messages += viewer.picture_messages(viewer.PICTURES, pictures)
    messages += body_transforms("/tf", _bodies(sequence, sources))
    messages = [entry for entry in messages if len(entry.log_times_ns)]
    record = {
        "sequence": sequence.name,
        "estimators": ",".join(estimates),
        "topics": ",".join(sources),
    }
    records = {RESULT_RECORD: record | dict(about or {})}
    write_recording(Path(path), messages, records)
    # one layer a topic, whatever the number of its entries
    layers = []
    for topic, entry in {entry.topic: entry for entry in messages}.items():
        colour = colours.get(topic.split("/")[1], viewer.GREY)
        layers.append(viewer.Layer(topic, entry.type_name, colour, entry.is_latched))
    viewer.write_layouts(Path(path), layers, scene)


def source_names(estimators: Iterable[str]) -> list[str]:
    """Names of estimators in topics and frames.

    ROS allows letters, digits and single underscores, and no digit first. Names that would be alike get a number.
    """
    taken = {TRUTH, "tf", "tf_static"}
    names = []
    for estimator in estimators:
        # names of topics in ROS allow no other characters
        plain = re.sub(r"[^0-9A-Za-z]+", "_", estimator).strip("_")
        plain = plain if plain[:1].isalpha() else f"estimator_{plain}".rstrip("_")
        candidates = (
            plain if i == 1 else f"{plain}_{i}" for i in range(1, len(taken) + 2)
        )
        names.append(next(name for name in candidates if name not in taken))
        taken.add(names[-1])
    return names


def _estimator(
    name: str, estimate: Estimates, colour: viewer.Colour, scene: viewer.Scene
) -> list[Outgoing]:
    """Messages of one estimator; an empty estimate has none."""
    causal, smoothed, landmarks = estimate
    messages = []
    if len(causal):
        messages.append(
            odometry_messages(f"/{name}/odometry", causal, f"{name}/{BODY_FRAME}")
        )
        messages.append(pose_messages(f"/{name}/pose", causal))
        messages.append(
            viewer.position_ellipsoids(f"/{name}/pose_ellipsoid", causal, colour)
        )
        first_ns = int(causal.stamps_ns[0])
        last_ns = int(causal.stamps_ns[-1])
        # the path so far, now and then, and thinned: all of them together would grow with the square of time
        period_ns = max(_PATH_PERIOD_NS, (last_ns - first_ns) // _MOST_CAUSAL_PATHS)
        thinned = _thinned(
            causal,
            max(_CAUSAL_PATH_STEP_NS, (last_ns - first_ns) // _MOST_CAUSAL_POSES),
        )
        # each path holds all poses before it: few of them keep the file small
        ends_ns = np.arange(first_ns + period_ns, last_ns, period_ns)
        counts = np.searchsorted(thinned.stamps_ns, ends_ns, side="right")
        for count, end_ns in zip(counts.tolist(), ends_ns.tolist(), strict=True):
            messages.append(_path(f"/{name}/path", thinned.rows(slice(count)), end_ns))
    # what is known at the end is published at the end, so that playing shows it then
    ends = [int(t.stamps_ns[-1]) for t in (causal, smoothed) if len(t)]
    if len(smoothed):
        messages.append(pose_messages(f"/{name}/smoothed", smoothed))
        messages.append(_path(f"/{name}/path", _drawable(smoothed), max(ends)))
    return messages + (
        _landmarks(name, landmarks, max(ends), colour, scene) if ends else []
    )


def _landmarks(
    name: str,
    landmarks: LandmarkMap,
    stamp_ns: int,
    colour: viewer.Colour,
    scene: viewer.Scene,
) -> list[Outgoing]:
    if not len(landmarks):
        return []
    topic = f"/{name}/landmarks"
    return [
        viewer.landmark_markers(topic, landmarks, stamp_ns, colour, scene.text_height_m)
    ]


def _drawable(trajectory: Trajectory) -> Trajectory:
    """The poses that a line needs."""
    duration_ns = int(trajectory.stamps_ns[-1] - trajectory.stamps_ns[0])
    return _thinned(trajectory, max(_PATH_STEP_NS, duration_ns // _MOST_POSES))


def _thinned(trajectory: Trajectory, step_ns: int) -> Trajectory:
    """The first pose of each step of time."""
    _, kept = np.unique(trajectory.stamps_ns // step_ns, return_index=True)
    return trajectory.rows(kept)


def _path(topic: str, trajectory: Trajectory, stamp_ns: int) -> Outgoing:
    """One ``nav_msgs/Path`` published at an instant."""
    at_ns = np.array([stamp_ns])
    quaternions = np.tile([0.0, 0.0, 0.0, 1.0], (len(trajectory), 1))
    if trajectory.has_orientation:
        quaternions = trajectory.quaternions_xyzw
    values = header(at_ns, WORLD_FRAME)
    values |= header(trajectory.stamps_ns, WORLD_FRAME, "poses.header")
    values |= fields("poses.pose.position", "xyz", trajectory.positions)
    values |= fields("poses.pose.orientation", "xyzw", quaternions)
    lengths = {"poses": len(trajectory)}
    return outgoing(topic, viewer.PATH, at_ns, values, lengths, is_latched=True)


def _bodies(
    sequence: Sequence, sources: Mapping[str, Estimates]
) -> dict[str, Trajectory]:
    """Trajectories of body frames: the sensors', each causal estimate's, and the truth's at the estimates' instants."""
    bodies = {
        f"{name}/{BODY_FRAME}": causal
        for name, (causal, _, _) in sources.items()
        if len(causal)
    }
    truth = sequence.true_poses
    # a frame has one parent: the first estimator carries the sensors
    owner = next(iter(bodies.values()), truth)
    if truth is not None and len(truth):
        # viewers interpolate no frames: the truth needs the instants of the estimates
        drawn = list(bodies.values()) or [_drawable(truth)]
        at_ns = np.unique(np.concatenate([body.stamps_ns for body in drawn]))
        first_ns, last_ns = truth.stamps_ns[[0, -1]]
        at_ns = at_ns[(at_ns >= first_ns) & (at_ns <= last_ns)]
        bodies[f"{TRUTH}/{BODY_FRAME}"] = truth.at(at_ns) if len(truth) > 1 else truth
    return {BODY_FRAME: owner, **bodies} if owner is not None and len(owner) else bodies


def body_transforms(topic: str, bodies: Mapping[str, Trajectory]) -> list[Outgoing]:
    """``tf2_msgs/TFMessage`` at every instant at which a body has a pose; bodies by child frame."""
    if not bodies:
        return []
    stamps_ns = np.unique(np.concatenate([body.stamps_ns for body in bodies.values()]))
    present = np.column_stack(
        [np.isin(stamps_ns, body.stamps_ns) for body in bodies.values()]
    )
    entries = []
    # one layout of messages for each set of bodies
    for pattern in np.unique(present, axis=0):
        at_ns = stamps_ns[(present == pattern).all(axis=1)]
        chosen = [
            name for name, is_there in zip(bodies, pattern, strict=True) if is_there
        ]
        rows = [
            bodies[name].rows(np.searchsorted(bodies[name].stamps_ns, at_ns))
            for name in chosen
        ]
        # each transform has its own header
        instants_ns = np.tile(at_ns[:, None], len(rows))
        places = np.stack([row.positions for row in rows], axis=1)
        turns = np.stack([row.quaternions_xyzw for row in rows], axis=1)
        values = header(instants_ns, WORLD_FRAME, "transforms.header")
        values |= fields("transforms.transform.translation", "xyz", places)
        values |= fields("transforms.transform.rotation", "xyzw", turns)
        values["transforms.child_frame_id"] = chosen
        entries.append(outgoing(topic, TF, at_ns, values, {"transforms": len(rows)}))
    return entries
