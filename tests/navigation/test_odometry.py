"""Odometry: nodes and steps by stamps alone, running motion, motion between any two instants."""

from itertools import pairwise

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sonar_graph.calibration import ROWS_BEFORE, Calibration, DvlCalibration
from sonar_graph.errors import MeasurementError
from sonar_graph.measurements import Dvl, Imu
from sonar_graph.navigation import PreintegratedMotion, Preintegrator
from sonar_graph.navigation.odometry import (
    Odometry,
    RunningMotion,
    motion_between,
    motion_between_nodes,
    motion_since_node,
)
from sonar_graph.navigation.preintegration.recursion import Steps
from sonar_graph.navigation.samples import longest_interval_ns

from .rows import NS, T0_NS, at, dvl, imu, part, random_steps, stamps, waves
from .ways import DVL, NOISY, QUIET, Vehicle

SECONDS, ZERO = 3.0, np.zeros(3)
HELD = Calibration(odometry_interpolation="hold-past")


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


COVERED = odometry_of(imu(stamps(50, 1.35, 0.15), 0.0), dvl(stamps(10, 2.0), [0.5, 0, 0]))
"""Ten nodes a second from 0 to 2 s, inertial rows from 0.15 to 1.5 s."""


def same_steps(a: Steps, b: Steps) -> bool:
    columns = ("duration_s", "rate", "velocity", "velocity_psd", "specific_force")
    return all(np.array_equal(getattr(a, c), getattr(b, c), equal_nan=True) for c in columns)


@given(
    st.lists(st.integers(0, round(SECONDS * NS)), min_size=8, max_size=8).map(sorted),
    st.just(list(range(9))) | st.permutations(range(9)),
)
@settings(max_examples=60)
def test_steps_do_not_depend_on_how_rows_are_cut_into_blocks_and_in_what_order_they_come(cuts, order):
    imu_rows, dvl_rows = recorded()
    agile = Calibration(dvl=DvlCalibration(velocity_walk_density=2.0))
    whole, pieces = odometry_of(imu_rows, dvl_rows, agile), Odometry(agile)
    edges = [0, *(T0_NS + cut for cut in cuts), T0_NS + 10 * NS]
    for k in order:
        pieces.add(imu_rows.between(edges[k], edges[k + 1]), dvl_rows.between(edges[k], edges[k + 1]))
    first, last = (int(whole.nodes(0, T0_NS + 10 * NS)[k]) for k in (0, -1))
    assert not pieces.refused
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
    nodes = everything.nodes(0, until_ns).tolist()
    assert nodes == so_far.nodes(0, until_ns).tolist()
    for node_ns in nodes:
        assert same_steps(everything.steps_since_node(node_ns, until_ns), so_far.steps_since_node(node_ns, until_ns))
    here, there = (odometry.steps_between_nodes(nodes[0], nodes[-1]) for odometry in (everything, so_far))
    assert same_steps(here, there)


def test_velocity_at_a_node_is_its_row_and_the_rate_in_between():
    imu_rows, dvl_rows = recorded()
    velocity, cov, rate = odometry_of(imu_rows, dvl_rows).velocity_at_node(int(dvl_rows.stamps_ns[5]))
    t = (np.r_[imu_rows.stamps_ns, dvl_rows.stamps_ns[5]] - T0_NS) * 1e-9
    assert np.array_equal(velocity, dvl_rows.velocity[5])
    assert np.array_equal(cov, dvl_rows.velocity_cov[5])
    assert rate == pytest.approx([np.interp(t[-1], t[:-1], column) for column in imu_rows.angular_velocity.T])


def test_a_node_is_reached_only_when_an_imu_row_covers_it():
    imu_ns, dvl_ns = T0_NS + np.array([0, 100, 200]), T0_NS + np.array([-50, 0, 50, 150, 250])
    odometry = odometry_of(imu(imu_ns, 0.0), dvl(dvl_ns, 0.0))
    reached = [(odometry.nodes(0, T0_NS + until) - T0_NS).tolist() for until in (-1, 0, 99, 100, 160, 200, 300)]
    assert reached == [[], [-50, 0], [-50, 0], [-50, 0, 50], [-50, 0, 50], [-50, 0, 50, 150], [-50, 0, 50, 150]]
    assert odometry.start_ns() == T0_NS
    assert (odometry.nodes(T0_NS + 50, T0_NS + 300) - T0_NS).tolist() == [150]


