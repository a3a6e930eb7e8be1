import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sonar_graph.calibration import Calibration
from sonar_graph.navigation.odometry import Odometry, RunningMotion
from sonar_graph.navigation.preintegration.motion import PreintegratedMotion, Preintegrator

from .rows import NS, T0_NS, dvl, imu, part, random_steps, stamps, waves

SECONDS = 3.0
LEVER = np.array([-0.2, 0.1, -0.15])
BIAS = np.array([0.01, -0.02, 0.03])
EARTH = {"no Earth": None, "Earth": np.array([0.02, -0.03, 0.05])}
PREINTEGRATOR = Preintegrator(3e-3, LEVER)
instants = st.lists(st.integers(0, round((SECONDS - 0.3) * NS)), min_size=1, max_size=12)
seeds = st.integers(0, 2**32 - 1)


@pytest.fixture(scope="module", params=["linear", "hold-past"])
def odometry(request) -> Odometry:
    imu_ns, dvl_ns = stamps(50, SECONDS, -0.005), stamps(7, SECONDS - 0.2)
    rng = np.random.default_rng(0)
    cov = 1e-4 * (1 + rng.random((len(dvl_ns), 1, 1))) * np.eye(3)
    made = Odometry(Calibration(odometry_interpolation=request.param))
    made.add(imu(imu_ns, waves(imu_ns, 1, 0.5), waves(imu_ns, 3, 1.0)), dvl(dvl_ns, waves(dvl_ns, 2, 0.3), cov))
    return made


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
@given(offsets=instants)
@settings(max_examples=40)
def test_running_motion_equals_direct_integration_from_the_node(odometry, earth, offsets):
    """For instants in order, between nodes, on them, and the same one twice."""
    running = RunningMotion(odometry, PREINTEGRATOR, T0_NS, BIAS, earth)
    for offset in sorted(offsets):
        assert_same(running.until(T0_NS + offset), directly(odometry, earth, T0_NS + offset))


def test_at_a_reached_node_the_motion_is_the_final_one():
    """Of sensors that share their stamps; asked for twice, it is the same object."""
    odometry, at = Odometry(Calibration()), stamps(10, SECONDS)
    odometry.add(imu(at, waves(at, 1, 0.5)), dvl(at[::2], waves(at[::2], 2, 0.3), 1e-4 * np.eye(3)))
    running = RunningMotion(odometry, PREINTEGRATOR, T0_NS, BIAS, None)
    for node_ns in odometry.nodes(T0_NS, T0_NS + 10 * NS).tolist():
        motion = running.until(node_ns)
        assert_same(motion, PREINTEGRATOR.integrate(odometry.steps_between_nodes(T0_NS, node_ns), BIAS))
        assert running.until(node_ns) is motion


def test_what_is_final_is_not_integrated_again(odometry):
    """Of twenty instants a second for two seconds, each takes in the rows of one Doppler interval and a bit."""
    counted: list[int] = []

    class Counting(Preintegrator):
        def integrate(self, steps, bias, earth_rate=None):
            counted.append(len(steps))
            return super().integrate(steps, bias, earth_rate)

    running = RunningMotion(odometry, Counting(3e-3, LEVER), T0_NS, BIAS, None)
    for offset in range(0, 2 * NS, NS // 20):
        running.until(T0_NS + offset)
    rows = len(odometry.steps_since_node(T0_NS, T0_NS + 2 * NS))
    assert max(counted) < 0.15 * rows


def test_the_earth_turns_in_the_frame_of_the_node(odometry):
    """Negative control: its rate taken as that of the newest node's frame would be felt."""
    until_ns, earth = T0_NS + 2 * NS, EARTH["Earth"]
    middle = int(odometry.newest_node(T0_NS, T0_NS + NS))
    first = PREINTEGRATOR.integrate(odometry.steps_between_nodes(T0_NS, middle), BIAS, earth)
    unturned = first.then(PREINTEGRATOR.integrate(odometry.steps_since_node(middle, until_ns), BIAS, earth))
    off = gtsam.Pose3.Logmap(unturned.i_T_j.between(directly(odometry, earth, until_ns).i_T_j))
    assert np.abs(off).max() > 1e-4


@given(seeds, st.integers(1, 59))
@settings(max_examples=30)
def test_then_is_integration_of_both(seed, cut):
    """Mean, covariance, bias derivative, mean force and duration."""
    steps = random_steps(seed)
    first, second = (PREINTEGRATOR.integrate(part(steps, a, b), BIAS) for a, b in ((0, cut), (cut, 60)))
    assert_same(first.then(second), PREINTEGRATOR.integrate(steps, BIAS))
    turned_round = second.then(first)
    assert np.abs(gtsam.Pose3.Logmap(first.then(second).i_T_j.between(turned_round.i_T_j))).max() > 1e-6


@given(seeds, st.integers(1, 30), st.integers(31, 59))
@settings(max_examples=20)
def test_then_is_associative(seed, one, two):
    steps = random_steps(seed)
    a, b, c = (PREINTEGRATOR.integrate(part(steps, i, j), BIAS) for i, j in ((0, one), (one, two), (two, 60)))
    assert_same(a.then(b).then(c), a.then(b.then(c)))


def test_an_unmeasured_force_stays_unmeasured():
    steps = random_steps(4)
    first, second = (PREINTEGRATOR.integrate(part(steps, i, j), BIAS) for i, j in ((0, 20), (20, 60)))
    silent = PreintegratedMotion(
        second.i_T_j, second.covariance, second.D_bias, second.bias, second.duration_s, np.full(3, np.nan)
    )
    assert np.isnan(first.then(silent).mean_specific_force).all()
    assert_same(
        PreintegratedMotion(*(getattr(first.then(silent), c) for c in COLUMNS), first.then(second).mean_specific_force),
        first.then(second),
    )


COLUMNS = ("i_T_j", "covariance", "D_bias", "bias", "duration_s")
