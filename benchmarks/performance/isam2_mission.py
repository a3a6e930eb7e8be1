"""Speed of our incremental smoother beside the plain use of gtsam.ISAM2, on the same long mission.

All get the same preintegrated odometry, depth and sightings, as the same kinds of factors. The plain use: ISAM2 as it
comes (its defaults), every frame with detections a keyframe, the newest pose asked after each update. Ours is the
estimator as users get it, with its causal covariance after each frame, its kernel, gravity and bias. Two plain uses:

* ``plain``: without a gyro bias, so that all its factors are GTSAM's own. The cheapest, of a smaller problem.
* ``plain, bias``: the same graph with the gyro bias in it, as ours has.

Only time inside the estimators counts, that of this process's CPU and of the clock. They take turns of 100 frames, so
that a busy machine slows all alike; with turns of a single frame each would begin with the others' data in the
processor's caches, which no user's run does.
"""

import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, L, X

sys.path.append(str(Path(__file__).resolve().parents[1]))
from common import conclude, make_parser, note, print_table

from sonar_graph.calibration import Calibration
from sonar_graph.measurements import LandmarkDetections, Measurements
from sonar_graph.models import (
    BIASES,
    bias_sigmas,
    by_biases,
    elevation_on_floor,
    locate,
)
from sonar_graph.navigation import Odometry, PreintegratedMotion
from sonar_graph.sequence import Sequence
from sonar_graph.simulation import MissionOptions, simulate_mission
from sonar_graph.slam import factors
from sonar_graph.slam.isam2 import Isam2
from sonar_graph.slam.odometry_factor import OdometryWithBias
from sonar_graph.states import Estimate

FRAME_RATE_HZ = 2.0
TURN = 100
"""Frames."""
NO_BIAS = np.zeros(3)
TARGETS = {"plain_ratio": 0.15, "p99_ms": 5.0, "decile_ratio": 1.5}


@dataclass
class Stopwatch:
    """Durations of successive calls, seconds."""

    wall_s: list[float] = field(default_factory=list)
    cpu_s: list[float] = field(default_factory=list)

    def __enter__(self) -> None:
        self._wall, self._cpu = time.perf_counter(), time.thread_time()

    def __exit__(self, *_: object) -> None:
        self.cpu_s.append(time.thread_time() - self._cpu)
        self.wall_s.append(time.perf_counter() - self._wall)


class PlainIsam2:
    """Plain use as in GTSAM's examples: a pose and an update a frame, and the newest pose asked.

    The gyro bias is not estimated: a native BetweenFactorPose3 has no place for it.
    """

    def __init__(self, calibration: Calibration) -> None:
        self._calibration = calibration
        self._odometry = Odometry(calibration)
        self._isam = gtsam.ISAM2()
        self._body_T_sonar = calibration.sonar.mounting.pose()
        self._graph, self._values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self._node_ns: int | None = None
        self._index = 0
        self._pose = calibration.start.pose()
        self._seen: set[int] = set()

    def process(self, measurements: Measurements) -> gtsam.Pose3:
        """Take in measurements that end with a frame; the newest pose."""
        self._odometry.add(measurements.imu, measurements.dvl)
        if self._node_ns is None:
            self._start(measurements.end_ns)
        if self._node_ns is not None and measurements.detections is not None:
            frame_ns = int(measurements.detections.stamps_ns[-1])
            nodes = self._odometry.epochs(self._node_ns, frame_ns)
            if len(nodes):
                self._add_pose(int(nodes[-1]), measurements)
            self._add_sightings(measurements.detections)
            self._isam.update(self._graph, self._values)
            self._graph, self._values = gtsam.NonlinearFactorGraph(), gtsam.Values()
            self._pose = self._isam.calculateEstimatePose3(X(self._index))
        return self._pose

    def _start(self, until_ns: int) -> None:
        self._node_ns = self._odometry.start_by(until_ns)
        if self._node_ns is None:
            return
        self._values.insert(X(0), self._pose)
        self._graph.push_back(factors.start_prior(X(0), self._calibration))

    def _add_pose(self, node_ns: int, measurements: Measurements) -> None:
        motion = self._odometry.motion(
            self._node_ns, node_ns, NO_BIAS, known_ns=measurements.end_ns
        )
        self._pose = self._pose.compose(motion.i_T_j)
        self._graph.push_back(self._odometry_factor(motion))
        self._index += 1
        self._values.insert(X(self._index), self._pose)
        self._node_ns = node_ns
        self._odometry.forget_before(node_ns)
        depth = measurements.depth.between(0, node_ns) if measurements.depth else None
        if depth is not None:
            port, sigma_m = (
                np.array(self._calibration.depth.port_m),
                self._calibration.depth.sigma_m,
            )
            self._graph.push_back(
                factors.depth(X(self._index), float(depth.z_m[-1]), port, sigma_m)
            )

    def _odometry_factor(self, motion: PreintegratedMotion) -> gtsam.NonlinearFactor:
        return factors.odometry(X(self._index), X(self._index + 1), motion)

    def _add_sightings(self, detections: LandmarkDetections) -> None:
        motion = self._odometry.motion(
            self._node_ns, int(detections.stamps_ns[-1]), NO_BIAS
        )
        body_T_sonar = motion.i_T_j.compose(self._body_T_sonar)
        ids, probabilities = detections.most_probable()
        for row in np.flatnonzero(probabilities > 0.7).tolist():
            z = np.array([detections.range_m[row], detections.azimuth_rad[row]])
            self._sight(
                int(ids[row]), body_T_sonar, z, detections.range_azimuth_cov[row]
            )

    def _sight(
        self, landmark: int, body_T_sonar: gtsam.Pose3, z: np.ndarray, cov: np.ndarray
    ) -> None:
        key, floor = L(landmark), self._calibration.floor
        if landmark not in self._seen:
            self._seen.add(landmark)
            world_T_sonar = self._pose.compose(body_T_sonar)
            aperture = self._calibration.sonar.elevation_aperture_rad
            elevation = (
                elevation_on_floor(world_T_sonar, z[0], z[1], floor.z_m, aperture)
                if floor
                else None
            )
            self._values.insert(
                key, locate(world_T_sonar, z[0], z[1], elevation or 0.0)
            )
            if floor:
                self._graph.push_back(
                    factors.floor_prior(key, floor.z_m, floor.sigma_m)
                )
        made = factors.landmark_sighting(
            X(self._index), key, body_T_sonar, z, cov, lambda noise: noise
        )
        for factor in made.values():
            self._graph.push_back(factor)