@pytest.mark.parametrize(
    ("imu_s", "dvl_s", "start_ns"),
    [(0.0, 1.05, None), (5.0, 0.0, None), (0.0, -0.33, T0_NS + 70_000_000), (0.0, 1.0, T0_NS + NS)],
)
def test_there_is_no_start_before_imu_rows_cover_a_node(imu_s, dvl_s, start_ns):
    imu_rows, dvl_rows = imu(stamps(10, 1, imu_s), 0.0), dvl(stamps(10, 1, dvl_s), 0.0)
    assert odometry_of(imu_rows, dvl_rows).start_ns() == start_ns
    for rows in ((None, None), (imu_rows, None), (None, dvl_rows)):
        assert odometry_of(*rows).start_ns() is None
    held = odometry_of(imu(stamps(10, 1), 0.0), dvl(stamps(10, 1, 0.03), 0.0), HELD)
    assert (held.start_by(at(0.099)), held.start_by(at(0.1))) == (None, at(0.03))


@pytest.mark.parametrize("calibration", [Calibration(), HELD], ids=["linear", "held"])
def test_forgetting_changes_nothing_afterwards(calibration):
    imu_rows, dvl_rows = recorded(seconds=12.0)
    full, forgetful = (odometry_of(imu_rows, dvl_rows, calibration) for _ in range(2))
    nodes = full.nodes(0, T0_NS + 20 * NS).tolist()
    for k, node_ns in enumerate(nodes[1:-1], 1):
        forgetful.forget_before(node_ns)
        later, until = nodes[k + 1], node_ns + 10_000_000
        assert same_steps(forgetful.steps_between_nodes(node_ns, later), full.steps_between_nodes(node_ns, later))
        assert same_steps(forgetful.steps_since_node(node_ns, until), full.steps_since_node(node_ns, until))
        for mine, theirs in zip(forgetful.velocity_at_node(node_ns), full.velocity_at_node(node_ns), strict=True):
            assert np.array_equal(mine, theirs)
        assert np.array_equal(forgetful.nodes(node_ns, T0_NS + 20 * NS), nodes[k + 1 :])
    assert len(forgetful.columns()[0]) < len(full.columns()[0]) / 1.5


@given(st.lists(st.floats(0.05, 0.4), min_size=3, max_size=30), st.integers(0, 2**32 - 1))
@settings(max_examples=30)
def test_a_chain_has_the_variance_of_its_doppler_samples_wherever_the_imu_cuts(intervals_s, seed):
    """A sample's weight is half its two intervals, a and b: it adds ((a + b) / 2)^2 of its variance.

    Splitting it into halves adds (a^2 + b^2) / 2 instead: more by ((a - b) / 2)^2, and by (a / 2)^2 at either end.
    """
    at = T0_NS + np.concatenate([[0], np.cumsum(np.round(np.array(intervals_s) * NS))]).astype(np.int64)
    variance = 1e-4 * (0.5 + np.random.default_rng(seed).random(len(at)))
    a, b = np.concatenate([[0], intervals_s]), np.concatenate([intervals_s, [0]])
    true, excess = np.sum(((a + b) / 2) ** 2 * variance), np.sum(((a - b) / 2) ** 2 * variance)
    for imu_ns in (at, stamps(97, 13.0, -0.01)):
        odometry = odometry_of(imu(imu_ns, 0.0), dvl(at, 0.0, variance[:, None, None] * np.eye(3)))
        chain = [odometry.steps_between_nodes(int(i), int(j)) for i, j in pairwise(at)]
        along_x = sum(Preintegrator(0.0, ZERO).integrate(steps, ZERO).covariance[3, 3] for steps in chain)
        assert along_x == pytest.approx(true + excess, rel=1e-6)


