"""Order of events in a call of a filter, as columns, and the motions to them.

A filter's state sits at an epoch, a stamp of the Doppler log. Events happen in the order of their stamps, whatever the
calls in which measurements arrive: an epoch when it is reached, a depth sample, a heading, a position fix, then the
detections of a frame. What is measured at an instant is related to the newest epoch reached by then, through a motion
from rows stamped no later::

    epoch i --- epoch j          predict; then the plane, and gravity where an interval of it ends here
          i -------- t           depth, heading, position fix, frame, or estimate at the end of the call
    t' ------ i                  position fix that comes late, by the motion backwards (`FilterShell._use_late`)

Measurements that are related to one epoch over the same gap of the Doppler log share its error. The k-th gets k (k + 1)
times the motion's covariance: together those of one kind, such as depths or detections, tell no more than one exact
measurement, ``sum 1 / (k (k + 1)) = 1``.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sonar_graph.measurements import Floats, Ints
from sonar_graph.models import ACCEPTED
from sonar_graph.motion import Motions
from sonar_graph.navigation.alignment import up_direction
from sonar_graph.numerics import I3, LOWER_LEFT, ZERO, compiled, cross, exp_and_mean, mat, store, vec


class Motion(Motions):
    """One row of `Motions`: i_T_j with covariance C, derivative D by the gyro bias, and impulse."""


@compiled
def remove_rate(dR: Floats, dp: Floats, D: Floats, impulse: Floats, bias: Floats, earth: Floats) -> None:
    """Remove a gyro bias and the Earth's rate (frame i, rad/s) from dR, dp and impulse, to first order.

    To gyros the Earth's rate is a bias, the mean of that in both frames, i and j; the specific force is turned by half
    of what the body is.
    """
    R, p, f, rate_i = mat(dR), vec(dp), vec(impulse), vec(earth)
    rate = vec(bias) + 0.5 * (rate_i + R.T @ rate_i)
    theta, rho = mat(D) @ rate, mat(D, LOWER_LEFT) @ rate
    store(R @ exp_and_mean(theta)[0], dR)
    dp[0], dp[1], dp[2] = p + R @ rho
    impulse[0], impulse[1], impulse[2] = f + 0.5 * cross(R @ theta, f)


@compiled
def add_force(i_R_j: Floats, impulse: Floats, dR: Floats, more: Floats) -> None:
    """Continue an interval of gravity by a motion: rotation, and specific force summed up in the frame of its start."""
    R = mat(i_R_j)
    impulse[0], impulse[1], impulse[2] = vec(impulse) + R @ vec(more)
    store(R @ mat(dR), i_R_j)


@compiled
def up_at_end(i_R_j: Floats, impulse: Floats, interval: Floats) -> Floats:
    """World's up in the body where an interval of `Events.gravity` ends; NaN if not measured. The next one begins."""
    duration_s = interval[6]
    for i in range(3):
        impulse[i] /= duration_s
    up = up_direction(impulse, i_R_j, interval[:3], interval[3:6], duration_s)
    store(I3, i_R_j)
    impulse[0], impulse[1], impulse[2] = ZERO
    return up


EPOCH, PLANE, GRAVITY, DEPTH, HEADING, FIX, FRAME, END = range(8)
"""Kinds of events; at equal stamps the lower comes first, but plane and gravity right after their epoch."""
NOT_STARTED, LONG_AGO = int(np.iinfo(np.int64).max), int(np.iinfo(np.int64).min)


class Views(NamedTuple):
    """Detections of a call: range and azimuth z (m, 2) with covariance R_z, innovation e with S (NaN without one)."""

    stamp_ns: Ints
    landmark: Ints
    """Number of the landmark in the state; -1 for one that may be new, or far from where it is predicted."""
    z: Floats
    R_z: Floats
    outcome: NDArray[np.int8]
    """`OUTCOME_NUMBERS`, or ACCEPTED: to be used."""
    e: Floats
    S: Floats


def accepted_rows(seen_ns: Ints, outcome: NDArray[np.int8], first: int) -> list[int]:
    """Detections of a frame that are to be used, of which one is given."""
    return np.flatnonzero((seen_ns == seen_ns[first]) & (outcome == ACCEPTED)).tolist()


