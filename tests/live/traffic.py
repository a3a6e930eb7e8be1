"""Messages of a log as they would arrive over a network that delays them."""

import socket
from pathlib import Path

import numpy as np
from mcap.reader import make_reader

from sonar_graph.live import Message

TRUTH = "/ground_truth"


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
                arrival_ns = (
                    message.log_time
                    + int(noise.uniform(0.0, delay_s) * 1e9)
                    + 1_000_000
                )
                newest_ns[channel.topic] = arrival_ns = max(
                    arrival_ns, newest_ns.get(channel.topic, 0)
                )
                found.append(
                    Message(channel.topic, schema.name, message.data, arrival_ns)
                )
    return sorted(found, key=lambda message: message.arrival_ns)


def free_endpoint() -> str:
    """Endpoint of zenoh on a free port of the loopback."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"