@pytest.mark.parametrize(
    ("steps", "spans_s"),
    [
        ("steps_between_nodes", ((0.2, 0.3), (0.2, 0.2))),
        ("steps_since_node", ((0.2, 0.25), (0.2, 0.2))),
        ("steps_to_node", ((0.42, 1.0), (0.15, 0.2), (1.0, 1.0))),
    ],
)
def test_covered_nodes_bound_motion(steps, spans_s):
    for start_s, end_s in spans_s:
        found = getattr(COVERED, steps)(at(start_s), at(end_s))
        assert found.duration_s.sum() == pytest.approx(end_s - start_s)


@pytest.mark.parametrize(
    ("steps", "start_s", "end_s", "message"),
    [
        ("steps_between_nodes", 0.2, 900.0, r"end_ns: \d+ is none of the 21 Doppler stamps from \d+ to \d+ ns"),
        *(("steps_between_nodes", 0.25, end_s, r"start_ns: \d+ is none of the 21") for end_s in (1.0, 0.25)),
        ("steps_between_nodes", 0.5, 1.02, rf"end_ns: \d+ is none of the 21 .* nearest is {T0_NS + NS}$"),
        ("steps_between_nodes", 1.0, 0.2, "before its start"),
        ("steps_between_nodes", 0.2, 2.0, r"IMU rows \(from .*\) do not cover"),
        ("steps_since_node", 0.25, 0.4, r"node_ns: \d+ is none of the 21"),
        *(("steps_since_node", a, b, r"IMU rows \(from .*\) do not cover") for a, b in ((0.1, 0.4), (1.7, 1.8))),
        ("steps_since_node", 0.5, 0.4, "before its start"),
        ("steps_to_node", 0.02, 1.0, "lies before the rows"),
        ("steps_to_node", 1.000001, 1.0, "before its start"),
        ("steps_to_node", 0.42, 1.02, "node_ns: .* is none of the 21"),
    ],
)
def test_nothing_else_bounds_motion(steps, start_s, end_s, message):
    """Far outside the rows a motion was of millions of metres."""
    with pytest.raises(MeasurementError, match=message):
        getattr(COVERED, steps)(at(start_s), at(end_s))


def test_rows_that_are_missing_or_of_another_kind_are_named():
    imu_rows, dvl_rows = recorded()
    for blocks, message in (
        ((dvl_rows, imu_rows), "expected Imu and Dvl, not Dvl and Imu"),
        ((None, imu_rows), "expected Imu and Dvl, not NoneType and Imu"),
        ((None, "rows"), "expected Imu and Dvl, not NoneType and str"),
    ):
        with pytest.raises(MeasurementError, match=message):
            Odometry(Calibration()).add(*blocks)
    with pytest.raises(MeasurementError, match="there are no Doppler rows; add them first"):
        Odometry(Calibration()).steps_between_nodes(1, 2)
    with pytest.raises(MeasurementError, match=r"IMU rows \(none\) do not cover"):
        odometry_of(None, dvl(stamps(10, 1.0), 0.0)).steps_between_nodes(T0_NS, T0_NS + NS)
    for instant_s in (0.25, 4.2, -0.5):
        with pytest.raises(MeasurementError, match=rf"node_ns: {at(instant_s)} is none of the 9 Doppler stamps"):
            steady().velocity_at_node(at(instant_s))


def steady(seconds: float = 4.0, calibration: Calibration | None = None) -> Odometry:
    """Ten IMU rows a second and two of the Doppler log: tenths of a second in rad/s, and their hundredth in m/s."""
    quick, slow = stamps(10, seconds), stamps(2, seconds)
    rate, velocity = (np.outer((t - T0_NS) / (NS / 10), [0, 0, 1.0]) for t in (quick, slow))
    return odometry_of(imu(quick, rate), dvl(slow, 0.01 * velocity), calibration)


