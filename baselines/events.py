"""Events of a call of a filter in their order, and the motions that lead to them.

A filter's state is that of an epoch, a stamp of the Doppler log. Events happen in the order of their stamps, whatever the
calls in which measurements arrive: an epoch when it is reached, a depth sample, a heading, a position fix, then the
detections of a frame. A measurement is related to the newest epoch reached by then, through a motion from rows stamped
no later::

    epoch i --- epoch j          predict; then the plane, and gravity where an interval of it ends at j
          i -------- t           depth, heading, position fix, frame, or estimate at the end of the call
    t' ------ i                  position fix that comes late, by the motion backwards
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sonar_graph.measurements import Floats, Ints
from sonar_graph.models import ACCEPTED, Mount, floor_elevation
from sonar_graph.motion import Motions
from sonar_graph.numerics import (
    LOWER_LEFT,
    Vec3,
    compiled,
    cross,
    exp_and_mean,
    inlined,
    mat,
    store,
    store_vector,
    vec,
)

EPOCH, DEPTH, HEADING, FIX, FRAME, END = range(6)
"""Kinds of events; at equal stamps the lower comes first."""
UNKNOWN = -1
"""In place of the number of a landmark that is not in the state."""
NO_ROW = -1
"""In place of a row where there is none."""
NOT_STARTED = int(np.iinfo(np.int64).max)
LONG_AGO = int(np.iinfo(np.int64).min)


class Motion(NamedTuple):
    """One row of `Motions`."""

    dR: Floats
    """i_R_j, shape (3, 3)."""
    dp: Floats
    """i_p_j, shape (3,), m."""
    C: Floats
    """Covariance of [theta, rho] in frame j, shape (6, 6)."""
    D: Floats
    """Derivative of [theta, rho] by the gyro bias, shape (6, 3)."""
    impulse: Floats
    """Integral of the specific force in frame i, shape (3,), m/s."""


class Sonar(NamedTuple):
    """Sonar and floor, and the treatment of doubtful detections."""

    body_R_sonar: Floats
    body_p_sonar: Floats
    aperture_rad: float
    floor_z_m: float
    """NaN where it is not known."""
    floor_variance_m2: float
    gate: float
    """Mahalanobis distance beyond which a detection is refused."""
    kernel_width: float
    """Of the Cauchy kernel, in standard deviations; infinite: none."""

    @property
    def mount(self) -> Mount:
        """Place of the sonar."""
        return Mount(self.body_R_sonar, self.body_p_sonar)


class Samples(NamedTuple):
    """Depths, headings and position fixes of a call, in order."""

    stamp_ns: Ints
    kind: Ints
    value: Floats
    """Shape (s, 3): the position of a fix, the height of a depth sample as last number, the yaw as first."""
    noise: Floats
    """Covariances, shape (s, 3, 3), in the same places."""


class Views(NamedTuple):
    """Detections of a call: range and azimuth z (m, 2) with covariance R_z, innovation e with S (NaN without one)."""

    stamp_ns: Ints
    ids: Ints
    """Identity of the landmark that is most probable."""
    slot: Ints
    """Number of that landmark in the state; `UNKNOWN` of one that is not in it."""
    gate: Floats
    """Mahalanobis distance beyond which the detection is refused."""
    z: Floats
    R_z: Floats
    outcome: NDArray[np.int8]
    """`OUTCOME_NUMBERS`, or ACCEPTED: to be used."""
    e: Floats
    S: Floats


@compiled
def in_frame(views: Views, first: int) -> Ints:
    """Detections of a frame that are to be used, from its first row on."""
    found = np.empty(len(views.stamp_ns), np.int64)
    n = 0
    for row in range(first, len(found)):
        # rows of one frame follow each other
        if views.stamp_ns[row] != views.stamp_ns[first]:
            break
        if views.outcome[row] == ACCEPTED:
            found[n] = row
            n += 1
    return found[:n]


@compiled
def shows_new(views: Views, first: int) -> bool:
    """True where a frame, from its first row on, shows a landmark that is not in the state."""
    for row in in_frame(views, first):  # noqa: SIM110  # numba compiles no generator in any()
        if views.slot[row] == UNKNOWN:
            return True
    return False


class Felt(NamedTuple):
    """Turn and specific force since an interval of gravity began."""

    turn: Floats
    """Rotation from the start of the interval to the newest epoch, shape (3, 3)."""
    impulse: Floats
    """Specific force, integrated in the frame of the start, shape (3,), m/s."""

    @classmethod
    def nothing(cls) -> "Felt":
        """At the start of an interval."""
        return cls(np.eye(3), np.zeros(3))

    def forget(self) -> None:
        """Begin another interval."""
        self.turn[:] = np.eye(3)
        self.impulse[:] = 0.0


@compiled
def feel(felt: Felt, motion: Motion) -> None:
    """Continue by the motion to the next epoch."""
    turn = mat(felt.turn)
    store_vector(vec(felt.impulse) + turn @ vec(motion.impulse), felt.impulse, 0)
    store(turn @ mat(motion.dR), felt.turn)


class Order(NamedTuple):
    """Events in their order, as columns."""

    stamp_ns: Ints
    """When they happen; no row stamped later is used."""
    start_ns: Ints
    """Newest epoch, at which the motion to an event begins."""
    end_ns: Ints
    """Instant at which that motion ends."""
    kind: Ints
    row: Ints
    """Number of the sample, or of the first detection of the frame."""
    has_more: Ints
    """1 for an epoch at which the plane, or gravity over an interval that ends there, is measured too, else 0."""


class Call(NamedTuple):
    """Times of a call of a filter."""

    end_ns: int
    node_ns: int
    """Epoch of the state before the call."""
    opened_ns: int
    """Epoch at which the interval of gravity began."""
    interval_ns: int
    """Least length of an interval of gravity; 0: gravity is not used."""
    has_plane: bool
    """True where the vehicle stays on a plane."""


@compiled
def in_order(
    epochs_ns: Ints,
    reached_ns: Ints,
    sample_ns: Ints,
    sample_kind: Ints,
    views: Views,
    call: Call,
) -> Ints:
    """Order the epochs, samples and frames of a call up to `END`; columns of `Order` as rows, shape (6, n)."""
    out = np.empty(
        (6, len(epochs_ns) + len(sample_ns) + len(views.stamp_ns) + 1), np.int64
    )
    n = epoch = sample = view = 0
    node_ns = call.node_ns
    opened_ns = call.opened_ns
    frame_ns = LONG_AGO
    kind = EPOCH
    while kind != END:
        # pass over what is refused, or of the frame that was just ordered
        while view < len(views.stamp_ns) and (
            views.stamp_ns[view] == frame_ns or views.outcome[view] != ACCEPTED
        ):
            view += 1
        # the earliest of what comes next; at equal stamps the lower kind
        kind = END
        stamp_ns = call.end_ns
        row = 0
        if view < len(views.stamp_ns):
            kind = FRAME
            stamp_ns = views.stamp_ns[view]
            row = view
        if sample < len(sample_ns) and sample_ns[sample] <= stamp_ns:
            kind = sample_kind[sample]
            stamp_ns = sample_ns[sample]
            row = sample
        # an epoch counts from when its rows are known, which may be later than its own stamp
        if epoch < len(epochs_ns) and reached_ns[epoch] <= stamp_ns:
            kind = EPOCH
            stamp_ns = reached_ns[epoch]
            row = epoch
        out[0, n] = stamp_ns
        out[1, n] = node_ns
        out[2, n] = epochs_ns[row] if kind == EPOCH else stamp_ns
        out[3, n] = kind
        out[4, n] = row
        out[5, n] = 0
        if kind == EPOCH:
            epoch += 1
            node_ns = epochs_ns[row]
            out[5, n] = call.has_plane
            if 0 < call.interval_ns <= node_ns - opened_ns:
                out[5, n] = 1
                opened_ns = node_ns
        elif kind == FRAME:
            # the other detections of this frame are part of the same event
            frame_ns = stamp_ns
        elif kind != END:
            sample += 1
        n += 1
    return out[:, :n].copy()


class Events(NamedTuple):
    """Events of a call, n of them, the motion to each from its newest epoch, and samples."""

    order: Order
    motions: Motions
    is_gap: NDArray[np.bool_]
    """True where that motion leads over a gap of the Doppler log, shape (n,)."""
    value: Floats
    """`Samples.value`."""
    noise: Floats
    views: Views


class FilterSetup(NamedTuple):
    """What a filter knows beside its state and the events."""

    felt: Felt
    port_m: Floats
    """Pressure port in the body, shape (3,)."""
    earth_rad_s: Floats
    """The Earth's rate in the world, shape (3,)."""
    has_rate: bool
    """True where gyros measure a bias of the state or the Earth's rate."""
    walk_density: Floats
    """Of the biases in the state."""
    sonar: Sonar
    follows_frames: bool
    """False where landmarks may be far, or are compared with a map: each frame is then an event of its own."""


