"""What is let through and what is refused, on either side of each limit."""

from __future__ import annotations

import numpy as np
import pytest

from sonar_graph.errors import CalibrationError, MeasurementError
from sonar_graph.navigation.samples import (
    finite_vector,
    no_doppler_stamp,
    require_covariances,
    require_distinct_stamps,
    require_nanoseconds,
    require_noise,
    require_order,
)

AT = np.array([10, 20, 30, 40, 50]) * 1_000_000_000
"""Five stamps, ten seconds apart."""


def test_a_vector_is_so_many_finite_numbers_in_one_row():
    assert finite_vector("bias", [1, 2, 3], 3).tolist() == [1.0, 2.0, 3.0]
    for values in ([1, 2], [[1], [2], [3]], 1.0):
        with pytest.raises(MeasurementError, match=r"bias: expected shape \(3,\)"):
            finite_vector("bias", values, 3)
    for kind in (MeasurementError, CalibrationError):
        with pytest.raises(kind, match=r"bias: expected finite numbers, not \[0.0, inf, 0.0\]"):
            finite_vector("bias", [0, np.inf, 0], 3, kind)


def test_noise_is_so_many_numbers_of_zero_or_more():
    for numbers, size in ((0.0, 1), (2, 1), ([0.0, 1.0, 2.0], 3), (np.ones(3, np.int64), 3)):
        require_noise("sigma", numbers, size)
    for numbers, size in ((True, 1), ([1.0], 1), (1.0, 3), ([1.0, 2.0], 3), ("1", 1), ([True] * 3, 3)):
        with pytest.raises(CalibrationError, match=rf"sigma: expected {size} number{'s' if size > 1 else ''}, not"):
            require_noise("sigma", numbers, size)
    for numbers, size in ((-1e-9, 1), (np.inf, 1), (np.nan, 1), ([1.0, 1.0, -1.0], 3), ([-1.0, 1.0, 1.0], 3)):
        with pytest.raises(CalibrationError, match="sigma: expected finite numbers of zero or more"):
            require_noise("sigma", numbers, size)


def test_an_interval_is_of_integers_the_earlier_first():
    require_order(1, 2)
    require_order(np.int64(1), np.int32(2))
    for ends, name in (((1.0, 2), "start_ns"), ((1, 2.0), "end_ns"), ((1, np.float64(2)), "end_ns")):
        with pytest.raises(MeasurementError, match=f"^{name}: expected integer nanoseconds"):
            require_order(*ends)
    for end_ns in (5, 4):
        with pytest.raises(MeasurementError, match=f"end_ns: {end_ns} is not after start_ns 5"):
            require_order(5, end_ns)


@pytest.mark.parametrize(("instant_s", "nearest_s"), [(1, 10), (24, 20), (26, 30), (99, 50)])
def test_the_nearest_stamp_is_named_from_either_side(instant_s, nearest_s):
    text = str(no_doppler_stamp("end_ns", instant_s * 10**9, AT))
    assert text.endswith(f"the nearest is {nearest_s * 10**9}")


@pytest.mark.parametrize(
    ("instant", "hint"),
    [
        (10, "in seconds: times 1000000000 "),
        (50, "in seconds: times 1000000000 "),
        (51, None),
        (9, None),
        (10_000, "in milliseconds: times 1000000 "),
        (50_000_000, "in microseconds: times 1000 "),
    ],
)
def test_an_instant_that_lies_among_the_stamps_in_another_unit_is_taken_for_it(instant, hint):
    text = str(no_doppler_stamp("end_ns", instant, AT))
    assert (f"; it seems to be {hint}" in text) if hint else "seems" not in text


def test_zero_is_of_no_unit():
    assert "seems" not in str(no_doppler_stamp("start_ns", 0, AT - 30 * 10**9 - 1))


@pytest.mark.parametrize(("spacing_ns", "is_close"), [(999_000, True), (1_001_000, False)])
def test_doppler_stamps_closer_than_a_millisecond_are_in_a_larger_unit(spacing_ns, is_close):
    """In the mean over all; a single one tells nothing."""
    text = str(no_doppler_stamp("end_ns", -5, np.arange(5) * spacing_ns))
    assert ("the stamps are so close" in text) == is_close
    assert "the stamps are so close" not in str(no_doppler_stamp("end_ns", 5, np.array([9])))


