"""Is preintegrated odometry as sure as it is right? NEES, beside the rules of others.

Vehicles on splines (`spline_vehicle.py`, no code of the library's) carry a 200 Hz IMU and a Doppler log with lever
arms and a mounting. Each run is another stretch of motion with fresh noise. The normalised squared error (NEES) is
averaged over the runs, per dimension (ANEES): 1 is consistent, above it the covariance claims too much.

Ours: "joint" is all twelve errors (rotation, velocity, position, Doppler displacement) with the accelerometer between
Doppler samples; "inertial" its displacement alone; "linear" the displacement by gyro and Doppler log alone. The others'
are displacements by their rule for the mean and for the covariance: coug_fgo's tight integrator (zoh-previous, gyro and
Doppler noise jointly), TURTLMap's (zoh-current, Doppler noise alone), and a trapezoid. All of a row see the same
samples, but for TURTLMap's rotations: they come from an AHRS, whose noise its covariance leaves out, and are true here.

A chain is 60 keyframes of 1 s, composed; joint is then the relative pose (6 dimensions). What the Doppler sample that
two keyframes share adds is counted for all rules (`JointMotion.after`), though the others take them as independent.

Brisk rows change surge and course every second instead of every three, which no straight line between Doppler samples
follows. ``passed``: joint is within 0.9 and 1.1 in all rows but those.
"""

import sys
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import NamedTuple

import gtsam
import numpy as np

sys.path.append(str(Path(__file__).resolve().parents[1]))
sys.path.append(str(Path(__file__).resolve().parent))
from common import in_parallel, make_parser, print_figures, print_table
from spline_vehicle import BODY_P_DVL, BODY_P_IMU, BODY_R_DVL, GRAVITY, Vehicle, make_vehicle

from sonar_graph.measurements import Dvl, Imu
from sonar_graph.navigation import DISPLACEMENT, JointMotion, JointPreintegrator

NS = 1_000_000_000
IMU_HZ, ACCEL_DENSITY = 200.0, 1e-3
COLUMNS = ("joint", "inertial", "linear", "coug_fgo", "TURTLMap", "trapezoid")
RULES = (("inertial", True), ("linear", True), ("zoh-previous", True), ("zoh-current", False), ("trapezoid", True))
"""Names, and whether the gyros are noisy, in what is measured and in the covariance."""
BAND = (0.9, 1.1)
BODY_T_IMU = gtsam.Pose3(gtsam.Rot3(), BODY_P_IMU)
BODY_T_DVL = gtsam.Pose3(gtsam.Rot3(BODY_R_DVL.as_matrix()), BODY_P_DVL)
CHAIN = 60


class Measured(NamedTuple):
    """Samples of one run."""

    imu: Imu
    dvl: Dvl
    true_rate: np.ndarray
    """Of the IMU's rows."""

    def rows(self, noisy_gyro: bool) -> tuple[Imu, Dvl]:
        """With the gyros as measured, or with the true rates instead."""
        return (self.imu if noisy_gyro else replace(self.imu, angular_velocity=self.true_rate)), self.dvl


@dataclass(frozen=True)
class Case:
    """One row of the table."""

    keyframe_s: float
    gyro_density: float
    dvl_sigma: float
    dvl_hz: float
    keyframes: int
    runs: int
    knot_s: float = 3.0
    """Time between the knots of the vehicle's splines."""

    def __str__(self) -> str:
        length = f"{self.keyframe_s:g} s" + (f" x {self.keyframes}" if self.keyframes > 1 else "")
        length += " brisk" if self.knot_s < 3.0 else ""
        return f"{length}, {self.gyro_density:g}, {1e3 * self.dvl_sigma:g} mm/s, {self.dvl_hz:g} Hz"

    @property
    def seed(self) -> tuple[int, ...]:
        """Random generator of each case."""
        numbers = (
            self.keyframe_s,
            1e6 * self.gyro_density,
            1e3 * self.dvl_sigma,
            self.dvl_hz,
            self.keyframes,
            self.knot_s,
        )
        return tuple(round(number) for number in numbers)

    @property
    def group(self) -> str:
        """The figures that it belongs to."""
        return "brisk" if self.knot_s < 3.0 else "chain" if self.keyframes > 1 else "keyframe"

    def sensors(self, rule: str, noisy_gyro: bool = True) -> JointPreintegrator:
        """A preintegrator that knows the sensors; a covariance without gyro noise where asked for."""
        gyro, sigmas = self.gyro_density * noisy_gyro, (self.dvl_sigma,) * 3
        return JointPreintegrator(gyro, ACCEL_DENSITY, sigmas, BODY_T_IMU, BODY_T_DVL, rule)


def measure(vehicle: Vehicle, start_s: float, case: Case, rng: np.random.Generator) -> Measured:
    """Samples of one run, stamped from zero; those of the IMU begin at an arbitrary phase."""
    length_s = case.keyframe_s * case.keyframes
    dvl_t = np.arange(round(length_s * case.dvl_hz) + 1) / case.dvl_hz
    dvl_ns = np.round(dvl_t * NS).astype(np.int64)
    imu_ns = np.round((np.arange(-2, length_s * IMU_HZ + 3) + rng.uniform()) / IMU_HZ * NS).astype(np.int64)
    t = start_s + imu_ns / NS
    noise = rng.standard_normal((2, len(t), 3)) * np.sqrt(IMU_HZ)
    true_rate = vehicle.rate(t)
    rate = true_rate + case.gyro_density * noise[0]
    force = vehicle.specific_force(t) + ACCEL_DENSITY * noise[1]
    velocity = vehicle.doppler(start_s + dvl_t) + case.dvl_sigma * rng.standard_normal((len(dvl_t), 3))
    return Measured(Imu(imu_ns, rate, force), Dvl(dvl_ns, velocity, np.full((len(dvl_t), 3, 3), np.nan)), true_rate)


