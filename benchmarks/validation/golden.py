"""Keep the results of every estimator on fixed logs, and compare the results of two versions of the code.

    python benchmarks/validation/golden.py keep FOLDER [--logs NAME ...] [--estimators NAME ...] [--quick]
    python benchmarks/validation/golden.py compare OLD NEW [--tolerance 1e-9]

``keep`` runs the version of the package that Python imports. To keep the results of another checkout, set
``PYTHONPATH`` to that checkout. Each run becomes two files, ``FOLDER/LOG/ESTIMATOR.npz`` (all numbers) and ``.json``
(a summary). A run that is already kept is skipped, so an interrupted call can be repeated. Failed runs are repeated.

``compare`` prints one row for each log and estimator, and exits with code 1 when a difference exceeds the tolerance:

* ``causal`` and ``smoothed``: largest distance of two positions (m) and angle of two rotations (rad);
* ``cov``: largest ``|P_new - P_old|_ij / sqrt(P_old,ii P_old,jj)`` of all pose covariances, and of the map;
* ``map m``: largest distance of two landmarks; infinite when a landmark exists in only one of the maps;
* ``outcomes``: detections whose outcome changed;
* ``rms`` and ``NEES``: the scores of the causal and the smoothed estimate against the truth, where there is one;
* ``time``: ratio of the processor seconds.

The script uses only the public interface, so that one script can run old and new versions: `run_estimator`, `judge`,
the simulators and the readers of logs.
"""

import argparse
import hashlib
import json
import math
import os
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, NamedTuple

sys.path.append(str(Path(__file__).resolve().parents[1]))
from common import THREAD_VARIABLES, make_parser, note, print_table, recording, refuse

for variable in THREAD_VARIABLES:
    # before numpy: sums in several threads differ from run to run
    os.environ.setdefault(variable, "1")

import numpy as np
from scipy.spatial.transform import Rotation

import baselines
import sonar_graph
from sonar_graph.calibration import PositionCalibration
from sonar_graph.evaluation import RunResult, judge, run_estimator
from sonar_graph.logs.convert import read_akit, read_dlr, read_mrclam, read_stpere
from sonar_graph.measurements import Floats, Heading, PositionFixes
from sonar_graph.sequence import Sequence
from sonar_graph.simulation import (
    BasinOptions,
    MissionOptions,
    simulate_basin,
    simulate_mission,
)
from sonar_graph.states import Trajectory

ESTIMATORS = ("dead-reckoning", "ekf-slam", "invariant-ekf", "isam2")
RATE_HZ = 2.0
NS_PER_S = 1_000_000_000
QUICK_S = 60.0
PROGRESS_S = 15.0
"""Time between two lines of progress within one run."""
SEED = 7
GAPS_S = ((200.0, 220.0), (400.0, 445.0))
"""Doppler gaps of the mission."""
HEADING_SIGMA_RAD = 0.02
HEADING_BIAS_RAD = 0.03
FIX_SIGMA_M = (0.5, 0.5, 1.0)
ANTENNA_M = (-0.4, 0.2, 0.6)
FIX_PERIOD_S = 10.0
SCORES = {
    "causal_rms_m": ("causal.ate_raw_m",),
    "smoothed_rms_m": ("smoothed.ate_raw_m",),
    "causal_aligned_rms_m": ("causal.ate_se2_m",),
    "smoothed_aligned_rms_m": ("smoothed.ate_se2_m",),
    "causal_position_nees": ("causal.nees_position",),
    "causal_heading_nees": ("causal.nees_yaw",),
    "smoothed_position_nees": ("smoothed.nees_position",),
    "smoothed_heading_nees": ("smoothed.nees_yaw",),
    "map_rms_m": ("landmarks.raw_m", "landmarks.se2_m"),
}
"""Names in the summary, and the scores that `judge` gives, of which the first that exists is taken."""


class GoldenLog(NamedTuple):
    """A log that all estimators run on."""

    read: Callable[[Path | None], Sequence]
    """Makes the log, given the folder of the recordings."""
    seconds: float
    """The part that is run, from the start."""


