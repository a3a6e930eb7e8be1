"""Do the intervals of time offsets, DVL yaw, scale, lever arm and gyro bias hold the truth? Coverage in simulation.

Each run is another motion, with fresh noise, an offset of up to 0.6 s, a yaw of up to 4° and a scale of up to 2 %, a
gyro bias of 1e-3 rad/s an axis and a calibration whose IMU is up to 1.5 m an axis from its place, all known. Vehicles
on splines (`spline_vehicle.py`, no code of the library's) and the simulated basin. The reference is the true attitude
once a second with 1 mrad of noise. An estimate that the log cannot tell counts neither way; how many could is in the
table. ``passed``: no coverage lies below the band that holds 99 % of the binomial distribution of so many runs with a
probability of 0.95, and no root mean square of error over sigma outside that which holds 99.9 % of chi's, either way.
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import binom, chi2

sys.path.append(str(Path(__file__).resolve().parents[1]))
sys.path.append(str(Path(__file__).resolve().parent))
from common import conclude, in_parallel, make_parser, print_table
from spline_vehicle import BODY_P_DVL, BODY_P_IMU, BODY_R_DVL, make_vehicle

from sonar_graph.calibration import (
    Calibration,
    DvlCalibration,
    ImuCalibration,
    Mounting,
)
from sonar_graph.measurements import Dvl, Imu
from sonar_graph.navigation.alignment import match_dvl_to_imu, match_reference_to_imu
from sonar_graph.simulation import BasinOptions, simulate_basin
from sonar_graph.states import Trajectory

NS = 1_000_000_000
IMU_HZ, DURATION_S = 100.0, 240.0
GYRO_DENSITY, ACCEL_DENSITY, DVL_SIGMA, REFERENCE_SIGMA = 1.2e-4, 1.2e-3, 0.01, 1e-3
GYRO_BIAS, ACCEL_BIAS = 1e-3, 1e-2
FARTHEST_M = 1.5
"""By which the calibration's place of the IMU is wrong at most, along an axis."""
VECTORS = [f"{name} {axis}" for name in ("lever arm", "gyro bias") for axis in "xyz"]
QUANTITIES = ("DVL offset", "DVL yaw", "DVL scale", "reference offset", *VECTORS)
Recorded = tuple[Imu, Dvl, Trajectory, Calibration]
SPLINE_RPY = tuple(BODY_R_DVL.as_euler("ZYX")[::-1].tolist())
SPLINE_CALIBRATION = Calibration(
    imu=ImuCalibration(mounting=Mounting(translation_m=tuple(BODY_P_IMU.tolist()))),
    dvl=DvlCalibration(
        mounting=Mounting(translation_m=tuple(BODY_P_DVL.tolist()), rpy_rad=SPLINE_RPY)
    ),
)


@dataclass(frozen=True)
class Held:
    """One estimate: whether it could be told, and its error in sigmas."""

    known: bool
    error_sigmas: float


def spline_run(dvl_hz: float, seed: int) -> Recorded:
    """A vehicle on splines, its IMU and Doppler log with noise, its true attitude with noise; gyros without bias."""
    vehicle, rng = (
        make_vehicle(seed, DURATION_S + 2),
        np.random.default_rng([seed, round(dvl_hz)]),
    )
    t, dvl_t, truth_t = (
        np.arange(0, DURATION_S, 1 / hz) for hz in (IMU_HZ, dvl_hz, 1.0)
    )
    white = rng.standard_normal((2, len(t), 3)) * np.sqrt(IMU_HZ)
    rate = vehicle.rate(t + 1) + GYRO_DENSITY * white[0]
    force = (
        vehicle.specific_force(t + 1)
        + ACCEL_DENSITY * white[1]
        + ACCEL_BIAS * rng.standard_normal(3)
    )
    velocity = vehicle.doppler(dvl_t + 1) + DVL_SIGMA * rng.standard_normal(
        (len(dvl_t), 3)
    )
    truth = noisy(vehicle.attitude(truth_t + 1), rng)
    imu_ns, dvl_ns, truth_ns = (
        np.round(times * NS).astype(np.int64) for times in (t, dvl_t, truth_t)
    )
    unknown = np.full((len(dvl_t), 3, 3), np.nan)
    reference = Trajectory.without_covariances(
        truth_ns, vehicle.position(truth_t + 1), truth.as_quat()
    )
    return (
        Imu(imu_ns, rate, force),
        Dvl(dvl_ns, velocity, unknown),
        reference,
        SPLINE_CALIBRATION,
    )


def basin_run(seed: int) -> Recorded:
    """The nominal basin, one lap, gyros without bias."""
    run = simulate_basin(
        BasinOptions(seed=seed, duration_s=DURATION_S, laps=1, gyro_bias_scale=0.0)
    )
    assert run.truth is not None
    every = slice(None, None, 50)
    attitude = noisy(
        Rotation.from_quat(run.truth.quaternions_xyzw[every]),
        np.random.default_rng([seed, 3]),
    )
    places = run.truth.positions[every]
    reference = Trajectory.without_covariances(
        run.truth.stamps_ns[every], places, attitude.as_quat()
    )
    return run.imu, run.dvl, reference, run.calibration


