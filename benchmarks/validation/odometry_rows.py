"""Gain by accelerometers in odometry: twelve rows, six with them between Doppler samples, or six without.

* Keyframes: error of one displacement by the rules "linear" (what every estimator here takes for odometry) and
  "inertial", and as the estimators have it where ``dvl.gap_s`` is below the Doppler log's interval, so that each
  counts as a gap; and its normalised square by the covariance, per dimension (1 is consistent). On the vehicles of
  `preintegration_consistency`, gentle (knots every 3 s) and brisk (every second).
* Chains of motions alone, biases as unknowns with their priors, each motion ``after`` the one before: basins of 240 s,
  and the A-KIT trajectories with their stamps put right as in `akit`. Twice the graph's error at the solution
  (chi-square) over its degrees of freedom, position, roll and pitch at the end against the truth, and the normalised
  squares of both (of little meaning at sea, where the reference is no truth; trajectory 6, whose start attitude is
  unsure, is left out of the means). "gravity" has a direction of gravity at each keyframe, as iSAM2 has where the
  calibration says so.

There is no target.
"""

import sys
import time
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

sys.path.append(str(Path(__file__).resolve().parents[1]))
sys.path.append(str(Path(__file__).resolve().parent))
from akit import realigned, with_imu_at
from akit_landmarks import UNSURE_START
from common import in_parallel, make_parser, print_figures, print_table, recording
from preintegration_consistency import ACCEL_DENSITY, NS, Case, errors, measure
from spline_vehicle import BODY_P_DVL, BODY_P_IMU, BODY_R_DVL, Vehicle, make_vehicle

from sonar_graph.calibration import Calibration, DvlCalibration, ImuCalibration, Mounting
from sonar_graph.logs.convert import read_akit
from sonar_graph.measurements import Dvl, Floats, Imu, Ints
from sonar_graph.navigation import (
    DISPLACEMENT,
    DopplerRule,
    JointMotion,
    JointPreintegrator,
    Odometry,
)
from sonar_graph.navigation.alignment import (
    earth_rate_in_world,
    gravity_direction,
    match_dvl_to_imu,
    match_reference_to_imu,
)
from sonar_graph.sequence import Sequence
from sonar_graph.simulation import BasinOptions, simulate_basin
from sonar_graph.slam import factors
from sonar_graph.slam.inertial_factors import doppler_odometry, inertial_doppler_odometry

RATES_HZ = (1.0, 2.0, 5.0, 10.0)
WAYS = ("linear", "inertial", "small gap_s")
KNOTS_S = {"gentle": 3.0, "brisk": 1.0}
BASIN_STEP, AKIT_STEP = 14, 5
"""Doppler samples in a motion: 2 s and 5 s."""
ITERATIONS = 6
ERRORS = ("error_m", "tilt_rad")


class Rows(NamedTuple):
    """Factor of a motion in the graph."""

    rule: DopplerRule
    is_inertial: bool
    """Twelve rows."""
    has_gravity: bool = False


KINDS = {
    "12": Rows("inertial", True),
    "6": Rows("inertial", False),
    "6 linear": Rows("linear", False),
    "6, gravity": Rows("inertial", False, True),
    "6 linear, gravity": Rows("linear", False, True),
}
UNPLACED, NO_EARTH = "IMU at the reference's point", "Earth at rest"
VARIANTS = {UNPLACED: "12", NO_EARTH: "12", "12": "12", "6": "6", "6 linear": "6 linear"}
"""Of A-KIT; the first two are what a wrong calibration does."""


@dataclass(frozen=True)
class Told:
    """Errors and covariances of one chain."""

    chi_square: float
    dof: int
    error_m: float
    tilt_rad: float
    position_nees: float
    tilt_nees: float
    accel_bias_up: float
    """What is found of it along the body's z axis, m/s²."""
    iteration_ms: float
    """One linearisation and solution of the whole chain."""


def nodes_of(sequence: Sequence, step: int) -> Ints:
    """Doppler stamps at which motions end."""
    stamps, imu_ns = sequence.dvl.stamps_ns, sequence.imu.stamps_ns
    assert sequence.truth is not None
    last_ns = min(imu_ns[-1], sequence.truth.stamps_ns[-1])
    return stamps[(stamps >= imu_ns[0]) & (stamps <= last_ns)][::step]


