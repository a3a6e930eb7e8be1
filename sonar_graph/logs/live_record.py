"""Record of a live run: every message as it came, and what the estimator was not given.

A record is a log like any other. Its metadata record ``sonar_graph`` has the calibration, notes and description of the
topics that counted live, and `DROPPED_TOPIC` names the messages that were late, dropped or unreadable. Without them
`read_log` gives the rows that the estimator had, so that its estimates are those of the live run, to the bit.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from sonar_graph.calibration import Calibration
from sonar_graph.errors import LogError
from sonar_graph.logs.adapters import LogConfig
from sonar_graph.logs.cdr import Value, encode, parse_definition
from sonar_graph.logs.mcap import (
    LogWriter,
    Recording,
    SchemaText,
    Topic,
    latched,
    own_schema,
)
from sonar_graph.logs.roles import DROPPED, NAVIGATION, TF, Choice
from sonar_graph.logs.vehicle_setup import (
    METADATA,
    read_notes,
)

if TYPE_CHECKING:
    from sonar_graph.logs.reading import Assembly

DROPPED_TOPIC = "/sonar_graph/dropped"
LIVE_RATE = "live.rate_hz"
LATENESS = "live.lateness_s"
"""Notes on how often the live estimator was queried, and its lateness budget."""
NEWEST_FRAMES = "live.newest_frames_ns"
"""Note with the log time of the newest transforms that the calibration was gathered from; later ones did not count."""


def dropped_in(recording: Recording) -> dict[tuple[str, int], str]:
    """Reasons of the messages that the estimator was not given live, by topic and log time."""
    topic = recording.topics.get(DROPPED_TOPIC)
    if topic is None or not topic.is_a(DROPPED):
        return {}
    found = dict[tuple[str, int], str]()
    for group in topic.messages():
        columns = zip(
            group.strings("topic"),
            group["log_time"].tolist(),
            group.strings("reason"),
            strict=True,
        )
        for (name,), log_time_ns, (reason,) in columns:
            found[name, log_time_ns] = reason
    return found


def leave_out_dropped(recording: Recording) -> dict[str, str]:
    """Remove these messages, and transforms that came after the calibration was gathered; a note that counts them."""
    dropped = dropped_in(recording)
    newest_ns = read_notes(recording).get(NEWEST_FRAMES, "")
    for topic in recording.topics.values():
        times_ns = topic.log_times_ns
        # a message is named by topic and log time
        gone_ns = [time_ns for name, time_ns in dropped if name == topic.name]
        is_frames = topic.is_a(TF) and topic.is_latched
        if newest_ns.isdecimal() and is_frames:
            gone_ns += times_ns[times_ns > int(newest_ns)].tolist()
        if gone_ns:
            topic.leave_out(np.array(gone_ns, np.int64))
    counts = Counter((name, reason) for (name, _), reason in dropped.items())
    texts = [f"{n} of {name}: {why}" for (name, why), n in sorted(counts.items())]
    note = f"not given to the estimator live, so left out: {'; '.join(texts)}"
    return {"log.live": note} if texts else {}


def recorded_config(recording: Recording) -> LogConfig | None:
    """Description of the topics in a log's own record, or None."""
    text = recording.metadata.get(METADATA, {}).get("log_config")
    if text is None:
        return None
    source = f"{recording.path}: metadata record {METADATA!r}: log_config"
    try:
        return LogConfig.parse(json.loads(text), source)
    except (ValueError, RecursionError, AttributeError) as error:
        raise LogError(f"{source} is no JSON object: {error}") from error