@pytest.mark.parametrize(("calibration", "kept_s"), [(HELD, 0.0), (Calibration(), 5.0)], ids=["held", "linear"])
def test_forgetting_drops_rows_of_both_sensors_that_no_motion_needs(calibration, kept_s):
    """A gap that opens later is bridged by a line through the five seconds before it; held velocities need one row.

    What counts as a hole of the IMU is told from some rows more.
    """
    odometry = steady(20.0, calibration)
    odometry.forget_before(at(15.0))
    columns = odometry.columns()
    assert columns[6] == (calibration is HELD)
    more_s = ROWS_BEFORE / 10
    for stamps_ns, earliest_s in ((columns[0], 15.0 - more_s), (columns[3], 14.5)):
        assert at(earliest_s - kept_s - 0.1) <= stamps_ns[0] <= at(15.0 - kept_s)
        assert stamps_ns[-1] == at(20.0)


def test_a_row_at_the_very_instant_is_used_and_none_after_it():
    """Rates are linear from 10 on and held after the newest row; so are velocities from 0.1 on."""
    odometry = steady()
    for until_s, turn, way in ((1.2, 2.2, 0.02), (1.25, 2.2 + 0.6, 0.025), (1.5, 6.25, 0.0625)):
        steps = odometry.steps_since_node(at(1.0), at(until_s))
        assert steps.duration_s @ steps.rate[:, 2] == pytest.approx(turn)
        assert steps.duration_s @ steps.velocity[:, 2] == pytest.approx(way)


def test_a_gap_is_longer_than_the_calibration_says():
    """Between nodes that follow each other; held samples leave none."""
    calibration = Calibration(dvl=DvlCalibration(gap_s=0.5))
    assert longest_interval_ns(calibration) == NS // 2
    rows = imu(stamps(10, 5.0), 0.0), dvl(T0_NS + np.array([0, 500, 1001, 1501, 4000]) * 1_000_000, 0.0)
    odometry, held = (odometry_of(*rows, c) for c in (calibration, HELD.model_copy(update={"dvl": calibration.dvl})))
    assert not odometry.is_gap(at(0.0), at(0.5))
    assert odometry.is_gap(at(0.0), at(0.5) + 1)
    assert odometry.gaps(at(0.0), at(4.0)) == [(at(0.5), at(1.001)), (at(1.501), at(4.0))]
    assert odometry.gaps(at(0.5), at(1.501)) == [(at(0.5), at(1.001))]
    assert not held.gaps(at(0.0), at(4.0))
    assert not held.is_gap(at(0.0), at(1e6))


