from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import Calibration, DvlCalibration, ImuCalibration, Mounting
from sonar_graph.errors import MeasurementError
from sonar_graph.measurements import Dvl, Imu
from sonar_graph.navigation.odometry import Odometry
from sonar_graph.navigation.preintegration.motion import Preintegrator
from sonar_graph.navigation.preintegration.recursion import Steps
from sonar_graph.states import Refusal

from .rows import NS, T0_NS, dvl, imu, stamps, waves

SECONDS = 3.0


def recorded(
    imu_hz: float = 50, dvl_hz: float = 7, dvl_offset_s: float = 0.013, seconds: float = SECONDS
) -> tuple[Imu, Dvl]:
    imu_ns, dvl_ns = stamps(imu_hz, seconds), stamps(dvl_hz, seconds - 0.5, dvl_offset_s)
    rng = np.random.default_rng(0)
    cov = 1e-4 * (1 + rng.random((len(dvl_ns), 1, 1))) * np.eye(3)
    return imu(imu_ns, waves(imu_ns, 1, 0.5), waves(imu_ns, 3, 1.0)), dvl(dvl_ns, waves(dvl_ns, 2, 0.3), cov)


def odometry_of(imu_rows: Imu | None, dvl_rows: Dvl | None, calibration: Calibration | None = None) -> Odometry:
    odometry = Odometry(calibration or Calibration())
    odometry.add(imu_rows, dvl_rows)
    return odometry


def same_steps(a: Steps, b: Steps) -> bool:
    columns = ("duration_s", "rate", "velocity", "velocity_psd", "specific_force")
    return all(np.array_equal(getattr(a, c), getattr(b, c), equal_nan=True) for c in columns)


@pytest.fixture(params=["linear", "hold-past"])
def calibration(request):
    return Calibration(odometry_interpolation=request.param)


@given(st.lists(st.integers(0, round(SECONDS * NS)), max_size=6))
@settings(max_examples=30)
def test_steps_do_not_depend_on_how_rows_are_cut_into_blocks(cuts):
    imu_rows, dvl_rows = recorded()
    whole, pieces = odometry_of(imu_rows, dvl_rows), Odometry(Calibration())
    edges = [0, *(T0_NS + cut for cut in sorted(cuts)), T0_NS + 10 * NS]
    for after_ns, until_ns in pairwise(edges):
        pieces.add(imu_rows.between(after_ns, until_ns), dvl_rows.between(after_ns, until_ns))
    first, last = (int(whole.nodes(0, T0_NS + 10 * NS)[k]) for k in (0, -1))
    assert pieces.start_ns() == whole.start_ns()
    assert same_steps(pieces.steps_between_nodes(first, last), whole.steps_between_nodes(first, last))


@given(st.integers(round(0.3 * NS), round((SECONDS - 0.6) * NS)))
@settings(max_examples=30)
def test_later_rows_change_nothing(offset_ns):
    """Nodes reached and the provisional motion at t are the same with and without the rows after t."""
    until_ns = T0_NS + offset_ns
    imu_rows, dvl_rows = recorded()
    everything = odometry_of(imu_rows, dvl_rows)
    so_far = odometry_of(imu_rows.between(0, until_ns), dvl_rows.between(0, until_ns))
    nodes = everything.nodes(0, until_ns)
    assert np.array_equal(nodes, so_far.nodes(0, until_ns))
    for node_ns in nodes.tolist():
        here, there = (odometry.steps_since_node(node_ns, until_ns) for odometry in (everything, so_far))
        assert same_steps(here, there)
    assert same_steps(
        everything.steps_between_nodes(int(nodes[0]), int(nodes[-1])),
        so_far.steps_between_nodes(int(nodes[0]), int(nodes[-1])),
    )


