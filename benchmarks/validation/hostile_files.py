"""Hostile input as `hostile_input.py` gives it: logs, text files, and folders with users' files."""

import bz2
import json
import os
import shutil
import struct
import tempfile
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import zstandard
from mcap.opcode import Opcode
from mcap.records import Channel, Message, Schema
from mcap.stream_reader import StreamReader

from sonar_graph.logs import write_log
from sonar_graph.testing import small_world

MAGIC = b"\x89MCAP0\r\n"
COMPARED, BATCH, SUITE, IMAGED = "compared", "batch", "suite.toml", "imaged.mcap"
"""Beside the sound log: folders with a comparison and a batch of it, the batch's suite, and a log with images."""
NOISE = (  # what terminals, pages, spreadsheets and file systems might obey
    *(
        "\x1b[2J\x1b]0;owned\x07",
        "\x9b31m",
        "\x00",
        "a\rb",
        "\u202e/imu",
        "=cmd|' /C calc'!A0",
        "+1+1",
        "@SUM(A1)",
    ),
    *(
        "<script>alert(1)</script>",
        "../../etc/passwd",
        "/" * 300,
        "x" * 100_000,
        "[red]a[/red]",
        "%s%n{0}",
        "\n\n",
        "",
    ),
)
Rng = np.random.Generator


@dataclass
class Case:
    """A command in a folder of its own."""

    kind: str
    command: list[str]
    protected: list[Path] = field(default_factory=list)
    """Files that must be as they are afterwards, links and pipes among them."""
    log: Path | None = None
    """Log whose measurements are compared with those of the sound one."""
    may_differ: bool = False
    """The measurements themselves are changed, so that no comparison says anything."""


def record(opcode: int, content: bytes, size: int | None = None) -> bytes:
    return struct.pack("<BQ", opcode, len(content) if size is None else size) + content


def text(value: str) -> bytes:
    encoded = value.encode("utf-8", "surrogatepass")
    return struct.pack("<I", len(encoded)) + encoded


def schema(number: int, name: str, content: str, encoding: str = "ros2msg") -> bytes:
    data = content.encode()
    return record(
        Opcode.SCHEMA,
        struct.pack("<H", number)
        + text(name)
        + text(encoding)
        + struct.pack("<I", len(data))
        + data,
    )


def channel(number: int, schema_number: int, topic: str) -> bytes:
    head = struct.pack("<HH", number, schema_number)
    return record(
        Opcode.CHANNEL, head + text(topic) + text("cdr") + struct.pack("<I", 0)
    )


def message(number: int, time_ns: int, data: bytes) -> bytes:
    return record(
        Opcode.MESSAGE, struct.pack("<HIQQ", number, 0, time_ns, time_ns) + data
    )


def chunk(
    content: bytes,
    compression: str = "",
    packed: bytes | None = None,
    size: int | None = None,
) -> bytes:
    """A chunk; ``packed`` and ``size`` may claim what is not so, and then there is no CRC."""
    crc = zlib.crc32(content) if packed is None and size is None else 0
    pack: dict[str, Callable[[bytes], bytes]] = {
        "zstd": zstandard.compress,
        "lz4": lz4.frame.compress,
        "": bytes,
    }
    packed = pack.get(compression, bytes)(content) if packed is None else packed
    head = struct.pack("<QQQI", 0, 2**62, len(content) if size is None else size, crc)
    return record(
        Opcode.CHUNK, head + text(compression) + struct.pack("<Q", len(packed)) + packed
    )


def metadata(name: str, entries: dict[str, str]) -> bytes:
    content = b"".join(text(key) + text(value) for key, value in entries.items())
    return record(
        Opcode.METADATA, text(name) + struct.pack("<I", len(content)) + content
    )


def file_of(*records: bytes, ending: bytes | None = None) -> bytes:
    end = (
        record(Opcode.DATA_END, struct.pack("<I", 0))
        + record(Opcode.FOOTER, struct.pack("<QQI", 0, 0, 0))
        + MAGIC
    )
    head = record(Opcode.HEADER, text("ros2") + text("a recorder"))
    return MAGIC + head + b"".join(records) + (end if ending is None else ending)


