"""Messages of a log as they would arrive over a network that delays them."""

import socket
import threading
import time
from pathlib import Path

import numpy as np
from mcap.reader import make_reader

from sonar_graph import read_log
from sonar_graph.live import (
    Engine,
    LiveOptions,
    LiveRun,
    Message,
    definition_of,
    open_session,
    subscribe,
)
from sonar_graph.live.outlets import zenoh_outlet
from sonar_graph.logs import LiveRecord
from sonar_graph.measurements import BLOCKS

TRUTH = "/ground_truth"
NS = 1_000_000_000


def messages_of(
    path: Path, noise: np.random.Generator, delay_s: float
) -> list[Message]:
    """All messages but the truth, in order of arrival.

    Each is delayed by a time drawn evenly from 0 to ``delay_s``, and never overtakes one of its own topic.
    """
    found = []
    newest_ns = dict[str, int]()
    with path.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages():
            if not channel.topic.startswith(TRUTH):
                delay_ns = int(noise.uniform(0.0, delay_s) * 1e9) + 1_000_000
                arrival_ns = message.log_time + delay_ns
                arrival_ns = max(arrival_ns, newest_ns.get(channel.topic, 0))
                newest_ns[channel.topic] = arrival_ns
                content = (channel.topic, schema.name, message.data)
                found.append(Message(*content, arrival_ns))
    return sorted(found, key=lambda message: message.arrival_ns)


def free_endpoint() -> str:
    """Endpoint of zenoh on a free port of the loopback."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def live(path: Path, messages: list[Message], **options):
    """The engine after all messages, and the steps that it gave since it began anew last."""
    with LiveRecord(path) as record:
        engine = Engine(record, definition_of, LiveOptions(**options))
        generation = 0
        steps = []
        for message in messages:
            engine.take(message)
            if engine.generation != generation:
                generation = engine.generation
                steps = []
            for step in engine.steps():
                steps.append(step)
                assert len(steps) < 1000, "steps without end"
        steps += engine.finish()
    return engine, steps


def lived(folder: Path, endpoint: str, sender: threading.Thread, said, **options):
    """The outcome of a live run on what a thread sends, and its counts."""
    made = LiveOptions("ekf-slam", lateness_s=1.0, **options)
    with (
        open_session([endpoint]) as session,
        LiveRecord(folder / "record.mcap") as record,
        LiveRun(
            record, definition_of, made, [zenoh_outlet(session, 0)], said.append
        ) as run,
    ):
        subscriptions = subscribe(session, 0, run.accept)
        time.sleep(0.5)
        sender.start()
        last_s = time.monotonic() + 90
        while sender.is_alive() and time.monotonic() < last_s:
            run.turn()
        until_s = time.monotonic() + 2.0
        while time.monotonic() < until_s:
            run.turn()
        for one in subscriptions:
            one.undeclare()
        return run.finish(), run.counts()


def assert_same_steps(mine, theirs):
    """Steps with the same rows, to the bit."""
    assert [step.end_ns for step in mine] == [step.end_ns for step in theirs]
    for ours, others in zip(mine, theirs, strict=True):
        for name in BLOCKS:
            one = getattr(ours, name)
            other = getattr(others, name)
            assert (one is None) == (other is None), name
            for column, values in {} if one is None else vars(one).items():
                expected = getattr(other, column)
                if values.ndim == 2:  # candidates that none of the step has
                    expected, rest = np.split(expected, [values.shape[1]], axis=1)
                    assert (rest <= 0).all()
                assert values.tobytes() == expected.tobytes(), f"{name}.{column}"


def assert_record_equals(engine, steps):
    """The record of a run gives the steps that were live."""
    record = read_log(engine.record_path)
    assert record.calibration == engine.calibration
    assert len(steps) >= 50
    rate_hz = float(record.notes["live.rate_hz"])
    assert_same_steps(steps, list(record.replay(record.instants(rate_hz))))
