"""From a `Sequence` to an MCAP log."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from sonar_graph.logs import encoding
from sonar_graph.logs.log_record import METADATA
from sonar_graph.logs.mountings import encode_mountings
from sonar_graph.logs.recorder import Outgoing, recording
from sonar_graph.logs.roles import TF
from sonar_graph.sequence import Sequence


def write_sequence(path: Path, sequence: Sequence, more: Iterable[Outgoing] = ()) -> None:
    """Write a log of ROS 2 messages from which `read_sequence` gives the same sequence.

    Parameters
    ----------
    path
        The MCAP file; one that exists is replaced.
    sequence
        Its calibration, name and notes go into the metadata record ``sonar_graph``; the mountings into ``/tf_static``.
    more
        What does not fit into memory at once, such as images: entries in the order of time, each taken when the one
        before is written.

    Raises
    ------
    LogError
        When the file cannot be written, or a stamp does not fit into a ROS 2 message.
    """
    record = {
        "name": sequence.name,
        "calibration": sequence.calibration.model_dump_json(),
        "notes": json.dumps(sequence.notes),
    }
    with recording(Path(path), {METADATA: record}) as out:
        for piece in _pieces(_messages(sequence), more):
            out.write(piece)


def _pieces(messages: list[Outgoing], more: Iterable[Outgoing]) -> Iterator[list[Outgoing]]:
    """The messages cut in time: what comes up to the end of each further entry, with that entry, and then the rest."""
    begins = [0] * len(messages)
    for entry in more:
        until_ns = int(entry.log_times_ns[-1])
        ends = [int(np.searchsorted(m.log_times_ns, until_ns, side="right")) for m in messages]
        yield [*map(_rows, messages, begins, ends), entry]
        begins = ends
    yield list(map(_rows, messages, begins, [len(m.log_times_ns) for m in messages]))


def _rows(entry: Outgoing, first: int, end: int) -> Outgoing:
    return replace(entry, log_times_ns=entry.log_times_ns[first:end], payloads=entry.payloads[first:end])


def _messages(sequence: Sequence) -> list[Outgoing]:
    first_ns = int(min(sequence.imu.stamps_ns[0], sequence.dvl.stamps_ns[0]))
    messages = [encoding.static_message("/tf_static", TF, first_ns, encode_mountings(sequence.calibration))]
    if sequence.true_landmarks is not None:
        messages.append(encoding.landmark_map_message("/ground_truth/landmarks", sequence.true_landmarks, first_ns))
    messages.append(encoding.imu_messages("/imu/data", sequence.imu))
    messages.append(encoding.dvl_messages("/dvl/data", sequence.dvl))
    if sequence.depth is not None:
        messages.append(encoding.depth_messages("/depth/pose", sequence.depth))
    if sequence.detections is not None:
        messages += encoding.detection_messages("/sonar/landmarks", sequence.detections)
    if sequence.truth is not None:
        messages.append(encoding.odometry_messages("/ground_truth/odometry", sequence.truth))
    return messages