def motions(sequence: Sequence, nodes: Ints, rule: DopplerRule, earth: Floats | None) -> list[JointMotion]:
    """One after another, the Earth's rotation turned into each first frame by the path so far."""
    sensors = JointPreintegrator.from_calibration(sequence.calibration, rule)
    world_R_i, found = sequence.calibration.start.pose().rotation(), list[JointMotion]()
    for start_ns, end_ns in pairwise(nodes.tolist()):
        earth_i = None if earth is None else world_R_i.unrotate(earth)
        motion = sensors.integrate(sequence.imu, sequence.dvl, start_ns, end_ns, earth_rate=earth_i)
        found.append(motion.after(found[-1]) if found else motion)
        world_R_i = world_R_i.compose(motion.i_R_j)
    return found


def gravity(sequence: Sequence, n: int, motion: JointMotion) -> gtsam.NonlinearFactor:
    """The direction of gravity at the end of motion n."""
    calibration, rows = sequence.calibration, np.searchsorted(sequence.dvl.stamps_ns, [motion.start_ns, motion.end_ns])
    imu, log = calibration.imu.mounting.pose(), calibration.dvl.mounting.pose()
    rates = rates_at(sequence, sequence.dvl.stamps_ns[rows]) @ imu.rotation().matrix().T
    at_imu = sequence.dvl.velocity[rows] @ log.rotation().matrix().T
    at_imu = at_imu + np.cross(rates, imu.translation() - log.translation())
    sigma = float(np.sqrt(np.mean(np.square(calibration.dvl.velocity_sigma_m_s))))
    told = gravity_direction(motion.relative_pose(), *at_imu, sigma, calibration)
    assert told is not None
    return factors.gravity_direction(X(n + 1), *told)


def rates_at(sequence: Sequence, stamps_ns: Ints) -> Floats:
    """Angular rates, IMU axes."""
    return np.column_stack([np.interp(stamps_ns, sequence.imu.stamps_ns, w) for w in sequence.imu.angular_velocity.T])


