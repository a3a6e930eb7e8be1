"""Recovery from 1,000 damaged recordings of sonars, and frames that come out wrong without a warning.

    python benchmarks/validation/damaged_sonar_files.py [--quick] [--data FOLDER]

Recordings of eight frames in the layouts of DIDSON (versions 3 and 4), ARIS and Oculus (both versions), written by the
tests, and the real ARIS and Oculus samples where ``--data`` (or SONAR_GRAPH_DATA) has them. Each file is cut, loses or
gains bytes, has bits flipped anywhere or in the frames' headers, a stretch zeroed or doubled, or two of these. A file
counts as a hang after ``TIME_LIMIT_S``, as a crash when anything but this package's own error is raised.

The formats have no checksums. So a flipped sample cannot be told, nor a time that is still between those of its
neighbours, nor that bytes are missing or too many by exactly a frame's length: ``unseen_samples``, ``unseen_times`` and
``unseen_shifts`` count such frames, and ``unseen_settings`` those with a damaged setting where fewer than three frames
are left to compare. Everything else that differs from what was
recorded (samples of another place, other ranges or azimuths, another time, a frame missing without a word) is a silent
error.

``recovered_share`` is the share of the frames whose bytes, and those of the frame after, are all in the damaged file.
"""

import signal
import sys
import tempfile
from collections import Counter, defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "logs" / "converters"))
from common import make_parser, note, print_figures, print_table
from sonar_damages import BY_A_FRAME, DAMAGES, Convert, Frame, Source
from sonar_recordings import Aris, Ddf, Oculus, images

from sonar_graph.errors import SonarGraphError
from sonar_graph.logs import read_sonar_frames
from sonar_graph.logs.convert import (
    SonarConversion,
    convert_aris,
    convert_didson,
    convert_oculus,
)

FILES, QUICK_FILES = 1000, 60
FRAMES = 8
TIME_LIMIT_S = 20
TARGETS = {"crashes": 0, "hangs": 0, "silent_errors": 0, "recovered_share": 1.0}
UNSEEN = ("unseen_samples", "unseen_times", "unseen_shifts", "unseen_settings")
MOST_FLIPS = 60
ENOUGH_TO_COMPARE = 3
ROUNDING_NS = 2
DRIFT = 1.1e-3


@dataclass(frozen=True)
class Damaged:
    """A file to be read."""

    source: Source
    kind: str
    content: bytes


class HangError(Exception):
    """A file takes too long."""


def main() -> int:
    parser = make_parser(__doc__, data=True)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        sources = make_sources(
            Path(folder), Path(options.data) if options.data else None
        )
        note(f"recordings: {', '.join(source.name for source in sources)}")
        figures = judge_all(
            make_files(sources, QUICK_FILES if options.quick else FILES), Path(folder)
        )
    print_figures(figures)
    return 0 if figures["passed"] else 1


def make_sources(folder: Path, data: Path | None) -> list[Source]:
    small = images(FRAMES, 48, 60)
    kinds: list[tuple[str, Convert, list[bytes]]] = [
        ("DIDSON 3", convert_didson, Ddf(images(FRAMES, 96, 60)).pieces()),
        ("DIDSON 4", convert_didson, Ddf(small, version=4, high=0).pieces()),
        ("ARIS", convert_aris, Aris(small, mode=1).pieces()),
        ("Oculus 1", convert_oculus, Oculus(small).pieces()),
        ("Oculus 2", convert_oculus, Oculus(small, version=2).pieces()),
    ]
    real = data / "sonar" if data else Path()
    if (real / "sample.aris").exists():
        kinds.append(
            (
                "sample.aris",
                convert_aris,
                split(real / "sample.aris", 1024, 1024 + 48 * 2000),
            )
        )
    if (real / "three_pings_8bit.raw").exists():
        kinds.append(
            (
                "three_pings_8bit.raw",
                convert_oculus,
                split(real / "three_pings_8bit.raw", 0, 182_016),
            )
        )
    sources = []
    for name, convert, pieces in kinds:
        _, frames = read(convert, b"".join(pieces), folder)
        is_relative = name in ("Oculus 1", "three_pings_8bit.raw")
        sources.append(Source(name, convert, pieces, frames, is_relative))
    return sources


def split(path: Path, header: int, size: int) -> list[bytes]:
    content = path.read_bytes()
    return [
        content[:header],
        *(content[at : at + size] for at in range(header, len(content), size)),
    ]


def make_files(sources: list[Source], count: int) -> Iterator[Damaged]:
    rng = np.random.default_rng(0)
    kinds = list(DAMAGES)
    for number in range(count):
        source = sources[number % len(sources)]
        kind = kinds[int(rng.integers(len(kinds)))]
        content = DAMAGES[kind](source, source.content, rng)
        if rng.random() < 0.15:
            second = kinds[int(rng.integers(len(kinds)))]
            content = DAMAGES[second](source, content, rng) if content else content
            kind += f" and {second}"
        yield Damaged(source, kind, content)


def read(
    convert: Convert, content: bytes, folder: Path
) -> tuple[SonarConversion, list[Frame]]:
    path, log = folder / "damaged.bin", folder / "damaged.mcap"
    path.write_bytes(content)
    done = convert(path, log)
    frames = [
        (
            image.tobytes(),
            stamp_ns,
            block.ranges_m.tobytes() + block.azimuths_rad.tobytes(),
        )
        for block in read_sonar_frames(log)
        for stamp_ns, image in zip(
            block.stamps_ns.tolist(), block.intensity, strict=True
        )
    ]
    return done, frames


@contextmanager
def time_limit() -> Iterator[None]:
    def stop(*_: object) -> None:
        raise HangError

    signal.signal(signal.SIGALRM, stop)
    signal.alarm(TIME_LIMIT_S)
    try:
        yield
    finally:
        signal.alarm(0)


