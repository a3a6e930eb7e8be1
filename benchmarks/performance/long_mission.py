"""Time and memory of the smoother with a bounded history over a mission of hours, tenth by tenth.

The mission of `sonar_graph.simulation.mission`: a vehicle that goes round a loop of 40 m and passes the same landmarks
again and again. Another process simulates it and writes its columns to files; this one reads a minute at a time, so
that the log is never in the memory that is measured. The estimator is asked at each sonar frame, as users would.

* ``decile_ratio``: processor time a keyframe, last tenth of the mission over the first;
* ``max_update_ms``: the longest single call of `Isam2.process`, by the clock on the wall, or by the processor's where
  the system gave the core to another process meanwhile (``max_wall_ms`` has those calls by the wall too);
* ``memory_growth_ratio``: resident memory in the last tenth over that at the end of the first, medians.

The mission is run twice, and a call counts by the shorter of its two times: the estimator does the same in both, and
what else the machine does is seldom in both. Memory is that of the first run.

Resident memory is that of the whole process. Poses and outcomes of a quarter of an hour are remembered; with
``--remembered 0`` those of the whole mission, in columns. `--trace` counts what Python allocates, by the line that did,
at several times the run time.
"""

import multiprocessing
import os
import resource
import sys
import tempfile
import time
import tracemalloc
from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).resolve().parents[1]))
from common import conclude, make_parser, note, print_table

from sonar_graph.calibration import Calibration
from sonar_graph.measurements import (
    NS_PER_S,
    Block,
    Depth,
    Dvl,
    Imu,
    LandmarkDetections,
    Measurements,
)
from sonar_graph.navigation import Odometry
from sonar_graph.sequence import Sequence
from sonar_graph.simulation import MissionOptions, simulate_mission
from sonar_graph.slam import BoundedHistory, Isam2, Isam2Params, WholeHistory
from sonar_graph.states import Estimate

TARGETS = {"decile_ratio": 1.3, "max_update_ms": 100.0, "memory_growth_ratio": 1.1}
PIECE_S = 60.0
TENTHS = 10
BLOCKS: dict[str, type[Block]] = {
    "imu": Imu,
    "dvl": Dvl,
    "depth": Depth,
    "detections": LandmarkDetections,
}


@dataclass(frozen=True)
class StoredMission:
    """A simulated mission in files: one for each column, and the calibration."""

    folder: Path

    @property
    def calibration(self) -> Calibration:
        """Poses of the vehicle."""
        return Calibration.model_validate_json(
            (self.folder / "calibration.json").read_text()
        )

    @property
    def frames_ns(self) -> np.ndarray:
        """Stamps of the frames with detections, within IMU and Doppler log."""
        stamps = np.unique(np.load(self.folder / "detections.stamps_ns.npy"))
        ends = [
            np.load(self.folder / f"{name}.stamps_ns.npy", mmap_mode="r")[-1]
            for name in ("imu", "dvl")
        ]
        return stamps[stamps < min(ends)]

    def measurements(self) -> Iterator[Measurements]:
        """Measurements between successive frames, from pieces of a minute."""
        frames_ns = self.frames_ns
        piece_ns = round(PIECE_S * NS_PER_S)
        after_ns = int(np.iinfo(np.int64).min)
        for first_ns in range(int(frames_ns[0]), int(frames_ns[-1]) + 1, piece_ns):
            instants = frames_ns[
                (frames_ns >= first_ns) & (frames_ns < first_ns + piece_ns)
            ]
            if not len(instants):
                continue
            piece = {
                name: self._rows(name, after_ns, int(instants[-1])) for name in BLOCKS
            }
            for end_ns in instants.tolist():
                yield Measurements(
                    end_ns,
                    **{
                        n: b.between(after_ns, end_ns) if b else None
                        for n, b in piece.items()
                    },
                )
                after_ns = end_ns

    def _rows(self, name: str, after_ns: int, until_ns: int) -> Block | None:
        """Rows after one stamp up to another, in memory of their own."""
        stamps = np.load(self.folder / f"{name}.stamps_ns.npy", mmap_mode="r")
        first, last = np.searchsorted(stamps, [after_ns, until_ns], side="right")
        if first == last:
            return None
        columns = (
            np.load(path, mmap_mode="r")[first:last].copy()
            for path in _paths(self.folder, name)
        )
        return BLOCKS[name](*columns)

    def true_positions(self, stamps_ns: np.ndarray) -> np.ndarray:
        """Shape (n, 3), m."""
        at, positions = (
            np.load(self.folder / "truth_ns.npy"),
            np.load(self.folder / "truth.npy"),
        )
        return np.column_stack(
            [np.interp(stamps_ns, at, column) for column in positions.T]
        )


