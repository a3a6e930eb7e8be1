"""Smoothing of dense and long logs: time of each update, of the last solution, and nearness to the batch.

The smoother with its defaults, asked after every frame, on

* MRCLAM sets 6 and 9: planar robots that see 15 landmarks thousands of times, after much drift;
* the DLR building: 3298 steps past 576 landmarks;
* a synthetic survey of 1000 landmarks at 2 Hz, lane after lane: sighted a few times each, and again a lane later.

Of each log one line of JSON:

* ``max_update_ms``, ``p99_ms``: of single calls of `Isam2.process`, by this thread's processor time, so that what else
  the machine does does not count (``max_wall_ms`` does); the mission before the first log loads what is compiled, and
  what is there after it is frozen (`gc.freeze`), as a live program should: else Python's collector walks over all
  modules in some updates;
* ``finish_s``: the batch solution at the end with all landmarks' covariances, processor time;
* ``landmark_gap_m``: largest horizontal distance of a landmark between the live estimate and the minimum to which it
  descends (above or below the plane of a planar robot is the same to its sonar), and ``gap_sigmas``, the largest of
  these over their standard deviation at that minimum: most landmarks of the survey are known to decimetres only;
* ``sigma_ratio``: largest ratio, or its inverse, of live standard deviations to those of ``gtsam.Marginals`` at that
  minimum: the newest keyframe's horizontal position and yaw, and the landmarks' horizontal position;
* ``other_minimum``: landmarks that the batch solution puts more than the target of ``landmark_gap_m`` away from that
  minimum, with the distance, and by how much the error of the graph, half a sum of squares, is lower there. Sightings
  that contradict each other give a robust kernel several minima. iSAM2 stays in the one of the first sighting; the
  batch solution starts such a landmark again at the median of its sightings, and keeps the lower one. They count
  apart because a descent from the live estimate does not reach that one either. ``other_minimum_at_tenths_m`` is
  their largest distance in the course of the run;

and ``real_time_ratio``, processor time of all calls over the length of the log.

The last line has the worst of the recordings, and the ``real_time_ratio`` of all. The survey's times are stated; its
one limit is that it keeps up with its 2 Hz.
"""

import gc
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L, X

sys.path.append(str(Path(__file__).resolve().parents[1]))
from common import conclude, make_parser, note, print_figures, recording, write_results

from sonar_graph.calibration import (
    Calibration,
    DvlCalibration,
    ImuCalibration,
    PlanarMotion,
    SonarCalibration,
)
from sonar_graph.logs.convert import read_dlr, read_mrclam
from sonar_graph.measurements import NS_PER_S, Dvl, Imu, LandmarkDetections
from sonar_graph.navigation import Odometry
from sonar_graph.sequence import Sequence
from sonar_graph.simulation import MissionOptions, simulate_mission
from sonar_graph.slam import Isam2
from sonar_graph.slam.smoother import Marginals, solve
from sonar_graph.states import LandmarkMap

TARGETS = {
    "max_update_ms": 100.0,
    "p99_ms": 20.0,
    "finish_s": 5.0,
    "landmark_gap_m": 0.05,
    "sigma_ratio": 1.1,
    "real_time_ratio": 1.0,
}
RATE_HZ = 2.0
GYRO_NOISE, SPEED_SIGMA_M_S, RANGE_SIGMA_M, AZIMUTH_SIGMA_RAD = 2e-3, 0.05, 0.05, 0.01
LANE_M, APART_M, SPEED_M_S, RANGE_MAX_M, HALF_APERTURE_RAD = 100.0, 6.0, 1.0, 10.0, 1.0


def survey(landmarks: int = 1000, seed: int = 1) -> Sequence:
    """Lanes of 100 m, 6 m apart, over landmarks at random; all lie in the plane."""
    lanes = max(2, round(landmarks / 80))
    return along_lanes(lanes, LANE_M, landmarks, seed)


def repeated_survey(minutes: float, seed: int = 1) -> Sequence:
    """A field of 60 m x 60 m with 200 landmarks, surveyed to and fro for so long, with a frame every 4 s."""
    lanes = round(60.0 * minutes * SPEED_M_S / (60.0 + np.pi * APART_M / 2))
    return along_lanes(
        lanes, 60.0, 200, seed, lanes_a_lap=10, frame_every=round(4.0 * RATE_HZ)
    )


