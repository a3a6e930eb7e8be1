"""Recovery from 1,000 damaged logs, and numbers that come out wrong without a warning.

    python benchmarks/validation/damaged_logs.py [--quick]

Logs of a minute (IMU, Doppler log, pressure, odometry, sonar images; chunks of 64 KiB) are written by mcap's own writer
with zstd, lz4 and without compression, without indexes, without summary, without chunks, with a CRC over all data; one
is written by this package. Each file is damaged in one of the ways of `damages.py`, some in two; a few come from
writers that were killed. Each is read in a process of its own account: a file counts as a crash when anything but this
package's own error is raised, as a hang after ``TIME_LIMIT_S``.

Truth is the undamaged file as mcap's own reader sees it. A silent error is a message, a description or a metadata
record that differs from it, or a missing message, while the reader names no loss, no cut end and no missing protection.
``unprotected_errors`` are those that differ where the reader says that no CRC covers them.

``recovered_share`` is the share of the messages in undamaged chunks that were read: chunks whose bytes are all in the
damaged file, and whose channels are still described in it. ``loose_share`` is the same for messages without chunks.
"""

import sys
import tempfile
from collections import Counter, defaultdict
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
sys.path.insert(0, str(Path(__file__).parents[1] / "performance"))
from common import make_parser, note, print_figures, print_table
from damages import DAMAGES, Damaged
from log_truth import Truth, read_truth
from reading_apart import Reading, read_all
from source_logs import killed_logs, source_logs

FILES, QUICK_FILES = 1000, 60
KILLED, QUICK_KILLED = 10, 2
TARGETS = {"crashes": 0, "hangs": 0, "silent_errors": 0, "recovered_share": 1.0}


def main() -> int:
    parser = make_parser(__doc__, workers=True)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        damaged = make_files(
            Path(folder), QUICK_FILES if options.quick else FILES, quick=options.quick
        )
        readings = read_all([file.path for file, _ in damaged], options.workers)
        figures = judge(damaged, readings)
    print_figures(figures)
    return 0 if figures["passed"] else 1


def make_files(folder: Path, count: int, *, quick: bool) -> list[tuple[Damaged, Truth]]:
    """Damaged files with what they held."""
    rng = np.random.default_rng(0)
    sources = [(path, read_truth(path)) for path in source_logs(folder)]
    note(
        f"{len(sources)} logs of {min(t.count for _, t in sources)} to {max(t.count for _, t in sources)} messages"
    )
    killed = killed_logs(folder, QUICK_KILLED if quick else KILLED)
    found = [
        (Damaged(path, "killed writer", path.read_bytes()), truth)
        for path, truth in killed
    ]
    kinds = list(DAMAGES)
    while len(found) < count:
        source, truth = sources[len(found) % len(sources)]
        kind = kinds[int(rng.integers(len(kinds)))]
        content = DAMAGES[kind](source.read_bytes(), truth, rng)
        if rng.random() < 0.1:
            content = DAMAGES["cut"](content, truth, rng)
            kind += " and cut"
        path = folder / f"{len(found):04d}.mcap"
        path.write_bytes(content)
        found.append((Damaged(path, kind, content), truth))
    return found


def judge(
    damaged: list[tuple[Damaged, Truth]], readings: list[Reading]
) -> dict[str, Any]:
    totals: Counter[str] = Counter()
    by_kind: dict[str, Counter[str]] = defaultdict(Counter)
    for (file, truth), reading in zip(damaged, readings, strict=True):
        verdict = judge_one(file, truth, reading)
        by_kind[file.kind.removesuffix(" and cut")] += verdict
        totals += verdict
        for trouble in ("crashes", "hangs", "silent_errors", "missed", "loose_missed"):
            if verdict[trouble]:
                note(
                    f"{file.path.name} ({truth.name}, {file.kind}): {trouble} {verdict[trouble]}: {reading.trouble}"
                )
    headings = [
        "files",
        "refused",
        "in_sound",
        "missed",
        "silent_errors",
        "unprotected_errors",
    ]
    print_table(
        ["damage", *headings],
        [[kind, *(c[h] for h in headings)] for kind, c in sorted(by_kind.items())],
    )
    figures = {
        "files": len(damaged),
        "crashes": totals["crashes"],
        "hangs": totals["hangs"],
        "silent_errors": totals["silent_errors"],
        "recovered_share": 1 - totals["missed"] / max(totals["in_sound"], 1),
        "loose_share": 1 - totals["loose_missed"] / max(totals["loose"], 1),
        "refused": totals["refused"],
        "unprotected_errors": totals["unprotected_errors"],
    }
    return {
        **figures,
        "passed": all(figures[name] == target for name, target in TARGETS.items()),
    }


def judge_one(file: Damaged, truth: Truth, reading: Reading) -> Counter[str]:
    verdict = Counter(
        files=1,
        crashes=int(reading.crashed),
        hangs=int(reading.hung),
        refused=int(reading.refused),
    )
    found = {name: Counter(messages) for name, messages in reading.messages.items()}
    for chunk in truth.sound_chunks(file.content):
        verdict["in_sound"] += len(chunk)
        verdict["missed"] += sum(
            not found.get(name, {}).get(message, 0) for name, message in chunk
        )
    for name, message in truth.sound_loose(file.content):
        verdict["loose"] += 1
        verdict["loose_missed"] += not found.get(name, {}).get(message, 0)
    if reading.refused or reading.crashed or reading.hung:
        return verdict
    wrong = sum(
        (count - truth.messages.get(name, Counter())).total()
        for name, count in found.items()
    )
    wrong += sum(reading.types[name] != truth.types.get(name) for name in found)
    wrong += sum(
        truth.metadata.get(name) != content
        for name, content in reading.metadata.items()
    )
    missing = truth.count - sum(count.total() for count in found.values())
    if wrong and not reading.names_loss:
        verdict[
            "unprotected_errors" if reading.names_unprotected else "silent_errors"
        ] += wrong
    if missing > 0 and not (reading.names_loss or reading.names_unprotected):
        verdict["silent_errors"] += missing
    return verdict


if __name__ == "__main__":
    sys.exit(main())
