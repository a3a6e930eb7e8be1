"""Is preintegrated odometry as sure as it is right? NEES, beside the rules of others.

Vehicles on splines (`spline_vehicle.py`, no code of the library's) carry a 200 Hz IMU and a Doppler log with lever
arms and a mounting. Each run is another stretch of motion with fresh noise. The normalised squared error (NEES) is
averaged over the runs, per dimension (ANEES): 1 is consistent, above it the covariance claims too much.

Ours: "pose" is the whole motion of `Odometry`, six dimensions; "displacement" its last three; "as gaps" the same with
``dvl.gap_s`` below the Doppler interval, so that the accelerometers carry the velocity between any two samples. The
others' are displacements by their rule for the mean and for the covariance (`published_rules.py`): coug_fgo's tight
integrator (held previous velocity), TURTLMap's (held newest velocity), and a trapezoid. All of a row see the same
samples, but for TURTLMap's rotations: they come from an AHRS, whose noise its covariance leaves out, and are true here.

A chain is 60 keyframes of 1 s, composed as if their noises were independent.

Brisk rows change surge and course every second instead of every three, which no straight line between Doppler samples
follows. The second table has slow Doppler logs: error of the displacement over 1 s, and its ANEES.

``passed``: pose is within 0.85 and 1.1 in all rows but the brisk and slow ones.
"""

import sys
from dataclasses import dataclass, replace
from itertools import pairwise, product
from pathlib import Path
from typing import NamedTuple

import gtsam
import numpy as np

sys.path.append(str(Path(__file__).resolve().parents[1]))
sys.path.append(str(Path(__file__).resolve().parents[1] / "published_rules"))
sys.path.append(str(Path(__file__).resolve().parent))
from common import in_parallel, make_parser, print_figures, print_table
from published_rules import TRAPEZOID, ZOH_CURRENT, ZOH_PREVIOUS, motion_by_rule
from spline_vehicle import BODY_P_DVL, BODY_P_IMU, BODY_R_DVL, Vehicle, make_vehicle

from sonar_graph import Calibration, Odometry
from sonar_graph.calibration import DvlCalibration, ImuCalibration, Mounting
from sonar_graph.measurements import Dvl, Imu
from sonar_graph.motion import PreintegratedMotion
from sonar_graph.navigation.preintegration import Sensors

NS = 1_000_000_000
IMU_HZ, ACCEL_DENSITY = 200.0, 1e-3
SLOW_HZ = (1.0, 1.25, 5.0 / 3.0, 2.0, 2.5, 10.0 / 3.0)
"""Rates of slow Doppler logs: also intervals of a log of 5 or 10 Hz that lost samples."""
COLUMNS = ("pose", "displacement", "as gaps", "coug_fgo", "TURTLMap", "trapezoid")
RULES = ((ZOH_PREVIOUS, True), (ZOH_CURRENT, False), (TRAPEZOID, True))
"""Rules, and whether the gyros are noisy, in what is measured and in the covariance."""
BAND = (0.85, 1.1)
"""The covariance of a short motion counts half a Doppler sample too much: docs/theory/preintegration.md, (10)."""
CHAIN = 60
NO_BIAS = np.zeros(3)


class Measured(NamedTuple):
    """Samples of one run."""

    imu: Imu
    dvl: Dvl
    true_rate: np.ndarray
    """Of the IMU's rows."""


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
        length = f"{self.keyframe_s:g} s" + (
            f" x {self.keyframes}" if self.keyframes > 1 else ""
        )
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
        if self.dvl_hz in SLOW_HZ:
            return "slow"
        if self.knot_s < 3.0:
            return "brisk"
        return "chain" if self.keyframes > 1 else "keyframe"

    def calibration(
        self, gyro_is_noisy: bool = True, gap_s: float = 10.0
    ) -> Calibration:
        """The sensors as they are; a covariance without gyro noise where asked for."""
        rpy = BODY_R_DVL.as_euler("xyz").tolist()
        imu = ImuCalibration(
            gyro_noise_density=self.gyro_density * gyro_is_noisy,
            accel_noise_density=ACCEL_DENSITY,
            accel_bias_sigma=0.0,
            mounting=Mounting(translation_m=tuple(BODY_P_IMU.tolist())),
        )
        dvl = DvlCalibration(
            velocity_sigma_m_s=(self.dvl_sigma,) * 3,
            mounting=Mounting(
                translation_m=tuple(BODY_P_DVL.tolist()), rpy_rad=tuple(rpy)
            ),
            gap_s=gap_s,
        )
        return Calibration(imu=imu, dvl=dvl)


