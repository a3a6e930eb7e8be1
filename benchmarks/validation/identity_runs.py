"""One basin with late and wrong identities, run by every estimator; each run is kept in a file once it is done."""

import hashlib
import json
import os
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

import baselines
import sonar_graph
from sonar_graph.evaluation import (
    Comparison,
    ErrorSeries,
    RunResult,
    judge,
    landmark_errors,
    rmse,
    run_estimator,
)
from sonar_graph.simulation import BasinOptions, simulate_basin
from sonar_graph.states import LandmarkMap

ESTIMATORS: dict[str, tuple[str, dict[str, Any]]] = {
    "dead reckoning": ("dead-reckoning", {}),
    "EKF-SLAM": ("ekf-slam", {}),
    "invariant EKF": ("invariant-ekf", {}),
    "iSAM2, gate": (
        "isam2",
        {
            "identity": {"policy": "gate", "longest_wait_s": 0},
            "kernel": {"shape": "none"},
        },
    ),
    "iSAM2, robust": ("isam2", {"identity": {"longest_wait_s": 0}}),
    "iSAM2, deferred": ("isam2", {}),
    "iSAM2, max-mixture": ("isam2", {"identity": {"policy": "max-mixture"}}),
}
"""By the name in the table: entry point and settings."""
LOST_M = 1.0
"""A run whose smoothed trajectory is farther off than this (rms) is lost: of no use in a basin of 20 by 14 m."""
RATE_HZ = 0.5
DURATION_S, FRAME_RATE_HZ = 1000.0, 2.0
"""Of the three laps; they take 728 s without hovering."""
SETTLING_S = 60.0
"""Instants before this are not judged: the start is known."""


@dataclass(frozen=True)
class Case:
    """Faults of the identities and of the gyro."""

    wrong_id_rate: float
    id_delay_s: float = 0.0
    gyro_bias_scale: float = 1.0
    wrong_id_share: float = 0.5
    tracks: bool = True

    @property
    def name(self) -> str:
        """Name in tables."""
        kind = "corrected halfway" if self.wrong_id_share < 1 else "never corrected"
        kind = kind if self.tracks else "frame by frame"
        return f"delay {self.id_delay_s:g} s, bias {self.gyro_bias_scale:g}, {kind}"

    def options(self, seed: int, *, is_quick: bool) -> BasinOptions:
        """Options of the simulated basin: less hovering and fewer frames, to afford thousands of runs."""
        route: dict[str, Any] = (
            {"duration_s": 240.0, "laps": 1} if is_quick else {"duration_s": DURATION_S}
        )
        return BasinOptions(
            seed=seed, frame_rate_hz=FRAME_RATE_HZ, **route, **asdict(self)
        )


@dataclass(frozen=True)
class Judged:
    """The figures of one estimator in one run; None where it has none."""

    status: str
    reason: str
    causal_m: float | None
    """Horizontal rms of the causal trajectory after settling, not aligned."""
    smoothed_m: float | None
    landmarks_m: float | None
    """Horizontal rms of all landmarks that were found, not aligned."""
    landmarks: int
    causal_nees: dict[str, float] | None
    """Mean over time after settling, by quantity, per degree of freedom."""
    final_nees: dict[str, float] | None
    """At the last instant."""
    smoothed_nees: dict[str, float] | None

    @property
    def is_lost(self) -> bool:
        """Failure of the run: no result, or a useless one."""
        return self.smoothed_m is None or self.smoothed_m > LOST_M


@dataclass(frozen=True)
class Job:
    """A run to be done."""

    case: Case
    seed: int
    is_quick: bool
    folder: Path | None
    """Where runs that are done are kept; None: nowhere."""

    def __str__(self) -> str:
        return (
            f"{self.case.wrong_id_rate:.0%} wrong, {self.case.name}, seed {self.seed}"
        )

    def file(self, estimator: str) -> Path | None:
        """File of one estimator's figures; another version of the code has other files."""
        if self.folder is None:
            return None
        name, params = ESTIMATORS[estimator]
        key = json.dumps(
            [
                asdict(self.case),
                self.seed,
                self.is_quick,
                name,
                params,
                source_version(),
            ]
        )
        return self.folder / f"{hashlib.sha256(key.encode()).hexdigest()[:24]}.json"


def source_version() -> str:
    """A hash of all that a run's result depends on."""
    roots = [Path(str(package.__file__)).parent for package in (sonar_graph, baselines)]
    files = [
        (path.relative_to(root.parent), path)
        for root in roots
        for path in root.rglob("*.py")
    ]
    digest = hashlib.sha256(Path(__file__).read_bytes())
    for name, path in sorted(files):
        digest.update(str(name).encode() + path.read_bytes())
    return digest.hexdigest()


def run_job(job: Job) -> dict[str, Judged]:
    """Every estimator on the same detections; those that are kept already are read instead."""
    files = {name: job.file(name) for name in ESTIMATORS}
    judged = {
        name: _read(file)
        for name, file in files.items()
        if file is not None and file.exists()
    }
    missing = [name for name in ESTIMATORS if name not in judged]
    if missing:
        sequence = simulate_basin(job.case.options(job.seed, is_quick=job.is_quick))
        instants_ns = sequence.instants(RATE_HZ)
        for name in missing:
            run = run_estimator(
                sequence, *ESTIMATORS[name], instants_ns=instants_ns, interim_maps=False
            )
            judged[name] = _judged(
                run, judge(sequence, instants_ns, [run]), sequence.true_landmarks
            )
            _write(files[name], judged[name])
    return judged


def _judged(
    run: RunResult, comparison: Comparison, true_landmarks: LandmarkMap
) -> Judged:
    if run.status == "failed" or run.landmarks is None:
        return Judged("failed", run.reason, None, None, None, 0, None, None, None)
    errors = comparison.errors[run.estimator]
    causal, smoothed = (_settled(errors[kind]) for kind in ("causal", "smoothed"))
    found = landmark_errors(run.landmarks, true_landmarks)
    return Judged(
        status="ok",
        reason="",
        causal_m=rmse(causal.position_m[:, :2]),
        smoothed_m=rmse(smoothed.position_m[:, :2]),
        landmarks_m=rmse(found.horizontal_m) if len(found) else None,
        landmarks=len(found),
        causal_nees=_nees(causal, slice(None)),
        final_nees=_nees(causal, slice(-1, None)),
        smoothed_nees=_nees(smoothed, slice(None)),
    )


def _settled(series: ErrorSeries) -> ErrorSeries:
    """Without the first instants, at which the start is still known."""
    kept = series.stamps_ns >= series.stamps_ns[0] + int(SETTLING_S * 1e9)
    rows = {
        f.name: rows[kept]
        for f in fields(series)
        if isinstance(rows := getattr(series, f.name), np.ndarray)
    }
    return replace(series, **rows)


def _nees(series: ErrorSeries, at: slice) -> dict[str, float]:
    return {
        "position": float(series.nees_position[at].mean() / series.position_dof),
        "yaw": float(series.nees_yaw[at].mean()),
    }


def _read(file: Path) -> Judged:
    return Judged(**json.loads(file.read_text()))


def _write(file: Path | None, judged: Judged) -> None:
    """All of it or nothing, so that a run that is interrupted leaves no half of a file."""
    if file is None:
        return
    file.parent.mkdir(parents=True, exist_ok=True)
    unfinished = file.with_suffix(f".{os.getpid()}")
    unfinished.write_text(json.dumps(asdict(judged)))
    unfinished.replace(file)
