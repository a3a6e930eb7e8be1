"""Does the heading of a vehicle with a cheap IMU run away? Errors and NEES over 50 minutes without landmarks.

A survey by splines of angles, with no code of the library's simulator: legs and turns of 40 to 200 degrees at 0.1
rad/s, rolled by 2 degrees in turns. Ten times a second gyros with a bias of 1e-3 rad/s and accelerometers with one of
0.1 m/s² (standard deviations, drawn anew in each run, constant in it), a Doppler log 1.5 times a second with outliers.

Nothing measures the heading: an estimator with a gyro bias state can do no better than one that leaves the bias out,
and has to say so. Roll and pitch come from gravity, whose directions all share the accelerometers' bias. Headings are
unwrapped along the run, so that full turns count.

* drawn: gyro bias as the calibration says. NEES of the heading at the end, averaged over runs, is to lie between 0.7
  and 1.4 for the estimators that have the bias as a state; so is that of roll and pitch together.
* true bias zero: the same with unbiased gyros, which the calibration does not know. The heading error is to be at most
  1.5 times that of EKF-SLAM, which takes the bias for zero.

``--one-bias`` lets gravity reach the heading, with one gyro bias for both: what that costs.
"""

import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation

sys.path.append(str(Path(__file__).resolve().parents[1]))
from common import conclude, in_parallel, make_parser, note, print_table

from baselines import invariant_ekf
from sonar_graph.calibration import (
    Calibration,
    DvlCalibration,
    ImuCalibration,
    Mounting,
    Start,
)
from sonar_graph.evaluation import compare
from sonar_graph.measurements import Dvl, Imu
from sonar_graph.models import gyro_bias_of
from sonar_graph.numerics import vec
from sonar_graph.sequence import Sequence
from sonar_graph.slam.keyframes import Keyframes
from sonar_graph.states import Trajectory

ESTIMATORS = ("ekf-slam", "invariant-ekf", "isam2")
HELD_TO_BAND = ("invariant-ekf", "isam2")
BAND, WORST_RATIO = (0.7, 1.4), 1.5
GRAVITY, TURN_RATE, TURN_ROLL = 9.80665, 0.1, np.radians(2.0)
DVL_ARM, DVL_RPY = np.array([-0.3, 0.0, -0.1]), np.array([np.pi, 0.0, 1.0])
CALIBRATION = Calibration(
    imu=ImuCalibration(
        gyro_noise_density=2e-3,
        gyro_bias_sigma=1e-3,
        accel_noise_density=1e-2,
        accel_bias_sigma=0.1,
    ),
    dvl=DvlCalibration(
        velocity_sigma_m_s=(0.08, 0.08, 0.08),
        mounting=Mounting(translation_m=tuple(DVL_ARM), rpy_rad=tuple(DVL_RPY)),
    ),
    start=Start(rpy_sigma_rad=(0.1, 0.1, 0.01)),
    gravity_m_s2=GRAVITY,
)
CASES = {"drawn": 1.0, "zero": 0.0}


