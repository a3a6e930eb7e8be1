"""Errors and NEES in and after a gap of the Doppler log, with position fixes during the gap or without.

A slow vehicle of 0.2 m/s on splines (`spline_vehicle`, which shares no code with the library) loses bottom lock 20 s
after the start for 40 s. Its gyros have a bias, so that the accelerometers alone drift by tens of metres. Position
fixes of 0.5 m arrive every 5 s, the first 3 s after the start. Three cases: fixes throughout (``fixes``), the same by
a calibration without ``use_gravity``, where nothing but the fixes constrains tilt and gyro bias (``no gravity``), and
fixes outside the gap only (``none in gap``).

Position errors and NEES (3 dimensions, divided by 3) are averaged over the gap, and from 3 to 20 s after it, over all
seeds. NEES has an interval from the spread between seeds, because the instants of one run are correlated. ``leap``:
largest change of the error within half a second in the gap. ``passed``: after the gap, with fixes throughout, the
interval of every judged estimator holds 1 or lies below it, and no seed's NEES exceeds 10.
"""

import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

sys.path.append(str(Path(__file__).resolve().parents[1]))
sys.path.append(str(Path(__file__).resolve().parent))
from common import conclude, in_parallel, make_parser, print_table
from scipy.interpolate import make_interp_spline
from spline_vehicle import BODY_P_DVL, BODY_P_IMU, BODY_R_DVL, Vehicle

from sonar_graph.calibration import (
    Calibration,
    DvlCalibration,
    ImuCalibration,
    Mounting,
    PositionCalibration,
    Start,
)
from sonar_graph.evaluation import run_estimator
from sonar_graph.evaluation.consistency import world_position_covs
from sonar_graph.measurements import Dvl, Imu, PositionFixes
from sonar_graph.sequence import Sequence
from sonar_graph.states import Trajectory

ESTIMATORS = ("ekf-slam", "invariant-ekf", "isam2")
JUDGED = ("invariant-ekf", "isam2")
DURATION_S = 90.0
GAP_S = (20.0, 60.0)
JUDGED_S = (3.0, 20.0)
"""After the gap."""
IMU_RATE_HZ = 20.0
DVL_RATE_HZ = 5.0
FIX_INTERVAL_S = 5.0
FIRST_FIX_S = 3.0
FIX_SIGMA_M = 0.5
GYRO_NOISE = 1e-4
GYRO_BIAS_SIGMA = 2e-3
ACCEL_NOISE = 1e-3
ACCEL_BIAS_SIGMA = 0.02
VELOCITY_SIGMA_M_S = 0.005
START_SIGMA_M = 0.001
START_SIGMA_RAD = 0.001
WORST_NEES = 10.0


class Case(NamedTuple):
    """What constrains the vehicle."""

    has_fixes_in_gap: bool
    use_gravity: bool


CASES = {
    "fixes": Case(has_fixes_in_gap=True, use_gravity=True),
    "no gravity": Case(has_fixes_in_gap=True, use_gravity=False),
    "none in gap": Case(has_fixes_in_gap=False, use_gravity=True),
}
JUDGED_CASES = ("fixes", "no gravity")


class Scores(NamedTuple):
    """Scores of one run."""

    square_in_gap_m2: float
    nees_in_gap: float
    leap_m: float
    square_after_m2: float
    nees_after: float


def slow_vehicle(rng: np.random.Generator) -> Vehicle:
    """Surge of about 0.2 m/s, and yaw rates of about 0.02 rad/s, with new knots every 5 s."""
    knot_s = 5.0
    knots = np.arange(-6.0 * knot_s, DURATION_S + 6.0 * knot_s, knot_s)
    n = len(knots)
    yaw = np.cumsum(knot_s * 0.02 * rng.standard_normal(n))
    tilt = 0.01 * rng.standard_normal((2, n))
    angles = make_interp_spline(knots, np.column_stack([*tilt, yaw - yaw[6]]), k=5)
    surge = np.column_stack(
        [rng.uniform(0.15, 0.25, n), *(0.02 * rng.standard_normal((2, n)))]
    )
    fine = np.arange(knots[0], knots[-1], 0.05)
    body_velocity = make_interp_spline(knots, surge, k=5)(fine)
    world_velocity = Rotation.from_euler("ZYX", angles(fine)[:, ::-1]).apply(
        body_velocity
    )
    velocity = make_interp_spline(fine, world_velocity, k=5)
    return Vehicle(angles, velocity, velocity.antiderivative())