@pytest.mark.parametrize(("speed_m_s", "reached"), [(0.0, 20), (3.0, 60)])
def test_the_start_is_reached_at_the_same_time_however_the_log_is_cut(speed_m_s, reached):
    """When its velocity is confirmed: at 3 m/s by two rows more than at rest."""
    imu_rows, dvl_rows = imu(stamps(100, 3), 0.0), dvl(stamps(5, 3), (speed_m_s, 0, 0), 1e-4 * np.eye(3))
    at_once, by_and_by = odometry_of(imu_rows, dvl_rows), Odometry(Calibration())
    for row, until_ns in enumerate(imu_rows.stamps_ns.tolist()):
        by_and_by.add(*(rows.between(until_ns - NS // 100, until_ns) for rows in (imu_rows, dvl_rows)))
        assert by_and_by.start_by(until_ns) == at_once.start_by(until_ns) == (T0_NS if row >= reached else None)
    assert at_once.start_ns() == T0_NS


LEVER, BIAS = np.array([-0.2, 0.1, -0.15]), np.array([0.01, -0.02, 0.03])
EARTH = {"no Earth": None, "Earth": np.array([0.02, -0.03, 0.05])}
PREINTEGRATOR = Preintegrator(3e-3, LEVER)


@pytest.fixture(scope="module", params=["linear", "hold-past"])
def swaying(request) -> Odometry:
    return odometry_of(*recorded(dvl_offset_s=0.0), Calibration(odometry_interpolation=request.param))


def assert_same(one: PreintegratedMotion, other: PreintegratedMotion) -> None:
    assert np.abs(gtsam.Pose3.Logmap(one.i_T_j.between(other.i_T_j))).max() < 1e-12
    scale = np.sqrt(np.outer(np.diag(other.covariance), np.diag(other.covariance)))
    assert np.abs(one.covariance - other.covariance).max() <= 1e-9 * scale.max()
    assert np.allclose(one.D_bias, other.D_bias, rtol=0, atol=1e-12)
    assert one.duration_s == pytest.approx(other.duration_s, abs=1e-12)
    assert np.allclose(one.mean_specific_force, other.mean_specific_force, equal_nan=True, atol=1e-12)
    assert np.array_equal(one.bias, other.bias)


def directly(odometry: Odometry, earth: np.ndarray | None, until_ns: int) -> PreintegratedMotion:
    return PREINTEGRATOR.integrate(odometry.steps_since_node(T0_NS, until_ns), BIAS, earth)


@pytest.mark.parametrize("earth", EARTH.values(), ids=EARTH)
@given(offsets=st.lists(st.integers(0, round((SECONDS - 0.3) * NS)), min_size=1, max_size=12))
@settings(max_examples=40)
def test_running_motion_equals_direct_integration_from_the_node(swaying, earth, offsets):
    """For instants in order, between nodes, on them, and the same one twice."""
    running = RunningMotion(swaying, PREINTEGRATOR, T0_NS, BIAS, earth)
    for offset in sorted(offsets):
        assert_same(running.until(T0_NS + offset), directly(swaying, earth, T0_NS + offset))


def test_what_is_final_is_not_integrated_again(swaying):
    """Of twenty instants a second for two seconds, each takes in the rows of one Doppler interval and a bit."""
    counted: list[int] = []

    class Counting(Preintegrator):
        def integrate(self, steps, bias, earth_rate=None):
            counted.append(len(steps))
            return super().integrate(steps, bias, earth_rate)

    running = RunningMotion(swaying, Counting(3e-3, LEVER), T0_NS, BIAS, None)
    for offset in range(0, 2 * NS, NS // 20):
        running.until(T0_NS + offset)
    rows = len(swaying.steps_since_node(T0_NS, T0_NS + 2 * NS))
    assert max(counted) < 0.15 * rows


def test_the_earth_turns_in_the_frame_of_the_node(swaying):
    """Negative control: its rate taken as that of the newest node's frame would be felt."""
    until_ns, earth = T0_NS + 2 * NS, EARTH["Earth"]
    middle = int(swaying.newest_node(T0_NS, T0_NS + NS))
    first = PREINTEGRATOR.integrate(swaying.steps_between_nodes(T0_NS, middle), BIAS, earth)
    unturned = first.then(PREINTEGRATOR.integrate(swaying.steps_since_node(middle, until_ns), BIAS, earth))
    off = gtsam.Pose3.Logmap(unturned.i_T_j.between(directly(swaying, earth, until_ns).i_T_j))
    assert np.abs(off).max() > 1e-4


@given(st.integers(0, 2**32 - 1), st.integers(1, 59))
@settings(max_examples=30)
def test_then_is_integration_of_both(seed, cut):
    """Mean, covariance, bias derivative, mean force and duration."""
    steps = random_steps(seed)
    first, second = (PREINTEGRATOR.integrate(part(steps, a, b), BIAS) for a, b in ((0, cut), (cut, 60)))
    assert_same(first.then(second), PREINTEGRATOR.integrate(steps, BIAS))
    turned_round = second.then(first)
    assert np.abs(gtsam.Pose3.Logmap(first.then(second).i_T_j.between(turned_round.i_T_j))).max() > 1e-6


def ready(until_s=20.0, imu=QUIET):
    """What was measured until an instant, and what it means."""
    calibration = Calibration(imu=imu, dvl=DVL)
    odometry = odometry_of(*(rows.between(0, at(until_s)) for rows in Vehicle().rows()), calibration)
    return odometry, Preintegrator.from_calibration(calibration)


def moved(start_s, end_s, until_s=20.0, imu=QUIET):
    return motion_between(*ready(until_s, imu), at(start_s), at(end_s), ZERO)


@pytest.mark.parametrize(
    ("start_s", "end_s"),
    [
        *((1.03, 1.17), (5.9, 6.0), (5.93, 8.31), (6.0, 12.0), (6.0, 16.0), (6.0, 17.3), (8.07, 8.36), (13.0, 15.9)),
        *((5.03, 16.53), (16.0, 16.1)),
    ],
)
def test_motion_is_that_of_the_vehicle_before_in_over_and_after_a_gap(start_s, end_s):
    truth, found = Vehicle().displacement(start_s, end_s), moved(start_s, end_s)
    assert found.i_T_j.translation() == pytest.approx(truth, abs=0.02)
    turn = Vehicle().attitude([end_s - start_s]).as_matrix()[0]
    assert found.i_T_j.rotation().equals(gtsam.Rot3(turn), 1e-6)
    assert found.duration_s == pytest.approx(end_s - start_s)


def test_without_a_gap_motion_is_that_over_the_steps_to_the_bit():
    odometry, preintegrator = ready()
    found = motion_between(odometry, preintegrator, at(1.0), at(3.2), ZERO)
    expected = preintegrator.integrate(odometry.steps_between_nodes(at(1.0), at(3.2)), ZERO)
    assert np.array_equal(found.i_T_j.matrix(), expected.i_T_j.matrix())
    assert np.array_equal(found.covariance, expected.covariance)


def test_motions_that_follow_each_other_in_a_gap_add_up_to_that_since_the_node():
    odometry, preintegrator = ready(15.0, NOISY)
    total = motion_between(odometry, preintegrator, at(Vehicle.LOST_S), at(7.3), ZERO)
    for start_s, end_s in pairwise([7.3, 7.6, 9.0, 9.2, 12.0, 14.7]):
        total = total.then(motion_between(odometry, preintegrator, at(start_s), at(end_s), ZERO))
    whole = motion_since_node(odometry, preintegrator, at(Vehicle.LOST_S), at(14.7), ZERO, None)
    assert total.i_T_j.equals(whole.i_T_j, 1e-9)
    assert total.covariance == pytest.approx(whole.covariance, rel=1e-3, abs=1e-9)
    assert total.D_bias == pytest.approx(whole.D_bias, rel=1e-6, abs=1e-9)
    assert total.mean_specific_force == pytest.approx(whole.mean_specific_force, abs=1e-9)
    assert total.duration_s == pytest.approx(whole.duration_s)


def test_a_gap_that_has_ended_is_bridged_with_both_its_ends():
    odometry, preintegrator = ready(imu=NOISY)
    found = motion_between(odometry, preintegrator, at(5.0), at(17.0), ZERO)
    nodes = motion_between_nodes(odometry, preintegrator, at(5.0), at(17.0), ZERO, None)
    assert found.i_T_j.equals(nodes.i_T_j, 1e-12)
    assert found.covariance == pytest.approx(nodes.covariance)
    longer = motion_between(odometry, preintegrator, at(4.91), at(17.09), ZERO)
    assert np.trace(longer.covariance) > np.trace(nodes.covariance)


@pytest.mark.parametrize(
    ("start_s", "end_s"), [(1.03, 1.17), (5.0, 9.0), (8.0, 9.0), (15.0, Vehicle.FOUND_S + 0.2), (15.0, 16.3)]
)
def test_nothing_stamped_after_the_second_instant_is_used(start_s, end_s):
    here, there = (moved(start_s, end_s, until_s, NOISY) for until_s in (20.0, end_s))
    assert np.array_equal(here.i_T_j.matrix(), there.i_T_j.matrix())
    assert np.array_equal(here.covariance, there.covariance)


def test_no_variance_is_negative_and_from_an_instant_to_itself_nothing_moves():
    for start_s in np.arange(6.0, 15.0, 0.37):
        assert np.linalg.eigvalsh(moved(start_s, start_s + 0.05, 15.9, NOISY).covariance)[0] >= -1e-18
    for found in (moved(instant_s, instant_s) for instant_s in (1.1, 3.0, 9.0)):
        assert found.i_T_j.equals(gtsam.Pose3(), 0.0)
        assert not found.covariance.any()
