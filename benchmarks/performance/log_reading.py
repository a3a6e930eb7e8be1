"""Time of reading a long log, beside the limit of the machine and two other libraries.

    python benchmarks/performance/log_reading.py [--quick]

The log: 2039 s of IMU at 100 Hz, Doppler log at 8 Hz, pressure at 10 Hz, odometry at 50 Hz, and 2,000 sonar images of
512 x 96; about 250 MB in chunks of 1 MiB, compressed with zstd, written by mcap's own writer into a temporary folder.

Four sides take turns, and of each the fastest round counts:

limit
    Reads every chunk, decompresses it, and checks its CRC. Nothing is decoded.
ours
    Loads what SLAM needs of the four sensors into arrays: stamps; angular rates and specific forces; velocities with
    covariances, modes and beams; pressures with variances; poses with covariances. The same chunks, all CRCs checked.
rosbags, mcap-ros2-support
    Decode the messages of the same four topics one by one, and do nothing with them.

``limit_ratio`` is our time over the limit's, ``rosbags_ratio`` and ``mcap_ros2_ratio`` theirs over ours.
``sequence_ratio`` is the time of `read_log` over the limit's; it sorts, checks and rotates covariances besides.
``peak_rss_mb`` is the largest resident memory (Linux only) of a process that does nothing but load the same columns and
add them up chunk by chunk; ``arrays_rss_mb`` of one that keeps them; ``sequence_rss_mb`` of one that runs
`read_log`. The arrays themselves take ``arrays_mb``.

The figures are void, and the exit code 1, unless the arrays hold what rosbags decodes.
"""

import re
import struct
import subprocess
import sys
import tempfile
import time
import zlib
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import zstandard

sys.path.insert(0, str(Path(__file__).parents[1]))
from common import make_parser, note, print_figures, print_table
from mission_log import DEPTH, DVL, IMU, ODOMETRY, TYPES, write_mission

from sonar_graph.logs.mcap import Keep, stream

FULL = (2039.0, 2000)
QUICK = (60.0, 60)
ROUNDS, OTHERS_ROUNDS = 4, 3
MIB = 1 << 20
TARGETS = {
    "limit_ratio": 2.0,
    "rosbags_ratio": 8.0,
    "mcap_ros2_ratio": 20.0,
    "peak_rss_mb": 150.0,
}
COLUMNS = {
    IMU: [
        *(
            f"{field}.{axis}"
            for field in ("angular_velocity", "linear_acceleration")
            for axis in "xyz"
        )
    ],
    DVL: [
        *(f"velocity.{axis}" for axis in "xyz"),
        "velocity_covar",
        "velocity_mode",
        "num_good_beams",
    ],
    DEPTH: ["fluid_pressure", "variance"],
    ODOMETRY: [
        *(f"pose.pose.position.{axis}" for axis in "xyz"),
        *(f"pose.pose.orientation.{axis}" for axis in "xyzw"),
        "pose.covariance",
    ],
}
SENSORS = frozenset(TYPES[topic] for topic in COLUMNS)
Columns = dict[str, dict[str, np.ndarray]]


def limit(path: Path) -> int:
    """Read, decompress and check every chunk; the number of bytes."""
    decompressor, total = zstandard.ZstdDecompressor(), 0
    with path.open("rb") as file:
        file.seek(8)
        while True:
            opcode, length = struct.unpack("<BQ", file.read(9))
            content = file.read(length)
            if opcode == 0x0F:
                return total
            if opcode == 0x06:
                _, _, size, crc, letters = struct.unpack_from("<QQQII", content)
                data = decompressor.decompress(
                    memoryview(content)[40 + letters :], max_output_size=size
                )
                assert zlib.crc32(data) == crc
                total += len(data)


def pieces(path: Path) -> Iterator[tuple[str, dict[str, np.ndarray]]]:
    """The columns of one topic in one chunk after another."""
    for topic in stream(path, lambda kind: Keep.ALL if kind in SENSORS else Keep.NONE):
        for group in topic.messages():
            stamps_ns = (
                group["header.stamp.sec"].astype(np.int64) * 10**9
                + group["header.stamp.nanosec"]
            )
            yield (
                topic.name,
                {"stamp_ns": stamps_ns}
                | {name: group[name] for name in COLUMNS[topic.name]},
            )


def load(path: Path) -> Columns:
    """The columns of all sensors."""
    parts: dict[str, dict[str, list[np.ndarray]]] = defaultdict(
        lambda: defaultdict(list)
    )
    for topic, columns in pieces(path):
        for name, values in columns.items():
            parts[topic][name].append(values.copy())
    return {
        t: {name: np.concatenate(p) for name, p in columns.items()}
        for t, columns in parts.items()
    }


def add_up(path: Path) -> float:
    return sum(
        float(values.sum())
        for _, columns in pieces(path)
        for values in columns.values()
    )


def read_with_sequence(path: Path) -> None:
    from sonar_graph.logs import read_log

    read_log(path)