def test_provisional_motion_holds_the_newest_rows_until_the_instant():
    imu_ns, dvl_ns = T0_NS + np.array([0, 10, 20]) * NS // 10, T0_NS + np.array([5, 15, 25]) * NS // 10
    odometry = odometry_of(
        imu(imu_ns, [[0, 0, 1], [0, 0, 2], [0, 0, 9]]), dvl(dvl_ns, [[0.1, 0, 0], [0.3, 0, 0], [0.9, 0, 0]])
    )
    steps = odometry.steps_since_node(int(dvl_ns[0]), int(imu_ns[1]) + NS * 4 // 10)
    assert steps.duration_s == pytest.approx([0.5, 0.4])
    assert steps.rate[:, 2] == pytest.approx([1.75, 2.0])
    assert steps.velocity[:, 0] == pytest.approx([0.1, 0.1])


@pytest.mark.parametrize("imu_offset_s", [0.0, 0.004, 0.0095])
def test_interpolation_is_exact_for_piecewise_linear_truth(imu_offset_s):
    """Rate and velocity are a t and v t: the angle is a t^2 / 2, and straight on, the way v t^2 / 2."""
    imu_ns, dvl_ns = stamps(100, 2.2, imu_offset_s - 0.1), stamps(5, 2.0)
    t_imu, t_dvl = (imu_ns - T0_NS) * 1e-9, (dvl_ns - T0_NS) * 1e-9
    odometry = odometry_of(
        imu(imu_ns, np.outer(t_imu, [0.0, 0.0, 0.4])), dvl(dvl_ns, np.outer(t_dvl, [0.3, -0.2, 0.1]))
    )
    until = T0_NS + 2 * NS
    steps = odometry.steps_between_nodes(T0_NS, until)
    assert steps.duration_s.sum() == pytest.approx(2.0)
    assert (steps.duration_s[:, None] * steps.rate).sum(0) == pytest.approx([0, 0, 0.8])
    assert (steps.duration_s[:, None] * steps.velocity).sum(0) == pytest.approx([0.6, -0.4, 0.2])


def test_a_held_sample_is_the_mean_over_the_interval_that_ends_at_its_stamp():
    calibration = Calibration(odometry_interpolation="hold-past")
    at = T0_NS + np.array([0, 2, 3, 7]) * NS
    odometry = odometry_of(
        imu(at, np.outer([9, 1, 2, 3], [0, 0, 1.0])), dvl(at, np.outer([9, 4, 5, 6], [1.0, 0, 0])), calibration
    )
    steps = odometry.steps_between_nodes(T0_NS, T0_NS + 7 * NS)
    assert steps.duration_s == pytest.approx([2, 1, 4])
    assert steps.rate[:, 2] == pytest.approx([1, 2, 3])
    assert steps.velocity[:, 0] == pytest.approx([4, 5, 6])
    assert odometry.velocity_at_node(T0_NS + 3 * NS)[2] == pytest.approx([0, 0, 2])


def test_velocity_at_a_node_is_its_row_and_the_rate_in_between():
    imu_rows, dvl_rows = recorded()
    odometry, k = odometry_of(imu_rows, dvl_rows), 5
    velocity, cov, rate = odometry.velocity_at_node(int(dvl_rows.stamps_ns[k]))
    t = (imu_rows.stamps_ns - T0_NS) * 1e-9
    at = (dvl_rows.stamps_ns[k] - T0_NS) * 1e-9
    assert np.array_equal(velocity, dvl_rows.velocity[k])
    assert np.array_equal(cov, dvl_rows.velocity_cov[k])
    assert rate == pytest.approx([np.interp(at, t, imu_rows.angular_velocity[:, axis]) for axis in range(3)])


def test_a_node_is_reached_only_when_an_imu_row_covers_it():
    imu_ns, dvl_ns = T0_NS + np.array([0, 100, 200]), T0_NS + np.array([-50, 0, 50, 150, 250])
    odometry = odometry_of(imu(imu_ns, 0.0), dvl(dvl_ns, 0.0))
    reached = [(odometry.nodes(0, T0_NS + until) - T0_NS).tolist() for until in (-1, 0, 99, 100, 160, 200, 300)]
    assert reached == [[], [-50, 0], [-50, 0], [-50, 0, 50], [-50, 0, 50], [-50, 0, 50, 150], [-50, 0, 50, 150]]
    assert odometry.start_ns() == T0_NS
    assert (odometry.nodes(T0_NS + 50, T0_NS + 300) - T0_NS).tolist() == [150]


def test_there_is_no_start_before_imu_rows_cover_a_node():
    assert Odometry(Calibration()).start_ns() is None
    assert odometry_of(imu(stamps(10, 1), 0.0), None).start_ns() is None
    assert odometry_of(None, dvl(stamps(10, 1), 0.0)).start_ns() is None
    assert odometry_of(imu(stamps(10, 1), 0.0), dvl(stamps(10, 1, 1.05), 0.0)).start_ns() is None
    assert odometry_of(imu(stamps(10, 1, 5.0), 0.0), dvl(stamps(10, 1), 0.0)).start_ns() is None
    assert odometry_of(imu(stamps(10, 1), 0.0), dvl(stamps(10, 1, -0.33), 0.0)).start_ns() == T0_NS + 70_000_000
    assert odometry_of(imu(stamps(10, 1), 0.0), dvl(stamps(10, 1, 1.0), 0.0)).start_ns() == T0_NS + NS


def test_rows_are_late_once_their_motion_is_settled():
    imu_rows, dvl_rows = recorded()
    odometry = odometry_of(imu_rows, dvl_rows)
    odometry.settle(int(dvl_rows.stamps_ns[-1]))
    first, last = (int(odometry.nodes(0, T0_NS + 10 * NS)[k]) for k in (0, -1))
    before = odometry.steps_between_nodes(first, last)
    odometry.add(imu(imu_rows.stamps_ns[3:9] + 7, 99.0), dvl(dvl_rows.stamps_ns[:4] + 7, 99.0))
    assert same_steps(odometry.steps_between_nodes(first, last), before)
    assert [row.sensor for row in odometry.refused] == ["imu"] * 6 + ["dvl"] * 4
    assert {row.reason for row in odometry.refused} == {Refusal.LATE}


@given(st.permutations(range(12)))
@settings(max_examples=30)
def test_rows_out_of_order_give_the_same_steps_as_in_order(order):
    imu_rows, dvl_rows = recorded()
    agile = Calibration(dvl=DvlCalibration(velocity_walk_density=2.0))
    whole, pieces = odometry_of(imu_rows, dvl_rows, agile), Odometry(agile)
    edges = [0, *(T0_NS + k * NS // 4 for k in range(1, 12)), T0_NS + 10 * NS]
    for k in order:
        pieces.add(imu_rows.between(edges[k], edges[k + 1]), dvl_rows.between(edges[k], edges[k + 1]))
    first, last = (int(whole.nodes(0, T0_NS + 10 * NS)[k]) for k in (0, -1))
    assert not pieces.refused
    assert same_steps(pieces.steps_between_nodes(first, last), whole.steps_between_nodes(first, last))


def test_forgetting_changes_nothing_afterwards(calibration):
    imu_rows, dvl_rows = recorded(seconds=12.0)
    full, forgetful = (odometry_of(imu_rows, dvl_rows, calibration) for _ in range(2))
    nodes = full.nodes(0, T0_NS + 20 * NS).tolist()
    for k, node_ns in enumerate(nodes[1:-1], 1):
        forgetful.forget_before(node_ns)
        later = nodes[k + 1]
        assert same_steps(forgetful.steps_between_nodes(node_ns, later), full.steps_between_nodes(node_ns, later))
        until = node_ns + 10_000_000
        assert same_steps(forgetful.steps_since_node(node_ns, until), full.steps_since_node(node_ns, until))
        for mine, theirs in zip(forgetful.velocity_at_node(node_ns), full.velocity_at_node(node_ns), strict=True):
            assert np.array_equal(mine, theirs)
        assert np.array_equal(forgetful.nodes(node_ns, T0_NS + 20 * NS), nodes[k + 1 :])
    assert len(forgetful.columns()[0]) < len(full.columns()[0]) / 1.5


def test_unmeasured_forces_pass_through():
    imu_rows, dvl_rows = recorded()
    force = imu_rows.specific_force.copy()
    force[70:80] = np.nan
    odometry = odometry_of(Imu(imu_rows.stamps_ns, imu_rows.angular_velocity, force), dvl_rows)
    nodes = odometry.nodes(0, T0_NS + 10 * NS)
    steps = odometry.steps_between_nodes(int(nodes[0]), int(nodes[-1]))
    unmeasured = np.isnan(steps.specific_force).all(axis=1)
    assert 0 < unmeasured.sum() < len(steps) / 4
    assert np.isfinite(steps.rate).all()
    assert np.isfinite(steps.velocity).all()


def test_rows_are_turned_into_the_body_by_the_mountings():
    imu_rpy, dvl_rpy = (0.3, -0.2, 1.0), (0.1, 0.4, -0.8)
    calibration = Calibration(
        imu=ImuCalibration(mounting=Mounting(rpy_rad=imu_rpy)),
        dvl=DvlCalibration(mounting=Mounting(rpy_rad=dvl_rpy), velocity_sigma_m_s=(0.01, 0.02, 0.03)),
    )
    body_R_imu, body_R_dvl = (Rotation.from_euler("xyz", rpy).as_matrix() for rpy in (imu_rpy, dvl_rpy))
    at, rate, force, velocity = stamps(10, 0.2), np.array([1.0, 2, 3]), np.array([4.0, 5, 6]), np.array([0.7, 0.8, 0.9])
    steps = odometry_of(imu(at, rate, force), dvl(at, velocity), calibration).steps_between_nodes(at[0], at[-1])
    assert np.allclose(steps.rate, body_R_imu @ rate)
    assert np.allclose(steps.specific_force, body_R_imu @ force)
    assert np.allclose(steps.velocity, body_R_dvl @ velocity)
    assert np.allclose(steps.velocity_psd, 0.1 * body_R_dvl @ np.diag([1e-4, 4e-4, 9e-4]) @ body_R_dvl.T)


def test_a_covariance_in_the_log_goes_before_that_of_the_calibration():
    at = stamps(10, 0.2)
    cov = np.stack([np.full((3, 3), np.nan), np.eye(3) * 4e-4, np.eye(3) * 4e-4])
    calibration = Calibration(dvl=DvlCalibration(velocity_sigma_m_s=(0.1, 0.1, 0.1)))
    steps = odometry_of(imu(at, 0.0), dvl(at, 0.0, cov), calibration).steps_between_nodes(at[0], at[-1])
    assert steps.velocity_psd[:, 0, 0] == pytest.approx([0.1 * (1e-2 + 4e-4) / 2, 0.1 * 4e-4])


def displacement_variance(odometry: Odometry, nodes: list[int]) -> float:
    """Along x, over a chain of intervals, each preintegrated on its own."""
    still_gyro = Preintegrator(0.0, np.zeros(3))
    chain = [odometry.steps_between_nodes(i, j) for i, j in pairwise(nodes)]
    return sum(float(still_gyro.integrate(steps, np.zeros(3)).covariance[3, 3]) for steps in chain)


@given(st.lists(st.floats(0.05, 0.4), min_size=3, max_size=30), st.integers(0, 2**32 - 1))
@settings(max_examples=30)
def test_a_chain_has_the_variance_of_its_doppler_samples(intervals_s, seed):
    """A sample's weight is half its two intervals, a and b: it adds ((a + b) / 2)^2 of its variance.

    Splitting it into halves adds (a^2 + b^2) / 2 instead: more by ((a - b) / 2)^2, and by (a / 2)^2 at either end.
    """
    at = T0_NS + np.concatenate([[0], np.cumsum(np.round(np.array(intervals_s) * NS))]).astype(np.int64)
    variance = 1e-4 * (0.5 + np.random.default_rng(seed).random(len(at)))
    odometry = odometry_of(imu(at, 0.0), dvl(at, 0.0, variance[:, None, None] * np.eye(3)))
    a, b = np.concatenate([[0], intervals_s]), np.concatenate([intervals_s, [0]])
    true, excess = np.sum(((a + b) / 2) ** 2 * variance), np.sum(((a - b) / 2) ** 2 * variance)
    assert displacement_variance(odometry, at.tolist()) == pytest.approx(true + excess, rel=1e-6)


def test_a_long_regular_chain_has_the_variance_of_its_doppler_samples():
    """No more than half a sample too much: weight^2 times variance for all but the ends."""
    at, sigma, interval_s = stamps(10, 20.0), 0.02, 0.1
    odometry = odometry_of(imu(at, 0.0), dvl(at, 0.0, sigma**2 * np.eye(3)))
    true = (len(at) - 1.5) * (interval_s * sigma) ** 2
    assert true < displacement_variance(odometry, at.tolist()) < 1.003 * true


def test_the_weight_of_a_doppler_sample_is_half_its_two_intervals():
    at = T0_NS + np.array([0, 100, 350, 400, 700]) * 1_000_000
    weights = []
    for k in range(len(at)):
        velocity = np.zeros((len(at), 3))
        velocity[k, 0] = 0.01
        steps = odometry_of(imu(at, 0.0), dvl(at, velocity)).steps_between_nodes(int(at[0]), int(at[-1]))
        weights.append(100 * float(steps.duration_s @ steps.velocity[:, 0]))
    assert weights == pytest.approx([0.05, 0.175, 0.15, 0.175, 0.15])


def test_velocity_noise_does_not_depend_on_where_the_imu_cuts():
    """Many gyro samples in a Doppler interval, or none: the same variance in all."""
    at, cov = stamps(5, 2.0), 1e-4 * np.eye(3)
    coarse, fine = (odometry_of(imu(t, 0.0), dvl(at, 0.0, cov)) for t in (at, stamps(97, 3.0, -0.01)))
    assert displacement_variance(fine, at.tolist()) == pytest.approx(displacement_variance(coarse, at.tolist()))


@pytest.mark.parametrize("sensor", ["imu", "dvl"])
def test_a_repeated_stamp_counts_once(sensor):
    """Drivers do repeat rows; the first of equal stamps holds."""
    imu_rows, dvl_rows = recorded()
    rows = {"imu": imu_rows, "dvl": dvl_rows}
    rows[sensor] = rows[sensor].rows(
        np.repeat(np.arange(len(rows[sensor])), np.where(np.arange(len(rows[sensor])) == 8, 2, 1))
    )
    repeated = odometry_of(rows["imu"], rows["dvl"])
    plain = odometry_of(imu_rows, dvl_rows)
    nodes = plain.nodes(0, T0_NS + 10 * NS)
    assert np.array_equal(repeated.nodes(0, T0_NS + 10 * NS), nodes)
    first, last = int(nodes[0]), int(nodes[-1])
    assert same_steps(repeated.steps_between_nodes(first, last), plain.steps_between_nodes(first, last))


@pytest.mark.parametrize(
    ("start", "end", "message"),
    [
        (0.0, 900.0, r"end_ns: \d+ is none of the 21 Doppler stamps from \d+ to \d+ ns"),
        (0.05, 1.0, r"start_ns: \d+ is none of the 21"),
        (0.5, 1.02, rf"end_ns: \d+ is none of the 21 .* nearest is {T0_NS + NS}$"),
        (1.0, 0.2, "before its start"),
        (0.0, 2.0, r"IMU rows \(from .*\) do not cover"),
        (0.0, 0.3, None),
        (0.1, 0.1, None),
    ],
)
def test_only_covered_nodes_bound_final_motion(start, end, message):
    """Far outside the rows a motion was of millions of metres."""
    odometry = odometry_of(imu(stamps(50, 1.5), 0.0), dvl(stamps(10, 2.0), [0.5, 0, 0]))
    ends = [T0_NS + round(t * NS) for t in (start, end)]
    if message is None:
        assert odometry.steps_between_nodes(*ends).duration_s.sum() == pytest.approx(end - start)
    else:
        with pytest.raises(MeasurementError, match=message):
            odometry.steps_between_nodes(*ends)


def test_provisional_motion_begins_at_a_covered_node():
    odometry = odometry_of(imu(stamps(50, 1.5, 0.15), 0.0), dvl(stamps(10, 3.0), [0.5, 0, 0]))
    for node, until, message in (
        (0.25, 0.4, r"node_ns: \d+ is none of the 31"),
        (0.1, 0.4, r"IMU rows \(from .*\) do not cover"),
        (1.7, 1.8, r"IMU rows \(from .*\) do not cover"),
        (0.5, 0.4, "before its start"),
    ):
        with pytest.raises(MeasurementError, match=message):
            odometry.steps_since_node(T0_NS + round(node * NS), T0_NS + round(until * NS))
    assert odometry.steps_since_node(T0_NS + NS // 5, T0_NS + NS // 4).duration_s.sum() == pytest.approx(0.05)
    with pytest.raises(MeasurementError, match="is none of the 31"):
        odometry.velocity_at_node(T0_NS + 1)


def test_motion_to_a_node_begins_at_any_instant_among_the_rows():
    odometry = odometry_of(imu(stamps(50, 3.0), 0.0), dvl(stamps(10, 2.0, 0.05), [0.5, 0, 0]))
    since, node = (T0_NS + round(t * NS) for t in (0.42, 1.05))
    assert odometry.steps_to_node(since, node).duration_s.sum() == pytest.approx(0.63)
    for ends, message in (
        ((T0_NS + NS // 50, node), "lies before the rows"),
        ((node + 1, node), "before its start"),
        ((since, node + 1), "node_ns: .* is none of the 21"),
    ):
        with pytest.raises(MeasurementError, match=message):
            odometry.steps_to_node(*ends)


def test_without_rows_there_is_no_motion():
    with pytest.raises(MeasurementError, match="there are no Doppler rows; add them first"):
        Odometry(Calibration()).steps_between_nodes(1, 2)
    with pytest.raises(MeasurementError, match=r"IMU rows \(none\) do not cover"):
        odometry_of(None, dvl(stamps(10, 1.0), 0.0)).steps_between_nodes(T0_NS, T0_NS + NS)


def test_swapped_blocks_are_refused():
    imu_rows, dvl_rows = recorded()
    with pytest.raises(MeasurementError, match="expected Imu and Dvl, not Dvl and Imu"):
        Odometry(Calibration()).add(dvl_rows, imu_rows)
