"""Time of recognition for a sonar frame, beside AcTag's detector on the same frames.

    python benchmarks/performance/recognition.py [--quick]

The log: one lap of the simulated basin at the paper's pace (680 s, 5 Hz), 96 x 512 samples a frame, written into a
temporary folder and read again. About two thirds of its frames are taken while a landmark is watched.

``frame_ms`` is the mean of `Recogniser.process` over all frames: candidate selection, tracking, comparison with the
designs, beliefs. ``selection_ms``, ``tracking_ms``, ``look_ms`` and ``beliefs_ms`` are means of its parts, ``p99_ms``
and ``median_ms`` are of the whole. Motion, tilt and height (``motion_ms``) come from the other sensors and are not
part of it. ``simulate_frame_ms`` is the mean for making a frame.

``frame_of_5_ms`` and ``frame_of_50_ms`` are of frames in which so many discs and squares of a landmark's size lie on
speckle, from 1 to 10 m, each of them compared with the designs in every frame.

``actag_ratio`` is AcTag's time for a frame over ours, in the mean over the same frames, every few of the log. AcTag
1.0.1 as it comes (compiled path, its default settings), for tags as large as our landmarks; where it is not installed
(``pip install benchmarks/actag_plugin``) the figure is null and its target not met. Our time has tracking and beliefs in
it, AcTag's has none; AcTag finds nothing here, since these are not its tags.

Everything runs on one core; of each side all CPU time of the process counts, which no other process adds to. ``wall``
figures are by the clock. The sides take turns of one chunk of the log.

``rss_growth_mb``: by how much the peak memory (Linux only) of a process that runs `recognise` on all frames exceeds
that of one that does so on the first quarter of them, with all other sensors in both. It is what a report keeps: small
pictures, at most 400, and the detections. The frames that only the longer log has are ``frames_mb``.
"""

import os
import re
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any
from unittest.mock import patch

sys.path.append(str(Path(__file__).resolve().parents[1]))
from common import THREAD_VARIABLES, conclude, make_parser, note, print_table

os.environ.update(dict.fromkeys(THREAD_VARIABLES, "1"))

import cv2
import numpy as np

from sonar_graph.calibration import Calibration
from sonar_graph.images import SonarFrames
from sonar_graph.logs import (
    read_log,
    read_sonar_frames,
    sonar_image_messages,
    write_log,
)
from sonar_graph.recognition import recognise_images
from sonar_graph.recognition.session import one_by_one
from sonar_graph.recognition.sonar_motion import SonarMotions
from sonar_graph.sequence import Sequence
from sonar_graph.simulation import BasinOptions, simulate_basin, simulate_basin_frames
from sonar_graph.simulation.sonar_image import ImageOptions
from sonar_graph.sonar import Recogniser, RecogniserParams, SonarStep, recogniser
from sonar_graph.sonar.appearance import CandidateFit
from sonar_graph.sonar.bayes import Beliefs
from sonar_graph.sonar.cfar import DetectionParams
from sonar_graph.sonar.tracker import Tracker

TOPIC = "/sonar/image"
FULL = BasinOptions(
    duration_s=680.0, laps=1, frame_rate_hz=5.0, seed=1, image=ImageOptions()
)
QUICK = BasinOptions(
    duration_s=130.0, laps=1, frame_rate_hz=2.0, seed=1, image=ImageOptions()
)
ACTAG_EVERY = 16
"""Frames: AcTag gets one of so many."""
TAG_FAMILY, TAG_SIZE_M = "AcTag24h10", 0.3
CROWDS, CROWDED_FRAMES = (5, 50), 40
MOST = {
    "frame_ms": 3.0,
    "frame_of_5_ms": 3.0,
    "frame_of_50_ms": 15.0,
    "simulate_frame_ms": 25.0,
    "rss_growth_mb": 32.0,
}
LEAST_ACTAG_RATIO = 30.0
PARTS = {
    "selection": (recogniser, "select_candidates"),
    "tracking": (Tracker, "step"),
    "look": (CandidateFit, "at"),
    "beliefs": (Beliefs, "step"),
}


@dataclass
class Clocks:
    """Durations of successive pieces of work by name, milliseconds."""

    cpu_ms: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    """Of the process, all its threads."""
    wall_ms: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))

    @contextmanager
    def timing(self, name: str) -> Iterator[None]:
        wall, cpu = time.perf_counter(), time.process_time()
        try:
            yield
        finally:
            self.cpu_ms[name].append(1e3 * (time.process_time() - cpu))
            self.wall_ms[name].append(1e3 * (time.perf_counter() - wall))

    @contextmanager
    def timing_parts(self) -> Iterator[None]:
        """Times the parts of `Recogniser.process` too, wherever it runs within."""

        def timed(name: str, work: Any) -> Any:
            def run(*arguments: object) -> object:
                with self.timing(name):
                    return work(*arguments)

            return run

        with ExitStack() as stack:
            for name, (owner, method) in PARTS.items():
                stack.enter_context(
                    patch.object(owner, method, timed(name, getattr(owner, method)))
                )
            yield