def drive(seed: int, case: Case) -> Sequence:
    """Measurements of one run, with its truth."""
    rng = np.random.default_rng(seed)
    vehicle = slow_vehicle(rng)
    imu_s = np.arange(0.0, DURATION_S, 1.0 / IMU_RATE_HZ)
    dvl_s = np.arange(0.0, DURATION_S, 1.0 / DVL_RATE_HZ)
    fix_s = np.arange(FIRST_FIX_S, DURATION_S, FIX_INTERVAL_S)
    is_lost = (dvl_s > GAP_S[0]) & (dvl_s < GAP_S[1])
    dvl_s = dvl_s[~is_lost]
    if not case.has_fixes_in_gap:
        fix_s = fix_s[(fix_s <= GAP_S[0]) | (fix_s >= GAP_S[1])]
    noise_density = np.sqrt(IMU_RATE_HZ)
    rate = vehicle.rate(imu_s) + GYRO_BIAS_SIGMA * rng.standard_normal(3)
    rate += GYRO_NOISE * noise_density * rng.standard_normal(rate.shape)
    force = vehicle.specific_force(imu_s) + ACCEL_BIAS_SIGMA * rng.standard_normal(3)
    force += ACCEL_NOISE * noise_density * rng.standard_normal(force.shape)
    velocity = vehicle.doppler(dvl_s)
    velocity += VELOCITY_SIGMA_M_S * rng.standard_normal(velocity.shape)
    fixes_m = vehicle.position(fix_s) + FIX_SIGMA_M * rng.standard_normal(
        (len(fix_s), 3)
    )
    position_m = vehicle.position(imu_s)
    start_R = vehicle.attitude(np.zeros(1))[0]
    told_R = start_R * Rotation.from_rotvec(START_SIGMA_RAD * rng.standard_normal(3))
    yaw, pitch, roll = told_R.as_euler("ZYX").tolist()
    told_m = position_m[0] + START_SIGMA_M * rng.standard_normal(3)
    dvl_rpy = BODY_R_DVL.as_euler("xyz").tolist()
    calibration = Calibration(
        imu=ImuCalibration(
            mounting=Mounting(translation_m=tuple(BODY_P_IMU.tolist())),
            gyro_noise_density=GYRO_NOISE,
            gyro_bias_sigma=GYRO_BIAS_SIGMA,
            gyro_bias_walk_density=0.0,
            accel_noise_density=ACCEL_NOISE,
            accel_bias_sigma=ACCEL_BIAS_SIGMA,
        ),
        dvl=DvlCalibration(
            mounting=Mounting(
                translation_m=tuple(BODY_P_DVL.tolist()), rpy_rad=tuple(dvl_rpy)
            ),
            velocity_sigma_m_s=(VELOCITY_SIGMA_M_S,) * 3,
        ),
        use_gravity=case.use_gravity,
        positions=PositionCalibration(sigma_m=(FIX_SIGMA_M,) * 3),
        start=Start(
            position_m=tuple(told_m.tolist()),
            rpy_rad=(roll, pitch, yaw),
            position_sigma_m=(START_SIGMA_M,) * 3,
            rpy_sigma_rad=(START_SIGMA_RAD,) * 3,
        ),
    )
    stamps_ns = np.rint(imu_s * 1e9).astype(np.int64)
    return Sequence(
        name=f"gap {seed}",
        calibration=calibration,
        imu=Imu(stamps_ns, rate, force),
        dvl=Dvl(
            np.rint(dvl_s * 1e9).astype(np.int64),
            velocity,
            np.full((len(dvl_s), 3, 3), np.nan),
        ),
        positions=PositionFixes(
            np.rint(fix_s * 1e9).astype(np.int64),
            fixes_m,
            np.full((len(fix_s), 3, 3), np.nan),
        ),
        truth=Trajectory.without_covariances(
            stamps_ns, position_m, vehicle.attitude(imu_s).as_quat()
        ),
    )


