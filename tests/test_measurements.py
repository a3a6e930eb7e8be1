import itertools
import re

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonar_graph.errors import MeasurementError
from sonar_graph.measurements import (
    FIRST_TOO_LARGE_ID,
    PAUSE_NS,
    Depth,
    Dvl,
    Heading,
    Imu,
    LandmarkDetections,
    Measurements,
    PositionFixes,
)


def depth(stamps_ns: list[int]) -> Depth:
    """Rows whose height is their number."""
    n = len(stamps_ns)
    return Depth(np.array(stamps_ns), np.arange(float(n)), np.full(n, np.nan))


def heading(stamps_ns: list[int]) -> Heading:
    return Heading(stamps_ns, np.zeros(len(stamps_ns)), np.ones(len(stamps_ns)))


def fixes(stamps_ns: list[int]) -> PositionFixes:
    n = len(stamps_ns)
    return PositionFixes(stamps_ns, np.zeros((n, 3)), np.ones((n, 3, 3)))


sorted_stamps = st.lists(st.integers(-(2**62), 2**62), min_size=1, max_size=20).map(
    sorted
)


@given(sorted_stamps, st.lists(st.integers(-(2**62), 2**62), max_size=5))
def test_windows_between_consecutive_cuts_hold_every_row_once(stamps_ns, cuts_ns):
    block = depth(stamps_ns)
    edges = [np.iinfo(np.int64).min, *sorted(cuts_ns), np.iinfo(np.int64).max]
    windows = [
        block.between(after, until) for after, until in itertools.pairwise(edges)
    ]
    rows = np.concatenate([window.z_m for window in windows if window is not None])
    np.testing.assert_array_equal(rows, block.z_m)


def test_a_window_excludes_its_beginning_and_includes_its_end():
    assert depth([10, 20, 30]).between(10, 20).stamps_ns.tolist() == [20]
    assert depth([10, 20]).between(20, 100) is None


@given(sorted_stamps, st.integers(0, 20))
def test_concatenation_undoes_a_split(stamps_ns, at):
    block = depth(stamps_ns)
    parts = [
        part for part in (slice(None, at), slice(at, None)) if len(stamps_ns[part])
    ]
    joined = Depth.concatenate([block.rows(part) for part in parts])
    np.testing.assert_array_equal(joined.stamps_ns, block.stamps_ns)
    np.testing.assert_array_equal(joined.z_m, block.z_m)


@pytest.mark.parametrize(
    ("stamps_ns", "said"),
    [
        ([], "at least one row"),
        ([1, 5, 5, 4], "backwards after row 2"),
        ([2**62, -(2**62)], "backwards after row 0"),
    ],
)
def test_no_rows_and_stamps_that_run_backwards_are_refused(stamps_ns, said):
    """Also where they lie farther apart than an integer holds."""
    with pytest.raises(MeasurementError, match=said):
        depth(stamps_ns)
    assert depth([-(2**62), 2**62]).stamps_ns.tolist() == [-(2**62), 2**62]


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_numbers_without_a_meaning_for_not_measured_must_be_finite(bad):
    """Named with their row; a specific force may be missing."""
    rate = np.zeros((3, 3))
    rate[1, 2] = bad
    with pytest.raises(
        MeasurementError, match=r"Imu.angular_velocity: row 1 is not finite"
    ):
        Imu(np.arange(3), rate, np.zeros((3, 3)))
    Imu(np.arange(3), np.zeros((3, 3)), np.full((3, 3), np.nan))


@pytest.mark.parametrize(
    ("stamps", "expected"),
    [
        (
            np.array([0.0, 5e6, 1e7]),
            r"expected integers, not float64; of seconds: np\.round\(seconds \* 1e9\)",
        ),
        (np.array([[0, 1, 2]]), r"expected shape \(n,\), not \(1, 3\)"),
    ],
)
def test_stamps_that_are_no_row_of_integers_are_refused(stamps, expected):
    """Also whole numbers in floating point: near an epoch they are off by up to 128 ns. Any integers are stamps."""
    for kind in (np.int32, np.uint64):
        assert depth(np.array([1, 2], kind)).stamps_ns.dtype == np.int64
    with pytest.raises(MeasurementError, match=rf"Imu\.stamps_ns: {expected}"):
        Imu(stamps, np.zeros((3, 3)), np.zeros((3, 3)))


@pytest.mark.parametrize(
    ("made", "message"),
    [
        (
            lambda n: Imu(n, np.zeros((5, 2)), np.zeros((5, 3))),
            "Imu.angular_velocity: expected shape (5, 3)",
        ),
        (
            lambda n: Imu(n, np.zeros((3, 5)), np.zeros((3, 5))),
            "one row for each of 5 stamps; transpose it",
        ),
        (
            lambda n: Dvl(n, np.zeros((5, 3)), np.zeros((5, 3))),
            "Dvl.velocity_cov: expected shape (5, 3, 3)",
        ),
        (
            lambda n: Heading(n, np.zeros((5, 1)), np.zeros(5)),
            "Heading.yaw_rad: expected shape (5,)",
        ),
    ],
)
def test_columns_of_another_shape_are_refused_by_name(made, message):
    with pytest.raises(MeasurementError, match=re.escape(message)):
        made(np.arange(5))


UNSAID = np.full((2, 2, 2), np.nan)


def seen(**columns) -> LandmarkDetections:
    two = {
        "stamps_ns": [1, 1],
        "range_m": [3.0, 4.0],
        "azimuth_rad": [0.0, 0.1],
        "range_azimuth_cov": UNSAID,
        "candidate_ids": [[1, 2], [1, 2]],
        "id_probability": [[0.9, 0.1]] * 2,
    }
    return LandmarkDetections(**(two | columns))