def write_basin(path: Path, options: BasinOptions, clocks: Clocks) -> int:
    """Simulate a basin and write it; the number of frames."""
    blocks = simulate_basin_frames(options)
    next(simulate_basin_frames(options, 1))  # compiles
    made = 0

    def messages() -> Iterator[Any]:
        nonlocal made
        while True:
            with clocks.timing("simulation"):
                block = next(blocks, None)
            if block is None:
                return
            made += len(block.frames)
            clocks.cpu_ms["simulation"][-1] /= len(block.frames)
            yield sonar_image_messages(TOPIC, block.frames)
            note(f"{made} frames simulated")

    write_log(path, simulate_basin(options), messages())
    return made


def shorten(path: Path, shorter: Path, frames: int) -> None:
    """The log with its first frames only."""
    every = (frame for block in read_sonar_frames(path) for frame in one_by_one(block))
    messages = (sonar_image_messages(TOPIC, frame) for frame in islice(every, frames))
    write_log(shorter, read_log(path), messages)


def make_actag(frames: SonarFrames) -> Any:
    """AcTag's detector for such frames; None where it is not installed."""
    try:
        from actag import AcTag
    except ImportError:
        note(
            "AcTag is not installed, so that nothing is compared with it: pip install benchmarks/actag_plugin"
        )
        return None
    opening_rad = float(np.ptp(frames.azimuths_rad))
    return AcTag(
        float(frames.ranges_m[0]),
        float(frames.ranges_m[-1]),
        opening_rad,
        TAG_FAMILY,
        TAG_SIZE_M,
    )


def race(path: Path, sequence: Sequence, clocks: Clocks) -> int:
    """Both sides over the frames of a log, a chunk each in turn; the number of detections."""
    motions, ours, theirs = (
        SonarMotions(sequence),
        Recogniser(sequence.calibration),
        None,
    )
    found = number = 0
    for block in read_sonar_frames(path):
        theirs = theirs or make_actag(block)
        seen = [
            frame
            for frame in one_by_one(block)
            if not motions.refusal(int(frame.stamps_ns[0]))
        ]
        known = []
        for frame in seen:
            with clocks.timing("motion"):
                known.append(motions.at(int(frame.stamps_ns[0])))
        compared = [(number + k) % ACTAG_EVERY == 0 for k in range(len(seen))]
        number += len(seen)
        for frame, (step, view), is_compared in zip(seen, known, compared, strict=True):
            with clocks.timing("frame"):
                detections = ours.process(frame, step, view).detections
            if is_compared:
                clocks.cpu_ms["compared"].append(clocks.cpu_ms["frame"][-1])
                clocks.wall_ms["compared"].append(clocks.wall_ms["frame"][-1])
            found += 0 if detections is None else len(detections)
        for frame, is_compared in zip(seen, compared, strict=True):
            if theirs is not None and is_compared:
                picture = np.ascontiguousarray(frame.intensity[0].T[::-1])
                with clocks.timing("actag"):
                    theirs.run_detection(picture)
    return found


