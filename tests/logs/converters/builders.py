"""Motion that planar odometry describes, and the message of a refused data set."""

from itertools import accumulate

import numpy as np
import pytest
from scipy.linalg import expm

from sonar_graph.errors import DatasetError


def chain(motions):
    """Poses reached by composing relative motions from the identity, shape (n + 1, 3, 3)."""
    return np.array(list(accumulate(motions, np.matmul, initial=np.eye(3))))


def hold_past_motions(sequence):
    """Motion over each interval between rows: the matrix exponential of the twist at its end, shape (n, 3, 3)."""
    assert np.array_equal(sequence.imu.stamps_ns, sequence.dvl.stamps_ns)
    duration = np.diff(sequence.imu.stamps_ns) * 1e-9
    twists = np.zeros((len(duration), 3, 3))
    twists[:, 1, 0] = sequence.imu.angular_velocity[1:, 2]
    twists[:, 0, 1] = -twists[:, 1, 0]
    twists[:, :2, 2] = sequence.dvl.velocity[1:, :2]
    return expm(twists * duration[:, None, None])


def assert_refused(call, *fragments):
    """Assert that a data set is refused in one line that has all fragments."""
    with pytest.raises(DatasetError) as caught:
        call()
    assert "\n" not in str(caught.value)
    for fragment in fragments:
        assert str(fragment) in str(caught.value)