class Events(NamedTuple):
    """Events of a call in their order, as columns."""

    stamp_ns: Ints
    """When they happen; no row stamped later is used."""
    start_ns: Ints
    """Newest epoch, at which the motion to an event begins, and the instant at which it ends."""
    end_ns: Ints
    kind: Ints
    row: Ints
    """Number of the sample in its block, of the interval of gravity, or of the first detection of the frame."""
    dR: Floats
    """Columns of `Motions`; NaN over a gap, until that is bridged."""
    dp: Floats
    C: Floats
    D: Floats
    impulse: Floats
    has_rate: NDArray[np.bool_]
    """True where a gyro bias and the Earth's rate are still in a motion."""
    z_m: Floats
    """Depths, with their variances; NaN: that of the calibration."""
    variance_m2: Floats
    gravity: Floats
    """Intervals of gravity: velocity of the IMU's point at both ends, duration, and sigma of the tilt, shape (g, 8)."""
    seen_ns: Ints
    """Columns of `Views`."""
    landmark: Ints
    z: Floats
    R_z: Floats
    outcome: NDArray[np.int8]
    e: Floats
    S: Floats


@compiled
def in_order(
    epochs_ns: Ints, reached_ns: Ints, samples: Ints, seen_ns: Ints, outcome: NDArray[np.int8], since_ns: int,
    end_ns: int, node_ns: int, opened_ns: int, interval_ns: int, is_planar: bool, out: Ints,
) -> int:  # fmt: skip
    """Write the first five columns of `Events` into the rows of ``out``, up to the end of a call; their number.

    Parameters
    ----------
    samples
        Stamps, kinds and rows of depths, headings and fixes, in order, shape (3, s).
    since_ns
        Samples stamped earlier are passed over, and detections that are not accepted.
    node_ns, opened_ns, interval_ns
        Epochs of the state and at which the interval of gravity began, and its least length; 0: no gravity.
    """
    n, e, s, r, g, kind, stamp_ns, frame_ns = 0, 0, 0, 0, 0, END, LONG_AGO, LONG_AGO
    sample_ns = samples[0]
    while n == 0 or kind != END:
        if kind == EPOCH and is_planar:
            kind, until_ns = PLANE, node_ns
        elif kind <= PLANE and 0 < interval_ns <= node_ns - opened_ns:
            kind, until_ns, opened_ns, row, g = GRAVITY, node_ns, node_ns, g, g + 1
        else:
            while s < len(sample_ns) and sample_ns[s] < since_ns:
                s += 1
            while r < len(seen_ns) and (seen_ns[r] == frame_ns or outcome[r] != ACCEPTED):
                r += 1
            stamp_ns, until_ns, kind, row = end_ns, end_ns, END, 0
            if r < len(seen_ns):
                stamp_ns, until_ns, kind, row = seen_ns[r], seen_ns[r], FRAME, r
            if s < len(sample_ns) and sample_ns[s] <= stamp_ns:
                stamp_ns, until_ns, kind, row = sample_ns[s], sample_ns[s], samples[1, s], samples[2, s]
            if e < len(epochs_ns) and reached_ns[e] <= stamp_ns:
                stamp_ns, until_ns, kind, row = reached_ns[e], epochs_ns[e], EPOCH, e
            e, s = e + int(kind == EPOCH), s + int(DEPTH <= kind <= FIX)
            frame_ns = stamp_ns if kind == FRAME else frame_ns
        out[0, n], out[1, n], out[2, n], out[3, n], out[4, n] = stamp_ns, node_ns, until_ns, kind, row
        node_ns, n = until_ns if kind == EPOCH else node_ns, n + 1
    return n


NO_BIAS, NO_STAMPS, NO_DEPTH, NO_GRAVITY = np.zeros(3), np.empty(0, np.int64), np.empty(0), np.empty((0, 8))
NO_SAMPLES = np.empty((3, 0), np.int64)
NO_PAIRS, NO_COV = np.empty((0, 2)), np.empty((0, 2, 2))
NO_VIEWS = Views(NO_STAMPS, NO_STAMPS, NO_PAIRS, NO_COV, np.empty(0, np.int8), NO_PAIRS, NO_COV)
