"""Estimators by the rules of other projects, which take part in the open bench."""

import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from sonar_graph import Odometry
from sonar_graph.simulation import BasinOptions, simulate_basin
from sonar_graph.testing import check_estimator

FILE = (
    Path(__file__).parents[1] / "benchmarks" / "published_rules" / "published_rules.py"
)


@pytest.fixture(scope="module")
def rules() -> ModuleType:
    spec = importlib.util.spec_from_file_location("published_rules", FILE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("name", ["PlainIsam2", "HeldVelocity", "NewestVelocity"])
def test_a_published_rule_keeps_the_contract_of_estimators(rules, name):
    check_estimator(getattr(rules, name))


def test_held_velocities_lie_on_either_side_of_our_odometry(rules):
    """By half an interval of acceleration; the mean of both samples lies between them."""
    world = simulate_basin(BasinOptions(duration_s=130.0, laps=1, seed=3))
    ours, bias = Odometry(world.calibration), np.array([1e-4, -2e-4, 3e-4])
    ours.add(world.imu, world.dvl)
    epochs_ns = ours.epochs(0, world.end_ns)
    start_ns, end_ns = int(epochs_ns[100]), int(epochs_ns[130])
    expected = ours.motion(start_ns, end_ns, bias, known_ns=ours.reached_ns(end_ns))

    def by(rule):
        source = type("OfRule", (rules.RuleOdometry,), {"rule": rule})(
            world.calibration
        )
        source.add(world.imu, world.dvl)
        return source.motion(start_ns, end_ns, bias, known_ns=ours.reached_ns(end_ns))

    middle, held, newest = (
        by(rule) for rule in (rules.TRAPEZOID, rules.ZOH_PREVIOUS, rules.ZOH_CURRENT)
    )
    off = np.array(
        [
            one.i_T_j.translation() - expected.i_T_j.translation()
            for one in (held, newest)
        ]
    )
    assert (np.linalg.norm(off, axis=1) > 1e-5).all()
    assert off[0] @ off[1] < 0
    assert np.linalg.norm(
        middle.i_T_j.translation() - expected.i_T_j.translation()
    ) < 0.2 * np.linalg.norm(off[0])
    sigmas = np.sqrt(np.diag(expected.covariance))
    for one in (middle, held, newest):
        assert one.i_T_j.rotation().equals(expected.i_T_j.rotation(), 1e-8)
        assert np.diag(one.covariance) == pytest.approx(sigmas**2, rel=0.1)
        assert one.D_bias == pytest.approx(
            expected.D_bias, abs=0.04 * np.abs(expected.D_bias).max()
        )
