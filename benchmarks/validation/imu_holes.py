"""Is dead reckoning as sure as it is right after holes in the IMU, and after wrong first velocities? NEES of many runs.

The simulated basin, driven once in 300 s. From each run all IMU rows of 0.5, 2 and 10 s are taken, beginning at another
place in each. Normalised squared errors (NEES) are taken 0.2 s after the hole and at the end of the run, of heading (1
dimension), of position (3, in the world), and of the pose (6, in the exponential coordinates of the estimate, in which
the covariance is). Divided by the dimensions their mean is 1 for a covariance that is right.

"noise only" takes the turn in the hole as sure as if it had been measured. "as calibrated" has the defaults of
``imu.turn_sigma_rad_s`` and ``imu.turn_time_s``, "own rates" the root mean square of the rates of that very run, with a
time of 1.8 s. Turns of the simulated vehicle are rare and sharp, far from normal: means hang on few runs, so that
medians are given as well. A heading that errs by 30 degrees bends the position's distribution away from any ellipse of
the world.

Then the first rows of the Doppler log are replaced: NEES of position 10 s after the start and at the end.

``passed``: over all holes, the mean NEES of heading and of pose is at most 2 as calibrated and more than that with
noise only; and no wrong first row makes the NEES of position 10 s after the start larger by half than without.
"""

import sys
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np

sys.path.append(str(Path(__file__).resolve().parents[1]))
from common import conclude, in_parallel, make_parser, print_table

from sonar_graph.evaluation import run_estimator
from sonar_graph.evaluation.consistency import world_position_covs
from sonar_graph.measurements import Floats
from sonar_graph.sequence import Sequence
from sonar_graph.simulation import BasinOptions, simulate_basin
from sonar_graph.states import Trajectory

HOLES_S = (0.5, 2.0, 10.0)
MODES = ("noise only", "as calibrated", "own rates")
OF = ("heading", "position", "pose")
OWN_TIME_S = 1.8
STARTS: dict[str, list[list[float]]] = {
    "all right": [],
    "5 m/s": [[5.0, 0.0, 0.0]],
    "1 m/s": [[1.0, 0.0, 0.0]],
    "5 m/s, three times": [[5.0, 0.0, 0.0]] * 3,
    "three different": [[5.0, 0.0, 0.0], [-3.0, 1.0, 0.0], [2.0, -2.0, 2.0]],
}
LARGEST = 2.0
NS = 1_000_000_000


def judged(seed: int) -> tuple[Floats, Floats]:
    """NEES by hole, mode, quantity and instant, shape (3, 3, 3, 2); of position by start and instant, shape (5, 2)."""
    sequence = simulate_basin(
        BasinOptions(
            seed=seed, duration_s=300.0, laps=1, speed_m_s=0.3, frame_rate_hz=1
        )
    )
    begin_s = np.random.default_rng(seed).uniform(20.0, 240.0)
    holes = [
        [after_hole(sequence, mode, begin_s, hole_s) for mode in MODES]
        for hole_s in HOLES_S
    ]
    return np.array(holes), np.array(
        [after_start(sequence, wrong) for wrong in STARTS.values()]
    )