def crowded_frame_ms(objects: int) -> float:
    """Mean time for a frame with so many objects, each of which is compared with the designs."""
    rng = np.random.default_rng(0)
    ranges_m, azimuths_rad = (
        np.linspace(1.0, 10.0, 512),
        np.radians(np.linspace(-14.4, 14.4, 96)),
    )
    x, y = (
        ranges_m * np.cos(azimuths_rad)[:, None],
        ranges_m * np.sin(azimuths_rad)[:, None],
    )
    places = [
        (r, a)
        for r in np.arange(2.0, 9.7, 0.62)
        for a in np.arange(-0.25 + 0.32 / r, 0.25 - 0.32 / r, 0.62 / r)
    ]
    power = np.ones_like(x)
    for number, row in enumerate(rng.permutation(len(places))[:objects].tolist()):
        r, a = places[row]
        dx, dy = np.abs(x - r * np.cos(a)), np.abs(y - r * np.sin(a))
        power[
            (np.hypot(dx, dy) < 0.15) if number % 2 else (np.maximum(dx, dy) < 0.13)
        ] = 10**1.2
    params = RecogniserParams(
        detection=DetectionParams(max_candidates=objects), independent=False
    )
    ours, clocks, still = (
        Recogniser(Calibration(), params=params),
        Clocks(),
        SonarStep.none(),
    )
    for frame in range(CROWDED_FRAMES):
        level = 35 + 10 * np.log10(power * rng.exponential(size=power.shape) + 1e-9)
        picture = np.clip(np.rint(level * 255 / 80), 0, 255).astype(np.uint8)
        block = SonarFrames(
            np.array([frame * 200_000_000]), picture[None], ranges_m, azimuths_rad
        )
        with clocks.timing("frame"):
            result = ours.process(block, still if frame else None)
    sightings = [track.sighting for track in result.tracks]
    fitted = [sighting for sighting in sightings if sighting and sighting.fit]
    assert len(fitted) >= 0.9 * objects
    return float(np.mean(clocks.cpu_ms["frame"][CROWDED_FRAMES // 4 :]))


def peak_rss_mb(path: Path) -> float:
    """Peak memory of a separate process that runs `recognise`."""
    command = [sys.executable, __file__, "--measure", str(path)]
    return float(
        subprocess.run(command, check=True, capture_output=True, text=True).stdout
    )


def measure(path: Path) -> None:
    recognise_images(path, read_log(path))
    status = Path("/proc/self/status").read_text(encoding="ascii")
    peak = re.search(r"VmHWM:\s+(\d+) kB", status)
    assert peak is not None
    print(int(peak[1]) * 1024 / 1e6)


def report(clocks: Clocks) -> dict[str, Any]:
    """Print the table; the figures by name."""
    mean = {name: float(np.mean(values)) for name, values in clocks.cpu_ms.items()}
    rows = [
        (
            name,
            len(cpu),
            mean[name],
            float(np.median(cpu)),
            float(np.quantile(cpu, 0.99)),
            float(np.mean(wall)),
        )
        for name, cpu, wall in (
            (name, clocks.cpu_ms[name], clocks.wall_ms[name]) for name in mean
        )
        if name not in ("simulation", "compared")
    ]
    print_table(("", "times", "mean ms", "median ms", "p99 ms", "mean wall ms"), rows)
    frame_ms, has_actag = clocks.cpu_ms["frame"], "actag" in mean
    walls = clocks.wall_ms
    return {
        "frame_ms": mean["frame"],
        "median_ms": float(np.median(frame_ms)),
        "p99_ms": float(np.quantile(frame_ms, 0.99)),
        **{f"{name}_ms": mean[name] for name in PARTS},
        "motion_ms": mean["motion"],
        "frame_wall_ms": float(np.mean(walls["frame"])),
        "actag_ms": mean["actag"] if has_actag else None,
        "actag_ratio": mean["actag"] / mean["compared"] if has_actag else None,
        "actag_wall_ratio": float(np.sum(walls["actag"]) / np.sum(walls["compared"]))
        if has_actag
        else None,
        "simulate_frame_ms": mean["simulation"],
    }


def meets_targets(figures: dict[str, Any]) -> bool:
    """Check that all targets are met; without AcTag they are not."""
    ratio = figures["actag_ratio"]
    return (
        all(figures[name] <= limit for name, limit in MOST.items())
        and (ratio or 0.0) >= LEAST_ACTAG_RATIO
    )


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument(
        "--measure", type=Path, metavar="LOG", help="only print the peak memory, in MB"
    )
    arguments = parser.parse_args()
    if arguments.measure:
        measure(arguments.measure)
    else:
        conclude(measured(QUICK if arguments.quick else FULL), is_quick=arguments.quick)


def measured(options: BasinOptions) -> dict[str, Any]:
    """All figures, rounded."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    cv2.setNumThreads(1)
    clocks = Clocks()
    with tempfile.TemporaryDirectory() as folder:
        path, shorter = Path(folder) / "basin.mcap", Path(folder) / "shorter.mcap"
        frames = write_basin(path, options, clocks)
        shorten(path, shorter, frames // 4)
        sequence = read_log(path)
        race(shorter, sequence, Clocks())
        with clocks.timing_parts():
            detections = race(path, sequence, clocks)
        note("measuring memory")
        peaks_mb = peak_rss_mb(shorter), peak_rss_mb(path)
    figures = report(clocks) | {
        "peak_rss_mb": peaks_mb[1],
        "rss_growth_mb": peaks_mb[1] - peaks_mb[0],
    }
    figures |= {
        "frames_mb": 96 * 512 * (frames - frames // 4) / 1e6,
        "frames": frames,
        "detections": detections,
    }
    figures |= {
        f"frame_of_{objects}_ms": crowded_frame_ms(objects) for objects in CROWDS
    }
    figures["passed"] = meets_targets(figures)
    return {
        name: float(f"{value:.4g}") if isinstance(value, float) else value
        for name, value in figures.items()
    }


if __name__ == "__main__":
    main()