def _paths(folder: Path, name: str) -> list[Path]:
    return [folder / f"{name}.{column.name}.npy" for column in fields(BLOCKS[name])]


def store(options: MissionOptions, folder: Path) -> None:
    """Simulate a mission and write it down."""
    mission: Sequence = simulate_mission(options)
    (folder / "calibration.json").write_text(mission.calibration.model_dump_json())
    for name in BLOCKS:
        for path in _paths(folder, name):
            np.save(path, getattr(getattr(mission, name), path.stem.partition(".")[2]))
    assert mission.truth is not None
    np.save(folder / "truth_ns.npy", mission.truth.stamps_ns)
    np.save(folder / "truth.npy", mission.truth.positions)


class Record:
    """Measurements at each call, in arrays allocated at the start."""

    def __init__(self, calls: int) -> None:
        self.calls = 0
        self.cpu_s, self.wall_s, self.own_s, self.resident_mb = np.zeros((4, calls))
        self.keyframes = np.zeros(calls, dtype=np.int64)
        self.stamps_ns = np.zeros(calls, dtype=np.int64)
        self.positions = np.full((calls, 3), np.nan)

    def add(
        self,
        seconds: tuple[float, float, float],
        keyframes: int,
        estimate: Estimate | None,
    ) -> None:
        """One call: by the processor, by the wall, and by what counts as its own."""
        k, self.calls = self.calls, self.calls + 1
        self.cpu_s[k], self.wall_s[k], self.own_s[k] = seconds
        self.resident_mb[k], self.keyframes[k] = resident_mb(), keyframes
        if estimate is not None:
            self.stamps_ns[k], self.positions[k] = (
                estimate.stamp_ns,
                estimate.world_T_body.translation(),
            )


