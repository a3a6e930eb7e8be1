"""EKF-SLAM, the smoother and dead reckoning where they must agree."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from baselines.dead_reckoning import DeadReckoning
from baselines.ekf_slam import EkfSlam, EkfSlamParams
from baselines.invariant_ekf import InvariantEkf, InvariantEkfParams
from sonar_graph.calibration import (
    Calibration,
    DvlCalibration,
    ImuCalibration,
    Mounting,
    Start,
)
from sonar_graph.estimator import Estimator
from sonar_graph.measurements import (
    NS_PER_S,
    Depth,
    Dvl,
    Floats,
    Heading,
    Imu,
    Measurements,
    PositionFixes,
)
from sonar_graph.navigation import Odometry
from sonar_graph.sequence import Sequence
from sonar_graph.simulation import MissionOptions, simulate_mission
from sonar_graph.slam import (
    GaussianKernel,
    Isam2,
    Isam2Params,
    KeyframeParams,
    RobustKernel,
    SmootherParams,
)
from sonar_graph.states import Estimate, Refusal
from sonar_graph.testing import aided_world

from .slam.rail import STEP_S, T0_NS, rail

NODES = 21
EVERY_NODE = KeyframeParams(max_interval_s=0.1)
SMOOTHERS = {
    name: Isam2Params(
        kernel=GaussianKernel(),
        smoother=SmootherParams(
            lag_s=lag_s, relinearize_threshold=1e-6, waiting_gain=0.0
        ),
        keyframes=EVERY_NODE,
    )
    for name, lag_s in (("everything kept", 1e6), ("three seconds kept", 3.1))
}
smoothers = pytest.mark.parametrize("params", SMOOTHERS.values(), ids=SMOOTHERS)
each = pytest.mark.parametrize("kind", [EkfSlam, InvariantEkf, Isam2])
FILTERS = {
    EkfSlam: EkfSlamParams(),
    InvariantEkf: InvariantEkfParams(kernel_width=0.0),
}
"""Both filters, with Gaussian noise."""


def run(
    kind: type[Estimator],
    sequence: Sequence,
    rate_hz: float = 1 / STEP_S,
    params: Any = None,
) -> tuple[Estimator, list[Estimate]]:
    """The estimator after the sequence, and its estimates."""
    estimator = kind(sequence.calibration, Odometry(sequence.calibration), params)
    answers = [
        estimator.process(step) for step in sequence.replay(sequence.instants(rate_hz))
    ]
    return estimator, [answer for answer in answers if answer is not None]


def difference(
    one: list[Estimate], other: list[Estimate], axes: slice = slice(0, 6)
) -> tuple[float, float]:
    """Largest difference of pose (m, rad) and of the covariance of some axes, relative to the sigmas."""
    assert [e.stamp_ns for e in one] == [e.stamp_ns for e in other]
    poses = []
    covs = []
    for a, b in zip(one, other, strict=True):
        a_T_b = a.world_T_body.inverse().compose(b.world_T_body)
        poses.append(np.abs(a_T_b.matrix() - np.eye(4)).max())
        sigma = np.sqrt(np.diag(b.covariance)[axes])
        off = (a.covariance - b.covariance)[axes, axes] / np.outer(sigma, sigma)
        covs.append(np.abs(off).max())
    return max(poses), max(covs)


@smoothers
def test_filter_and_smoother_are_least_squares_where_all_is_linear(params):
    """At every node, with what was measured until then, along x, and in the map at the end: to 1e-6."""
    sequence, numbers = rail(NODES)
    for kind, own in (FILTERS | {Isam2: params}).items():
        estimator, estimates = run(kind, sequence, params=own)
        for k, estimate in enumerate(estimates, 1):
            mean, variance = numbers.solution(k + 1)
            assert estimate.world_T_body.translation()[0] == pytest.approx(
                mean[f"x{k}"], abs=1e-6
            )
            assert estimate.covariance[3, 3] == pytest.approx(
                variance[f"x{k}"], abs=1e-6 * variance[f"x{k}"] ** 0.5
            )
        found = estimator.landmarks()
        assert found.ids.tolist() == [4, 7]
        assert found.positions[:, 0] == pytest.approx(
            [mean["l4"], mean["l7"]], abs=1e-6
        )
        assert found.covariances[:, 0, 0] == pytest.approx(
            [variance["l4"], variance["l7"]], abs=1e-6
        )


@pytest.mark.parametrize(
    ("params", "kernel_width"),
    [(EkfSlamParams(), 0.0), (InvariantEkfParams(), 1.5)],
    ids=["ekf-slam", "invariant-ekf"],
)
def test_filters_judge_detections_as_the_smoother_or_as_published(params, kernel_width):
    smoother = Isam2Params()
    assert smoother.kernel == RobustKernel(shape="cauchy", width=1.5)
    assert params.kernel_width == kernel_width
    assert params.minimum_id_probability == smoother.identity.minimum_probability
    assert params.gate_probability == 1.0
    assert np.isinf(smoother.identity.gate)


@smoothers
@pytest.mark.parametrize("with_fixes", [False, True])
def test_filter_and_smoother_agree_where_all_is_linear(params, with_fixes):
    """Between nodes too, and in all that is known of the pose; by position fixes between nodes as well.

    An azimuth constrains y less from farther off, and filters do not re-linearise: 2e-6 of the variance of y.
    """
    sequence, _ = rail(NODES)
    _, without = run(EkfSlam, sequence)
    fixes_ns = sequence.dvl.stamps_ns[1:-1] + NS_PER_S // 10
    x = [estimate.world_T_body.translation()[0] + 0.12 for estimate in without]
    places = np.outer(x[: len(fixes_ns)], [1.0, 0.0, 0.0])
    fixes = PositionFixes(
        fixes_ns, places, np.tile(0.1 * np.eye(3), (len(places), 1, 1))
    )
    aided = replace(sequence, positions=fixes) if with_fixes else sequence
    ekf, invariant, smoother = (
        run(kind, aided, 10, own)[1]
        for kind, own in (FILTERS | {Isam2: params}).items()
    )
    for estimates in (ekf, invariant):
        assert max(difference(estimates, smoother, slice(3, 4))) < 1e-6
        assert difference(estimates, smoother, slice(3, 6))[1] < 1e-5
    if with_fixes:
        _, without = run(EkfSlam, sequence, 10)
        assert difference(ekf, without, slice(3, 4))[1] > 0.1


@each
def test_headings_of_a_biased_compass_are_the_textbook_s_scalar_update(kind):
    """At rest: n of them have the variance ``bias^2 + sigma^2 / n``, and ``1 / P' = 1 / P + 1 / R``."""
    n = 21
    yaw_rad = 0.01
    sigma = 0.02
    bias = 0.05
    prior = 0.3
    sequence, _ = rail()
    start = sequence.calibration.start.model_copy(
        update={"rpy_sigma_rad": (1e-6, 1e-6, prior)}
    )
    known = sequence.calibration.model_copy(update={"start": start})
    still = replace(sequence.dvl, velocity=np.zeros((NODES, 3)))
    heading = Heading(sequence.dvl.stamps_ns, np.full(n, yaw_rad), np.full(n, sigma))
    at_rest = replace(
        sequence, calibration=known, dvl=still, heading=heading, detections=None
    )
    estimate = run(kind, at_rest, 1.0)[1][-1]
    R = bias**2 + sigma**2 / n
    assert estimate.world_T_body.rotation().yaw() == pytest.approx(
        yaw_rad * prior**2 / (prior**2 + R), abs=1e-6
    )
    assert estimate.covariance[2, 2] == pytest.approx(
        1 / (1 / prior**2 + 1 / R), rel=1e-3
    )