class PlainIsam2WithBias(PlainIsam2):
    """The same with one set of biases for the whole run."""

    def _start(self, until_ns: int) -> None:
        super()._start(until_ns)
        if self._node_ns is None:
            return
        self._values.insert(B(0), np.zeros(BIASES))
        self._graph.push_back(
            factors.bias_prior(B(0), bias_sigmas(self._calibration)[0])
        )

    def _odometry_factor(self, motion: PreintegratedMotion) -> gtsam.NonlinearFactor:
        dR, dp = motion.i_T_j.rotation().matrix(), motion.i_T_j.translation()
        up = (self._pose.rotation().matrix() @ dR.T)[2]
        body_p_dvl = np.array(self._calibration.dvl.mounting.translation_m)
        D = by_biases(motion.D_bias, dR, dp, up, up, body_p_dvl)
        motion = replace(motion, D_bias=D, bias=np.zeros(BIASES))
        return OdometryWithBias(X(self._index), X(self._index + 1), B(0), motion)


def frame_instants(sequence: Sequence) -> np.ndarray:
    """Stamps of the frames with detections, and the end of the run."""
    assert sequence.detections is not None
    stamps = np.unique(sequence.detections.stamps_ns)
    return np.append(stamps[stamps < sequence.end_ns], sequence.end_ns)


@dataclass(frozen=True)
class Race:
    """Results of all contestants over one mission."""

    clocks: dict[str, Stopwatch]
    """Of every frame, by runner."""
    finish: Stopwatch
    """Of our smoothed trajectory at the end."""
    error_m: dict[str, float]
    """Rms of the causal horizontal error, by runner."""


def race(sequence: Sequence) -> Race:
    """All runners over one mission, in turns."""
    instants = frame_instants(sequence)
    ours = Isam2(sequence.calibration, Odometry(sequence.calibration))
    runners: dict[str, Callable[[Measurements], gtsam.Pose3 | None]] = {
        "ours": lambda step: pose_of(ours.process(step)),
        "plain": PlainIsam2(sequence.calibration).process,
        "plain, bias": PlainIsam2WithBias(sequence.calibration).process,
    }
    clocks = {name: Stopwatch() for name in runners}
    positions: dict[str, list[np.ndarray]] = {name: [] for name in runners}
    for turn, steps in enumerate(batched(sequence.replay(instants), TURN), start=1):
        for name, process in runners.items():
            for step in steps:
                with clocks[name]:
                    pose = process(step)
                positions[name].append(
                    pose.translation() if pose else np.full(3, np.nan)
                )
        note(f"{min(turn * TURN, len(instants))} of {len(instants)} frames")
    finish = Stopwatch()
    with finish:
        ours.trajectory()
    truth = (
        sequence.truth.at(instants).positions
        if sequence.truth
        else np.full((len(instants), 3), np.nan)
    )
    error_m = {
        name: float(
            np.sqrt(np.nanmean(np.sum((np.array(said) - truth)[:, :2] ** 2, axis=1)))
        )
        for name, said in positions.items()
    }
    return Race(clocks, finish, error_m)