def mission_with_gaps(_: Path | None) -> Sequence:
    """Mission with two Doppler gaps, headings with a constant error, and position fixes."""
    mission = simulate_mission(MissionOptions(duration_s=600.0))
    assert mission.truth is not None
    noise = np.random.default_rng(SEED)
    seconds = (mission.dvl.stamps_ns - mission.start_ns) / NS_PER_S
    has_lock = np.ones(len(seconds), dtype=bool)
    for begin_s, end_s in GAPS_S:
        has_lock &= (seconds < begin_s) | (seconds >= end_s)
    # between the Doppler samples
    heading_ns = mission.instants(1.0)[:-1] + NS_PER_S // 7
    yaw_rad = mission.truth.at(heading_ns).rotations().as_euler("ZYX")[:, 0]
    yaw_rad = (
        yaw_rad
        + HEADING_BIAS_RAD
        + HEADING_SIGMA_RAD * noise.standard_normal(len(heading_ns))
    )
    fixes_ns = mission.instants(1.0 / FIX_PERIOD_S)[:-1]
    body = mission.truth.at(fixes_ns)
    antenna = body.positions + body.rotations().apply(ANTENNA_M)
    antenna = antenna + np.array(FIX_SIGMA_M) * noise.standard_normal(antenna.shape)
    covariances = np.tile(np.diag(np.square(FIX_SIGMA_M)), (len(fixes_ns), 1, 1))
    covariances[::2] = np.nan  # every second fix takes the noise of the calibration
    positions = PositionCalibration(sigma_m=FIX_SIGMA_M, antenna_m=ANTENNA_M)
    return replace(
        mission,
        calibration=mission.calibration.model_copy(update={"positions": positions}),
        dvl=mission.dvl.rows(has_lock),
        heading=Heading(
            heading_ns, yaw_rad, np.full(len(heading_ns), HEADING_SIGMA_RAD)
        ),
        positions=PositionFixes(fixes_ns, antenna, covariances),
    )


def basin(_: Path | None) -> Sequence:
    """Simulated basin with the default options."""
    return simulate_basin()


def basin_with_tracks(_: Path | None) -> Sequence:
    """Simulated basin in which identities come late and some are wrong or missing."""
    options = BasinOptions(
        duration_s=600.0,
        laps=1,
        tracks=True,
        wrong_id_rate=0.1,
        id_delay_s=1.0,
        anonymous_share=0.1,
    )
    return simulate_basin(options)


def mrclam(number: int, robot: int) -> Callable[[Path | None], Sequence]:
    """Reader of one robot's run."""

    def read(data: Path | None) -> Sequence:
        with recording(
            data, f"mrclam_ds{number}.tar.xz", f"MRCLAM_Dataset{number}"
        ) as folder:
            return read_mrclam(folder, robot)

    return read


def akit(number: int) -> Callable[[Path | None], Sequence]:
    """Reader of one trajectory at sea."""

    def read(data: Path | None) -> Sequence:
        with recording(data, "akit_1-7.tar.xz", "akit") as folder:
            return read_akit(folder, number)

    return read


def dlr(data: Path | None) -> Sequence:
    """Planar robot among hundreds of landmarks."""
    with recording(data, "dlr.tar.xz", "dlr") as folder:
        return read_dlr(folder)


def stpere(data: Path | None) -> Sequence:
    """Vehicle in a marina, with headings and without landmarks."""
    with recording(
        data, "stpere.tar.xz", "DVL.log"
    ) as table:  # the archive holds files without a folder
        return read_stpere(table.parent)


LOGS: dict[str, GoldenLog] = {
    "basin-tracks": GoldenLog(basin_with_tracks, 600.0),
    "mission-gaps": GoldenLog(mission_with_gaps, 600.0),
    "akit-2": GoldenLog(akit(2), 400.0),
    "akit-5": GoldenLog(akit(5), 400.0),
    "basin": GoldenLog(basin, 2039.0),
    "mrclam6-1": GoldenLog(mrclam(6, 1), 600.0),
    "mrclam6-2": GoldenLog(mrclam(6, 2), 600.0),
    "mrclam9-1": GoldenLog(mrclam(9, 1), 600.0),
    "mrclam9-2": GoldenLog(mrclam(9, 2), 600.0),
    "stpere": GoldenLog(stpere, 3345.0),
    "dlr": GoldenLog(dlr, 1000.0),
}
"""Quick ones first."""


class RunClock:
    """Processor time of a run, and lines of progress while it lasts.

    `run_estimator` calls ``step_done`` after each step of the run and not during its warm-up, so the time between the
    first and the last call holds neither compilation nor the preparation of the log.
    """

    def __init__(self, what: str) -> None:
        self._what = what
        self._first_s = math.nan
        self._last_s = math.nan
        self._noted_s = time.monotonic()

    def step_done(self, done: int, total: int) -> None:
        """Note the time."""
        self._last_s = time.process_time()
        if done == 1:
            self._first_s = self._last_s
        if time.monotonic() - self._noted_s > PROGRESS_S:
            self._noted_s = time.monotonic()
            note(f"{self._what}: step {done} of {total}")

    @property
    def steps_s(self) -> float:
        """Processor seconds of all steps but the first."""
        return self._last_s - self._first_s

    def finish_s(self) -> float:
        """Processor seconds since the last step: the smoothed trajectory, the map, and their check."""
        return time.process_time() - self._last_s


