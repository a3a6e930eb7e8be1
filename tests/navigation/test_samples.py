"""Rows of a sensor: storage, values in between, limits of what is refused, weights of depths, and intake of rows.

Rows that are not used are named; what is refused does not depend on how a log is cut.
"""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sonar_graph.calibration import (
    Calibration,
    DvlCalibration,
    ImuCalibration,
    Mounting,
)
from sonar_graph.devices import UNMEASURED_M_S, is_partial
from sonar_graph.measurements import Dvl
from sonar_graph.navigation import Odometry, samples
from sonar_graph.navigation.dvl_screening import RowIntake
from sonar_graph.states import Refusal

from .rows import NS, T0_NS, dvl, imu, odometry_at_rest, stamps

DVL_HZ = 5
SECONDS = 6.0
SIGMA = 0.01
BLIND = np.diag([SIGMA**2, 100.0**2, 100.0**2])
WHOLE = np.eye(3) * SIGMA**2


def driven(partial: tuple[int, ...] = (), outliers: tuple[int, ...] = ()) -> Dvl:
    """Straight ahead at 0.8 m/s; some rows measure the surge alone, some are wrong by 3 m/s."""
    at = stamps(DVL_HZ, SECONDS)
    velocity = np.tile([0.8, 0.0, 0.0], (len(at), 1))
    cov = np.tile(WHOLE, (len(at), 1, 1))
    cov[list(partial)] = BLIND
    velocity[list(outliers), 0] += 3.0
    return dvl(at, velocity, cov)


def told(odometry: Odometry) -> list[tuple[int, Refusal]]:
    return sorted(
        ((row.stamp_ns - T0_NS) * DVL_HZ // NS, row.reason) for row in odometry.refused
    )


@given(st.lists(st.integers(0, round(SECONDS * NS)), max_size=5))
@settings(max_examples=30, deadline=None)
def test_what_is_refused_does_not_depend_on_how_rows_are_cut(cuts):
    outliers = (0, 1, 5, 12, 21)
    partial = (8, 9, 10, 11, 20)
    rows = driven(partial=partial, outliers=outliers)
    edges = [0, *(T0_NS + cut for cut in sorted(cuts)), T0_NS + 10 * NS]
    whole = odometry_at_rest(rows)
    pieces = odometry_at_rest(*(rows.between(*ends) for ends in pairwise(edges)))
    assert told(whole) == sorted(
        [(k, Refusal.OUTLIER) for k in outliers]
        + [(k, Refusal.INCOMPLETE) for k in partial]
    )
    assert sorted(pieces.refused) == sorted(whole.refused)
    for one, other in zip(pieces.rows()[:6], whole.rows()[:6], strict=True):
        np.testing.assert_array_equal(one, other)


def test_rows_are_late_up_to_the_settled_stamp():
    rows = driven()
    odometry = odometry_at_rest(rows.rows(np.delete(np.arange(12), 4)))
    odometry.settle(int(rows.stamps_ns[5]))
    odometry.settle(int(rows.stamps_ns[2]))
    odometry.add(None, rows)
    odometry.add(None, rows.rows(slice(5, 6)))
    assert told(odometry) == [(4, Refusal.LATE)]
    assert odometry.rows()[3][-1] == rows.stamps_ns[-1]


def test_of_equal_stamps_the_first_counts():
    """In one block and in two."""
    ns = stamps(5, 1.0)
    one = dvl(ns, [0.8, 0.0, 0.0])
    other = dvl(ns, [0.81, 0.0, 0.0])
    within = dvl(np.repeat(ns, 2), np.tile([[0.8, 0, 0], [0.81, 0, 0]], (6, 1)))
    across = odometry_at_rest(one)
    assert across.add(None, other)
    for odometry in (across, odometry_at_rest(within)):
        np.testing.assert_array_equal(odometry.rows()[3], ns)
        np.testing.assert_array_equal(odometry.rows()[4], one.velocity)


@pytest.mark.parametrize(
    ("ratio", "is_sound"), [(1e-11, True), (1e-12, True), (0.0, False), (-1e-12, False)]
)
def test_a_covariance_is_valid_if_positive_definite_up_to_rounding(ratio, is_sound):
    """In axes that differ from the log's."""
    turn = np.linalg.qr(np.random.default_rng(0).standard_normal((3, 3)))[0]
    rows = driven()
    rows.velocity_cov[7] = 1e-4 * (turn * [1.0, 1.0, ratio]) @ turn.T
    odometry = odometry_at_rest(rows)
    assert told(odometry) == ([] if is_sound else [(7, Refusal.UNSOUND)])
    assert len(odometry.rows()[3]) == len(rows) - (not is_sound)


def test_rows_are_turned_into_body_axes_with_known_noise():
    """A sensor whose x axis points along the body's y, and whose y along the body's -x."""
    quarter = Mounting(rpy_rad=(0.0, 0.0, np.pi / 2))
    log = DvlCalibration(mounting=quarter, velocity_sigma_m_s=(0.01, 0.02, 0.03))
    turned = np.array([-2.0, 1.0, 3.0])
    for cov in (np.diag([1e-4, 4e-4, 9e-4]), np.nan):
        intake = RowIntake(Calibration(imu=ImuCalibration(mounting=quarter), dvl=log))
        intake.add_imu(imu(stamps(5, 0.2), [1.0, 2.0, 3.0], [2.0, 4.0, 6.0]))
        intake.add_dvl(dvl(stamps(5, 0.2), [0.1, 0.2, 0.3], cov))
        rate, force = intake.imu.values
        velocity, noise, *_ = intake.dvl.values
        assert np.array([rate[1], force[1] / 2, 10 * velocity[1]]) == pytest.approx(
            np.tile(turned, (3, 1))
        )
        assert noise[1] == pytest.approx(np.diag([4e-4, 1e-4, 9e-4]))


def test_an_infinite_variance_is_a_direction_not_measured():
    whole = np.array([[2.0, 0.5, 0.1], [0.5, 3.0, 0.2], [0.1, 0.2, 4.0]])
    cov = np.array([whole, whole, np.full((3, 3), np.nan)])
    cov[1, 1], cov[1, :, 1] = np.inf, np.inf
    cov[0, 2, 1] = np.nan
    unsaid = np.arange(9.0).reshape(3, 3)
    whole[2, 1] = 7.0
    found = samples.in_numbers(cov, unsaid)
    np.testing.assert_array_equal(found[0], whole)
    np.testing.assert_array_equal(
        found[1], [[2.0, 0.0, 0.1], [0.0, UNMEASURED_M_S**2, 0.0], [0.1, 0.0, 4.0]]
    )
    np.testing.assert_array_equal(found[2], unsaid)
    np.testing.assert_array_equal(is_partial(cov), [False, True, False])