def noisy(attitude: Rotation, rng: np.random.Generator) -> Rotation:
    return attitude * Rotation.from_rotvec(
        REFERENCE_SIGMA * rng.standard_normal((len(attitude), 3))
    )


CASES: dict[str, Callable[[int], Recorded]] = {
    "splines, 5 Hz": partial(spline_run, 5.0),
    "splines, 1 Hz": partial(spline_run, 1.0),
    "basin": basin_run,
}


def one(case: str, seed: int) -> list[Held]:
    """By quantity."""
    imu, dvl, reference, calibration = CASES[case](seed)
    rng = np.random.default_rng([seed, 5])
    offset_s, reference_s, yaw, scale = rng.uniform(
        [-0.6, -0.6, -0.07, 0.98], [0.6, 0.6, 0.07, 1.02]
    )
    body_R_dvl = calibration.dvl.mounting.pose().rotation().matrix()
    turned = Rotation.from_euler("z", -yaw).apply(dvl.velocity @ body_R_dvl.T) / scale
    early = Dvl(
        dvl.stamps_ns - round(offset_s * NS), turned @ body_R_dvl, dvl.velocity_cov
    )
    shifted = Trajectory.without_covariances(
        reference.stamps_ns - round(reference_s * NS),
        reference.positions,
        reference.quaternions_xyzw,
    )
    arm = np.subtract(
        calibration.dvl.mounting.translation_m, calibration.imu.mounting.translation_m
    )
    bias = GYRO_BIAS * rng.standard_normal(3)
    biased = Imu(imu.stamps_ns, imu.angular_velocity + bias, imu.specific_force)
    found = match_dvl_to_imu(
        biased,
        early,
        with_imu_moved(calibration, rng.uniform(-FARTHEST_M, FARTHEST_M, 3)),
    )
    other = match_reference_to_imu(biased, shifted, calibration).offset
    estimates = (
        found.offset,
        found.turn[2],
        found.scale,
        other,
        *found.lever,
        *found.gyro_bias,
    )
    pairs = zip(
        estimates, (offset_s, yaw, scale, reference_s, *arm, *bias), strict=True
    )
    return [Held(e.is_known, (e.value - true) / e.sigma) for e, true in pairs]


def with_imu_moved(calibration: Calibration, by_m: np.ndarray) -> Calibration:
    """The IMU is said to be elsewhere on the body, turned as it is."""
    mounting = calibration.imu.mounting
    moved = mounting.model_copy(
        update={"translation_m": tuple(np.add(mounting.translation_m, by_m).tolist())}
    )
    return calibration.model_copy(
        update={"imu": calibration.imu.model_copy(update={"mounting": moved})}
    )


def band(runs: int) -> tuple[float, float]:
    """Shares between which 99 % of such trials lie."""
    low, high = binom.interval(0.99, runs, 0.95)
    return float(low) / runs, float(high) / runs


def spread_band(runs: int) -> tuple[float, float]:
    """Root mean squares of error over sigma between which 99.9 % of such trials lie."""
    low, high = chi2.interval(0.999, runs)
    return float(np.sqrt(low / runs)), float(np.sqrt(high / runs))


def main() -> None:
    parser = make_parser(__doc__, workers=True)
    parser.add_argument("--runs", type=int, default=100, help="runs of each case")
    parser.add_argument(
        "--first-seed", type=int, default=1000, help="the others follow it"
    )
    arguments = parser.parse_args()
    runs = 3 if arguments.quick else arguments.runs
    seeds = range(arguments.first_seed, arguments.first_seed + runs)
    rows, figures, passed = [], {}, True
    for case in CASES:
        results = in_parallel(
            partial(one, case), seeds, arguments.workers, f"{case}: seed"
        )
        for quantity, trials in zip(
            QUANTITIES, zip(*results, strict=True), strict=True
        ):
            errors = np.array([trial.error_sigmas for trial in trials if trial.known])
            share, inner = (
                float(np.mean(np.abs(errors) < k)) if len(errors) else 0.0
                for k in (1.96, 1.0)
            )
            low, high = band(max(len(errors), 1))
            least, most = spread_band(max(len(errors), 1))
            spread, mean = (
                (float(np.sqrt(np.mean(errors**2))), float(errors.mean()))
                if len(errors)
                else (0.0, 0.0)
            )
            passed &= len(errors) > 0 and share >= low and least <= spread <= most
            rows.append(
                (
                    f"{case}: {quantity}",
                    len(errors),
                    share,
                    low,
                    high,
                    inner,
                    spread,
                    mean,
                )
            )
            figures[f"{case}: {quantity}"] = share
    print_table(
        (
            "",
            "told",
            "95 % held",
            "band from",
            "to",
            "68 % held",
            "rms error / sigma",
            "mean",
        ),
        rows,
    )
    conclude(
        {"runs": runs, "coverage": figures, "passed": passed}, is_quick=arguments.quick
    )


if __name__ == "__main__":
    main()