@dataclass(frozen=True)
class Place:
    """Files of one kept run."""

    folder: Path
    log: str
    estimator: str

    @property
    def arrays(self) -> Path:
        return self.folder / self.log / f"{self.estimator}.npz"

    @property
    def summary(self) -> Path:
        return self.folder / self.log / f"{self.estimator}.json"

    def is_kept(self, seconds: float) -> bool:
        """Tell whether a run over this part of the log succeeded before."""
        if not self.summary.is_file():
            return False
        summary = json.loads(self.summary.read_text("utf-8"))
        return summary["status"] == "ok" and summary["seconds"] == seconds


def keep(arguments: argparse.Namespace) -> None:
    """Run every chosen estimator on every chosen log, and keep the results."""
    note(
        f"sonar_graph: {Path(sonar_graph.__file__).parent}, baselines: {Path(str(baselines.__file__)).parent}"
    )
    for name in [name for name in LOGS if name in arguments.logs]:
        log = LOGS[name]
        seconds = min(log.seconds, QUICK_S) if arguments.quick else log.seconds
        places = [
            Place(arguments.folder, name, estimator)
            for estimator in arguments.estimators
        ]
        missing = [place for place in places if not place.is_kept(seconds)]
        if not missing:
            note(f"{name}: already kept")
            continue
        note(f"{name}: reading")
        sequence = log.read(arguments.data)
        for place in missing:
            keep_run(sequence, place, seconds)


def keep_run(sequence: Sequence, place: Place, seconds: float) -> None:
    """Run one estimator, and write its results."""
    instants = sequence.instants(RATE_HZ)
    instants = instants[instants <= sequence.start_ns + round(seconds * NS_PER_S)]
    clock = RunClock(f"{place.log} {place.estimator}")
    run = run_estimator(
        sequence,
        place.estimator,
        instants_ns=instants,
        interim_maps=False,
        progress=clock.step_done,
    )
    finish_s = clock.finish_s()
    summary: dict[str, Any] = {
        "log": place.log,
        "estimator": place.estimator,
        "status": run.status,
        "reason": run.reason,
        "seconds": seconds,
        "log_digest": digest(sequence),
        "package": str(Path(sonar_graph.__file__).parent),
        "processor_s": clock.steps_s + finish_s,
        "finish_processor_s": finish_s,
        "refused_rows": len(run.refused),
        "withheld": run.withheld,
    }
    place.summary.parent.mkdir(parents=True, exist_ok=True)
    if run.status == "ok":
        assert run.detections is not None
        scores = judge(sequence, instants, [run]).scores[run.estimator]
        for name, keys in SCORES.items():
            summary[name] = next(
                (scores[key].value for key in keys if key in scores), None
            )
        summary["outcomes"] = dict(
            sorted(Counter(outcome.name for outcome in run.detections.outcomes).items())
        )
        write_whole(
            place.arrays, lambda path: np.savez_compressed(path, **arrays_of(run))
        )
    text = json.dumps(summary, indent=1)
    # last: it marks the run as kept
    write_whole(place.summary, lambda path: path.write_text(text, "utf-8"))
    rms = summary.get("causal_rms_m")
    result = run.reason if rms is None else f"causal rms {rms:.3f} m"
    note(
        f"{place.log} {place.estimator}: {run.status} after {summary['processor_s']:.1f} s {result}"
    )


def arrays_of(run: RunResult) -> dict[str, Any]:
    """All numbers of a run that succeeded."""
    assert run.causal is not None
    assert run.smoothed is not None
    assert run.landmarks is not None
    assert run.detections is not None
    found: dict[str, Any] = {}
    for kind, trajectory in (("causal", run.causal), ("smoothed", run.smoothed)):
        for column in fields(Trajectory):
            found[f"{kind}_{column.name}"] = getattr(trajectory, column.name)
    found["map_ids"] = run.landmarks.ids
    found["map_positions"] = run.landmarks.positions
    found["map_covariances"] = run.landmarks.covariances
    found["detection_stamps_ns"] = run.detections.stamps_ns
    found["detection_ids"] = run.detections.landmark_ids
    found["detection_outcomes"] = np.array(
        [outcome.name for outcome in run.detections.outcomes], dtype=np.str_
    )
    found["update_s"] = run.update_s
    return found