def run_seed(seed: int) -> dict[tuple[str, str], Scores]:
    """Scores by estimator and case."""
    found = {}
    for label, case in CASES.items():
        sequence = drive(seed, case)
        for name in ESTIMATORS:
            found[name, label] = scores(sequence, name)
    return found


def scores(sequence: Sequence, name: str) -> Scores:
    """Scores of one estimator."""
    causal = run_estimator(sequence, name, rate_hz=2.0).causal
    assert causal is not None
    assert sequence.truth is not None
    seconds = (causal.stamps_ns - sequence.start_ns) * 1e-9
    error = causal.positions - sequence.truth.at(causal.stamps_ns).positions  # (n, 3)
    nees = (
        np.einsum(
            "ni,nij,nj->n", error, np.linalg.inv(world_position_covs(causal)), error
        )
        / 3
    )
    squares_m2 = np.square(error).sum(axis=1)
    in_gap = (seconds > GAP_S[0]) & (seconds < GAP_S[1])
    after = (seconds > GAP_S[1] + JUDGED_S[0]) & (seconds < GAP_S[1] + JUDGED_S[1])
    leaps_m = np.linalg.norm(np.diff(error[in_gap], axis=0), axis=1)
    return Scores(
        square_in_gap_m2=float(squares_m2[in_gap].mean()),
        nees_in_gap=float(nees[in_gap].mean()),
        leap_m=float(leaps_m.max()),
        square_after_m2=float(squares_m2[after].mean()),
        nees_after=float(nees[after].mean()),
    )


def main() -> None:
    parser = make_parser(__doc__, workers=True)
    parser.add_argument("--runs", type=int, default=20, help="seeds (default: 20)")
    parser.add_argument("--first-seed", type=int, default=100)
    arguments = parser.parse_args()
    runs = 2 if arguments.quick else arguments.runs
    seeds = range(arguments.first_seed, arguments.first_seed + runs)
    found = in_parallel(run_seed, seeds, arguments.workers, "seed")
    rows = []
    figures: dict[str, object] = {"runs": runs}
    passed = True
    for label in CASES:
        for name in ESTIMATORS:
            of_runs: Any = Scores(*np.array([one[name, label] for one in found]).T)
            nees = float(of_runs.nees_after.mean())
            half = 1.96 * float(of_runs.nees_after.std(ddof=1) / np.sqrt(runs))
            worst = float(of_runs.nees_after.max())
            in_gap_m = float(np.sqrt(of_runs.square_in_gap_m2.mean()))
            after_m = float(np.sqrt(of_runs.square_after_m2.mean()))
            nees_in_gap = float(of_runs.nees_in_gap.mean())
            leap_m = float(of_runs.leap_m.max())
            rows.append(
                (
                    f"{name}, {label}",
                    in_gap_m,
                    nees_in_gap,
                    leap_m,
                    after_m,
                    nees,
                    half,
                    worst,
                )
            )
            figures[f"{name}, {label}"] = {
                "rms_in_gap_m": in_gap_m,
                "rms_m": after_m,
                "nees": nees,
                "worst": worst,
            }
            if label in JUDGED_CASES and name in JUDGED:
                passed = passed and nees - half <= 1.0 and worst <= WORST_NEES
    print_table(
        (
            "",
            "rms m in gap",
            "NEES/3",
            "leap m",
            "rms m after",
            "NEES/3",
            "+-",
            "worst seed",
        ),
        rows,
    )
    figures["passed"] = passed
    conclude(figures, is_quick=arguments.quick)


if __name__ == "__main__":
    main()