def along_lanes(
    lanes: int,
    lane_m: float,
    landmarks: int,
    seed: int,
    *,
    lanes_a_lap: int = 10**6,
    frame_every: int = 1,
) -> Sequence:
    """Measurements along lanes, 6 m apart; after ``lanes_a_lap`` lanes the vehicle goes back over them."""
    rng = np.random.default_rng(seed)
    width_m = min(lanes, lanes_a_lap) * APART_M
    points = rng.uniform((0.0, -2.0), (lane_m, width_m + 2.0), (landmarks, 2))
    lane = round(lane_m / SPEED_M_S * RATE_HZ)
    turn = round(np.pi * APART_M / 2 / SPEED_M_S * RATE_HZ)
    side = 1.0
    rates = []
    for k in range(lanes):
        rates += [0.0] * lane + [side * np.pi * RATE_HZ / turn] * turn
        if (k + 1) % lanes_a_lap:
            side = -side
    n, dt = len(rates), 1.0 / RATE_HZ
    heading = np.concatenate([[0.0], np.cumsum(rates) * dt])
    middle = 0.5 * (heading[1:] + heading[:-1])
    chord = SPEED_M_S * dt * np.sinc(np.array(rates) * dt / (2 * np.pi))
    xy = np.vstack(
        [
            [0.0, 0.0],
            np.cumsum(
                np.column_stack([chord * np.cos(middle), chord * np.sin(middle)]),
                axis=0,
            ),
        ]
    )
    stamps_ns = (np.arange(n + 1) * (NS_PER_S // round(RATE_HZ))).astype(np.int64)
    gyro, velocity = np.zeros((n + 1, 3)), np.zeros((n + 1, 3))
    gyro[1:, 2] = rates + GYRO_NOISE / np.sqrt(dt) * rng.standard_normal(n)
    velocity[1:, 0] = SPEED_M_S
    velocity[1:, :2] += SPEED_SIGMA_M_S * rng.standard_normal((n, 2))
    rows = []
    for k in range(1, n + 1):
        if k % frame_every:
            continue
        away = points - xy[k]
        distance = np.hypot(*away.T)
        azimuth = (np.arctan2(away[:, 1], away[:, 0]) - heading[k] + np.pi) % (
            2 * np.pi
        ) - np.pi
        seen = np.flatnonzero(
            (distance < RANGE_MAX_M) & (np.abs(azimuth) < HALF_APERTURE_RAD)
        ).tolist()
        rows += [(k, i, distance[i], azimuth[i]) for i in seen]
    frames, ids, distances, azimuths = (
        np.array(column) for column in zip(*rows, strict=True)
    )
    m = len(rows)
    detections = LandmarkDetections(
        stamps_ns[frames],
        distances + RANGE_SIGMA_M * rng.standard_normal(m),
        azimuths + AZIMUTH_SIGMA_RAD * rng.standard_normal(m),
        np.tile(np.diag([RANGE_SIGMA_M**2, AZIMUTH_SIGMA_RAD**2]), (m, 1, 1)),
        ids[:, None],
        np.ones((m, 1)),
    )
    calibration = Calibration(
        imu=ImuCalibration(
            gyro_noise_density=GYRO_NOISE,
            gyro_bias_sigma=0.0,
            gyro_bias_walk_density=0.0,
        ),
        dvl=DvlCalibration(velocity_sigma_m_s=(SPEED_SIGMA_M_S, SPEED_SIGMA_M_S, 1e-3)),
        sonar=SonarCalibration(
            range_sigma_m=RANGE_SIGMA_M, azimuth_sigma_rad=AZIMUTH_SIGMA_RAD
        ),
        planar=PlanarMotion(),
        use_gravity=False,
        odometry_interpolation="hold-past",
    )
    cov = np.tile(np.diag(np.square(calibration.dvl.velocity_sigma_m_s)), (n + 1, 1, 1))
    return Sequence(
        name=f"survey of {landmarks} landmarks, {n * dt:.0f} s",
        calibration=calibration,
        imu=Imu(stamps_ns, gyro, np.full((n + 1, 3), np.nan)),
        dvl=Dvl(stamps_ns, velocity, cov),
        detections=detections,
    )


def run(sequence: Sequence, until_s: float | None = None) -> dict[str, Any]:
    """Figures of one log."""
    assert sequence.detections is not None
    stamps = np.unique(sequence.detections.stamps_ns)
    end_ns = (
        sequence.end_ns
        if until_s is None
        else sequence.start_ns + round(until_s * NS_PER_S)
    )
    stamps = stamps[(stamps > sequence.start_ns) & (stamps <= end_ns)]
    estimator = Isam2(sequence.calibration, Odometry(sequence.calibration))
    cpu_s, wall_s = [], []
    gaps_at_tenths_m = []
    other_minimum_at_tenths_m = []
    # not at the end: the batch solution would be kept, and its time is wanted
    tenths = set(
        np.linspace(len(stamps) / 10, len(stamps) - 1, 10)[:-1].astype(int).tolist()
    )
    for k, step in enumerate(sequence.replay(stamps)):
        cpu, wall = time.thread_time(), time.perf_counter()
        estimator.process(step)
        cpu_s.append(time.thread_time() - cpu)
        wall_s.append(time.perf_counter() - wall)
        if k in tenths:
            minimum = solve(estimator.graph, estimator.values)
            newest_map = positions(estimator.newest_landmarks())
            gaps_at_tenths_m.append(largest(gaps_m(minimum, newest_map)))
            other_minimum_at_tenths_m.append(
                largest(gaps_m(minimum, positions(estimator.landmarks())))
            )
    newest = estimator.keyframe_count - 1
    start = time.thread_time()
    batch = estimator.landmarks()
    finish_s = time.thread_time() - start
    graph = estimator.graph
    minimum = solve(graph, estimator.values)
    gap_m = gaps_m(minimum, positions(estimator.newest_landmarks()))
    gaps_at_tenths_m.append(largest(gap_m))
    other_minimum_at_tenths_m.append(largest(gaps_m(minimum, positions(batch))))
    marginals = Marginals(graph, minimum)
    spread_m = {
        i: np.sqrt(np.trace(marginals.marginalCovariance(L(i))[:2, :2])) for i in gap_m
    }
    ratios = [
        sigmas(estimator.marginal(keyframe=newest))
        / sigmas(marginals.marginalCovariance(X(newest)))
    ]
    ratios += [
        sigmas(estimator.marginal(landmark=i))
        / sigmas(marginals.marginalCovariance(L(i)))
        for i in gap_m
    ]
    ratio = np.concatenate(ratios)
    cpu_ms = 1e3 * np.array(cpu_s)
    by_ten_minutes_s = np.bincount(
        (stamps - sequence.start_ns) // (600 * NS_PER_S), weights=cpu_s
    )
    return {
        "log": sequence.name,
        "updates": len(stamps),
        "by_ten_minutes_s": by_ten_minutes_s.tolist(),
        "keyframes": newest + 1,
        "landmarks": len(batch),
        "median_ms": float(np.median(cpu_ms)),
        "p99_ms": float(np.quantile(cpu_ms, 0.99)),
        "max_update_ms": float(cpu_ms.max()),
        "max_wall_ms": 1e3 * max(wall_s),
        "finish_s": finish_s,
        "landmark_gap_m": largest(gap_m),
        "gaps_at_tenths_m": gaps_at_tenths_m,
        "other_minimum": other_minimum(graph, minimum, positions(batch)),
        "other_minimum_at_tenths_m": other_minimum_at_tenths_m,
        "gap_sigmas": max(gap_m[i] / spread_m[i] for i in gap_m),
        "sigma_ratio": float(np.maximum(ratio, 1.0 / ratio).max()),
        "real_time_ratio": sum(cpu_s) * NS_PER_S / float(stamps[-1] - stamps[0]),
    }


def positions(found: LandmarkMap) -> dict[int, np.ndarray]:
    """Position of each landmark, by its identity."""
    return dict(zip(found.ids.tolist(), found.positions, strict=True))


def gaps_m(values: gtsam.Values, points_m: dict[int, np.ndarray]) -> dict[int, float]:
    """Horizontal distance of each landmark between values and points, by its identity."""
    return {
        i: float(np.linalg.norm((values.atPoint3(L(i)) - point_m)[:2]))
        for i, point_m in points_m.items()
    }


def largest(distances_m: dict[int, float]) -> float:
    """Largest distance, 0 without landmarks."""
    return max(distances_m.values(), default=0.0)


def other_minimum(
    graph: gtsam.NonlinearFactorGraph,
    minimum: gtsam.Values,
    batch_m: dict[int, np.ndarray],
) -> dict[str, Any]:
    """Landmarks that the batch solution has in another minimum, and the decrease of the error down to that one."""
    far_m = {
        i: gap_m
        for i, gap_m in gaps_m(minimum, batch_m).items()
        if gap_m > TARGETS["landmark_gap_m"]
    }
    if not far_m:
        return {"distances_m": {}, "error_decrease": 0.0}
    moved = gtsam.Values(minimum)
    for i in far_m:
        moved.update(L(i), batch_m[i])
    lower = solve(graph, moved)
    return {
        "distances_m": far_m,
        "error_decrease": graph.error(minimum) - graph.error(lower),
    }


def sigmas(covariance: np.ndarray) -> np.ndarray:
    """Standard deviations of yaw and horizontal position of a keyframe, or of the horizontal position of a landmark."""
    variances = np.diag(covariance)
    return np.sqrt(variances[[2, 3, 4]] if len(variances) == 6 else variances[:2])


def logs(data: Path | str | None, *, is_quick: bool) -> Iterator[Sequence]:
    """Logs, one at a time."""
    yield survey(100 if is_quick else 1000)
    yield repeated_survey(4.0 if is_quick else 60.0)
    if is_quick:
        return
    for number in (9, 6):
        with recording(
            data, f"mrclam_ds{number}.tar.xz", f"MRCLAM_Dataset{number}"
        ) as folder:
            for robot in sorted(
                int(path.name[5]) for path in folder.glob("Robot?_Odometry.dat")
            ):
                yield read_mrclam(folder, robot)
    with recording(data, "dlr.tar.xz", "dlr") as folder:
        yield read_dlr(folder)


def listed(values: list[float]) -> str:
    """Numbers in one cell."""
    return ", ".join(f"{value:.2f}" for value in values)


def main() -> None:
    parser = make_parser(__doc__, data=True)
    parser.add_argument("--only", default="", help="logs whose name contains this")
    arguments = parser.parse_args()
    note("warming up: compiled functions load at their first use")
    run(simulate_mission(MissionOptions(duration_s=20.0)))
    gc.collect()
    gc.freeze()
    found = []
    for sequence in logs(arguments.data, is_quick=arguments.quick):
        if arguments.only.lower() in sequence.name.lower():
            gc.collect()  # what the log before left, which no single log's user has
            found.append(run(sequence, 120.0 if arguments.quick else None))
            print_figures(found[-1])
    if not found:
        sys.exit(
            f"--only {arguments.only}: no log has that in its name; expected a part of one, as in the docstring"
        )
    if not arguments.quick and not arguments.only:
        headers = (
            "log",
            "keyframes",
            "median ms",
            "p99 ms",
            "longest ms",
            "of real time",
            "last batch s",
        )
        headers += (
            "live from its minimum at the end m",
            "at tenths m",
            "that from batch at tenths m",
            "s in each ten minutes",
        )
        names = (
            "log",
            "keyframes",
            "median_ms",
            "p99_ms",
            "max_update_ms",
            "real_time_ratio",
            "finish_s",
            "landmark_gap_m",
        )
        rows = [
            (
                *(each[name] for name in names),
                listed(each["gaps_at_tenths_m"]),
                listed(each["other_minimum_at_tenths_m"]),
                listed(each["by_ten_minutes_s"]),
            )
            for each in found
        ]
        write_results("smoother.md", "The smoother on dense logs", headers, rows)
    recorded = [each for each in found if not each["log"].startswith("survey")] or found
    figures: dict[str, Any] = {
        name: max(each[name] for each in recorded) for name in (*TARGETS, "gap_sigmas")
    }
    figures["real_time_ratio"] = max(each["real_time_ratio"] for each in found)
    for name, limit in TARGETS.items():
        print(f"{name}: {figures[name]:.3f}, target at most {limit:g}")
    figures["passed"] = all(figures[name] <= limit for name, limit in TARGETS.items())
    conclude({"logs": len(found), **figures}, is_quick=arguments.quick)


if __name__ == "__main__":
    main()