def test_stamps_repeated_from_the_row_before_to_the_row_after_are_refused():
    """Of rows 2 to 4, from which motion may reach one row further at either end."""
    stamps = np.arange(9) * 100
    for row in range(8):
        twice = stamps.copy()
        twice[row + 1] = twice[row]
        if 1 <= row <= 4:
            with pytest.raises(
                MeasurementError, match=f"Imu.stamps_ns: rows {row} and {row + 1} are both .* {row}00 ns"
            ):
                require_distinct_stamps("Imu", twice, 2, 4)
        else:
            require_distinct_stamps("Imu", twice, 2, 4)
    for first, last in ((0, 8), (0, 0), (8, 8)):
        require_distinct_stamps("Imu", stamps, first, last)
    with pytest.raises(MeasurementError, match="rows 0 and 1"):
        require_distinct_stamps("Imu", np.array([0, 0, 100]), 0, 2)
    with pytest.raises(MeasurementError, match="rows 1 and 2"):
        require_distinct_stamps("Imu", np.array([0, 100, 100]), 0, 2)


@pytest.mark.parametrize(("spacing_ns", "rows", "is_close"), [(49_900, 3, True), (50_100, 3, False), (10, 2, False)])
def test_inertial_rows_closer_than_those_of_any_imu_are_in_a_larger_unit(spacing_ns, rows, is_close):
    """Of two rows nothing can be said; one of them may be late."""
    stamps = 7 + np.arange(rows) * spacing_ns
    if is_close:
        with pytest.raises(MeasurementError, match=r"Imu.stamps_ns: 3 rows are 4.99e\+04 ns apart"):
            require_nanoseconds("Imu", stamps)
    else:
        require_nanoseconds("Imu", stamps)


def correlated(xy: float, yz: float, zx: float, sigmas: tuple[float, float, float] = (0.01, 0.02, 0.05)) -> np.ndarray:
    return np.array([[1, xy, zx], [xy, 1, yz], [zx, yz, 1]]) * np.outer(sigmas, sigmas)


def is_covariance(cov: np.ndarray) -> bool:
    try:
        require_covariances("cov", cov[None], AT)
    except MeasurementError:
        return False
    return True


@pytest.mark.parametrize("row", [0, 1, 2])
def test_an_impossible_covariance_is_found_in_every_row(row):
    assert is_covariance(np.eye(3))
    every = np.tile(np.eye(3), (3, 1, 1))
    every[row] = -np.eye(3)
    with pytest.raises(MeasurementError, match=f"cov: the row at {AT[row]} ns is no covariance"):
        require_covariances("cov", every, AT)


@pytest.mark.parametrize("scale", [1.0, 1e-3, 1e3])
def test_correlations_are_possible_up_to_one_in_every_plane(scale):
    """Within the rounding of seven digits; whatever the unit."""
    sigmas = (0.01 * scale, 0.02 * scale, 0.05 * scale)
    for sign in (1.0, -1.0):
        for plane in np.eye(3):
            assert is_covariance(correlated(*(sign * plane), sigmas))
            assert is_covariance(correlated(*(sign * (1 + 1e-7) * plane), sigmas))
            assert not is_covariance(correlated(*(sign * 1.01 * plane), sigmas))


@pytest.mark.parametrize(
    ("correlations", "is_possible"),
    [
        ((0.9, 0.9, 0.9), True),
        ((0.9, -0.9, -0.9), True),
        ((0.9, 0.9, -0.9), False),
        ((-0.9, -0.9, -0.9), False),
        ((0.8, 0.6, 0.0), True),  # singular
        ((0.8, 0.0, 0.6), True),
        ((0.0, 0.8, 0.6), True),
        ((0.8, 0.61, 0.0), False),
        ((0.8, 0.0, 0.61), False),
        ((0.0, 0.8, 0.61), False),
    ],
)
def test_three_correlations_must_agree(correlations, is_possible):
    """``1 + 2 abc - a^2 - b^2 - c^2 >= 0``, by hand."""
    assert is_covariance(correlated(*correlations)) == is_possible


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_no_variance_is_negative_or_unknown_and_zero_is_possible(axis):
    for variance, is_possible in ((0.0, True), (-1e-6, False), (np.nan, False)):
        diagonal = np.array([1e-4, 4e-4, 9e-4])
        diagonal[axis] = variance
        assert is_covariance(np.diag(diagonal)) == is_possible
    assert is_covariance(np.zeros((3, 3)))


@pytest.mark.parametrize("place", [(0, 1), (1, 0), (1, 2), (2, 1), (0, 2), (2, 0)])
def test_a_covariance_is_symmetric_to_six_digits(place):
    for change, is_possible in ((5e-7, True), (-5e-7, True), (2e-6, False), (-2e-6, False)):
        cov = correlated(0.5, 0.5, 0.5)
        cov[place] += change * np.sqrt(cov[place[0], place[0]] * cov[place[1], place[1]])
        assert is_covariance(cov) == is_possible