def after_hole(sequence: Sequence, mode: str, begin_s: float, hole_s: float) -> Floats:
    """NEES, shape (3, 2)."""
    begin_ns = sequence.start_ns + round(begin_s * NS)
    end_ns = begin_ns + round(hole_s * NS)
    stamps = sequence.imu.stamps_ns
    lost = replace(
        sequence, imu=sequence.imu.rows((stamps <= begin_ns) | (stamps >= end_ns))
    )
    if mode == "noise only":
        lost = with_turns(lost, np.zeros(3), OWN_TIME_S)
    if mode == "own rates":
        lost = with_turns(
            lost, np.sqrt(np.mean(sequence.imu.angular_velocity**2, axis=0)), OWN_TIME_S
        )
    found, truth = reckoned(lost, end_ns + NS // 5)
    return np.array(
        [
            heading_nees(found, truth),
            position_nees(found, truth),
            pose_nees(found, truth),
        ]
    )


def with_turns(sequence: Sequence, sigma_rad_s: Floats, time_s: float) -> Sequence:
    """Another calibration of how the vehicle turns."""
    x, y, z = sigma_rad_s.tolist()
    update = {"turn_sigma_rad_s": (x, y, z), "turn_time_s": (time_s,) * 3}
    imu = sequence.calibration.imu.model_copy(update=update)
    return replace(
        sequence, calibration=sequence.calibration.model_copy(update={"imu": imu})
    )


def after_start(sequence: Sequence, wrong: list[list[float]]) -> Floats:
    """NEES of position, shape (2,)."""
    velocity = sequence.dvl.velocity.copy()
    velocity[: len(wrong)] = np.reshape(wrong, (-1, 3))
    damaged = replace(sequence, dvl=replace(sequence.dvl, velocity=velocity))
    return position_nees(*reckoned(damaged, sequence.start_ns + 10 * NS))


def reckoned(sequence: Sequence, instant_ns: int) -> tuple[Trajectory, Trajectory]:
    """Dead reckoning and truth at an instant and a second before the end."""
    assert sequence.truth is not None
    instants = np.array([instant_ns, int(sequence.truth.stamps_ns[-1]) - NS])
    found = run_estimator(sequence, "dead-reckoning", instants_ns=instants).causal
    assert found is not None
    return found, sequence.truth.at(instants)


def heading_nees(found: Trajectory, truth: Trajectory) -> Floats:
    """About the world's vertical, shape (2,)."""
    R = found.rotations().as_matrix()
    error = (R @ (truth.rotations().inv() * found.rotations()).as_rotvec()[..., None])[
        :, 2, 0
    ]
    return np.asarray(
        error**2
        / np.einsum("ni,nij,nj->n", R[:, 2], found.covariances[:, :3, :3], R[:, 2])
    )


def position_nees(found: Trajectory, truth: Trajectory) -> Floats:
    """Per dimension, shape (2,)."""
    error = found.positions - truth.positions
    return (
        np.einsum(
            "ni,nij,nj->n", error, np.linalg.inv(world_position_covs(found)), error
        )
        / 3
    )


def pose_nees(found: Trajectory, truth: Trajectory) -> Floats:
    """Per dimension, shape (2,)."""
    poses = [
        [
            gtsam.Pose3(gtsam.Rot3(R), p)
            for R, p in zip(one.rotations().as_matrix(), one.positions, strict=True)
        ]
        for one in (found, truth)
    ]
    error = np.array(
        [gtsam.Pose3.Logmap(a.between(b)) for a, b in zip(*poses, strict=True)]
    )
    return np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.covariances), error) / 6


def main() -> None:
    parser = make_parser(__doc__, workers=True)
    parser.add_argument("--runs", type=int, default=48, help="seeds (default: 48)")
    arguments = parser.parse_args()
    runs = 4 if arguments.quick else arguments.runs
    found = in_parallel(judged, range(runs), arguments.workers, "seed")
    holes, starts = (np.array(part) for part in zip(*found, strict=True))
    mean, median = holes.mean(axis=0), np.median(holes, axis=0)
    whens = [f"{of}, {when}" for of in OF for when in ("after", "end")]
    for name, values in (("mean", mean), ("median", median)):
        rows = [
            (f"{hole_s:g} s, {mode}", *values[h, m].ravel().tolist())
            for h, hole_s in enumerate(HOLES_S)
            for m, mode in enumerate(MODES)
        ]
        print_table((f"{name} NEES after a hole", *whens), rows)
    by_start = starts.mean(axis=0)
    rows = [
        (start, *values)
        for start, values in zip(STARTS, by_start.tolist(), strict=True)
    ]
    print_table(("first velocities", "position, 10 s", "position, end"), rows)
    over_holes = mean[:, :, [0, 2]].mean(axis=0).max(axis=(1, 2))
    figures = {
        "runs": runs,
        "holes_s": HOLES_S,
        "mean_nees": {mode: mean[:, m].tolist() for m, mode in enumerate(MODES)},
        "median_nees": {mode: median[:, m].tolist() for m, mode in enumerate(MODES)},
        "starts": dict(zip(STARTS, by_start.tolist(), strict=True)),
        "passed": bool(
            over_holes[1] <= LARGEST < over_holes[0]
            and np.all(by_start[:, 0] <= 1.5 * by_start[0, 0])
        ),
    }
    conclude(figures, is_quick=arguments.quick)


if __name__ == "__main__":
    main()