@dataclass
class SoundLog:
    """Records of a log that this package wrote, apart."""

    path: Path
    described: bytes
    messages: bytes
    others: dict[str, tuple[int, bytes]]
    """Channel and first payload of each topic."""

    @classmethod
    def written(cls, folder: Path) -> "SoundLog":
        path = folder / "sound.mcap"
        write_log(path, small_world())
        described, messages, names, others = b"", b"", {}, {}
        with path.open("rb") as stream:
            for found in StreamReader(stream).records:
                if isinstance(found, Schema):
                    described += schema(found.id, found.name, found.data.decode())
                elif isinstance(found, Channel) and found.id not in names:
                    described += channel(found.id, found.schema_id, found.topic)
                    names[found.id] = found.topic
                elif isinstance(found, Message):
                    others.setdefault(
                        names[found.channel_id], (found.channel_id, found.data)
                    )
                    if names[found.channel_id] != "/tf_static":
                        messages += message(
                            found.channel_id, found.log_time, found.data
                        )
        log = cls(path, described, messages, others)
        (folder / "control.mcap").write_bytes(log.content())
        return log

    def content(self, *extra: bytes, compression: str = "zstd") -> bytes:
        """A sound chunk, and what is put after it."""
        return file_of(chunk(self.described + self.messages, compression), *extra)


def zeros(rng: Rng, most: int = 1 << 32) -> int:
    return int(2 ** rng.uniform(20, np.log2(most)))


def zstd_of_zeros(size: int, *, is_stated: bool) -> bytes:
    """A frame of zeros, made without holding them."""
    packer = zstandard.ZstdCompressor(level=1).compressobj(
        size=size if is_stated else -1
    )
    block = bytes(1 << 20)
    parts = [
        packer.compress(block[: min(len(block), size - at)])
        for at in range(0, size, len(block))
    ]
    return b"".join([*parts, packer.flush()])


def lz4_of_zeros(size: int) -> bytes:
    packer, block = lz4.frame.LZ4FrameCompressor(), bytes(1 << 20)
    head = packer.begin()
    parts = [
        packer.compress(block[: min(len(block), size - at)])
        for at in range(0, size, len(block))
    ]
    return b"".join([head, *parts, packer.flush()])


def bombs(log: SoundLog, rng: Rng) -> bytes:
    """Chunks that claim, or have, more than fits into memory."""
    size, which = zeros(rng), rng.integers(7)
    small = zeros(rng, 1 << 24)
    if which == 0:
        return log.content(
            chunk(
                b"",
                "zstd",
                zstd_of_zeros(zeros(rng, 3 << 30), is_stated=bool(rng.integers(2))),
                size,
            )
        )
    if which == 1:
        return log.content(chunk(b"", "lz4", lz4_of_zeros(zeros(rng, 3 << 29)), size))
    if which == 2:  # a frame that says more than it has
        return log.content(
            chunk(b"", "zstd", zstd_of_zeros(small, is_stated=True)[:-5], size)
        )
    if which == 3:
        return log.content(
            record(
                Opcode.CHUNK,
                struct.pack("<QQQI", 0, 1, 2**63, 0)
                + text("")
                + struct.pack("<Q", 2**63),
            )
        )
    if which == 4:  # many that are each allowed
        one = chunk(b"", "zstd", zstd_of_zeros(1 << 28, is_stated=True), 1 << 28)
        return log.content(*[one] * int(rng.integers(2, 5)))
    if which == 5:  # of messages that are kept
        imu, payload = log.others["/imu/data"]
        return log.content(
            *[chunk(message(imu, 10**9, payload + bytes(200 << 20)), "zstd")]
            * int(rng.integers(2, 4))
        )
    return log.content(
        chunk(
            bytes(small),
            str(rng.choice(["bz2", "zst", "snappy"])),
            bz2.compress(bytes(small)),
        )
    )


