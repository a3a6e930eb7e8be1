import re

import numpy as np
import pytest


@pytest.fixture
def se2():
    """Homogeneous matrices of (x, y, theta), shape (n, 3)."""

    def matrices(poses):
        x, y, theta = np.asarray(poses, dtype=float).T
        zero, one = np.zeros_like(x), np.ones_like(x)
        rows = [
            [np.cos(theta), -np.sin(theta), x],
            [np.sin(theta), np.cos(theta), y],
            [zero, zero, one],
        ]
        return np.moveaxis(np.array(rows), -1, 0)

    return matrices


@pytest.fixture
def chain():
    """Poses reached by composing relative motions from the identity, shape (n + 1, 3, 3)."""

    def compose(motions):
        poses = [np.eye(3)]
        for motion in motions:
            poses.append(poses[-1] @ motion)
        return np.array(poses)

    return compose


@pytest.fixture
def hold_past_motions():
    """Motion over each interval between rows: the exponential of the twist at its end, summed as a power series."""

    def motions(sequence):
        assert np.array_equal(sequence.imu.stamps_ns, sequence.dvl.stamps_ns)
        duration = np.diff(sequence.imu.stamps_ns) * 1e-9
        twists = np.zeros((len(duration), 3, 3))
        twists[:, 1, 0] = sequence.imu.angular_velocity[1:, 2]
        twists[:, 0, 1] = -twists[:, 1, 0]
        twists[:, :2, 2] = sequence.dvl.velocity[1:, :2]
        generator = twists * duration[:, None, None]
        assert np.abs(generator[:, 1, 0]).max() < 2
        total = term = np.broadcast_to(np.eye(3), generator.shape)
        for order in range(1, 30):
            term = np.einsum("nij,njk->nik", term, generator) / order
            total = total + term
        return total

    return motions


@pytest.fixture
def refusal():
    """The one-line message with which a call is refused."""

    def message(call, *fragments):
        from sonar_graph.errors import DatasetError

        with pytest.raises(DatasetError) as caught:
            call()
        text = str(caught.value)
        assert "\n" not in text
        for fragment in fragments:
            assert re.search(re.escape(str(fragment)), text), f"{fragment!r} is not in {text!r}"
        return text

    return message
