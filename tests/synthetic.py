"""A comparison as a basin run would leave it, made without any estimator: truth, drifting paths, maps, scores."""

from dataclasses import replace

import numpy as np
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import Calibration, PlanarMotion, Start
from sonar_graph.evaluation import Comparison, RunResult, Score, judge
from sonar_graph.measurements import Dvl, Floats, Imu, Ints, LandmarkDetections
from sonar_graph.sequence import Sequence
from sonar_graph.states import (
    DetectionLog,
    LandmarkMap,
    Outcome,
    Refusal,
    RefusedRow,
    Trajectory,
)

STEP_NS = 500_000_000
CORNERS = np.array([[0.0, 0.0], [6.5, 0.0], [6.5, -6.5], [0.0, -6.5], [0.0, 0.0]])
LANDMARKS = np.array(
    [[5.0, 0.9, -1.0], [7.4, -5.0, -1.0], [2.0, -7.3, -1.0], [-0.9, -2.0, -1.0]]
)
IDS = np.array([1, 2, 3, 4])
REFUSALS = [Outcome.GATED, Outcome.NO_IDENTITY, Outcome.LATE, Outcome.UNLOCATED]
SIGMAS = np.array([0.02, 0.009])


def basin_comparison(
    instants: int = 240, *, planar: bool = True, truth: bool = True
) -> Comparison:
    """Three runs on three laps of a basin at 2 Hz: a smoother, a filter that believes too much, a dead reckoning."""
    rng = np.random.default_rng(7)
    stamps = (
        1_700_000_000_000_000_000 + np.arange(1, instants + 1, dtype=np.int64) * STEP_NS
    )
    path = _laps(stamps, planar)
    runs = [
        _run(rng, "isam2", path, wander_m=0.05, sigma_m=0.05, smoothed_m=0.02),
        _run(rng, "ekf-slam", path, wander_m=0.16, sigma_m=0.06, smoothed_m=None),
        replace(
            _run(rng, "dead-reckoning", path, 0.9, 1.0, None),
            landmarks=None,
            detections=None,
        ),
    ]
    return judge(_sequence(stamps, path if truth else None, planar), stamps, runs)


def with_failure(comparison: Comparison, name: str, reason: str) -> Comparison:
    """The same comparison, had one run failed."""
    failed = RunResult(name, {"gate": 0.99}, "failed", reason)
    others = only(comparison, *(comparison.errors.keys() - {name}))
    scores = {**comparison.scores, name: {}}
    return replace(with_run(comparison, failed), scores=scores, errors=others.errors)


def only(comparison: Comparison, *names: str) -> Comparison:
    """The same comparison with only some runs."""
    return replace(
        comparison,
        runs=[run for run in comparison.runs if run.estimator in names],
        scores={name: comparison.scores[name] for name in names},
        errors={
            name: comparison.errors[name] for name in names if name in comparison.errors
        },
    )


def with_score(comparison: Comparison, name: str, key: str, score: Score) -> Comparison:
    """The same comparison with one score set."""
    return replace(
        comparison,
        scores={**comparison.scores, name: {**comparison.scores[name], key: score}},
    )


def with_run(comparison: Comparison, run: RunResult) -> Comparison:
    """The same comparison with the run of that name replaced."""
    return replace(
        comparison,
        runs=[
            run if own.estimator == run.estimator else own for own in comparison.runs
        ],
    )


def outlier(stamp_ns: int, distance: float = 100.0) -> RefusedRow:
    """A refused velocity."""
    return RefusedRow("dvl", stamp_ns, Refusal.OUTLIER, distance)


def late(stamp_ns: int) -> RefusedRow:
    """A row of the IMU that came too late."""
    return RefusedRow("imu", stamp_ns, Refusal.LATE, np.nan)


def refusing(refused: list[RefusedRow], *names: str) -> Comparison:
    """A comparison, had some runs refused these rows."""
    comparison = basin_comparison(60)
    for run in comparison.runs:
        if run.estimator in names:
            comparison = with_run(comparison, replace(run, refused=refused))
    return comparison


