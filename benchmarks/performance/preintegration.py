"""Time of joint preintegration for an IMU sample, beside GTSAM's inertial preintegration.

    python benchmarks/performance/preintegration.py [--quick]

Ours is `JointPreintegrator.integrate` from Python, all twelve errors with their covariance and derivatives by ten
parameters; its slope between few and many samples (5 Hz Doppler log, 200 Hz IMU) is the cost of a sample, Doppler
samples included. GTSAM's has nine errors, no Doppler log, and derivatives by six parameters.

``gtsam_python_ratio``: time of `PreintegratedImuMeasurements.integrateMeasurement` called from Python for each sample,
over ours for the same samples (whole calls, not the slope).

``gtsam_cpp_ratio``: our slope over GTSAM's cost in C++, for which 150 ns is taken, measured in a C++ program for the
tangent preintegration (the manifold one: 320 ns), since its Python package takes no batch of samples.
``gtsam_scenario_ns`` bounds it from above in this run: the slope of `ScenarioRunner.integrate`, whose loop is in C++
but also makes up the samples.

``linear_1s_call_us``: a second by the rule "linear", which has the Doppler log alone between its samples.

``factor_us``: one linearisation of the two Python factors, of the one that iSAM2 has for odometry with a gyro bias, and
of the compiled ones that come nearest.

All take turns, and the fastest round of each counts.
"""

import sys
import time
from collections.abc import Callable
from pathlib import Path

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

sys.path.append(str(Path(__file__).resolve().parents[1]))
from common import make_parser, print_figures, print_table

from sonar_graph.measurements import Dvl, Floats, Imu
from sonar_graph.navigation import JointPreintegrator
from sonar_graph.slam.inertial_factors import doppler_odometry, inertial_doppler_odometry
from sonar_graph.slam.odometry_factor import OdometryWithBias

NS = 1_000_000_000
IMU_HZ, DVL_HZ = 200, 5
GTSAM_CPP_NS = 150.0
FEW_S, MANY_S = 1, 60
GRAVITY = np.array([0.0, 0.0, -9.81])
SENSORS, LINEAR = JointPreintegrator(1e-3, 1e-3), JointPreintegrator(1e-3, 1e-3, rule="linear")