def vehicle(seed: int, duration_s: float, gyro_bias_scale: float) -> Sequence:
    """Readings of a survey, with the truth."""
    rng = np.random.default_rng(seed)
    knot_s, rates = 4.0, [0.0]
    while len(rates) * knot_s < duration_s + 40.0:
        rates += [0.0] * rng.integers(5, 16)
        rates += [TURN_RATE * rng.choice([-1.0, 1.0])] * rng.integers(2, 9)
    knots, rate = knot_s * (np.arange(len(rates)) - 2.0), np.array(rates)
    turning = make_interp_spline(knots, rate, k=3)
    yaw, roll = (
        turning.antiderivative(),
        make_interp_spline(knots, TURN_ROLL / TURN_RATE * rate, k=3),
    )
    pitch = make_interp_spline(knots, 0.01 * rng.standard_normal(len(knots)), k=3)
    surge = make_interp_spline(knots, rng.uniform(0.2, 0.4, len(knots)), k=3)

    def attitude(t: np.ndarray) -> Rotation:
        return Rotation.from_euler(
            "ZYX", np.column_stack([yaw(t) - yaw(0.0), pitch(t), roll(t)])
        )

    def body_rate(t: np.ndarray) -> np.ndarray:
        a, b, da, db, dc = roll(t), pitch(t), roll(t, 1), pitch(t, 1), turning(t)
        return np.column_stack(
            [
                da - dc * np.sin(b),
                db * np.cos(a) + dc * np.sin(a) * np.cos(b),
                -db * np.sin(a) + dc * np.cos(a) * np.cos(b),
            ]
        )

    def ahead(t: np.ndarray) -> np.ndarray:
        return np.column_stack([surge(t), 0.02 * np.sin(0.05 * t), 0.0 * t])

    def world_velocity(t: np.ndarray) -> np.ndarray:
        return attitude(t).apply(ahead(t))

    imu_s, dvl_s = (
        np.arange(0.0, duration_s, 0.1),
        np.arange(0.0, duration_s, 1.0 / 1.5),
    )
    fine_s = np.arange(0.0, duration_s + 0.05, 0.1)
    acceleration = (world_velocity(imu_s + 1e-3) - world_velocity(imu_s - 1e-3)) / 2e-3
    force = attitude(imu_s).inv().apply(acceleration + np.array([0.0, 0.0, GRAVITY]))
    imu, dt = CALIBRATION.imu, 0.1
    gyro = body_rate(
        imu_s
    ) + gyro_bias_scale * imu.gyro_bias_sigma * rng.standard_normal(3)
    gyro += imu.gyro_noise_density / np.sqrt(dt) * rng.standard_normal(gyro.shape)
    force += imu.accel_bias_sigma * rng.standard_normal(3)
    force += imu.accel_noise_density / np.sqrt(dt) * rng.standard_normal(force.shape)
    doppler = (
        Rotation.from_euler("xyz", DVL_RPY)
        .inv()
        .apply(ahead(dvl_s) + np.cross(body_rate(dvl_s), DVL_ARM))
    )
    doppler += CALIBRATION.dvl.velocity_sigma_m_s * rng.standard_normal(doppler.shape)
    is_outlier = rng.uniform(size=len(dvl_s)) < 0.01
    is_outlier[:5] = False
    doppler[is_outlier] += rng.choice([-3.0, 3.0], (is_outlier.sum(), 3))
    steps = attitude(fine_s[:-1] + 0.05).apply(ahead(fine_s[:-1] + 0.05)) * 0.1
    position = np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])[: len(imu_s)]
    stamps_ns = np.rint(imu_s * 1e9).astype(np.int64)
    truth = Trajectory.without_covariances(
        stamps_ns, position, attitude(imu_s).as_quat()
    )
    start = CALIBRATION.start.model_copy(
        update={"rpy_rad": _start(attitude(np.zeros(1))[0], rng)}
    )
    unknown = np.full((len(dvl_s), 3, 3), np.nan)
    return Sequence(
        f"survey {seed}",
        CALIBRATION.model_copy(update={"start": start}),
        Imu(stamps_ns, gyro, force),
        Dvl(np.rint(dvl_s * 1e9).astype(np.int64), doppler, unknown),
        truth=truth,
    )


def _start(attitude: Rotation, rng: np.random.Generator) -> tuple[float, float, float]:
    wrong = attitude * Rotation.from_rotvec(
        CALIBRATION.start.rpy_sigma_rad * rng.standard_normal(3)
    )
    yaw, pitch, roll = wrong.as_euler("ZYX").tolist()
    return roll, pitch, yaw


@dataclass(frozen=True, eq=False)
class Run:
    """Errors of one estimator at the end of a run."""

    heading_rad: float
    """Unwrapped along the run."""
    heading_nees: float
    tilt_nees: float
    """Of roll and pitch together, per degree of freedom, averaged over the run."""