def write_whole(path: Path, write: Callable[[Path], object]) -> None:
    """Write a file under another name first, so that an interrupted call leaves no half of it."""
    draft = path.with_name(f"draft-{path.name}")
    write(draft)
    draft.replace(path)


def digest(sequence: Sequence) -> str:
    """Checksum of all measurements of a log."""
    found = hashlib.sha256()
    for name, block in sorted(sequence.blocks().items()):
        found.update(name.encode())
        for column in fields(block):
            found.update(np.ascontiguousarray(getattr(block, column.name)).tobytes())
    return found.hexdigest()[:16]


class Difference(NamedTuple):
    """Largest differences between two runs of one estimator on one log."""

    causal_m: float
    causal_rad: float
    smoothed_m: float
    smoothed_rad: float
    pose_covariance: float
    map_m: float
    map_covariance: float
    outcomes: int


def compare(arguments: argparse.Namespace) -> None:
    """Print the differences between two folders; exit code 1 when one exceeds the tolerance."""
    tolerance: float = arguments.tolerance
    rows: list[tuple[object, ...]] = []
    faults: list[str] = []
    for old, new in pairs(arguments, faults):
        what = f"{old.log} {old.estimator}"
        before = json.loads(old.summary.read_text("utf-8"))
        after = json.loads(new.summary.read_text("utf-8"))
        if before["log_digest"] != after["log_digest"]:
            faults.append(
                f"{what}: the two logs differ, so the difference of the results means nothing"
            )
        if "failed" in (before["status"], after["status"]):
            faults.append(
                f"{what}: {before['status']} {before['reason']} -> {after['status']} {after['reason']}"
            )
            continue
        difference = difference_of(load(old.arrays), load(new.arrays))
        largest = max(difference)
        if not largest <= tolerance:
            faults.append(f"{what}: differs by {largest:.1e}")
        rows.append((what, *map(shown, difference), *score_changes(before, after)))
    headers = (
        *(
            "",
            "causal m",
            "rad",
            "smoothed m",
            "rad",
            "pose cov",
            "map m",
            "map cov",
            "outcomes",
        ),
        *("causal rms m", "change", "smoothed rms m", "change", "map rms m", "change"),
        *(
            "NEES causal position",
            "heading",
            "smoothed position",
            "heading",
            "time s",
            "ratio",
        ),
    )
    print_table(headers, rows)
    for fault in faults:
        print(fault)
    print(
        f"{len(rows)} runs compared, tolerance {tolerance:g}: {'NOT EQUAL' if faults else 'equal'}"
    )
    raise SystemExit(1 if faults or not rows else 0)


def pairs(
    arguments: argparse.Namespace, faults: list[str]
) -> Iterator[tuple[Place, Place]]:
    """Runs that the new folder holds, with those of the old one; what has no partner is a fault."""
    kept = [
        (log, estimator)
        for log in LOGS
        for estimator in ESTIMATORS
        if log in arguments.logs and estimator in arguments.estimators
    ]
    for log, estimator in kept:
        old = Place(arguments.old, log, estimator)
        new = Place(arguments.new, log, estimator)
        if old.summary.is_file() and new.summary.is_file():
            yield old, new
        elif new.summary.is_file():
            faults.append(f"{log} {estimator}: only in {arguments.new}")
        elif old.summary.is_file():
            note(f"{log} {estimator}: not run in {arguments.new}, left out")


def load(path: Path) -> dict[str, Any]:
    """Arrays of a kept run."""
    with np.load(path) as content:
        return dict(content)


def difference_of(old: dict[str, Any], new: dict[str, Any]) -> Difference:
    """Largest differences between the arrays of two runs."""
    causal_m, causal_rad = pose_difference(old, new, "causal")
    smoothed_m, smoothed_rad = pose_difference(old, new, "smoothed")
    covariances = [
        relative_difference(old[f"{kind}_covariances"], new[f"{kind}_covariances"])
        for kind in ("causal", "smoothed")
    ]
    map_m = math.inf
    if np.array_equal(old["map_ids"], new["map_ids"]):
        distances = np.linalg.norm(new["map_positions"] - old["map_positions"], axis=1)
        map_m = float(distances.max(initial=0.0))
    map_covariance = relative_difference(old["map_covariances"], new["map_covariances"])
    outcomes = changed_outcomes(old, new)
    return Difference(
        causal_m,
        causal_rad,
        smoothed_m,
        smoothed_rad,
        max(covariances),
        map_m,
        map_covariance,
        outcomes,
    )


