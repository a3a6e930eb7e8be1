"""Laws of headings and position fixes in the filters, in gaps and late."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from baselines.ekf_slam import EkfSlam
from baselines.filter import backwards
from baselines.invariant_ekf import InvariantEkf
from sonar_graph.measurements import Measurements, PositionFixes
from sonar_graph.navigation import Odometry
from sonar_graph.states import Refusal
from sonar_graph.testing.numerical import central_differences

from .runs import (
    T0_NS,
    begun,
    circle,
    circle_calibration,
    height_and_tilt,
    in_a_gap,
    later,
    slam_filters,
)  # fmt: skip


@slam_filters
@pytest.mark.parametrize("is_late", [False, True], ids=["in time", "late"])
def test_aiding_in_a_gap_shares_the_error_of_the_motion(kind, is_late):
    """Ten fixes at 9 s of a gap constrain the start somewhat less than an exact one; a heading is as good as elsewhere."""
    fixes_ns = later(*np.linspace(9.0, 9.9, 10))
    covs = np.tile(1e-8 * np.eye(3), (10, 1, 1))
    fixes = PositionFixes(fixes_ns, np.zeros((10, 3)), covs)
    sequence = replace(in_a_gap(), positions=None if is_late else fixes)
    slam = begun(kind, sequence.calibration)
    for window in sequence.replay(later(8.0, 9.95)):
        slam.process(window)
    if is_late:
        slam.process(Measurements(later(9.96), positions=fixes))
    walked = sequence.calibration.dvl.velocity_walk_density**2 * 7.0**3 / 3
    assert 1 / (1 + 1 / walked) < height_and_tilt(slam)[1] < 0.9


def test_a_motion_backwards_has_the_covariance_of_the_inverse():
    """By differences."""
    odometry = Odometry(circle_calibration())
    odometry.add(*circle())
    forth = odometry.motion(later(6.03), later(9.8), np.zeros(3))
    back = backwards(forth)
    inverse = forth.i_T_j.inverse()
    assert_allclose(back.dR, inverse.rotation().matrix(), atol=1e-12)
    assert_allclose(back.dp, inverse.translation(), atol=1e-12)
    moved = lambda eps: inverse.localCoordinates(forth.i_T_j.retract(eps).inverse())  # noqa: E731
    J = central_differences(moved, np.zeros(6))
    assert_allclose(back.C, J @ forth.covariance @ J.T, rtol=1e-6, atol=1e-12)
    assert_allclose(back.D, J @ forth.D_bias, atol=1e-6)
    assert np.abs(back.C - forth.covariance).max() > 1e-6


GYRO_BIAS = np.array([2e-3, -4e-3, 6e-3])


def on_a_winding_way(kind, *cuts):
    """A filter on a winding way, its rows handed in by these cuts (s).

    The gyros have a bias that the invariant filter knows; EKF-SLAM, without a place for it, has gyros without.
    """
    gyro, doppler = circle(seconds=65)
    wave = np.cos(0.1 * (gyro.stamps_ns[:, None] - T0_NS) * 1e-9)
    gyro = replace(
        gyro,
        angular_velocity=gyro.angular_velocity * wave
        + GYRO_BIAS * (kind is InvariantEkf),
    )
    doppler = replace(doppler, velocity=doppler.velocity * (1.0 + 0.3 * wave[::10]))
    slam = begun(kind, circle_calibration())
    before_ns = T0_NS - 1
    for end_ns in (later(cut) for cut in cuts):
        slam.process(
            Measurements(
                end_ns,
                gyro.between(before_ns, end_ns),
                doppler.between(before_ns, end_ns),
            )
        )
        before_ns = end_ns
        if kind is InvariantEkf:
            slam._state.bias[:6] = np.tile(GYRO_BIAS, 2)
    return slam


def means_and_covariance(slam):
    """What the filter expects, as one row, and its covariance."""
    if isinstance(slam, EkfSlam):
        return slam.state()[1:]
    _, state = slam.state()
    return np.concatenate([state.R.ravel(), state.points.ravel(), state.bias]), state.P


@slam_filters
@pytest.mark.parametrize(
    ("now_s", "age_s", "is_used"),
    [
        (9.95, 0.02, True),
        (9.95, 3.92, True),
        (61.5, 20.0, True),
        (61.5, 20.5, False),
        (61.5, 35.0, False),
    ],
)
def test_a_late_fix_at_the_estimate_narrows_it_up_to_twenty_seconds(
    kind, now_s, age_s, is_used
):
    """And moves nothing, before the newest epoch and after it; an older one is refused by name.

    As far back as rows are kept, at 61.5 s just dropped, however many of an older time still are.
    """
    late_s = now_s - age_s
    slam = on_a_winding_way(kind, *np.arange(0.5, late_s, 0.5), late_s, now_s)
    said = slam.trajectory()
    mean, P = means_and_covariance(slam)
    (then,) = np.flatnonzero(said.stamps_ns == later(late_s))
    fix = PositionFixes(
        np.array([later(late_s)]), said.positions[[then]], 1e-4 * np.eye(3)[None]
    )
    slam.process(Measurements(later(now_s), positions=fix))
    mean_after, P_after = means_and_covariance(slam)
    assert [row.reason for row in slam.refused_rows()] == [Refusal.LATE] * (not is_used)
    assert_allclose(mean_after, mean, atol=1e-4 if is_used else 0.0)
    assert (np.trace(P_after) < 0.9 * np.trace(P)) == is_used