def rosbags(path: Path) -> Iterator[tuple[str, Any]]:
    from mission_log import definition_of
    from rosbags.rosbag2 import Reader
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    typestore = get_typestore(Stores.EMPTY)
    for topic, kind in TYPES.items():
        found = get_types_from_msg(definition_of(topic), kind)
        typestore.register(
            {name: found[name] for name in found.keys() - typestore.fielddefs.keys()}
        )
    with Reader(path) as reader:
        connections = [c for c in reader.connections if c.topic in COLUMNS]
        for connection, _, raw in reader.messages(connections=connections):
            yield connection.topic, typestore.deserialize_cdr(raw, connection.msgtype)


def mcap_ros2(path: Path) -> Iterator[tuple[str, Any]]:
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, _, message in reader.iter_decoded_messages(
            topics=list(COLUMNS)
        ):
            yield channel.topic, message


def exhaust(messages: Callable[[Path], Iterator[tuple[str, Any]]], path: Path) -> int:
    return sum(1 for _ in messages(path))


def agrees(columns: Columns, path: Path) -> bool:
    """Check that our arrays equal those of rosbags, bit for bit."""
    rows: dict[str, int] = defaultdict(int)
    for topic, message in rosbags(path):
        row, rows[topic] = rows[topic], rows[topic] + 1
        for name, values in columns[topic].items():
            expected: Any = message
            for field in ("header.stamp" if name == "stamp_ns" else name).split("."):
                expected = getattr(expected, field)
            if name == "stamp_ns":
                expected = expected.sec * 10**9 + expected.nanosec
            if not np.array_equal(values[row], expected):
                return False
    return rows == {topic: len(found["stamp_ns"]) for topic, found in columns.items()}


def timed(
    sides: dict[str, Callable[[], object]], rounds: int, best_s: dict[str, float]
) -> None:
    for number in range(rounds):
        for name, run in sides.items():
            before = time.perf_counter()
            run()
            best_s[name] = min(best_s.get(name, np.inf), time.perf_counter() - before)
        note(
            f"round {number + 1} of {rounds}: "
            + ", ".join(f"{name} {best_s[name]:.3f} s" for name in sides)
        )


WHAT = {"add-up": add_up, "arrays": load, "sequence": read_with_sequence}


def peak_rss_mb(path: Path, what: str) -> float:
    """Peak memory of a separate process."""
    command = [sys.executable, __file__, "--measure", what, str(path)]
    return float(
        subprocess.run(command, check=True, capture_output=True, text=True).stdout
    )


def measure(what: str, path: Path) -> int:
    WHAT[what](path)
    # getrusage would count the parent's memory too
    status = Path("/proc/self/status").read_text(encoding="ascii")
    print(int(re.search(r"VmHWM:\s+(\d+) kB", status)[1]) * 1024 / 1e6)
    return 0


def main() -> int:
    parser = make_parser(__doc__)
    parser.add_argument(
        "--measure",
        nargs=2,
        metavar=("WHAT", "LOG"),
        help="only print the peak memory, in MB",
    )
    options = parser.parse_args()
    if options.measure:
        return measure(options.measure[0], Path(options.measure[1]))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "mission.mcap"
        payload = write_mission(path, *(QUICK if options.quick else FULL))
        note(f"{payload / 1e6:.1f} MB of payload in {path.stat().st_size / 1e6:.1f} MB")
        figures = compare(path, quick=options.quick)
    print_figures(figures)
    return 0 if figures["agrees"] else 1


def compare(path: Path, *, quick: bool) -> dict[str, Any]:
    best_s: dict[str, float] = {}
    fast = {
        "limit": lambda: limit(path),
        "ours": lambda: load(path),
        "sequence": lambda: read_with_sequence(path),
    }
    others = {
        "rosbags": lambda: exhaust(rosbags, path),
        "mcap_ros2": lambda: exhaust(mcap_ros2, path),
    }
    timed(fast, ROUNDS, best_s)
    for _ in range(1 if quick else OTHERS_ROUNDS):
        timed({**fast, **others}, 1, best_s)
    columns = load(path)
    figures = {
        "limit_ratio": best_s["ours"] / best_s["limit"],
        "rosbags_ratio": best_s["rosbags"] / best_s["ours"],
        "mcap_ros2_ratio": best_s["mcap_ros2"] / best_s["ours"],
        "peak_rss_mb": peak_rss_mb(path, "add-up"),
        "arrays_rss_mb": peak_rss_mb(path, "arrays"),
        "arrays_mb": sum(v.nbytes for found in columns.values() for v in found.values())
        / 1e6,
        "sequence_ratio": best_s["sequence"] / best_s["limit"],
        "sequence_rss_mb": peak_rss_mb(path, "sequence"),
        **{f"{name}_s": seconds for name, seconds in best_s.items()},
    }
    print_table(["side", "best (s)"], best_s.items())
    is_met = all(
        figures[name] <= target
        if name in ("limit_ratio", "peak_rss_mb")
        else figures[name] >= target
        for name, target in TARGETS.items()
    )
    rounded = {name: float(f"{value:.4g}") for name, value in figures.items()}
    return {**rounded, "agrees": agrees(columns, path), "passed": is_met}


if __name__ == "__main__":
    sys.exit(main())