def errors(vehicle: Vehicle, start_s: float, motion: JointMotion) -> np.ndarray:
    """[theta, dv, dp, ds] against the truth."""
    t, ends = motion.duration_s, np.array([start_s, start_s + motion.duration_s])
    R_i, R_j = vehicle.attitude(ends)
    theta = gtsam.Rot3.Logmap(motion.i_R_j.between(gtsam.Rot3((R_i.inv() * R_j).as_matrix())))
    (a_i, a_j), (v_i, v_j) = vehicle.point(BODY_P_IMU, ends)
    d_i, d_j = vehicle.point(BODY_P_DVL, ends)[0]
    moved = v_j - v_i - GRAVITY * t, a_j - a_i - v_i * t - GRAVITY * t**2 / 2, d_j - d_i
    v, p, s = R_i.inv().apply(moved)
    return np.r_[theta, v - motion.velocity, p - motion.position, s - motion.displacement]


def nees(error: np.ndarray, covariance: np.ndarray) -> float:
    return float(error @ np.linalg.solve(covariance, error)) / len(error)


def one_keyframe(vehicle: Vehicle, start_s: float, case: Case, measured: Measured) -> list[float]:
    """NEES per dimension by column."""
    end_ns = round(case.keyframe_s * NS)
    found = []
    for rule, noisy_gyro in RULES:
        motion = case.sensors(rule, noisy_gyro).integrate(*measured.rows(noisy_gyro), 0, end_ns)
        error, cov = errors(vehicle, start_s, motion), motion.covariance
        if rule == "inertial":
            found.append(nees(error, cov))
        found.append(nees(error[DISPLACEMENT], cov[DISPLACEMENT, DISPLACEMENT]))
    return found


def chain(vehicle: Vehicle, start_s: float, case: Case, measured: Measured) -> list[float]:
    """NEES per dimension of all keyframes, composed."""
    found, step_ns = [], round(case.keyframe_s * NS)
    ends = np.array([start_s, start_s + case.keyframe_s * case.keyframes])
    R_i, R_j = vehicle.attitude(ends)
    p_i, p_j = vehicle.position(ends)
    truth = gtsam.Pose3(gtsam.Rot3((R_i.inv() * R_j).as_matrix()), R_i.inv().apply(p_j - p_i))
    for rule, noisy_gyro in RULES:
        sensors, rows = case.sensors(rule, noisy_gyro), measured.rows(noisy_gyro)
        total, before = None, None
        for k in range(case.keyframes):
            motion = sensors.integrate(*rows, k * step_ns, (k + 1) * step_ns)
            if before is not None:
                motion = motion.after(before)
            step, before = motion.relative_pose(), motion
            total = step if total is None else total.then(step)
        error = gtsam.Pose3.Logmap(total.i_T_j.between(truth))
        if rule == "inertial":
            found.append(nees(error, total.covariance))
        found.append(nees(error[3:], total.covariance[3:, 3:]))
    return found


def anees(case: Case) -> list[float]:
    """By column."""
    judge = one_keyframe if case.keyframes == 1 else chain
    values, length_s = [], case.keyframe_s * case.keyframes
    for run in range(case.runs):
        rng = np.random.default_rng([run, *case.seed])
        if run % 20 == 0:
            vehicle = make_vehicle(run, length_s + 20.0, case.knot_s)
        start_s = rng.uniform(0.0, 20.0)
        values.append(judge(vehicle, start_s, case, measure(vehicle, start_s, case, rng)))
    return [float(value) for value in np.mean(values, axis=0)]


def main() -> int:
    parser = make_parser(__doc__, workers=True)
    parser.add_argument("--runs", type=int, default=1000, help="for each case (default: 1000)")
    arguments = parser.parse_args()
    runs = 40 if arguments.quick else arguments.runs
    grid = product((1.0, 5.0), (1e-4, 1e-3), (0.003, 0.01), (4.0, 5.0, 10.0))
    cases = [Case(*values, keyframes=1, runs=runs) for values in grid]
    cases += [
        Case(1.0, gyro, sigma, 5.0, keyframes=2 if arguments.quick else CHAIN, runs=runs)
        for gyro, sigma in product((1e-4, 1e-3), (0.003, 0.01))
    ]
    cases += [Case(1.0, 1e-4, sigma, hz, 1, runs, knot_s=1.0) for sigma, hz in product((0.003, 0.01), (4.0, 10.0))]
    cases = cases[::5] if arguments.quick else cases
    found = in_parallel(anees, cases, arguments.workers, "case")
    print_table(
        ["keyframe, gyro density, DVL", *COLUMNS], [[str(case), *row] for case, row in zip(cases, found, strict=True)]
    )
    print_figures(figures(cases, found))
    return 0


def figures(cases: list[Case], found: list[list[float]]) -> dict[str, object]:
    """Extremes over single keyframes, chains and brisk keyframes."""
    named: dict[str, object] = {"runs": cases[0].runs, "cases": len(cases)}
    for group in ("keyframe", "chain", "brisk"):
        rows = np.array([row for case, row in zip(cases, found, strict=True) if case.group == group])
        for name, column in zip(COLUMNS, rows.T, strict=False):
            named[f"{group}_{name}_anees"] = [round(float(column.min()), 3), round(float(column.max()), 3)]
    joint = [row[0] for case, row in zip(cases, found, strict=True) if case.group != "brisk"]
    named["passed"] = BAND[0] <= min(joint) and max(joint) <= BAND[1]
    return named


if __name__ == "__main__":
    sys.exit(main())