def resident_mb() -> float:
    """Resident memory of this process, 10⁶ bytes."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def interrupted() -> int:
    """Number of involuntary context switches of this thread."""
    return resource.getrusage(resource.RUSAGE_THREAD).ru_nivcsw


def run(mission: StoredMission, params: Isam2Params) -> tuple[Isam2, Record]:
    """The estimator over the whole mission."""
    total, noted = len(mission.frames_ns), time.monotonic()
    estimator, record = (
        Isam2(mission.calibration, Odometry(mission.calibration), params),
        Record(total),
    )
    for step in mission.measurements():
        interruptions, cpu, wall = (
            interrupted(),
            time.thread_time(),
            time.perf_counter(),
        )
        estimate = estimator.process(step)
        cpu_s, wall_s = time.thread_time() - cpu, time.perf_counter() - wall
        own_s = wall_s if interrupted() == interruptions else cpu_s
        record.add((cpu_s, wall_s, own_s), estimator.keyframe_count, estimate)
        if time.monotonic() - noted > 10:
            noted = time.monotonic()
            note(
                f"{record.calls} of {total} frames, {record.resident_mb[record.calls - 1]:.0f} MB"
            )
    return estimator, record


def shorter(first: Record, second: Record) -> Record:
    """The first, with the shorter times of both."""
    first.cpu_s = np.minimum(first.cpu_s, second.cpu_s)
    first.wall_s = np.minimum(first.wall_s, second.wall_s)
    first.own_s = np.minimum(first.own_s, second.own_s)
    return first


def tenths(record: Record) -> list[dict[str, float]]:
    """Time and memory of each tenth of the calls."""
    rows = []
    for part in np.array_split(np.arange(record.calls), TENTHS):
        before = record.keyframes[part[0] - 1] if part[0] else 0
        cpu_ms, own_ms = 1e3 * record.cpu_s[part], 1e3 * record.own_s[part]
        keyframes = int(record.keyframes[part[-1]] - before)
        rows.append(
            {
                "keyframes": keyframes,
                "keyframe_ms": float(cpu_ms.sum() / keyframes),
                "max_cpu_ms": float(cpu_ms.max()),
                "max_ms": float(own_ms.max()),
                "resident_mb": float(np.median(record.resident_mb[part])),
                "resident_end_mb": float(record.resident_mb[part[-1]]),
            }
        )
    return rows


def report(
    mission: StoredMission, estimator: Isam2, record: Record
) -> dict[str, float | int | bool]:
    """Print the table; the figures by name."""
    rows = tenths(record)
    print_table(
        ("tenth", *rows[0]),
        [(str(k), *row.values()) for k, row in enumerate(rows, start=1)],
    )
    wall_ms, own_ms, cpu_ms = (
        1e3 * record.wall_s,
        1e3 * record.own_s,
        1e3 * record.cpu_s,
    )
    longest = int(np.argmax(own_ms))
    print(
        f"longest call: number {longest} of {record.calls}, {own_ms[longest]:.1f} ms\n"
    )
    off_m = (record.positions - mission.true_positions(record.stamps_ns))[
        record.stamps_ns > 0, :2
    ]
    figures: dict[str, float | int | bool] = {
        "decile_ratio": rows[-1]["keyframe_ms"] / rows[0]["keyframe_ms"],
        "max_update_ms": float(own_ms.max()),
        "memory_growth_ratio": rows[-1]["resident_mb"] / rows[0]["resident_end_mb"],
        "max_cpu_ms": float(cpu_ms.max()),
        "max_wall_ms": float(wall_ms.max()),
        "p99_update_ms": float(np.quantile(wall_ms, 0.99)),
        "median_update_ms": float(np.median(wall_ms)),
        "keyframe_ms": float(cpu_ms.sum() / record.keyframes[-1]),
        "resident_mb": rows[-1]["resident_end_mb"],
        "keyframes": int(record.keyframes[-1]),
        "frames": record.calls,
        "causal_error_m": float(np.sqrt(np.mean(np.sum(off_m**2, axis=1)))),
        "process_s": float(cpu_ms.sum() / 1e3),
    }
    clock = time.perf_counter()
    smoothed = estimator.trajectory()
    figures["trajectory_s"] = time.perf_counter() - clock
    off_m = (smoothed.positions - mission.true_positions(smoothed.stamps_ns))[:, :2]
    figures["smoothed_error_m"] = float(np.sqrt(np.mean(np.sum(off_m**2, axis=1))))
    figures["passed"] = all(figures[name] <= limit for name, limit in TARGETS.items())
    return figures


def simulated(options: MissionOptions, folder: Path) -> StoredMission:
    """The mission, simulated by a process whose memory is not ours."""
    child = multiprocessing.get_context("spawn").Process(
        target=store, args=(options, folder)
    )
    child.start()
    child.join()
    if child.exitcode:
        raise SystemExit(child.exitcode)
    return StoredMission(folder)


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument(
        "--hours", type=float, help="of the mission (default: 8; with --quick 0.25)"
    )
    parser.add_argument("--landmarks", type=int, default=20)
    parser.add_argument("--history", choices=["bounded", "whole"], default="bounded")
    parser.add_argument(
        "--remembered",
        type=float,
        default=900.0,
        help="seconds of poses and outcomes; 0: all",
    )
    parser.add_argument(
        "--trace",
        action="store_true",
        help="say which lines hold more memory at the end",
    )
    arguments = parser.parse_args()
    hours = arguments.hours or (0.25 if arguments.quick else 8.0)
    bounded = BoundedHistory(remembered_s=arguments.remembered or None)
    params = Isam2Params(
        history=bounded if arguments.history == "bounded" else WholeHistory()
    )
    with (
        tempfile.TemporaryDirectory() as first,
        tempfile.TemporaryDirectory() as second,
    ):
        note("warming up: compiled functions load at their first use")
        run(simulated(MissionOptions(duration_s=60.0), Path(first)), params)
        note(f"simulating {hours:g} h")
        options = MissionOptions(duration_s=3600 * hours, landmarks=arguments.landmarks)
        mission = simulated(options, Path(second))
        if arguments.trace:
            tracemalloc.start(5)
        estimator, record = run(mission, params)
        if not arguments.trace:
            record = shorter(record, run(mission, params)[1])
        figures = report(mission, estimator, record)
    if arguments.trace:
        for line in tracemalloc.take_snapshot().statistics("lineno")[:25]:
            note(str(line))
    for name, limit in TARGETS.items():
        print(f"{name}: {figures[name]:.3f}, target at most {limit:g}")
    is_quick = arguments.quick or hours < 8 or arguments.history != "bounded"
    conclude(
        {"hours": hours, "landmarks": arguments.landmarks, **figures}, is_quick=is_quick
    )


if __name__ == "__main__":
    main()
