"""Time of preintegration for an IMU sample, beside GTSAM's inertial preintegration.

    python benchmarks/performance/preintegration.py [--quick]

Ours is the motion of `Odometry`: six errors with their covariance and derivatives by the gyro bias, and the mean
specific force, from a 200 Hz IMU and a 5 Hz Doppler log; the cost of an IMU sample includes the Doppler samples.
GTSAM's `PreintegratedImuMeasurements` has nine errors, no Doppler log, and derivatives by six parameters.

``ours_ns``: slope of ``Odometry.motion`` between few and many samples, nothing kept from an earlier call.
``gtsam_cpp_ratio``: the same over GTSAM's cost in C++, for which 150 ns is taken, measured in a C++ program for the
tangent preintegration (the manifold one: 320 ns), since its Python package takes no batch of samples.
``gtsam_scenario_ns`` bounds it from above in this run: the slope of `ScenarioRunner.integrate`, whose loop is in C++
but also makes up the samples.

``gtsam_python_ratio``: time of `PreintegratedImuMeasurements.integrateMeasurement` called from Python for each sample,
over ours for the same samples (whole calls of ``motion``, not the slope; the lower of few and many samples).
``with_add_ratio``: the same, with the call of ``Odometry.add`` that screens and stores the samples counted as ours.

``epoch_us``: a motion between two successive epochs (40 IMU samples), many in one call of ``Odometry.motions``, as the
filters use it. ``provisional_us``: a motion to the newest IMU row, 30 ms after an epoch until which the sums are kept.
``add_us``: ``Odometry.add`` of the samples of one Doppler interval.

``factor_us``: one linearisation of the factor that iSAM2 has for odometry with a gyro bias, and of the compiled ones
that come nearest.

All take turns, and the fastest round of each counts.
"""

import sys
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

sys.path.append(str(Path(__file__).resolve().parents[1]))
from common import make_parser, print_figures, print_table

from sonar_graph import Calibration, Odometry
from sonar_graph.calibration import ImuCalibration
from sonar_graph.measurements import Dvl, Floats, Imu
from sonar_graph.motion import PreintegratedMotion
from sonar_graph.slam.odometry_factor import OdometryWithBias

NS = 1_000_000_000
IMU_HZ, DVL_HZ = 200, 5
GTSAM_CPP_NS = 150.0
FEW_S, MANY_S = 1, 60
CALIBRATION = Calibration(
    imu=ImuCalibration(gyro_noise_density=1e-3, accel_noise_density=1e-3)
)
NO_BIAS = np.zeros(3)