def _sequence(stamps: Ints, truth: Trajectory | None, planar: bool) -> Sequence:
    ends = np.array([stamps[0] - STEP_NS, stamps[-1]])
    n = len(stamps)
    return Sequence(
        name="basin-three-laps",
        calibration=Calibration(
            start=Start(), planar=PlanarMotion() if planar else None
        ),
        imu=Imu(ends, np.zeros((2, 3)), np.zeros((2, 3))),
        dvl=Dvl(ends, np.zeros((2, 3)), np.zeros((2, 3, 3))),
        detections=LandmarkDetections(
            stamps,
            np.ones(n),
            np.zeros(n),
            np.full((n, 2, 2), np.nan),
            np.ones((n, 1), dtype=np.int64),
            np.ones((n, 1)),
        ),
        truth=truth,
        true_landmarks=LandmarkMap(IDS, LANDMARKS, np.full((4, 3, 3), np.nan))
        if truth
        else None,
        notes={"source": "synthetic"},
    )


def _laps(stamps: Ints, planar: bool) -> Trajectory:
    along = np.linspace(0, 3 * 4 * 0.999, len(stamps)) % 4
    side = along.astype(int)
    start = CORNERS[side]
    step = CORNERS[side + 1] - CORNERS[side]
    xy = start + (along - side)[:, None] * step
    z = np.zeros(len(stamps)) if planar else 0.2 * np.sin(along)
    return Trajectory.without_covariances(
        stamps, np.column_stack([xy, z]), _turned(np.arctan2(step[:, 1], step[:, 0]))
    )


def _turned(yaw: Floats) -> Floats:
    return np.asarray(Rotation.from_euler("z", yaw[:, None]).as_quat())


def _disturbed(
    rng: np.random.Generator, path: Trajectory, wander_m: float, sigma_m: float
) -> Trajectory:
    """The path with slowly varying errors of standard deviation ``wander_m``, reported as ``sigma_m``."""
    n = len(path)
    memory = 0.995
    slow = wander_m * lfilter(
        [1], [1, -memory], rng.normal(0, np.sqrt(1 - memory**2), (n, 4)), axis=0
    )
    slow[:, 2] *= 0.1
    yaw = path.rotations().as_euler("zyx")[:, 0] + 0.15 * slow[:, 3]
    deviations = np.array([1e-3, 1e-3, 0.15 * sigma_m, sigma_m, sigma_m, 0.1 * sigma_m])
    growing = np.linspace(0.3, 1.7, n)[:, None, None]
    covariances = growing * np.tile(np.diag(deviations**2), (n, 1, 1))
    return Trajectory(
        path.stamps_ns, path.positions + slow[:, :3], _turned(yaw), covariances
    )


def _run(
    rng: np.random.Generator,
    name: str,
    path: Trajectory,
    wander_m: float,
    sigma_m: float,
    smoothed_m: float | None,
) -> RunResult:
    causal = _disturbed(rng, path, wander_m, sigma_m)
    shape = np.array([[1.0, 0.4, 0.0], [0.4, 0.7, 0.0], [0.0, 0.0, 0.5]])
    points = LANDMARKS + rng.normal(0, wander_m, LANDMARKS.shape)
    return RunResult(
        estimator=name,
        params={"gate_probability": 0.99, "robust": {"kernel": "huber", "k": 1.345}},
        status="ok",
        causal=causal,
        smoothed=causal
        if smoothed_m is None
        else _disturbed(rng, path, smoothed_m, smoothed_m),
        landmarks=LandmarkMap(IDS, points, np.tile(sigma_m**2 * shape, (4, 1, 1))),
        detections=_detections(rng, path.stamps_ns),
        update_s=rng.lognormal(np.log(4e-4), 0.5, len(path)),
        finish_s=0.12,
        peak_memory_mb=41.0,
    )


def _detections(rng: np.random.Generator, stamps: Ints) -> DetectionLog:
    n = len(stamps)
    outcomes = [Outcome.NEW] * 4 + [Outcome.USED] * (n - 4)
    for number, refusal in enumerate(REFUSALS):
        for row in range(10 + 7 * number, n, 60):
            outcomes[row] = refusal
    innovations = rng.normal(0, SIGMAS, (n, 2))
    innovations[[outcome is Outcome.GATED for outcome in outcomes]] *= 6
    innovations[:4] = np.nan
    return DetectionLog(
        stamps,
        rng.integers(1, 5, n),
        innovations,
        np.tile(np.diag(SIGMAS**2), (n, 1, 1)),
        outcomes,
    )
