"""Rows are kept in the order of their stamps, each stamp once, and no more than are needed."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sonar_graph.navigation.samples import StampedRows, node_range, rows_before_gaps


def kept(*blocks: list[int]) -> StampedRows:
    """Values are the number of the block, so that it is seen which of equal stamps is there."""
    rows = StampedRows((3,), (3, 3))
    for number, block in enumerate(blocks):
        n = len(block)
        rows.insert(np.array(block), np.full((n, 3), float(number)), np.full((n, 3, 3), float(-number)))
    return rows


@given(st.lists(st.lists(st.integers(0, 40), min_size=1, unique=True).map(sorted), min_size=1, max_size=5))
def test_rows_are_those_of_all_blocks_in_order_and_the_first_of_equal_stamps(blocks):
    rows, first = kept(*blocks), {}
    for number, block in enumerate(blocks):
        for stamp in block:
            first.setdefault(stamp, number)
    assert rows.stamps_ns.tolist() == sorted(first)
    assert rows.values[0][:, 1].tolist() == [first[stamp] for stamp in sorted(first)]
    assert rows.values[1][:, 2, 0].tolist() == [-first[stamp] for stamp in sorted(first)]


def test_inserting_says_whether_rows_were_there_at_or_after_the_first():
    rows = kept([10, 20])
    for stamp, is_before in ((21, False), (20, True), (15, True), (22, False), (22, True)):
        assert rows.insert(np.array([stamp]), np.zeros((1, 3)), np.zeros((1, 3, 3))) == is_before


def test_the_row_at_or_before_a_stamp_is_kept_and_those_after():
    for stamp, left in ((9, 10), (10, 10), (11, 10), (20, 10), (21, 20), (31, 30), (99, 30)):
        rows = kept([10, 20, 30])
        rows.forget_before(stamp)
        assert rows.stamps_ns[0] == left
        assert len(rows.values[0]) == len(rows.values[1]) == len(rows.stamps_ns)


def test_nodes_are_after_one_instant_and_covered_by_the_other_sensor_until_another():
    imu_ns, dvl_ns = np.array([0, 10, 20]), np.array([-5, 0, 7, 10, 15, 20, 25])
    assert node_range(imu_ns, dvl_ns, -5, 9) == (1, 2)
    assert node_range(imu_ns, dvl_ns, -6, 10) == (0, 4)
    assert node_range(imu_ns, dvl_ns, 7, 19) == (3, 4)
    assert node_range(imu_ns, dvl_ns, 7, 99) == (3, 6)
    assert node_range(imu_ns, dvl_ns, 15, 10) == (5, 5)
    assert node_range(imu_ns, dvl_ns, -6, -1) == (0, 0)


@given(
    st.lists(st.integers(0, 60), min_size=1, unique=True).map(sorted),
    st.tuples(st.integers(0, 12), st.integers(0, 12)).map(sorted),
    st.integers(1, 20),
)
def test_gaps_are_between_successive_rows_from_one_to_another_that_are_too_far_apart(stamps, ends, longest):
    start, end = (min(row, len(stamps) - 1) for row in ends)
    expected = [row for row in range(start, end) if stamps[row + 1] - stamps[row] > longest]
    assert rows_before_gaps(np.array(stamps), stamps[start], stamps[end], longest).tolist() == expected