@pytest.mark.parametrize(
    ("columns", "said"),
    [
        (
            {"candidate_ids": [[1.0, 2.0]] * 2},
            r"candidate_ids: expected integers, not float64",
        ),
        ({"range_m": ["near", "far"]}, r"range_m: expected numbers, not <U4"),
        (
            {"candidate_ids": [1, 2]},
            r"candidate_ids: expected shape \(n, k\).*not \(2,\)",
        ),
        (
            {"candidate_ids": np.empty((2, 0)), "id_probability": np.empty((2, 0))},
            r"candidate_ids: expected shape",
        ),
        (
            {"candidate_ids": [[1, 2], [1, 2**56]]},
            r"candidate_ids: row 1 .* has an identity of 2\^56 or more; number",
        ),
        ({"track": [[1], [2]]}, r"track: expected shape \(2,\), not \(2, 1\)"),
        (
            {"candidate_ids": np.array([[1, 2], [1, 2**63]], np.uint64)},
            r"candidate_ids: expected integers below 2\^63",
        ),
        (
            {"id_probability": [[0.9, 0.1], [97.0, 1.0]]},
            r"id_probability: row 1 .* has probabilities .* 97 % is 0\.97",
        ),
        (
            {"id_probability": [[0.9, 0.2], [0.9, 0.1]]},
            r"id_probability: row 0 .* more than 1 in sum",
        ),
        ({"id_probability": [[np.nan, 0.1], [0.9, 0.1]]}, r"id_probability: row 0"),
    ],
)
def test_detections_that_cannot_be_are_named_in_one_line(columns, said):
    assert len(seen()) == 2
    with pytest.raises(
        MeasurementError, match=rf"^LandmarkDetections\.{said}"
    ) as caught:
        seen(**columns)
    assert "\n" not in str(caught.value)


@given(
    st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4),
    st.integers(-70, 70),
    st.integers(-70, 70),
)
def test_a_detection_is_valid_if_its_covariance_is_positive_definite(root, i, j):
    for more in (0.1, -0.1):
        A = np.reshape(root, (2, 2))
        cov = A @ A.T + more * np.eye(2)
        least = np.linalg.eigvalsh(cov)[0]
        scale = np.diag([10.0**i, 10.0**j])
        assert np.abs(least) < 1e-3 or bool(
            seen(range_azimuth_cov=[scale @ cov @ scale] * 2).are_sound()[0]
        ) == (least > 0)
    for partly in (np.nan * np.eye(2), [[0.01, np.nan], [np.nan, 1e-4]]):
        assert seen(range_azimuth_cov=[partly, partly]).are_sound().all()
    for wrong in (
        [[1.0, 0.1], [0.2, 1.0]],
        [[np.inf, 0.0], [0.0, 1.0]],
        [[1.0, -np.inf], [np.inf, 1.0]],
    ):
        assert not seen(range_azimuth_cov=[wrong, np.eye(2)]).are_sound()[0]


def test_the_largest_identity_is_the_last_that_a_key_gives_back():
    largest = FIRST_TOO_LARGE_ID - 1
    assert gtsam.Symbol(gtsam.symbol("l", largest)).index() == largest
    with pytest.raises((ValueError, RuntimeError)):
        gtsam.symbol("l", FIRST_TOO_LARGE_ID)


@pytest.mark.parametrize(
    ("name", "made"), [("depth", depth), ("heading", heading), ("positions", fixes)]
)
def test_rows_after_the_end_of_a_call_are_refused_by_name(name, made):
    block = made([3, 5])
    assert len(getattr(Measurements(5, **{name: block}), name)) == 2
    with pytest.raises(
        MeasurementError,
        match=rf"{type(block).__name__} has a row at 5 ns, after end_ns = 4",
    ):
        Measurements(4, **{name: block})


def test_heading_and_fixes_tell_the_rows_whose_noise_cannot_be():
    """Unknown noise (NaN) is not one of them, and of a covariance only what rounding of single precision explains."""
    sigmas = [np.nan, 0.01, 0.0, -1.0, np.inf]
    assert Heading(
        np.arange(5), np.zeros(5), np.array(sigmas)
    ).are_sound().tolist() == [True, True, *[False] * 3]
    good = np.array([[4.0, 1.9, 0.0], [1.9, 1.0, 0.0], [0.0, 0.0, 1e8]])
    unknown, skew, indefinite, infinite = (good.copy() for _ in range(4))
    unknown[0, 0] = np.nan
    skew[0, 1] = 1.8
    indefinite[[0, 1], [1, 0]] = 2.1
    infinite[2, 2] = np.inf
    # indefinite, though no pair of axes is
    cyclic = np.array([[1.0, 0.9, 0.9], [0.9, 1.0, -0.9], [0.9, -0.9, 1.0]])
    sound = [good, 1e-9 * good, good.astype(np.float32), unknown]
    covs = np.stack([*sound, skew, indefinite, cyclic, infinite, -good, 0 * good])
    fixes = PositionFixes(np.arange(10), np.zeros((10, 3)), covs)
    assert fixes.are_sound().tolist() == [True] * 4 + [False] * 6


@pytest.mark.parametrize(("name", "made"), [("heading", heading), ("positions", fixes)])
def test_rows_a_day_before_all_else_are_refused_as_stamps_in_seconds(name, made):
    """Of the call's end or its first motion, for a whole log may be one call."""
    block = {name: made([20])}
    now_ns = PAUSE_NS + 21
    with pytest.raises(
        MeasurementError, match=r" has a row at 20 ns, .*of seconds: np.round"
    ):
        Measurements(now_ns, **block)
    Measurements(now_ns - 1, **block)
    first = Imu([PAUSE_NS], np.zeros((1, 3)), np.zeros((1, 3)))
    Measurements(now_ns, imu=first, **block)