def pose_difference(
    old: dict[str, Any], new: dict[str, Any], kind: str
) -> tuple[float, float]:
    """Largest distance and angle between the poses of two trajectories; infinite at different stamps."""
    if not np.array_equal(old[f"{kind}_stamps_ns"], new[f"{kind}_stamps_ns"]):
        return math.inf, math.inf
    distances = np.linalg.norm(
        new[f"{kind}_positions"] - old[f"{kind}_positions"], axis=1
    )
    before = Rotation.from_quat(old[f"{kind}_quaternions_xyzw"])
    after = Rotation.from_quat(new[f"{kind}_quaternions_xyzw"])
    angles = (before.inv() * after).magnitude()
    return float(distances.max(initial=0.0)), float(angles.max(initial=0.0))


def relative_difference(old: Floats, new: Floats) -> float:
    """Largest ``|P_new - P_old|_ij / sqrt(P_old,ii P_old,jj)`` of covariances of shape (n, d, d)."""
    if old.shape != new.shape or not np.array_equal(np.isnan(old), np.isnan(new)):
        return math.inf
    sigmas = np.sqrt(np.maximum(np.einsum("nii->ni", old), 0.0))
    scale = sigmas[:, :, None] * sigmas[:, None, :]
    change = np.abs(new - old)
    is_known = scale > 0  # a variance of zero has no scale
    return float((change[is_known] / scale[is_known]).max(initial=0.0))


def changed_outcomes(old: dict[str, Any], new: dict[str, Any]) -> int:
    """Number of detections with another outcome, whatever the order of the rows."""
    counts = [
        Counter(
            zip(
                run["detection_stamps_ns"].tolist(),
                run["detection_ids"].tolist(),
                run["detection_outcomes"].tolist(),
                strict=True,
            )
        )
        for run in (old, new)
    ]
    lost = counts[0] - counts[1]
    added = counts[1] - counts[0]
    return max(lost.total(), added.total())


def score_changes(before: dict[str, Any], after: dict[str, Any]) -> list[str]:
    """Cells of the table for the scores and the time."""
    cells = []
    for name in ("causal_rms_m", "smoothed_rms_m", "map_rms_m"):
        old, new = before[name], after[name]
        if old is None or new is None:
            cells += ["-", "-"]
        else:
            cells += [f"{new:.4f}", f"{new / old - 1.0:+.2%}"]
    for name in (
        "causal_position_nees",
        "causal_heading_nees",
        "smoothed_position_nees",
        "smoothed_heading_nees",
    ):
        old, new = before[name], after[name]
        cells.append("-" if old is None or new is None else f"{old:.3g} -> {new:.3g}")
    cells.append(f"{after['processor_s']:.2f}")
    cells.append(f"{after['processor_s'] / before['processor_s']:.2f}")
    return cells


def shown(value: float) -> str:
    """A difference as a cell of the table."""
    return (
        "0" if value == 0 else str(value) if isinstance(value, int) else f"{value:.1e}"
    )


@contextmanager
def stopped_politely() -> Iterator[None]:
    """End with one line where the user interrupts."""
    try:
        yield
    except KeyboardInterrupt:
        note("interrupted; the same command continues with the runs that are missing")
        raise SystemExit(130) from None


def names(known: tuple[str, ...]) -> Callable[[str], str]:
    """Check of a name on the command line."""

    def check(name: str) -> str:
        if name not in known:
            raise argparse.ArgumentTypeError(f"{name!r} is none of {', '.join(known)}")
        return name

    return check


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    commands = parser.add_subparsers(dest="command", required=True)
    keeping = commands.add_parser(
        "keep", parents=[make_parser("", data=True)], add_help=False
    )
    keeping.add_argument("folder", type=Path)
    comparing = commands.add_parser("compare")
    comparing.add_argument("old", type=Path)
    comparing.add_argument("new", type=Path)
    comparing.add_argument(
        "--tolerance",
        type=float,
        default=1e-9,
        help="largest difference that counts as equal",
    )
    for command in (keeping, comparing):
        command.add_argument(
            "--logs",
            nargs="+",
            type=names(tuple(LOGS)),
            default=list(LOGS),
            metavar="NAME",
        )
        command.add_argument(
            "--estimators",
            nargs="+",
            type=names(ESTIMATORS),
            default=ESTIMATORS,
            metavar="NAME",
        )
    arguments = parser.parse_args()
    with stopped_politely():
        if arguments.command == "keep":
            keep(arguments)
            return
        for folder in (arguments.old, arguments.new):
            if not folder.is_dir():
                refuse(
                    f"{folder} is not a folder; make one with: golden.py keep FOLDER"
                )
        compare(arguments)


if __name__ == "__main__":
    main()