@inlined
def is_followed(events: Events, setup: FilterSetup, k: int, first: int) -> bool:
    """True for an epoch, a depth or a frame; a motion over a gap depends on the state, and is bridged in its turn."""
    kind = events.order.kind[k]
    is_frame = kind == FRAME and setup.follows_frames
    return (kind <= DEPTH or is_frame) and (k == first or not events.is_gap[k])


@inlined
def motion_to(events: Events, k: int) -> Motion:
    """Motion that leads to an event."""
    motions = events.motions
    return Motion(
        motions.dR[k], motions.dp[k], motions.C[k], motions.D[k], motions.impulse[k]
    )


@compiled
def remove_rate(motion: Motion, bias: Vec3, earth_i: Vec3) -> Motion:
    """Motion without a gyro bias and the Earth's rate (frame i, both in rad/s), to first order.

    For gyros the Earth's rate is a bias, the mean of its values in frames i and j. The specific force turns by half of
    the correction of the rotation.
    """
    dR = mat(motion.dR)
    impulse = vec(motion.impulse)
    rate = bias + 0.5 * (earth_i + dR.T @ earth_i)
    theta = mat(motion.D) @ rate
    rho = mat(motion.D, LOWER_LEFT) @ rate
    # C and D stay: they would change in second order
    turn, _ = exp_and_mean(theta)
    reduced = Motion(np.empty((3, 3)), np.empty(3), motion.C, motion.D, np.empty(3))
    store(dR @ turn, reduced.dR)
    store_vector(vec(motion.dp) + dR @ rho, reduced.dp, 0)
    store_vector(impulse + 0.5 * cross(dR @ theta, impulse), reduced.impulse, 0)
    return reduced


def elevation_of_new(R: Floats, X: Floats, sonar: Sonar, z: Floats) -> float:
    """Elevation of a new landmark seen by a body at (R, X): on the floor; 0 without a floor within the aperture."""
    up = sonar.mount.body_R_sonar.T @ R[2]  # in the sonar's axes
    height_m = sonar.floor_z_m - (X + R @ sonar.mount.body_p_sonar)[2]
    elevation_rad = floor_elevation(up, height_m, z[0], z[1])
    return elevation_rad if abs(elevation_rad) <= 0.5 * sonar.aperture_rad else 0.0
