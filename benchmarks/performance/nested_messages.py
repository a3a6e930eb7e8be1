"""Time of decoding messages of many layouts, beside decoding them one at a time.

    python benchmarks/performance/nested_messages.py [--quick]

Messages made of strings and lists in lists have a layout each, the worst case for reading by columns. Three kinds are
read here from their bytes to the fields that one would want: detections with hypotheses, diagnostics (nothing but
strings), and scans whose number of beams varies. ``KIND_ratio``: time of mcap-ros2-support over ours where every
message has a layout of its own; ``KIND_shared_ratio``: where four share one. The two take turns, and the fastest round
of each counts. Both must find the same values, otherwise the exit code is 1. Ours checks every length, boolean and
string besides, theirs does not.
"""

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from mcap_ros2._dynamic import generate_dynamic, serialize_dynamic

from sonar_graph.logs.cdr import decode, parse_definition
from sonar_graph.logs.cdr.definitions import DEFINITIONS

FULL, QUICK = 1000, 100
ROUNDS = 5
RULE = "=" * 80


class Kind(NamedTuple):
    """A type with what to draw and what to read of it."""

    fields: str
    others: dict[str, str]
    draw: Callable[[np.random.Generator], dict[str, Any]]
    numbers: tuple[str, ...]
    strings: tuple[str, ...]

    def schema(self) -> str:
        shared = (
            "std_msgs/Header",
            "geometry_msgs/Pose",
            "geometry_msgs/Point",
            "geometry_msgs/Quaternion",
        )
        shared += (
            "builtin_interfaces/Time",
            "geometry_msgs/PoseWithCovariance",
            "geometry_msgs/Vector3",
        )
        texts = {name: DEFINITIONS[name] for name in shared} | self.others
        return self.fields + "".join(
            f"{RULE}\nMSG: {name}\n{text}\n" for name, text in texts.items()
        )


def word(rng: np.random.Generator) -> str:
    return "x" * int(rng.integers(1, 20))


def draw_detections(rng: np.random.Generator) -> dict[str, Any]:
    results = [
        [
            {"hypothesis": {"class_id": word(rng), "score": rng.random()}}
            for _ in range(rng.integers(1, 4))
        ]
        for _ in range(rng.integers(1, 6))
    ]
    return {"detections": [{"results": some, "id": word(rng)} for some in results]}


def draw_diagnostics(rng: np.random.Generator) -> dict[str, Any]:
    pairs = [{"key": word(rng), "value": word(rng)} for _ in range(6)]
    return {
        "status": [
            {"level": 1, "name": word(rng), "message": word(rng), "values": pairs}
            for _ in range(4)
        ]
    }


def draw_scan(rng: np.random.Generator) -> dict[str, Any]:
    return {
        "header": {"frame_id": word(rng)},
        "ranges": rng.random(int(rng.integers(10, 2000))).tolist(),
    }


KINDS = {
    "detections": Kind(
        "std_msgs/Header header\nDetection[] detections\n",
        {
            "some_msgs/Detection": "std_msgs/Header header\nResult[] results\ngeometry_msgs/Pose center\nstring id",
            "some_msgs/Result": "Hypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose",
            "some_msgs/Hypothesis": "string class_id\nfloat64 score",
        },
        draw_detections,
        (
            "detections.results.hypothesis.score",
            "detections.center.position.x",
            "detections.center.position.y",
        ),
        ("detections.results.hypothesis.class_id",),
    ),
    "diagnostics": Kind(
        "std_msgs/Header header\nStatus[] status\n",
        {
            "some_msgs/Status": "byte level\nstring name\nstring message\nstring hardware_id\nPair[] values",
            "some_msgs/Pair": "string key\nstring value",
        },
        draw_diagnostics,
        ("status.level",),
        ("status.name", "status.values.value"),
    ),
    "scans": Kind(
        "std_msgs/Header header\nfloat32[] ranges\n",
        {},
        draw_scan,
        ("ranges",),
        ("header.frame_id",),
    ),
}
NAME = "some_msgs/msg/Root"


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--quick", action="store_true", help=f"{QUICK} messages instead of {FULL}"
    )
    count = QUICK if parser.parse_args().quick else FULL
    found: dict[str, float] = {}
    is_same = True
    for name, kind in KINDS.items():
        for shared, label in ((1, "ratio"), (4, "shared_ratio")):
            ours_us, theirs_us, agree = compare(kind, count, shared)
            is_same = is_same and agree
            found[f"{name}_{label}"] = float(f"{theirs_us / ours_us:.3g}")
            print(
                f"{name}, {shared} a layout: {ours_us:.1f} µs a message, mcap-ros2-support {theirs_us:.1f} µs"
            )
    print(json.dumps(found | {"same": is_same}))
    return 0 if is_same else 1


def compare(kind: Kind, count: int, shared: int) -> tuple[float, float, bool]:
    """Microseconds a message of both, and whether they found the same."""
    rng, schema = np.random.default_rng(0), kind.schema()
    encoder = serialize_dynamic(NAME, schema)[NAME]
    payloads = [
        payload
        for _ in range(count // shared)
        for payload in [encoder(kind.draw(rng))] * shared
    ]
    theirs, ours = by_message(kind, schema, payloads), by_column(kind, schema, payloads)
    times = [[timed(read) for read in (ours, theirs)] for _ in range(ROUNDS)]
    ours_s, theirs_s = np.min(times, axis=0)
    return 1e6 * ours_s / count, 1e6 * theirs_s / count, ours() == theirs()


def timed(read: Callable[[], Any]) -> float:
    start = time.perf_counter()
    read()
    return time.perf_counter() - start


def by_column(
    kind: Kind, schema: str, payloads: list[bytes]
) -> Callable[[], list[list[list[Any]]]]:
    definition, sizes = (
        parse_definition(NAME, schema),
        np.array([len(p) for p in payloads]),
    )
    stacks = []
    for size in np.unique(sizes):
        rows = np.flatnonzero(sizes == size)
        joined = b"".join(payloads[row] for row in rows)
        stacks.append((rows, np.frombuffer(joined, np.uint8).reshape(len(rows), size)))

    def read() -> list[list[list[Any]]]:
        found: list[list[list[Any]]] = [[] for _ in payloads]
        for group in decode(definition, stacks).groups:
            numbers = [group[path].tolist() for path in kind.numbers]
            columns = numbers + [group.strings(path) for path in kind.strings]
            for row, *values in zip(group.rows.tolist(), *columns, strict=True):
                found[row] = values
        return found

    return read


def by_message(
    kind: Kind, schema: str, payloads: list[bytes]
) -> Callable[[], list[list[list[Any]]]]:
    decoder = generate_dynamic(NAME, schema)[NAME]
    paths = [path.split(".") for path in (*kind.numbers, *kind.strings)]

    def read() -> list[list[list[Any]]]:
        return [
            [list(leaves(message, path)) for path in paths]
            for message in map(decoder, payloads)
        ]

    return read


def leaves(value: Any, path: list[str]) -> Iterator[Any]:
    """The values at a path through lists."""
    if isinstance(value, list):
        for element in value:
            yield from leaves(element, path)
    elif path:
        yield from leaves(getattr(value, path[0]), path[1:])
    else:
        yield value


if __name__ == "__main__":
    sys.exit(main())