def schemas(log: SoundLog, rng: Rng) -> bytes:
    """Definitions that take long, nest deep, or are none."""
    n = int(10 ** rng.uniform(2, 5.5))
    makes: list[Callable[[], str]] = [
        lambda: "\n".join(f"float64 f{i}" for i in range(min(n, 60_000))),
        lambda: "=" * 80 + "\n" * n + "MSG: a/B\nint32 c",
        lambda: ("=" * 80 + "\n") * min(n, 20_000),
        lambda: "=" * n + " " * n,
        lambda: "float64 x" + " " * n + "#" * n,
        lambda: "a/" * n,
        lambda: "\n".join(
            [f"T{0} a"]
            + [
                f"{'=' * 80}\nMSG: p/T{i}\nT{i + 1} a\nT{i + 1} b"
                for i in range(min(n, 400))
            ]
        ),
        lambda: f"float64[{'9' * min(n, 5000)}] a",
        lambda: (
            f"float64[{int(rng.integers(1, 10**12))}] a\nstring[{int(rng.integers(1, 10**12))}] b"
        ),
        lambda: "Root a\n" + "=" * 80 + "\nMSG: p/Root\nRoot b",
        lambda: "".join(chr(int(c)) for c in rng.integers(1, 0x2FF, min(n, 20_000))),
        lambda: "\r\n" * n + "int32 a",
    ]
    body = makes[int(rng.integers(len(makes)))]()
    kind = str(
        rng.choice(
            [
                "p/msg/Root",
                "sensor_msgs/msg/Imu",
                "tf2_msgs/msg/TFMessage",
                "marine_acoustic_msgs/msg/Dvl",
            ]
        )
    )
    name = str(rng.choice(["/other", "/imu/other", "/tf_static"]))
    junk = chunk(
        schema(900, kind, body)
        + channel(900, 900, name)
        + message(900, 10**9, b"\0\1\0\0" + bytes(64))
    )
    if rng.random() < 0.3:  # as many topics of it as there may be
        junk += chunk(b"".join(channel(901 + i, 900, f"{name}{i}") for i in range(200)))
        junk += chunk(b"".join(message(901 + i, 10**9, bytes(40)) for i in range(200)))
    return log.content(junk)


def structure(log: SoundLog, rng: Rng) -> bytes:
    """Records that repeat, overlap, end early or point anywhere."""
    n, which = int(10 ** rng.uniform(2, 5.3)), rng.integers(8)
    end = record(Opcode.DATA_END, struct.pack("<I", 0))
    if which == 0:
        footer = (
            record(
                Opcode.FOOTER,
                struct.pack("<QQI", 8 + 13 + n, 0, int(rng.integers(1, 2**32))),
            )
            + MAGIC
        )
        return file_of(chunk(log.described + log.messages), ending=end * n + footer)
    if which == 1:
        return log.content(
            record(int(rng.integers(1, 256)), bytes(40), int(rng.integers(2**62)))
        )
    if which == 2:
        numbers = [int(value) for value in rng.integers(0, 2**32, 3)]
        return file_of(
            chunk(log.described + log.messages),
            ending=end + record(Opcode.FOOTER, struct.pack("<QQI", *numbers)) + MAGIC,
        )
    if which == 3:
        return log.content(
            b"".join(metadata(f"m{i}", {"a": "b" * 50}) for i in range(min(n, 20_000)))
        )
    if which == 4:
        return log.content(
            chunk(
                b"".join(
                    channel(int(i), 1, f"/t{i % 7}")
                    for i in rng.integers(0, 60_000, min(n, 30_000))
                )
            )
        )
    if which == 5:
        return log.content(
            chunk(
                b"",
                "",
                record(Opcode.MESSAGE, bytes(22)) * min(n, 100_000),
                min(n, 100_000) * 31,
            )
        )
    if which == 6:
        return log.content(
            record(Opcode.MESSAGE_INDEX, struct.pack("<HI", 3, n * 16) + bytes(n * 16))
        )
    return log.content(
        *[chunk(bytes(rng.integers(0, 256, 60, np.uint8)))] * min(n, 20_000)
    )


def transforms(log: SoundLog, rng: Rng) -> bytes:
    """Transforms that turn by nothing, are nowhere, or go in a circle."""
    number, payload = log.others["/tf_static"]
    content = bytearray(payload)
    doubles = [at for at in range(4, len(content) - 8, 4) if at % 8 == 4]
    values = [np.nan, np.inf, -np.inf, 0.0, 1e300, 1e308, 1e-320, 5.0, -1.0, 2e6]
    for at in rng.choice(doubles, int(rng.integers(1, 12))):
        before = struct.unpack_from("<d", content, at)[0]
        if abs(before) <= 1 and (
            before == 0 or abs(before) > 1e-6
        ):  # a number, not letters or lengths
            struct.pack_into("<d", content, at, float(rng.choice(values)))
    if rng.random() < 0.2:
        content = bytearray(
            bytes(content).replace(
                b"base_link",
                bytes(rng.choice([b"imu\0\0\0\0\0\0", b"\x1b[31mlink"])[:9]),
            )
        )
    return log.content(chunk(message(number, 10**9, bytes(content))))