def judge_all(files: Iterator[Damaged], folder: Path) -> dict[str, Any]:
    totals: Counter[str] = Counter()
    by_kind: dict[str, Counter[str]] = defaultdict(Counter)
    for number, file in enumerate(files):
        verdict = judge(file, folder)
        by_kind[file.kind if " and " not in file.kind else "two of these"] += verdict
        totals += verdict
        for trouble in ("crashes", "hangs", "silent_errors", "missed"):
            if verdict[trouble]:
                note(
                    f"file {number} ({file.source.name}, {file.kind}): {trouble} {verdict[trouble]}"
                )
    headings = [
        "files",
        "refused",
        "read",
        "intact",
        "missed",
        "silent_errors",
        *UNSEEN,
    ]
    print_table(
        ["damage", *headings],
        [[kind, *(c[h] for h in headings)] for kind, c in sorted(by_kind.items())],
    )
    names = ("files", "crashes", "hangs", "silent_errors", "refused", *UNSEEN)
    figures: dict[str, Any] = {name: totals[name] for name in names}
    figures["recovered_share"] = 1 - totals["missed"] / max(totals["intact"], 1)
    return {
        **figures,
        "passed": all(figures[name] == target for name, target in TARGETS.items()),
    }


def judge(file: Damaged, folder: Path) -> Counter[str]:
    verdict = Counter(files=1)
    frames: list[Frame] = []
    says_so = False
    try:
        with time_limit():
            done, frames = read(file.source.convert, file.content, folder)
        says_so = bool(done.shortcomings())
    except HangError:
        verdict["hangs"] = 1
        return verdict
    except SonarGraphError as error:
        verdict["refused"] = 1
        says_so = "\n" not in str(error)
    except Exception as error:  # whatever it is, it is what is looked for
        note(f"{type(error).__name__}: {error}")
        verdict["crashes"] = 1
        return verdict
    verdict["read"] = len(frames)
    verdict += compare(file, frames)
    intact = intact_frames(file)
    images_read = {image for image, _, _ in frames}
    verdict["intact"] = len(intact)
    verdict["missed"] = (
        0
        if verdict["refused"]
        else sum(file.source.frames[i][0] not in images_read for i in intact)
    )
    if verdict["missed"] and not says_so:
        verdict["silent_errors"] += verdict["missed"]
    return verdict


def intact_frames(file: Damaged) -> list[int]:
    """Frames that are in the damaged file together with the one after; the last one with the end of the file."""
    pieces = file.source.pieces[1:]
    return [
        i for i in range(len(pieces) - 1) if pieces[i] + pieces[i + 1] in file.content
    ]


def compare(file: Damaged, frames: list[Frame]) -> Counter[str]:
    """Number of frames that differ from the recording, by kind."""
    verdict: Counter[str] = Counter()
    origin_ns = origin(file, frames)
    for image, stamp_ns, geometry in frames:
        meant = recorded_frame(file.source, image, stamp_ns - origin_ns)
        if meant is None:
            verdict[
                "unseen_shifts"
                if BY_A_FRAME & set(file.kind.split(" and "))
                else "silent_errors"
            ] += 1
            continue
        right_image, right_time_ns, right_geometry = file.source.frames[meant]
        verdict["unseen_samples"] += image != right_image
        late_ns = abs(stamp_ns - origin_ns - right_time_ns)
        if late_ns > ROUNDING_NS:
            verdict[
                "unseen_times"
                if late_ns < between_neighbours_ns(file.source, meant)
                else "silent_errors"
            ] += 1
        if not same_geometry(geometry, right_geometry):
            verdict[
                "unseen_settings"
                if len(frames) < ENOUGH_TO_COMPARE
                else "silent_errors"
            ] += 1
    return verdict


def origin(file: Damaged, frames: list[Frame]) -> int:
    """Lead of the older Oculus clock, which counts from the first frame; 0 for others."""
    if not file.source.is_relative:
        return 0
    ahead: Counter[int] = Counter()
    for image, stamp_ns, _ in frames:
        meant = recorded_frame(file.source, image, stamp_ns)
        if meant is not None:
            ahead[stamp_ns - file.source.frames[meant][1]] += 1
    return ahead.most_common(1)[0][0] if ahead else 0


def recorded_frame(source: Source, image: bytes, stamp_ns: int) -> int | None:
    """Number of the frame that an image is, up to zeroed samples or one flipped bit; None without one."""
    found = []
    values = np.frombuffer(image, np.uint8)
    for number, (recorded, recorded_ns, _) in enumerate(source.frames):
        if len(recorded) == len(image):
            difference = values ^ np.frombuffer(recorded, np.uint8)
            is_flip = ((difference & (difference - 1)) == 0) | (
                (values & (values - 1)) == 0
            )
            if np.all(is_flip) and np.count_nonzero(difference & values) <= MOST_FLIPS:
                found.append((abs(recorded_ns - stamp_ns), number))
    return min(found)[1] if found else None


def between_neighbours_ns(source: Source, number: int) -> int:
    """Tolerance of a stamp: between its neighbours, at the ends near them."""
    stamps_ns = [stamp_ns for _, stamp_ns, _ in source.frames]
    usual_ns = max(np.diff(stamps_ns).tolist())
    is_inner = 0 < number < len(stamps_ns) - 1
    return 2 * usual_ns if is_inner else 12 * usual_ns + 10**9


def same_geometry(one: bytes, other: bytes) -> bool:
    """To a thousandth, by which the speed of sound may drift."""
    return len(one) == len(other) and bool(
        np.allclose(np.frombuffer(one), np.frombuffer(other), rtol=DRIFT, atol=1e-9)
    )


if __name__ == "__main__":
    sys.exit(main())