def run_seed(
    duration_s: float, scale: float, has_one_bias: bool, seed: int
) -> dict[str, Run]:
    """All estimators on one survey."""
    if has_one_bias:
        start: Any = invariant_ekf.start_state
        linearised: Any = Keyframes._linearisation

        def with_one_bias(self: Keyframes, i: int) -> Any:
            linearisation = linearised(self, i)
            nowhere = np.zeros(3)
            gyro_bias = np.array(gyro_bias_of(linearisation.biases, vec(nowhere)))
            return linearisation._replace(up=nowhere, gyro_bias=gyro_bias)

        replaced: Any = Keyframes
        replaced._linearisation = with_one_bias
        invariant_ekf.start_state = lambda calibration: start(calibration)._replace(
            is_level=False
        )
    sequence = vehicle(seed, duration_s, scale)
    comparison = compare(sequence, list(ESTIMATORS), rate_hz=0.5)
    told = {}
    for run in comparison.runs:
        if run.status == "failed":
            raise RuntimeError(f"seed {seed}: {run.estimator}: {run.reason}")
        told[run.estimator] = tell(run.causal, sequence.truth)
    return told


def tell(causal: Trajectory, truth: Trajectory | None) -> Run:
    """Errors of causal poses."""
    assert truth is not None
    true = truth.at(causal.stamps_ns).rotations()
    errors = (true.inv() * causal.rotations()).as_rotvec()
    yaws = [poses.as_euler("ZYX")[:, 0] for poses in (causal.rotations(), true)]
    heading = np.unwrap(yaws[0] - yaws[1])
    up = true.inv().apply([0.0, 0.0, 1.0])
    variance = np.einsum("ni,nij,nj->n", up, causal.covariances[:, :3, :3], up)
    level = (
        (causal.rotations().inv().apply([0.0, 0.0, 1.0]) - up)
        if len(errors)
        else errors
    )
    # R = R^ Exp(-e): the estimated up less the true one is -e x up, whose level part are pitch and roll
    tilts = np.column_stack([level[:, 1], -level[:, 0]])
    squares = np.einsum(
        "ni,nij,nj->n", tilts, np.linalg.inv(causal.covariances[:, :2, :2]), tilts
    )
    settled = slice(len(squares) // 10, None)
    return Run(
        float(heading[-1]),
        float(heading[-1] ** 2 / variance[-1]),
        float(squares[settled].mean() / 2),
    )


def main() -> None:
    parser = make_parser(__doc__, workers=True)
    parser.add_argument(
        "--seeds",
        type=int,
        help="number of runs in each case (default: 60; with --quick 3)",
    )
    parser.add_argument(
        "--first-seed",
        type=int,
        default=0,
        help="runs use this seed and those after it",
    )
    parser.add_argument(
        "--one-bias", action="store_true", help="one gyro bias for tilt and heading"
    )
    arguments = parser.parse_args()
    count, duration_s = (
        arguments.seeds or (3 if arguments.quick else 60),
        300.0 if arguments.quick else 3000.0,
    )
    seeds = range(arguments.first_seed, arguments.first_seed + count)
    figures: dict[str, Any] = {"runs": count, "duration_s": duration_s}
    for case, scale in CASES.items():
        note(f"gyro bias {case}:")
        told = in_parallel(
            partial(run_seed, duration_s, scale, arguments.one_bias),
            seeds,
            arguments.workers,
            "seed",
        )
        rows = []
        for name in ESTIMATORS:
            runs = [run[name] for run in told]
            row = {
                "heading_deg": float(
                    np.degrees(np.sqrt(np.mean([run.heading_rad**2 for run in runs])))
                ),
                "largest_deg": float(
                    np.degrees(max(abs(run.heading_rad) for run in runs))
                ),
                "heading_nees": float(np.mean([run.heading_nees for run in runs])),
                "tilt_nees": float(np.mean([run.tilt_nees for run in runs])),
            }
            rows.append((name, *row.values()))
            figures |= {f"{case}_{name}_{key}": value for key, value in row.items()}
        print(f"gyro bias {case}: {count} runs")
        print_table(
            (
                "at the end",
                "heading rms, deg",
                "largest, deg",
                "heading NEES",
                "tilt NEES",
            ),
            rows,
        )
    low, high = BAND
    nees = [figures[f"drawn_{name}_heading_nees"] for name in HELD_TO_BAND]
    worst = max(figures[f"zero_{name}_heading_deg"] for name in HELD_TO_BAND)
    figures["worst_ratio"] = worst / figures["zero_ekf-slam_heading_deg"]
    figures["passed"] = (
        all(low <= value <= high for value in nees)
        and figures["worst_ratio"] <= WORST_RATIO
    )
    conclude(figures, is_quick=arguments.quick)


if __name__ == "__main__":
    main()