def names(log: SoundLog, rng: Rng) -> bytes:
    """Names that a terminal, a page or a spreadsheet would obey."""
    one, two, three = (str(NOISE[int(i)]) for i in rng.integers(0, len(NOISE), 3))
    junk = schema(900, f"p/msg/{one[:300]}", f"int32 a # {two}") + channel(
        900, 900, f"/{three}"
    )
    notes = json.dumps({one: two, "log.warnings": three})
    entries = {"name": two, "notes": notes if rng.random() < 0.8 else two}
    return log.content(
        chunk(junk + message(900, 10**9, bytes(8))), metadata("sonar_graph", entries)
    )


DOCUMENTS: tuple[Callable[[Rng], str], ...] = (
    lambda rng: "[" * int(10 ** rng.uniform(2, 5.5)),
    lambda rng: '{"a":' * int(10 ** rng.uniform(2, 5)) + "1",
    lambda rng: '{"imu": {"gyro_sigma": ' + "9" * int(10 ** rng.uniform(1, 5)) + "}}",
    lambda rng: str(
        rng.choice(
            [
                "NaN",
                "null",
                "[]",
                "3",
                '"a"',
                "{}",
                '{"imu": 3}',
                '{"imu": {"mounting": [1, 2]}}',
            ]
        )
    ),
    lambda _: '{"start": {"position_m": [NaN, Infinity, 1e999]}}',
    lambda rng: "a = " + "[" * int(10 ** rng.uniform(1, 4)),
    lambda rng: "a." * int(10 ** rng.uniform(1, 4)) + "b = 1",
    lambda rng: f'[imu]\ntopic = "{NOISE[int(rng.integers(len(NOISE)))][:500]}"\n',
    lambda rng: "".join(chr(int(c)) for c in rng.integers(0, 0x3FF, 2000)),
    lambda rng: f"x = {'1' * int(10 ** rng.uniform(1, 4.5))}",
)


def records_of_ours(log: SoundLog, rng: Rng) -> bytes:
    """Calibration and notes in the log's own record that are no such thing."""
    calibration = DOCUMENTS[int(rng.integers(len(DOCUMENTS)))](rng)
    return log.content(
        metadata(
            "sonar_graph", {"name": "a", "calibration": calibration, "notes": "{}"}
        )
    )