def samples() -> tuple[Imu, Dvl]:
    quick = np.arange(MANY_S * IMU_HZ + 1) * (NS // IMU_HZ)
    slow = np.arange(MANY_S * DVL_HZ + 1) * (NS // DVL_HZ)
    t, s = quick[:, None] / NS, slow[:, None] / NS
    rate = 0.2 * np.sin(t * np.array([0.7, 1.1, 0.4]))
    force = np.array([0.0, 0.0, 9.81]) + 0.2 * np.cos(t * np.array([0.5, 0.9, 1.3]))
    velocity = 0.5 * np.sin(s * np.array([0.4, 0.6, 0.8]))
    return Imu(quick, rate, force), Dvl(
        slow, velocity, np.full((len(slow), 3, 3), np.nan)
    )


def filled(rows: tuple[Imu, Dvl]) -> Odometry:
    odometry = Odometry(CALIBRATION)
    odometry.add(*rows)
    return odometry


def part(rows: tuple[Imu, Dvl], seconds: int) -> tuple[Imu, Dvl]:
    """The samples until an instant, as a logger would hand them over."""
    imu, dvl = (block.between(-1, seconds * NS) for block in rows)
    assert imu is not None
    assert dvl is not None
    return imu, dvl


class AnyBias:
    """Motions of one odometry, each for another bias, so that nothing is kept from one call to the next."""

    def __init__(self, odometry: Odometry) -> None:
        self._odometry = odometry
        self._biases = [NO_BIAS, 1e-9 * np.ones(3)]
        self._known_ns = MANY_S * NS

    def __call__(self, seconds: int) -> PreintegratedMotion:
        self._biases.reverse()
        return self._odometry.motion(
            0, seconds * NS, self._biases[0], known_ns=self._known_ns
        )


def gtsam_params() -> gtsam.PreintegrationParams:
    params = gtsam.PreintegrationParams.MakeSharedU(9.81)
    params.setGyroscopeCovariance(1e-6 * np.eye(3))
    params.setAccelerometerCovariance(1e-6 * np.eye(3))
    params.setIntegrationCovariance(1e-9 * np.eye(3))
    return params


def per_sample(
    rows: tuple[Imu, Dvl], seconds: int
) -> gtsam.PreintegratedImuMeasurements:
    theirs, dt = gtsam.PreintegratedImuMeasurements(gtsam_params()), 1 / IMU_HZ
    integrate = theirs.integrateMeasurement
    for force, rate in zip(
        list(rows[0].specific_force[: seconds * IMU_HZ]),
        list(rows[0].angular_velocity),
        strict=False,
    ):
        integrate(force, rate, dt)
    return theirs


def scenario(seconds: int) -> None:
    """GTSAM's own loop in C++ over a motion that it makes up as it goes."""
    motion = gtsam.AcceleratingScenario(
        gtsam.Rot3(), np.zeros(3), np.zeros(3), np.array([0.1, 0, 0]), np.full(3, 0.1)
    )
    unbiased = gtsam.imuBias.ConstantBias()
    gtsam.ScenarioRunner(motion, gtsam_params(), 1 / IMU_HZ, unbiased).integrate(
        seconds, unbiased, False
    )


def fastest(works: dict[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    """Seconds; all take turns."""
    best = dict.fromkeys(works, np.inf)
    for _ in range(rounds):
        for name, work in works.items():
            before = time.perf_counter()
            work()
            best[name] = min(best[name], time.perf_counter() - before)
    return best


def factors(
    rows: tuple[Imu, Dvl],
) -> tuple[dict[str, gtsam.NonlinearFactor], gtsam.Values]:
    motion, theirs = (
        filled(rows).motion(0, FEW_S * NS, NO_BIAS, known_ns=MANY_S * NS),
        per_sample(rows, FEW_S),
    )
    values = gtsam.Values()
    values.insert(X(0), gtsam.Pose3())
    values.insert(X(1), motion.i_T_j)
    values.insert(B(0), gtsam.imuBias.ConstantBias())
    values.insert(B(1), np.zeros(3))
    for key in (V(0), V(1)):
        values.insert(key, np.zeros(3))
    noise = gtsam.noiseModel.Gaussian.Covariance(motion.covariance)
    return {
        "OdometryWithBias (Python)": OdometryWithBias(X(0), X(1), B(1), motion),
        "BetweenFactorPose3 (compiled)": gtsam.BetweenFactorPose3(
            X(0), X(1), motion.i_T_j, noise
        ),
        "ImuFactor (compiled)": gtsam.ImuFactor(X(0), V(0), X(1), V(1), B(0), theirs),
    }, values


def many(work: Callable[[], object], times: int) -> None:
    for _ in range(times):
        work()


def preintegration_ns(rows: tuple[Imu, Dvl], rounds: int) -> dict[str, Floats]:
    """Nanoseconds a call for few and for many seconds of samples."""
    found = []
    motion = AnyBias(filled(rows))
    for seconds in (FEW_S, MANY_S):
        block = part(rows, seconds)
        works: dict[str, Callable[[], object]] = {
            "ours": lambda seconds=seconds: motion(seconds),
            "add": lambda block=block: filled(block),
            "gtsam": lambda seconds=seconds: per_sample(rows, seconds),
            "scenario": lambda seconds=seconds: scenario(seconds),
        }
        found.append(fastest(works, rounds))
    return {name: np.array([1e9 * best[name] for best in found]) for name in found[0]}


def calls_us(rows: tuple[Imu, Dvl], rounds: int) -> dict[str, float]:
    """Microseconds of the calls of filters and of predictions."""
    odometry = filled(rows)
    epochs_ns = odometry.epochs(-1, MANY_S * NS)
    starts_ns, ends_ns = epochs_ns[:-1].copy(), epochs_ns[1:].copy()
    known_ns = np.full(len(starts_ns), MANY_S * NS)
    newest_ns = int(epochs_ns[-2]) + 30_000_000
    cuts_ns = np.append(-1, epochs_ns).tolist()
    blocks = [[block.between(a, b) for block in rows] for a, b in pairwise(cuts_ns)]

    def add_all() -> None:
        growing = Odometry(CALIBRATION)
        for block in blocks:
            growing.add(*block)

    times = 20
    works: dict[str, Callable[[], object]] = {
        "epoch_us": lambda: odometry.motions(starts_ns, ends_ns, known_ns, NO_BIAS),
        "provisional_us": lambda: many(
            lambda: odometry.motion(0, newest_ns, NO_BIAS), times
        ),
        "add_us": add_all,
    }
    seconds = fastest(works, rounds)
    counts = {
        "epoch_us": len(starts_ns),
        "provisional_us": times,
        "add_us": len(blocks),
    }
    return {name: 1e6 * seconds[name] / count for name, count in counts.items()}


def main() -> int:
    quick = make_parser(__doc__).parse_args().quick
    rows, rounds = samples(), 10 if quick else 60
    AnyBias(filled(rows))(FEW_S)  # compiles
    cost = preintegration_ns(rows, rounds)
    more = (MANY_S - FEW_S) * IMU_HZ
    slopes = {name: float(np.diff(values)[0]) / more for name, values in cost.items()}
    made, values = factors(rows)
    times = 30  # short enough that some rounds are not disturbed
    lines = fastest(
        {
            name: lambda f=factor: many(lambda: f.linearize(values), times)
            for name, factor in made.items()
        },
        7 * rounds,
    )
    factor_us = {
        name: round(1e6 * seconds / times, 2) for name, seconds in lines.items()
    }
    print_table(
        ["a sample", "ns"],
        [["ours", slopes["ours"]], ["GTSAM from Python", slopes["gtsam"]]],
    )
    print_table(["linearisation", "µs"], list(factor_us.items()))
    figures = {
        "ours_ns": slopes["ours"],
        "ours_1s_call_us": float(cost["ours"][0]) / 1e3,
        "gtsam_python_ns": slopes["gtsam"],
        "gtsam_scenario_ns": slopes["scenario"],
        "gtsam_cpp_ns": GTSAM_CPP_NS,
        "gtsam_cpp_ratio": slopes["ours"] / GTSAM_CPP_NS,
        "gtsam_python_ratio": float((cost["gtsam"] / cost["ours"]).min()),
        "with_add_ratio": float((cost["gtsam"] / (cost["ours"] + cost["add"])).min()),
        **calls_us(rows, rounds),
    }
    rounded: dict[str, object] = {
        name: float(f"{value:.4g}") for name, value in figures.items()
    }
    passed = figures["gtsam_cpp_ratio"] <= 1 and figures["gtsam_python_ratio"] >= 6
    print_figures({**rounded, "factor_us": factor_us, "passed": passed})
    return 0


if __name__ == "__main__":
    sys.exit(main())