def winding(gyro_bias_sigma: float = 0.0) -> Sequence:
    """A minute of driving, turning and leaning, with lever arms, and nothing that could correct it."""
    calibration = Calibration(
        imu=ImuCalibration(
            gyro_noise_density=1e-3,
            gyro_bias_sigma=gyro_bias_sigma,
            gyro_bias_walk_density=0.0,
        ),
        dvl=DvlCalibration(
            velocity_sigma_m_s=(0.01, 0.02, 0.03),
            mounting=Mounting(translation_m=(-0.4, 0.1, -0.2), rpy_rad=(0, 0, 0.8)),
        ),
        start=Start(
            position_m=(1, 2, -3),
            rpy_rad=(0.1, -0.2, 2.5),
            position_sigma_m=(0.1, 0.02, 0.3),
            rpy_sigma_rad=(0.01, 0.02, 0.03),
        ),
        use_gravity=False,
    )
    imu_ns, dvl_ns = (T0_NS + np.arange(60 * hz + 1) * NS_PER_S // hz for hz in (50, 6))
    rates, velocities = (_waves((ns - T0_NS) * 1e-9) for ns in (imu_ns, dvl_ns))
    into_dvl = Rotation.from_euler("z", 0.8).inv()
    return Sequence(
        "winding",
        calibration,
        Imu(imu_ns, 0.15 * rates, np.full((len(imu_ns), 3), np.nan)),
        Dvl(
            dvl_ns,
            into_dvl.apply([0.5, 0, 0] + 0.1 * velocities),
            np.full((len(dvl_ns), 3, 3), np.nan),
        ),
    )


def _waves(t: Floats) -> Floats:
    return np.column_stack([np.sin(1.1 * t), np.cos(0.7 * t), 0.5 + np.sin(0.3 * t)])


def test_without_sightings_all_are_dead_reckoning():
    """Poses and whole covariances, at nodes and between them."""
    _, reckoned = run(DeadReckoning, winding(), 3.7)
    for kind in (EkfSlam, InvariantEkf, Isam2):
        assert max(difference(run(kind, winding(), 3.7)[1], reckoned)) < 1e-6


@pytest.mark.parametrize("kind", [InvariantEkf, Isam2])
def test_without_sightings_a_state_carries_the_bias_as_dead_reckoning_does(kind):
    """A constant, unobservable bias: unknown, and the same at all times."""
    sequence = winding(gyro_bias_sigma=2e-3)
    _, reckoned = run(DeadReckoning, sequence, 3.7)
    poses, covariances = difference(run(kind, sequence, 3.7)[1], reckoned)
    assert poses < 1e-6
    assert covariances < 1e-3
    _, unaware = run(DeadReckoning, winding(), 3.7)
    assert difference(unaware, reckoned)[1] > 0.1


@each
def test_rows_of_a_call_older_than_the_newest_are_used_or_named(kind):
    """Rows of a sensor come 2 s late, in a call that ends before the one before: a fix counts, the others cannot."""
    sequence, _ = rail(NODES)
    estimator, _ = run(kind, sequence)
    others, _ = run(kind, sequence)
    end_ns = sequence.end_ns
    late_ns = np.array([end_ns - 3 * NS_PER_S, end_ns - 2 * NS_PER_S])
    zero = np.zeros(2)
    sigma = np.full(2, 0.01)
    late = Measurements(
        int(late_ns[-1]),
        depth=Depth(late_ns, zero, sigma**2),
        heading=Heading(late_ns, zero, sigma),
        positions=PositionFixes(
            late_ns, np.full((2, 3), 0.3), np.tile(1e-6 * np.eye(3), (2, 1, 1))
        ),
    )
    assert estimator.process(late) is None
    named, before = (
        [(row.sensor, row.stamp_ns, row.reason) for row in one.refused_rows()]
        for one in (estimator, others)
    )
    expected = [
        (sensor, int(t), Refusal.LATE)
        for sensor in ("depth", "heading")
        for t in late_ns
    ]
    assert sorted(named) == sorted([*before, *expected])
    after, without = (
        one.process(Measurements(end_ns + 1)).world_T_body.translation()
        for one in (estimator, others)
    )
    assert np.linalg.norm(after - without) > 0.01


@each
@pytest.mark.parametrize(
    ("wrong", "said"),
    [("heading", "headings contradict its yaw"), ("positions", "position fixes")],
)
def test_headings_or_fixes_that_contradict_the_estimate_are_counted(kind, wrong, said):
    """Its compass' bias follows them in time and hides that. Single outliers and an unsure start are no matter."""
    world = aided_world()
    rows = getattr(world, wrong)
    column = "yaw_rad" if wrong == "heading" else "position_m"
    # depths know z
    off = np.array(2.0 if wrong == "heading" else [40.0, 40.0, 0.0])
    for sigma, every, is_told in ((1e-3, 1, True), (1e-3, 10, False), (50.0, 1, False)):
        start = {"position_sigma_m": (sigma,) * 3}
        start["rpy_sigma_rad"] = (1e-3, 1e-3, min(sigma, 2.0))
        known = world.calibration.model_copy(
            update={"start": world.calibration.start.model_copy(update=start)}
        )
        values = getattr(rows, column).copy()
        values[::every] += off
        given = replace(world, calibration=known, detections=None)
        given = replace(given, heading=None, positions=None)
        values_off = {wrong: replace(rows, **{column: values})}
        estimator, _ = run(kind, replace(given, **values_off))
        told = [line for line in estimator.withheld() if said in line]
        assert bool(told) == is_told, (sigma, every, estimator.withheld())
        if told:
            count, judged = map(int, told[0].split(" ")[0:3:2])
            assert 0.8 * judged < count <= judged <= len(rows)


AT_NS = T0_NS + 5 * NS_PER_S
NO_ROWS = {
    "sigma of more than a turn": Heading([AT_NS], [0.0], [1e200]),
    "more turns than a double keeps": Heading([AT_NS], [1e300], [0.01]),
    "beyond the Earth": PositionFixes([AT_NS], [[1e12] * 3], [np.eye(3)]),
    "beyond everything": PositionFixes(
        [AT_NS], [[1e200] * 3], np.full((1, 3, 3), np.nan)
    ),
    "sigma beyond the Earth": PositionFixes([AT_NS], [[0.0] * 3], [1e300 * np.eye(3)]),
}


@each
@pytest.mark.parametrize("row", NO_ROWS.values(), ids=NO_ROWS)
def test_an_impossible_heading_or_fix_is_named_and_changes_nothing(kind, row):
    sequence, _ = rail(NODES)
    sensor = "heading" if isinstance(row, Heading) else "positions"
    estimator, estimates = run(kind, replace(sequence, **{sensor: row}))
    assert [refused[:3] for refused in estimator.refused_rows()] == [
        (sensor, AT_NS, Refusal.UNSOUND)
    ]
    assert max(difference(estimates, run(kind, sequence)[1])) < 1e-9


def test_dead_reckoning_names_the_headings_and_fixes_that_it_does_not_use():
    for sequence, told in (
        (aided_world(), ["headings and position fixes of the log are not used"]),
        (winding(), []),
    ):
        assert run(DeadReckoning, sequence, 3.7)[0].withheld() == told


@pytest.mark.parametrize("kind", [DeadReckoning, EkfSlam, InvariantEkf, Isam2])
def test_the_start_pose_holds_where_the_imu_begins_between_two_velocities(kind):
    """Not at the next row of a slow Doppler log, a third of a metre later; however the log is cut into calls."""
    whole = simulate_mission(MissionOptions(seed=2, duration_s=20.0, landmarks=6))
    dvl = whole.dvl.rows(slice(None, None, 7))
    imu = whole.imu.rows(whole.imu.stamps_ns >= dvl.stamps_ns[0] + 300_000_000)
    pose = whole.true_poses.at(imu.stamps_ns[:1])
    yaw, pitch, roll = pose.rotations().as_euler("ZYX")[0].tolist()
    start = Start(position_m=tuple(pose.positions[0]), rpy_rad=(roll, pitch, yaw))
    calibration = whole.calibration.model_copy(update={"start": start})
    cut = replace(whole, imu=imu, dvl=dvl, calibration=calibration)
    assert cut.start_ns == imu.stamps_ns[0]
    ends = []
    for rate_hz in (0.7, 5.0):
        estimator, _ = run(kind, cut, rate_hz)
        ends.append(estimator.trajectory().at(imu.stamps_ns[1500:1501]).positions[0])
    truth = whole.true_poses.at(imu.stamps_ns[1500:1501]).positions[0]
    assert np.linalg.norm(ends[0] - truth) < 0.1
    np.testing.assert_allclose(ends[0], ends[1], atol=0.02)