def measure(
    vehicle: Vehicle, start_s: float, case: Case, rng: np.random.Generator
) -> Measured:
    """Samples of one run, stamped from zero; those of the IMU begin at an arbitrary phase."""
    length_s = case.keyframe_s * case.keyframes
    dvl_t = np.arange(round(length_s * case.dvl_hz) + 1) / case.dvl_hz
    dvl_ns = np.round(dvl_t * NS).astype(np.int64)
    imu_ns = np.round(
        (np.arange(-2, length_s * IMU_HZ + 3) + rng.uniform()) / IMU_HZ * NS
    ).astype(np.int64)
    t = start_s + imu_ns / NS
    noise = rng.standard_normal((2, len(t), 3)) * np.sqrt(IMU_HZ)
    true_rate = vehicle.rate(t)
    rate = true_rate + case.gyro_density * noise[0]
    force = vehicle.specific_force(t) + ACCEL_DENSITY * noise[1]
    velocity = vehicle.doppler(start_s + dvl_t) + case.dvl_sigma * rng.standard_normal(
        (len(dvl_t), 3)
    )
    return Measured(
        Imu(imu_ns, rate, force),
        Dvl(dvl_ns, velocity, np.full((len(dvl_t), 3, 3), np.nan)),
        true_rate,
    )


def motions_of(case: Case, measured: Measured) -> list[list[PreintegratedMotion]]:
    """Motions over each keyframe: ours, as gaps, and by the three rules."""
    ends_ns = [round(k * case.keyframe_s * NS) for k in range(case.keyframes + 1)]
    found = []
    for gap_s in (10.0, 0.5 / case.dvl_hz):
        odometry = filled(case.calibration(gap_s=gap_s), measured.imu, measured.dvl)
        known_ns = int(measured.imu.stamps_ns[-1])
        spans = pairwise(ends_ns)
        found.append(
            [odometry.motion(i, j, NO_BIAS, known_ns=known_ns) for i, j in spans]
        )
    for rule, gyro_is_noisy in RULES:
        imu = (
            measured.imu
            if gyro_is_noisy
            else replace(measured.imu, angular_velocity=measured.true_rate)
        )
        calibration = case.calibration(gyro_is_noisy)
        rows = filled(calibration, imu, measured.dvl).rows()
        sensors = Sensors.of(calibration)
        spans = pairwise(ends_ns)
        found.append(
            [motion_by_rule(rows, rule, i, j, NO_BIAS, sensors) for i, j in spans]
        )
    return found


def filled(calibration: Calibration, imu: Imu, dvl: Dvl) -> Odometry:
    odometry = Odometry(calibration)
    odometry.add(imu, dvl)
    assert not odometry.refused
    return odometry


def true_motion(vehicle: Vehicle, start_s: float, duration_s: float) -> gtsam.Pose3:
    ends = np.array([start_s, start_s + duration_s])
    R_i, R_j = vehicle.attitude(ends)
    p_i, p_j = vehicle.position(ends)
    return gtsam.Pose3(
        gtsam.Rot3((R_i.inv() * R_j).as_matrix()), R_i.inv().apply(p_j - p_i)
    )


def nees(error: np.ndarray, covariance: np.ndarray) -> float:
    return float(error @ np.linalg.solve(covariance, error)) / len(error)


def one_run(
    vehicle: Vehicle, start_s: float, case: Case, measured: Measured
) -> list[float]:
    """NEES per dimension by column, then the squared errors of the displacement, ours and as gaps, m²."""
    truth = true_motion(vehicle, start_s, case.keyframe_s * case.keyframes)
    columns, squares = [], []
    for motions in motions_of(case, measured):
        total = motions[0]
        for motion in motions[1:]:
            total = total.then(motion)
        error = gtsam.Pose3.Logmap(total.i_T_j.between(truth))
        if not columns:
            columns.append(nees(error, total.covariance))
        columns.append(nees(error[3:], total.covariance[3:, 3:]))
        squares.append(float(error[3:] @ error[3:]))
    return columns + squares[:2]


