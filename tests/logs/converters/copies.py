"""Copies of logs as other programs write them."""

from collections.abc import Callable
from pathlib import Path

from mcap.reader import make_reader
from mcap.writer import Writer


def bare(
    source: Path,
    target: Path,
    payload: Callable[[int, bytes], bytes] = lambda _row, data: data,
) -> Path:
    """Messages of a log without the records of this package, each with a payload made of its own."""
    with source.open("rb") as stream, target.open("wb") as out:
        writer = Writer(out)
        writer.start("ros2", "test")
        channels: dict[int, int] = {}
        rows = enumerate(make_reader(stream).iter_messages())
        for row, (schema, channel, message) in rows:
            if channel.id not in channels:
                kind = schema.name, schema.encoding, schema.data
                channels[channel.id] = writer.register_channel(
                    channel.topic,
                    channel.message_encoding,
                    writer.register_schema(*kind),
                    channel.metadata,
                )
            writer.add_message(
                channels[channel.id],
                message.log_time,
                payload(row, message.data),
                message.publish_time,
            )
        writer.finish()
    return target