def pinned(
    config: LogConfig, choices: Mapping[str, Choice], assembly: Assembly
) -> dict[str, Any]:
    """Tables of a configuration with which a log gets the same topics in the same roles, read in the same way.

    What a log decides by all its messages is decided by those of an assembly: which fields a driver fills
    (`Adapter.pinned`), and the origin of the world.
    """
    tables: dict[str, Any] = {
        role: dict(table) for role, table in config.tables.items()
    }
    for role, choice in choices.items():
        if choice.topic is None:
            # a role that nothing played live must not be played by a topic that came later
            tables[role] = {"use": False}
        else:
            tables.setdefault(role, {})["topic"] = choice.topic
    for role in NAVIGATION:
        adapter = assembly.adapters[role]
        # single messages must be read as all of the log are
        tables[role] |= adapter.pinned(adapter.table(assembly.topics[role]))
    for role in ("positions", "truth"):
        is_used = choices[role].topic is not None
        if is_used and assembly.adapters[role].geodetic is not None:
            tables[role]["geodetic"] = {
                **tables[role].get("geodetic", {}),
                "origin_deg_m": assembly.setup(role).origin,
            }
    return tables


class LiveRecord:
    """Writer of a record; what was written before `flush` survives the end of the process.

    Parameters
    ----------
    path
        A new MCAP file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            # a record is never overwritten: it cannot be made again
            self._stream = path.open("xb")
        except FileExistsError as error:
            raise LogError(
                f"{path}: a record is there already; name another folder"
            ) from error
        except OSError as error:
            raise LogError(f"{path}: cannot be written: {error.strerror}") from error
        self._writer = LogWriter(self._stream)
        self._channels: dict[str, int] = {}
        self._newest_ns: dict[str, int] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.finish()
        self._stream.close()

    def describe(
        self,
        name: str,
        calibration: Calibration,
        tables: Mapping[str, Any],
        notes: Mapping[str, str],
        newest_frames_ns: int,
    ) -> None:
        """Write what counted: name, calibration with the start, configuration of the topics, and notes.

        ``newest_frames_ns``: log time of the newest transforms that the calibration was gathered from.
        """
        content = {
            "name": name,
            "calibration": calibration.model_dump_json(),
            "log_config": json.dumps(tables),
            "notes": json.dumps({**notes, NEWEST_FRAMES: str(newest_frames_ns)}),
        }
        self._writer.add_metadata(METADATA, content)
        # a run may be killed at any time, and without this record it cannot be repeated
        self.flush()

    def add_topic(self, topic: Topic) -> None:
        """State name, type and definition of a topic before its first message."""
        schema = SchemaText(
            topic.type_name, topic.schema_encoding, topic.schema_text.encode()
        )
        self._channels[topic.name] = self._writer.channel(
            topic.name, schema, topic.encoding, latched(topic.is_latched)
        )

    def write(
        self,
        topic: str,
        payload: bytes,
        arrival_ns: int,
        sequence: int = 0,
        sent_ns: int = 0,
    ) -> int:
        """Write a message as it came; its log time, by which it is named: of arrival, and unlike any other's."""
        # two messages of one instant would share their name
        log_time_ns = max(arrival_ns, self._newest_ns.get(topic, 0) + 1)
        self._newest_ns[topic] = log_time_ns
        # middleware without a time of sending gives 0
        sent_ns = sent_ns if 0 < sent_ns < 2**63 else log_time_ns
        self._writer.mcap.add_message(
            self._channels[topic], log_time_ns, payload, sent_ns, sequence % 2**32
        )
        return log_time_ns

    def drop(self, topic: str, log_time_ns: int, reason: str, arrival_ns: int) -> None:
        """Name a message that the estimator is not given."""
        if DROPPED_TOPIC not in self._channels:
            self._channels[DROPPED_TOPIC] = self._writer.channel(
                DROPPED_TOPIC, own_schema(DROPPED)
            )
        values: dict[str, Value] = {
            "topic": topic,
            "log_time": log_time_ns,
            "reason": reason,
        }
        payload = encode(parse_definition(DROPPED), 1, values)[0].tobytes()
        self.write(DROPPED_TOPIC, payload, arrival_ns)

    def flush(self) -> None:
        """Give all that was written to the operating system, where the end of this process loses nothing of it."""
        self._writer.mcap.flush()  # type: ignore[no-untyped-call]  # of the mcap package