def means(case: Case) -> list[float]:
    """Of `one_run` over all runs."""
    values, length_s = [], case.keyframe_s * case.keyframes
    for run in range(case.runs):
        rng = np.random.default_rng([run, *case.seed])
        if run % 20 == 0:
            vehicle = make_vehicle(run, length_s + 20.0, case.knot_s)
        start_s = rng.uniform(0.0, 20.0)
        values.append(
            one_run(vehicle, start_s, case, measure(vehicle, start_s, case, rng))
        )
    return [float(value) for value in np.mean(values, axis=0)]


def main() -> int:
    parser = make_parser(__doc__, workers=True)
    parser.add_argument(
        "--runs", type=int, default=1000, help="for each case (default: 1000)"
    )
    arguments = parser.parse_args()
    runs = 40 if arguments.quick else arguments.runs
    grid = product((1.0, 5.0), (1e-4, 1e-3), (0.003, 0.01), (4.0, 5.0, 10.0))
    cases = [Case(*values, keyframes=1, runs=runs) for values in grid]
    cases += [
        Case(
            1.0, gyro, sigma, 5.0, keyframes=2 if arguments.quick else CHAIN, runs=runs
        )
        for gyro, sigma in product((1e-4, 1e-3), (0.003, 0.01))
    ]
    cases += [
        Case(1.0, 1e-4, sigma, hz, 1, runs, knot_s=1.0)
        for sigma, hz in product((0.003, 0.01), (4.0, 10.0))
    ]
    cases = cases[::5] if arguments.quick else cases
    cases += [
        Case(2.0 / hz, 1e-4, 0.005, hz, 1, runs, knot_s)
        for knot_s, hz in product((3.0, 1.0), SLOW_HZ)
    ]
    found = in_parallel(means, cases, arguments.workers, "case")
    rows = [
        (case, row)
        for case, row in zip(cases, found, strict=True)
        if case.group != "slow"
    ]
    print_table(
        ["keyframe, gyro density, DVL", *COLUMNS],
        [[str(case), *row[:6]] for case, row in rows],
    )
    slow = [
        (case, row)
        for case, row in zip(cases, found, strict=True)
        if case.group == "slow"
    ]
    print_table(
        ["slow log", "ours, rms mm", "ANEES", "as gaps, rms mm", "ANEES"],
        [
            [str(case), 1e3 * row[6] ** 0.5, row[1], 1e3 * row[7] ** 0.5, row[2]]
            for case, row in slow
        ],
    )
    print_figures(figures(cases, found))
    return 0


def figures(cases: list[Case], found: list[list[float]]) -> dict[str, object]:
    """Extremes over single keyframes, chains and brisk keyframes; of slow logs every case."""
    named: dict[str, object] = {"runs": cases[0].runs, "cases": len(cases)}
    for group in ("keyframe", "chain", "brisk"):
        rows = np.array(
            [row for case, row in zip(cases, found, strict=True) if case.group == group]
        )
        for name, column in zip(COLUMNS, rows.T, strict=False):
            named[f"{group}_{name}_anees"] = [
                round(float(column.min()), 3),
                round(float(column.max()), 3),
            ]
    for case, row in zip(cases, found, strict=True):
        if case.group == "slow":
            pace = "brisk" if case.knot_s < 3.0 else "gentle"
            numbers = 1e3 * row[6] ** 0.5, row[1], 1e3 * row[7] ** 0.5, row[2]
            named[f"{pace}, {case.dvl_hz:g} Hz rms_mm, anees, as gaps"] = [
                round(number, 3) for number in numbers
            ]
    poses = [
        row[0]
        for case, row in zip(cases, found, strict=True)
        if case.group in ("keyframe", "chain")
    ]
    named["passed"] = BAND[0] <= min(poses) and max(poses) <= BAND[1]
    return named


if __name__ == "__main__":
    sys.exit(main())