def batched(steps: Iterator[Measurements], size: int) -> Iterator[list[Measurements]]:
    """Lists of at most this many."""
    while batch := list(islice(steps, size)):
        yield batch


def pose_of(estimate: Estimate | None) -> gtsam.Pose3 | None:
    """Positions of the body, where there is an estimate."""
    return estimate.world_T_body if estimate else None


def report(result: Race) -> dict[str, float | int | bool]:
    """Print the table; the figures by name."""
    rows = []
    for name, clock in result.clocks.items():
        cpu_ms, wall_ms = np.array(clock.cpu_s) * 1e3, np.array(clock.wall_s) * 1e3
        rows.append(
            (
                name,
                float(cpu_ms.sum() / 1e3),
                float(wall_ms.sum() / 1e3),
                float(np.median(wall_ms)),
                float(np.quantile(wall_ms, 0.99)),
                float(wall_ms.max()),
                decile_ratio(cpu_ms),
                result.error_m[name],
            )
        )
    print_table(
        (
            "",
            "CPU s",
            "clock s",
            "median ms",
            "p99 ms",
            "max ms",
            "last/first tenth",
            "error m",
        ),
        rows,
    )
    print(
        f"smoothed trajectory of the whole mission, asked once at the end: {result.finish.wall_s[0]:.2f} s\n"
    )
    ours, plain, with_bias = (
        result.clocks[name] for name in ("ours", "plain", "plain, bias")
    )
    figures: dict[str, float | int | bool] = {
        "plain_ratio": sum(ours.cpu_s) / sum(plain.cpu_s),
        "plain_with_bias_ratio": sum(ours.cpu_s) / sum(with_bias.cpu_s),
        "plain_ratio_with_finish": (sum(ours.cpu_s) + sum(result.finish.cpu_s))
        / sum(plain.cpu_s),
        "p99_ms": rows[0][4],
        "p99_cpu_ms": float(np.quantile(np.array(ours.cpu_s) * 1e3, 0.99)),
        "decile_ratio": rows[0][6],
        "ours_s": sum(ours.cpu_s),
        "plain_s": sum(plain.cpu_s),
        "finish_s": sum(result.finish.cpu_s),
        "ours_median_ms": rows[0][3],
        "plain_median_ms": rows[1][3],
        "ours_error_m": result.error_m["ours"],
        "plain_error_m": result.error_m["plain"],
        "frames": len(ours.cpu_s),
    }
    plain_p99_ms = float(np.quantile(np.array(plain.cpu_s) * 1e3, 0.99))
    figures["p99_ratio"] = figures["p99_cpu_ms"] / plain_p99_ms
    figures["passed"] = all(figures[name] <= limit for name, limit in TARGETS.items())
    return figures


def decile_ratio(durations: np.ndarray) -> float:
    """Sum of the last tenth over that of the first."""
    tenth = max(len(durations) // 10, 1)
    return float(durations[-tenth:].sum() / durations[:tenth].sum())


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument(
        "--landmarks",
        type=int,
        default=20,
        help="the targets are stated for at most 20",
    )
    arguments = parser.parse_args()
    duration_s = 120.0 if arguments.quick else 2040.0
    note("warming up: compiled functions load at their first use")
    race(simulate_mission(MissionOptions(duration_s=20.0)))
    options = MissionOptions(
        duration_s=duration_s,
        landmarks=arguments.landmarks,
        frame_rate_hz=FRAME_RATE_HZ,
    )
    figures = report(race(simulate_mission(options)))
    for name, limit in TARGETS.items():
        print(f"{name}: {figures[name]:.3f}, target at most {limit:g}")
    conclude(
        {"duration_s": duration_s, "landmarks": arguments.landmarks, **figures},
        is_quick=arguments.quick,
    )


if __name__ == "__main__":
    main()
