"""Laws of headings and position fixes in the filters, in gaps and late."""

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from baselines.ekf_slam import EkfSlam
from sonar_graph.measurements import Measurements, PositionFixes
from sonar_graph.testing.numerical import central_differences

from .runs import T0_NS, aided, begun, circle, circle_calibration, height_and_tilt, in_a_gap, later, run, slam_filters


@slam_filters
@pytest.mark.parametrize("sensor", ["heading", "positions"])
def test_aiding_of_huge_noise_tells_nothing_and_less_of_it_more(mission, kind, sensor):
    block, states = getattr(aided(mission), sensor), []
    for sigma in (None, 1e6, 0.1):
        n, runs = len(block), mission
        if sigma is not None:
            covs = np.tile(sigma**2 * np.eye(3), (n, 1, 1))
            noise = {"sigma_rad": covs[:, 0, 0] ** 0.5} if sensor == "heading" else {"covariance_m2": covs}
            runs = replace(mission, **{sensor: replace(block, **noise)})
        states.append(run(kind, runs).trajectory())
    for poses in ("positions", "covariances"):
        none, nothing, some = (getattr(trajectory, poses) for trajectory in states)
        assert_allclose(nothing, none, atol=1e-9)
        assert np.abs(some - none).max() > 1e-5


@slam_filters
def test_aiding_in_a_gap_shares_the_error_of_the_motion(kind):
    """Ten fixes at 9 s of a gap tell of the start rather less than an exact one; a heading is as good as elsewhere."""
    fixes_ns, unknown = later(*np.linspace(9.0, 9.9, 10)), np.full((10, 3, 3), math.nan)
    fixes = PositionFixes(fixes_ns, np.zeros((10, 3)), np.where(np.isnan(unknown), 1e-8 * np.eye(3), 0.0))
    sequence = replace(in_a_gap(), positions=fixes)
    slam = begun(kind, sequence.calibration)
    for window in sequence.replay(later(8.0, 9.95)):
        slam.process(window)
    walked = sequence.calibration.dvl.velocity_walk_density**2 * 7.0**3 / 3
    assert 1 / (1 + 1 / walked) < height_and_tilt(slam)[1] < 0.9


def test_a_late_fix_has_the_motion_backwards_with_its_covariance_and_derivative(monkeypatch):
    """By differences of the inverse; it is asked for with the attitude at its start, that of the fix."""
    told, (gyro, doppler), nothing = [], circle(), np.zeros(6)
    monkeypatch.setattr(EkfSlam, "_fix", lambda _, motion, *__: told.append(motion))
    slam, end_ns, fix_ns = begun(EkfSlam, circle_calibration()), later(10.0), later(6.03)
    slam.process(Measurements(end_ns, gyro.between(T0_NS - 1, end_ns), doppler.between(T0_NS - 1, end_ns)))
    late = PositionFixes(np.array([fix_ns]), np.zeros((1, 3)), np.eye(3)[None])
    asked, motion = [], slam.odometry.motion
    monkeypatch.setattr(slam.odometry, "motion", lambda *of: asked.append(of[3]) or motion(*of))
    slam.process(Measurements(end_ns, positions=late))
    monkeypatch.undo()
    forth, (back,) = slam.odometry.motion(fix_ns, slam.node_ns, np.zeros(3)), told
    inverse = forth.i_T_j.inverse()
    assert_allclose(asked[-1] @ forth.i_T_j.rotation().matrix(), slam.attitude(), atol=1e-9)
    assert_allclose(back.dR, inverse.rotation().matrix(), atol=1e-12)
    assert_allclose(back.dp, inverse.translation(), atol=1e-12)
    moved = lambda eps: inverse.localCoordinates(forth.i_T_j.retract(eps).inverse())  # noqa: E731
    J = central_differences(moved, nothing)
    assert_allclose(back.C, J @ forth.covariance @ J.T, rtol=1e-6, atol=1e-12)
    assert_allclose(back.D, J @ forth.D_bias, atol=1e-6)
    assert np.abs(back.C - forth.covariance).max() > 1e-6
