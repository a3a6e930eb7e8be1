import numpy as np
import pytest

from baselines.filter_window import (
    BEFORE_ALL,
    CLOCK,
    DEPTH,
    DEPTHS,
    END,
    FRAME,
    LOST,
    NODE,
    NODE_REACHED,
    SIGHTINGS,
    Stamps,
    next_event,
    reach_node,
)
from sonar_graph.numerics.jit import compiled


@compiled
def event_after(stamps, clock, longest_ns, done):
    return next_event(stamps, clock, longest_ns, done)


def events(dvl_ns, depth_ns, frame_ns, until_ns, longest_ns=10**6, imu_ns=range(1000)):
    """All events of a window that begins at the first Doppler row, and the clock at its end."""
    stamps = Stamps(*(np.array(part, dtype=np.int64) for part in (imu_ns, dvl_ns, depth_ns, frame_ns)), until_ns)
    clock, event, found = np.zeros(CLOCK, np.int64), BEFORE_ALL, []
    clock[NODE] = dvl_ns[0]
    while True:
        event = event_after(stamps, clock, longest_ns, event)
        found.append(event)
        if event.kind == NODE_REACHED:
            reach_node(clock, event.stamp_ns)
        if event.kind == END:
            return found, clock


def test_events_come_in_the_order_of_their_stamps_and_a_frame_has_all_rows_of_its_stamp():
    """At equal stamps node, depth, frame; a node waits for the IMU row that reaches it."""
    found, _ = events([0, 20, 40], [10, 20, 50], [20, 20, 45], 60)
    expected = [(DEPTH, 10), (NODE_REACHED, 20), (DEPTH, 20), (FRAME, 20), (NODE_REACHED, 40), (FRAME, 45), (DEPTH, 50)]
    assert [(event.kind, event.stamp_ns) for event in found] == [*expected, (END, 60)]
    found, _ = events([0], [], [5, 5, 5, 7], 9)
    assert [(event.first, event.rows) for event in found if event.kind == FRAME] == [(0, 3), (3, 4)]
    found, _ = events([0, 20], [21, 24], [], 30, imu_ns=[0, 10, 23, 33])
    assert [event.kind for event in found] == [DEPTH, NODE_REACHED, DEPTH, END]


@pytest.mark.parametrize(("longest_ns", "count_in_gap"), [(100, [0, 0, 0]), (20, [1, 3, 2])])
def test_what_is_told_over_a_gap_is_counted_depth_and_detections_each_for_themselves(longest_ns, count_in_gap):
    found, clock = events([0], [25, 30], [28, 28, 28], 40, longest_ns)
    assert [event.kind for event in found[:3]] == [DEPTH, FRAME, DEPTH]
    assert [event.count_in_gap for event in found[:3]] == count_in_gap
    assert clock.tolist()[DEPTHS : LOST + 1] == ([2, 3, 1] if longest_ns == 20 else [0, 0, 0])


def test_the_counts_begin_anew_at_a_node_and_the_loss_is_remembered():
    found, clock = events([0, 50], [25, 60, 65], [], 66, 20)
    assert [event.count_in_gap for event in found if event.kind == DEPTH] == [1, 0, 0]
    assert (clock[DEPTHS], clock[SIGHTINGS], clock[LOST]) == (0, 0, 1)
