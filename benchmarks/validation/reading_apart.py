"""Reading files in processes that may crash or hang without harm."""

import multiprocessing
import zlib
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path

from log_truth import Payload

from sonar_graph.errors import SonarGraphError
from sonar_graph.logs.mcap import Keep, Topic, scan

TIME_LIMIT_S = 20.0


@dataclass
class Reading:
    """Content read from a file."""

    messages: dict[str, list[Payload]] = field(default_factory=dict)
    types: dict[str, tuple[str, str]] = field(default_factory=dict)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    names_loss: bool = False
    names_unprotected: bool = False
    refused: bool = False
    crashed: bool = False
    hung: bool = False
    trouble: str = ""


def read_all(paths: list[Path], workers: int) -> list[Reading]:
    """A reading of each file."""
    shares = [paths[i::workers] for i in range(workers)]
    with ThreadPoolExecutor(workers) as pool:
        found = list(pool.map(_read_share, shares))
    return [found[i % workers][i // workers] for i in range(len(paths))]


def _read_share(paths: list[Path]) -> list[Reading]:
    readings = []
    worker = _Worker()
    for path in paths:
        readings.append(worker.read(path))
        if readings[-1].hung or readings[-1].crashed:
            worker.close()
            worker = _Worker()
    worker.close()
    return readings


class _Worker:
    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, other = context.Pipe()
        self._process = context.Process(target=_serve, args=(other,), daemon=True)
        self._process.start()
        other.close()

    def read(self, path: Path) -> Reading:
        self._pipe.send(path)
        try:
            if self._pipe.poll(TIME_LIMIT_S):
                reading: Reading = self._pipe.recv()
                return reading
        except EOFError:
            return Reading(crashed=True, trouble="the process died")
        return Reading(hung=True, trouble=f"no answer in {TIME_LIMIT_S:.0f} s")

    def close(self) -> None:
        self._process.kill()
        self._process.join()


def _serve(pipe: Connection) -> None:
    while True:
        pipe.send(read_one(pipe.recv()))


def read_one(path: Path) -> Reading:
    """Read a file whole."""
    try:
        recording = scan(path, lambda _: Keep.ALL)
        reading = Reading(
            messages={
                name: _payloads(topic) for name, topic in recording.topics.items()
            },
            types={
                name: (topic.type_name, topic.schema_text)
                for name, topic in recording.topics.items()
            },
            metadata=recording.metadata,
            names_loss=bool(recording.corrupt or recording.ending),
            names_unprotected=bool(recording.damage.unprotected),
            trouble="; ".join(
                [*recording.corrupt, recording.ending or "", *recording.damage.remarks]
            ),
        )
        for topic in recording.topics.values():
            if topic.is_ros2:
                _decode(topic)
    except SonarGraphError as error:
        return Reading(refused=True, trouble=str(error))
    except Exception as error:
        return Reading(crashed=True, trouble=repr(error))
    return reading


def _decode(topic: Topic) -> None:
    try:
        topic.messages()
    except SonarGraphError:
        return  # a definition that is not one


def _payloads(topic: Topic) -> list[Payload]:
    times_ns = topic.log_times_ns.tolist()
    stacks = [part for parts in topic.stacks.values() for part in parts]
    return [
        (times_ns[row], zlib.crc32(payload))
        for rows, payloads in stacks
        for row, payload in zip(rows.tolist(), payloads, strict=True)
    ]