def samples() -> tuple[Imu, Dvl]:
    quick = np.arange(MANY_S * IMU_HZ + 1) * (NS // IMU_HZ)
    slow = np.arange(MANY_S * DVL_HZ + 1) * (NS // DVL_HZ)
    t, s = quick[:, None] / NS, slow[:, None] / NS
    rate = 0.2 * np.sin(t * np.array([0.7, 1.1, 0.4]))
    force = np.array([0.0, 0.0, 9.81]) + 0.2 * np.cos(t * np.array([0.5, 0.9, 1.3]))
    velocity = 0.5 * np.sin(s * np.array([0.4, 0.6, 0.8]))
    return Imu(quick, rate, force), Dvl(slow, velocity, np.full((len(slow), 3, 3), np.nan))


def gtsam_params() -> gtsam.PreintegrationParams:
    params = gtsam.PreintegrationParams.MakeSharedU(9.81)
    params.setGyroscopeCovariance(1e-6 * np.eye(3))
    params.setAccelerometerCovariance(1e-6 * np.eye(3))
    params.setIntegrationCovariance(1e-9 * np.eye(3))
    return params


def per_sample(rows: tuple[Imu, Dvl], seconds: int) -> gtsam.PreintegratedImuMeasurements:
    theirs, dt = gtsam.PreintegratedImuMeasurements(gtsam_params()), 1 / IMU_HZ
    integrate = theirs.integrateMeasurement
    for force, rate in zip(
        list(rows[0].specific_force[: seconds * IMU_HZ]), list(rows[0].angular_velocity), strict=False
    ):
        integrate(force, rate, dt)
    return theirs


def scenario(seconds: int) -> None:
    """GTSAM's own loop in C++ over a motion that it makes up as it goes."""
    motion = gtsam.AcceleratingScenario(gtsam.Rot3(), np.zeros(3), np.zeros(3), np.array([0.1, 0, 0]), np.full(3, 0.1))
    unbiased = gtsam.imuBias.ConstantBias()
    gtsam.ScenarioRunner(motion, gtsam_params(), 1 / IMU_HZ, unbiased).integrate(seconds, unbiased, False)


def fastest(works: dict[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    """Seconds; all take turns."""
    best = dict.fromkeys(works, np.inf)
    for _ in range(rounds):
        for name, work in works.items():
            before = time.perf_counter()
            work()
            best[name] = min(best[name], time.perf_counter() - before)
    return best


def factors(rows: tuple[Imu, Dvl]) -> tuple[dict[str, gtsam.NonlinearFactor], gtsam.Values]:
    motion, theirs = SENSORS.integrate(*rows, 0, FEW_S * NS), per_sample(rows, FEW_S)
    pose, values = motion.relative_pose(), gtsam.Values()
    values.insert(X(0), gtsam.Pose3())
    values.insert(X(1), pose.i_T_j)
    values.insert(B(0), gtsam.imuBias.ConstantBias())
    values.insert(B(1), np.zeros(3))
    for key in (V(0), V(1)):
        values.insert(key, np.zeros(3))
    noise = gtsam.noiseModel.Gaussian.Covariance(pose.covariance)
    return {
        "OdometryWithBias (Python)": OdometryWithBias(X(0), X(1), B(1), pose),
        "doppler_odometry (Python)": doppler_odometry(X(0), X(1), B(0), motion),
        "inertial_doppler_odometry (Python)": inertial_doppler_odometry(X(0), V(0), X(1), V(1), B(0), motion, GRAVITY),
        "BetweenFactorPose3 (compiled)": gtsam.BetweenFactorPose3(X(0), X(1), pose.i_T_j, noise),
        "ImuFactor (compiled)": gtsam.ImuFactor(X(0), V(0), X(1), V(1), B(0), theirs),
    }, values


def many(factor: gtsam.NonlinearFactor, values: gtsam.Values, times: int) -> None:
    for _ in range(times):
        factor.linearize(values)


def preintegration_ns(rows: tuple[Imu, Dvl], rounds: int) -> dict[str, Floats]:
    """Nanoseconds a call for few and for many seconds of samples."""
    found = []
    for seconds in (FEW_S, MANY_S):
        works: dict[str, Callable[[], object]] = {
            "ours": lambda seconds=seconds: SENSORS.integrate(*rows, 0, seconds * NS),
            "linear": lambda seconds=seconds: LINEAR.integrate(*rows, 0, seconds * NS),
            "gtsam": lambda seconds=seconds: per_sample(rows, seconds),
            "scenario": lambda seconds=seconds: scenario(seconds),
        }
        found.append(fastest(works, rounds))
    return {name: np.array([1e9 * best[name] for best in found]) for name in found[0]}


def main() -> int:
    quick = make_parser(__doc__).parse_args().quick
    rows, rounds = samples(), 10 if quick else 60
    for sensors in (SENSORS, LINEAR):
        sensors.integrate(*rows, 0, NS)
    cost = preintegration_ns(rows, rounds)
    more = (MANY_S - FEW_S) * IMU_HZ
    slopes = {name: float(np.diff(values)[0]) / more for name, values in cost.items()}
    made, values = factors(rows)
    times = 30  # short enough that some rounds are not disturbed
    lines = fastest({name: lambda f=factor: many(f, values, times) for name, factor in made.items()}, 7 * rounds)
    factor_us = {name: round(1e6 * seconds / times, 2) for name, seconds in lines.items()}
    print_table(["a sample", "ns"], [["ours", slopes["ours"]], ["GTSAM from Python", slopes["gtsam"]]])
    print_table(["linearisation", "µs"], list(factor_us.items()))
    figures = {
        "ours_ns": slopes["ours"],
        "ours_1s_call_us": float(cost["ours"][0]) / 1e3,
        "linear_1s_call_us": float(cost["linear"][0]) / 1e3,
        "gtsam_python_ns": slopes["gtsam"],
        "gtsam_scenario_ns": slopes["scenario"],
        "gtsam_cpp_ns": GTSAM_CPP_NS,
        "gtsam_cpp_ratio": slopes["ours"] / GTSAM_CPP_NS,
        "gtsam_python_ratio": float((cost["gtsam"] / cost["ours"]).min()),
    }
    rounded: dict[str, object] = {name: float(f"{value:.4g}") for name, value in figures.items()}
    passed = figures["gtsam_cpp_ratio"] <= 2 and figures["gtsam_python_ratio"] >= 4
    print_figures({**rounded, "factor_us": factor_us, "passed": passed})
    return 0


if __name__ == "__main__":
    sys.exit(main())