def values(log: SoundLog, rng: Rng) -> bytes:
    """Measurements that no sensor gives: not finite, huge, of other times."""
    content = bytearray(log.messages)
    topics = [log.others[name][0] for name in ("/imu/data", "/dvl/data", "/depth/pose")]
    share, at = rng.choice([0.001, 0.1, 1.0]), 0
    wild = [np.nan, np.inf, -np.inf, 1e300, -1e300, 1e160, 5e-324, 1e9]
    stamp = rng.random() < 0.4
    while at < len(content):
        _, size = struct.unpack_from("<BQ", content, at)
        start = at + 9 + 22
        (number,) = struct.unpack_from("<H", content, at + 9)
        if number in topics and rng.random() < share:
            if stamp:
                struct.pack_into(
                    "<iI",
                    content,
                    start + 4,
                    int(rng.integers(-(2**31), 2**31)),
                    int(rng.integers(2**32)),
                )
            else:
                place = start + 4 + 8 * int(rng.integers(3, (size - 30) // 8))
                struct.pack_into("<d", content, place, float(rng.choice(wild)))
        at += 9 + size
    return file_of(chunk(log.described + bytes(content), "zstd"))


def flips(log: SoundLog, rng: Rng) -> bytes:
    content = bytearray(log.path.read_bytes())
    for at in rng.integers(0, len(content), int(rng.integers(1, 6))):
        content[at] ^= 1 << int(rng.integers(8))
    return bytes(
        content[: int(rng.integers(len(content)))] if rng.random() < 0.2 else content
    )


LOGS: dict[str, tuple[Callable[[SoundLog, Rng], bytes], bool]] = {
    "bombs": (bombs, False),
    "schemas": (schemas, False),
    "structure": (structure, False),
    "transforms": (transforms, True),
    "names": (names, False),
    "records": (records_of_ours, False),
    "values": (values, True),
    "bit flips": (flips, False),
}
"""Kinds of logs, and whether the measurements themselves are changed."""


def log_cases(kind: str, log: SoundLog, folder: Path, rng: Rng) -> Case:
    make, may_differ = LOGS[kind]
    path = folder / "log.mcap"
    path.write_bytes(make(log, rng))
    if rng.random() < 0.25:
        command = [
            "run",
            str(path),
            "-o",
            str(folder / "out"),
            "--estimator",
            "dead-reckoning",
        ]
    else:
        command = [
            "inspect",
            str(path),
            *rng.choice([["--quick"], ["--json"], ["--toml"]]),
        ]
    return Case(kind, command, [path], path, may_differ)


def reading_of_pipes(log: SoundLog, folder: Path, rng: Rng) -> Case:
    """Files that never end, or are none."""
    path = (
        folder / f"in{rng.choice(['.mcap', '.toml', '.json', '.bag', '.ddf', '.aris'])}"
    )
    which = rng.integers(4)
    if which == 0:
        os.mkfifo(path)
    elif which == 1:
        path.symlink_to("/dev/zero")
    elif which == 2:
        path.mkdir()
    else:
        path.write_bytes(b"")
        os.truncate(path, 1 << int(rng.integers(20, 31)))  # without a block on the disk
    out, sound = str(folder / "out.mcap"), str(log.path)
    commands = [
        ["inspect", str(path)],
        ["compare", str(path), "-o", str(folder / "out")],
        ["run", sound, "-o", str(folder / "out"), "--calibration", str(path)],
        ["inspect", sound, "--log-config", str(path)],
        ["recognise", sound, "-o", out, "--designs", str(path)],
        ["bench", str(path), "-o", str(folder / "out")],
        *(
            ["convert", kind, str(path), "-o", out]
            for kind in ("rosbag", "didson", "aris", "oculus")
        ),
        ["convert", "dlr", str(path), "-o", out],
        ["bench", "gate", str(folder), str(path)],
    ]
    return Case("pipes", commands[int(rng.integers(len(commands)))])


def texts(log: SoundLog, folder: Path, rng: Rng) -> Case:
    """TOML and JSON that are no such thing."""
    path = folder / str(rng.choice(["a.toml", "a.json"]))
    path.write_text(
        DOCUMENTS[int(rng.integers(len(DOCUMENTS)))](rng), "utf-8", "surrogatepass"
    )
    sound = str(log.path)
    commands = [
        ["inspect", sound, "--quick", "--calibration", str(path)],
        ["inspect", sound, "--quick", "--log-config", str(path)],
        ["run", sound, "-o", str(folder / "out"), "--calibration", str(path)],
        ["bench", str(path), "-o", str(folder / "out")],
        ["recognise", sound, "-o", str(folder / "out.mcap"), "--designs", str(path)],
        ["recognise", sound, "-o", str(folder / "out.mcap"), "--model", str(path)],
    ]
    return Case("texts", commands[int(rng.integers(len(commands)))], [path])


def recordings_of_sonars(_log: SoundLog, folder: Path, rng: Rng) -> Case:
    """Bags and recordings of sonars that begin well."""
    kind, start = [
        ("rosbag", b"#ROSBAG V2.0\n"),
        ("rosbag", b"SQLite format 3\0"),
        ("didson", b"DDF\x04"),
        ("didson", b"DDF\x03"),
        ("aris", b"DDF\x05"),
        ("oculus", b"\x53\x4f"),
    ][int(rng.integers(6))]
    if rng.random() < 0.2:
        return Case(
            "recordings",
            [
                "convert",
                "rosbag",
                str(zstd_bag(folder / "in", rng)),
                "-o",
                str(folder / "out.mcap"),
            ],
        )
    path = (
        folder
        / f"in.{'db3' if start.startswith(b'SQL') else 'bag' if kind == 'rosbag' else 'bin'}"
    )
    rest = rng.integers(0, 256, zeros(rng, 1 << 22) // 8, np.uint8).tobytes()
    if start.startswith(b"#ROSBAG") and rng.random() < 0.7:
        rest = bag_chunk(rng)
    repeated = (
        b"".join([start + bytes(rng.integers(0, 40, 120, np.uint8))] * 400)
        if rng.random() < 0.4
        else b""
    )
    path.write_bytes(start + rest + repeated)
    return Case(
        "recordings",
        ["convert", kind, str(path), "-o", str(folder / "out.mcap")],
        [path],
    )


def bag_chunk(rng: Rng) -> bytes:
    """A ROS 1 bag of one chunk of many zeros."""
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "a.bag"
        writer = Writer(path)
        writer.set_compression(
            Writer.CompressionFormat.BZ2
            if rng.random() < 0.5
            else Writer.CompressionFormat.LZ4
        )
        with writer:
            to = writer.add_connection(
                "/a", "std_msgs/msg/String", typestore=get_typestore(Stores.ROS1_NOETIC)
            )
            writer.write(
                to, 10**9, struct.pack("<I", size := zeros(rng, 1 << 29)) + bytes(size)
            )
        return path.read_bytes()[len(b"#ROSBAG V2.0\n") :]


def zstd_bag(path: Path, rng: Rng) -> Path:
    """A ROS 2 bag with a message of many zeros, compressed in each way that there is."""
    from rosbags.rosbag2 import (
        CompressionFormat,
        CompressionMode,
        StoragePlugin,
        Writer,
    )
    from rosbags.typesys import Stores, get_typestore

    modes = (CompressionMode.FILE, CompressionMode.MESSAGE, CompressionMode.STORAGE)
    mode = modes[int(rng.integers(len(modes)))]
    is_mcap = mode == CompressionMode.STORAGE or rng.random() < 0.5
    writer = Writer(
        path,
        version=9,
        storage_plugin=StoragePlugin.MCAP if is_mcap else StoragePlugin.SQLITE3,
    )
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        to = writer.add_connection(
            "/a", "std_msgs/msg/String", typestore=get_typestore(Stores.ROS2_JAZZY)
        )
        writer.write(
            to,
            10**9,
            b"\0\1\0\0" + struct.pack("<I", size := zeros(rng, 1 << 29)) + bytes(size),
        )
    return path


OURS = (
    *(
        "report.html",
        "comparison.json",
        "sequence.npz",
        "recognition.json",
        "recognised/1.jpg",
        "result.mcap",
    ),
    *(
        "result.rviz",
        "runs/dead-reckoning/causal.tum",
        "results.parquet",
        "suite.toml",
    ),
    *(
        ".sonar_graph.json",
        ".lock",
        "log.mcap",
        "tables/overview.csv",
    ),
)
THEIRS = (
    *(
        "recognised/holiday.jpg",
        "runs/mine/series.npz",
        "runs/mine/trajectory.tum",
        "runs/.partial-mine/a",
        "notes.txt",
    ),
    *(
        ".partial-log.mcap",
        "log.mcap.part",
        ".log.mcap.partial",
        ".partial-report.html",
        "runs/dead-reckoning/notes.txt",
    ),
)


def folders(log: SoundLog, folder: Path, rng: Rng) -> Case:
    """Users' files, links and pipes where results go, with or without earlier results."""
    out, elsewhere = folder / "out", folder / "elsewhere"
    sound, quick = str(log.path), ["--estimator", "dead-reckoning"]
    commands = [
        ["run", sound, "-o", str(out), *quick],
        ["run", sound, "-o", str(out), *quick],
        ["compare", sound, "-o", str(out), "--estimators", "dead-reckoning"],
        ["convert", "victoria-park", "-o", str(out / "log.mcap")],
        ["simulate", "landmarks", "--on", sound, "-o", str(out / "log.mcap")],
        ["recognise", str(log.path.parent / IMAGED), "-o", str(out / "log.mcap")],
        ["report", str(out)],
        ["bench", str(log.path.parent / SUITE), "-o", str(out), "--workers", "1"],
        ["calibrate", sound, "-o", str(out / "comparison.json")],
    ]
    command = commands[int(rng.integers(len(commands)))]
    # a new batch takes too long
    earlier = (None, BATCH, COMPARED)[int(rng.integers(command[0] == "bench", 3))]
    elsewhere.mkdir()
    shutil.copytree(log.path.parent / earlier, out) if earlier else out.mkdir()
    precious = elsewhere / "precious"
    precious.write_text("mine")
    protected = [precious]
    ours = rng.choice(OURS, int(max(rng.integers(-2, 3), 0)), replace=False).tolist()
    for name in [
        *ours,
        *rng.choice(THEIRS, int(rng.integers(1, 5)), replace=False).tolist(),
    ]:
        path = out / name
        if rng.random() < 0.1 and "/" in name and not path.parent.exists():
            path.parent.parent.mkdir(parents=True, exist_ok=True)
            path.parent.symlink_to(elsewhere)
        path.parent.mkdir(parents=True, exist_ok=True)
        which = rng.random()
        path.unlink(missing_ok=True)
        if which < 0.15:
            path.symlink_to(precious)
        elif which < 0.2:
            os.mkfifo(path)
        else:
            path.write_bytes(
                bytes(rng.integers(0, 256, 40, np.uint8))
                if which < 0.6
                else manifest(rng, precious)
            )
        protected.append(path)
    return Case("folders", command, protected)


def manifest(rng: Rng, precious: Path) -> bytes:
    """A manifest that names files which are not ours."""
    named = {
        str(rng.choice([*OURS, "../elsewhere/precious", str(precious)])): ["0" * 32]
    }
    content: dict[str, Any] = {
        "format": "sonar_graph folder 1",
        "kind": "comparison",
        "files": named,
    }
    if rng.random() < 0.3:
        content[str(rng.choice(list(content)))] = rng.choice([3, None, "x"])
    return json.dumps(content, default=str).encode()


def results(log: SoundLog, folder: Path, rng: Rng) -> Case:
    """Files of a comparison that somebody changed since."""
    out = folder / "out"
    shutil.copytree(log.path.parent / COMPARED, out)
    changed = rng.choice(
        sorted(path for path in out.rglob("*") if path.is_file()),
        int(rng.integers(1, 4)),
        replace=False,
    )
    for path in (Path(one) for one in changed):
        content, which = bytearray(path.read_bytes()), rng.integers(6)
        for at in (
            rng.integers(0, max(len(content), 1), int(rng.integers(1, 6)))
            if content
            else ()
        ):
            content[at] ^= 1 << int(rng.integers(8))
        path.unlink()
        if which == 0:
            os.mkfifo(path)
        elif which == 1:
            path.symlink_to("/dev/zero")
        elif which == 2:
            path.write_bytes(content)
            os.truncate(path, 1 << int(rng.integers(0, 29)))
        elif which == 3:
            path.write_text(
                DOCUMENTS[int(rng.integers(len(DOCUMENTS)))](rng),
                "utf-8",
                "surrogatepass",
            )
        else:
            path.write_bytes(content)
    again = ["compare", str(log.path), "-o", str(out), "--estimators", "dead-reckoning"]
    return Case(
        "results",
        ["report", str(out)] if rng.random() < 0.7 else again,
        # the list of our files is ours: a changed one that can still be read is written anew
        [Path(one) for one in changed if Path(one).name != ".sonar_graph.json"],
    )


FOLDER_CASES: dict[str, Callable[[SoundLog, Path, Rng], Case]] = {
    "pipes": reading_of_pipes,
    "texts": texts,
    "recordings": recordings_of_sonars,
    "folders": folders,
    "results": results,
}


def cases(log: SoundLog, count: int, seed: int) -> Iterator[tuple[Path, Case]]:
    """Cases of every kind in turn, each made when it is asked for."""
    folder, kinds = log.path.parent, [*LOGS, *FOLDER_CASES]
    for number in range(count):
        own = folder / f"{number:04d}"
        own.mkdir()
        kind, rng = kinds[number % len(kinds)], np.random.default_rng([seed, number])
        yield (
            own,
            log_cases(kind, log, own, rng)
            if kind in LOGS
            else FOLDER_CASES[kind](log, own, rng),
        )