def chain(
    sequence: Sequence, chained: list[JointMotion], kind: Rows
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """The graph, and where the path by odometry alone is."""
    imu, down = sequence.calibration.imu, np.array([0.0, 0.0, -sequence.calibration.gravity_m_s2])
    graph, values, pose = gtsam.NonlinearFactorGraph(), gtsam.Values(), sequence.calibration.start.pose()
    sigmas = np.repeat([imu.accel_bias_sigma, imu.gyro_bias_sigma], 3)
    unbiased = gtsam.imuBias.ConstantBias()
    graph.add(factors.start_prior(X(0), sequence.calibration))
    graph.add(gtsam.PriorFactorConstantBias(B(0), unbiased, gtsam.noiseModel.Diagonal.Sigmas(sigmas)))
    values.insert(B(0), unbiased)
    values.insert(X(0), pose)
    if kind.is_inertial:
        values.insert(V(0), np.zeros(3))
    for n, motion in enumerate(chained):
        pose = pose.compose(motion.relative_pose().i_T_j)
        values.insert(X(n + 1), pose)
        if kind.is_inertial:
            values.insert(V(n + 1), np.zeros(3))
            graph.add(inertial_doppler_odometry(X(n), V(n), X(n + 1), V(n + 1), B(0), motion, down))
        else:
            graph.add(doppler_odometry(X(n), X(n + 1), B(0), motion))
        if kind.has_gravity:
            graph.add(gravity(sequence, n, motion))
    return graph, values


def solve(sequence: Sequence, step: int, kind: Rows, earth: Floats | None) -> Told:
    """Gauss-Newton on one chain."""
    nodes = nodes_of(sequence, step)
    graph, values = chain(sequence, motions(sequence, nodes, kind.rule, earth), kind)
    fastest_s = np.inf
    for _ in range(ITERATIONS):
        before = time.perf_counter()
        values = values.retract(graph.linearize(values).optimize())
        fastest_s = min(fastest_s, time.perf_counter() - before)
    last = X(len(nodes) - 1)
    assert sequence.truth is not None
    true = sequence.truth.at(nodes[-1:])
    found, cov = values.atPose3(last), gtsam.Marginals(graph, values).marginalCovariance(last)
    truth = gtsam.Pose3(gtsam.Rot3(true.rotations()[0].as_matrix()), true.positions[0])
    error = gtsam.Pose3.Logmap(found.between(truth))
    rows = sum(graph.at(n).dim() for n in range(graph.size())) - len(nodes[1:]) * kind.has_gravity
    return Told(
        2.0 * graph.error(values),
        int(rows - values.dim()),
        float(np.linalg.norm(found.translation() - truth.translation())),
        float(np.linalg.norm(error[:2])),
        square(error[3:], cov[3:, 3:]),
        square(error[:2], cov[:2, :2]),
        float(values.atConstantBias(B(0)).accelerometer()[2]),
        1e3 * float(fastest_s),
    )


def square(error: Floats, cov: Floats) -> float:
    """Normalised squared error per dimension."""
    return float(error @ np.linalg.solve(cov, error)) / len(error)


def basin(seed: int) -> dict[str, Told]:
    """By kind."""
    sequence = simulate_basin(BasinOptions(seed=seed, duration_s=240.0, laps=1))
    return {name: solve(sequence, BASIN_STEP, kind, None) for name, kind in KINDS.items()}


def at_sea(folder: Path, number: int) -> dict[str, Told]:
    """By variant."""
    recorded = read_akit(folder, number)
    assert recorded.truth is not None
    dvl = match_dvl_to_imu(recorded.imu, recorded.dvl, recorded.calibration)
    reference = match_reference_to_imu(recorded.imu, recorded.truth, recorded.calibration)
    aligned = realigned(recorded, dvl.offset.value, reference.offset.value)
    earth = earth_rate_in_world(aligned.calibration)
    return {
        name: solve(
            with_imu_at(aligned, np.zeros(3)) if name == UNPLACED else aligned,
            AKIT_STEP,
            KINDS[kind],
            None if name == NO_EARTH else earth,
        )
        for name, kind in VARIANTS.items()
    }


def keyframes(runs: int, case: Case) -> Floats:
    """Root mean square error of a displacement, m, and its mean normalised square, by `WAYS`, shape (3, 2)."""
    found, end_ns = [], round(case.keyframe_s * NS)
    for run in range(runs):
        rng = np.random.default_rng([run, *case.seed])
        if run % 20 == 0:
            vehicle = make_vehicle(run, case.keyframe_s + 20.0, case.knot_s)
        start_s = rng.uniform(0.0, 20.0)
        rows = measure(vehicle, start_s, case, rng).rows(noisy_gyro=True)
        made = [case.sensors(rule).integrate(*rows, 0, end_ns) for rule in ("linear", "inertial")]
        told = [
            (errors(vehicle, start_s, motion)[DISPLACEMENT], motion.covariance[DISPLACEMENT, DISPLACEMENT])
            for motion in made
        ]
        told.append(as_gaps(vehicle, start_s, case, rows))
        found.append([[error @ error, square(error, cov)] for error, cov in told])
    means = np.mean(found, axis=0)
    return np.column_stack([np.sqrt(means[:, 0]), means[:, 1]])


def as_gaps(vehicle: Vehicle, start_s: float, case: Case, rows: tuple[Imu, Dvl]) -> tuple[Floats, Floats]:
    """Error and covariance of the body's displacement where every interval counts as a gap."""
    at_imu, at_dvl = (Mounting(translation_m=tuple(place.tolist())) for place in (BODY_P_IMU, BODY_P_DVL))
    turned = at_dvl.model_copy(update={"rpy_rad": tuple(BODY_R_DVL.as_euler("xyz").tolist())})
    sigmas = (case.dvl_sigma,) * 3
    calibration = Calibration(
        imu=ImuCalibration(
            gyro_noise_density=case.gyro_density, accel_noise_density=ACCEL_DENSITY, accel_bias_sigma=0, mounting=at_imu
        ),
        dvl=DvlCalibration(velocity_sigma_m_s=sigmas, mounting=turned, gap_s=0.5 / case.dvl_hz),
    )
    odometry, end_ns = Odometry(calibration), round(case.keyframe_s * NS)
    odometry.add(*rows)
    motion = odometry.motion(0, end_ns, np.zeros(3), known_ns=int(rows[0].stamps_ns[-1]))
    ends = np.array([start_s, start_s + case.keyframe_s])
    R_i, R_j = vehicle.attitude(ends)
    p_i, p_j = vehicle.position(ends)
    truth = gtsam.Pose3(gtsam.Rot3((R_i.inv() * R_j).as_matrix()), R_i.inv().apply(p_j - p_i))
    return gtsam.Pose3.Logmap(motion.i_T_j.between(truth))[3:], motion.covariance[3:, 3:]


def report_keyframes(runs: int, workers: int) -> dict[str, object]:
    """Print the errors of displacements; the figures by name."""
    base = Case(1.0, 1e-4, 0.005, 1.0, keyframes=1, runs=runs)
    cases = {
        f"{name}, {hz:g} Hz": replace(base, dvl_hz=hz, knot_s=knot_s)
        for name, knot_s in KNOTS_S.items()
        for hz in RATES_HZ
    }
    found = in_parallel(partial(keyframes, runs), list(cases.values()), workers, "case")
    rows = [(name, *(of_case * [1e3, 1.0]).T.ravel().tolist()) for name, of_case in zip(cases, found, strict=True)]
    headers = (f"{way} {figure}" for figure in ("rms mm", "NEES") for way in WAYS)
    print_table(("displacement over 1 s", *headers), rows)
    return {f"{name} rms_mm, nees": row for name, *row in rows}


def report_chains(title: str, told: list[dict[str, Told]]) -> dict[str, object]:
    """Print what chains say, on average over runs; the figures by name."""
    rows = []
    for name in told[0]:
        runs = [of_run[name] for of_run in told]
        over_dof = float(np.mean([run.chi_square / run.dof for run in runs])) if runs[0].dof else ""
        rms_m, tilt_rad = (float(np.sqrt(np.mean([getattr(run, of) ** 2 for run in runs]))) for of in ERRORS)
        means = [
            float(np.mean([getattr(run, of) for run in runs])) for of in ("position_nees", "tilt_nees", "accel_bias_up")
        ]
        means[-1] *= 1e3
        rows.append((name, over_dof, runs[0].dof, rms_m, 1e3 * tilt_rad, *means, min(run.iteration_ms for run in runs)))
    headers = (
        "chi-square / dof",
        "dof",
        "end rms m",
        "tilt rms mrad",
        "position NEES",
        "tilt NEES",
        "bias up mm/s²",
        "iteration ms",
    )
    print_table((f"{title}, {len(told)} runs", *headers), rows)
    return {f"{title} {row[0]}": row[1:] for row in rows}


def main() -> None:
    parser = make_parser(__doc__, data=True, workers=True)
    arguments = parser.parse_args()
    runs, seeds, numbers = (40, 4, (1,)) if arguments.quick else (1000, 40, (1, 2, 3, 4, 5, 6, 7))
    with recording(arguments.data, "akit_1-7.tar.xz", "akit") as folder:
        figures = report_keyframes(runs, arguments.workers)
        figures |= report_chains("basin", in_parallel(basin, range(seeds), arguments.workers, "seed"))
        told = in_parallel(partial(at_sea, folder), numbers, arguments.workers, "trajectory")
    kept = [of_run for n, of_run in zip(numbers, told, strict=True) if n not in UNSURE_START]
    figures |= report_chains("A-KIT", kept)
    print_table(
        ("trajectory: chi-square (end m)", *VARIANTS),
        [
            (n, *(f"{of_run[name].chi_square:.0f} ({of_run[name].error_m:.2f})" for name in VARIANTS))
            for n, of_run in zip(numbers, told, strict=True)
        ],
    )
    print_figures(figures | {"passed": True})


if __name__ == "__main__":
    main()
