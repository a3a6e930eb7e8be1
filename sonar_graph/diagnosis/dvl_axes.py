"""Axes and signs of the Doppler log, by the accelerations and turns that it shares with the IMU.

With C, F of `sonar_graph.navigation.alignment.dvl_imu`, v in body axes as the calibration has them, and l the arm from
IMU to log, the right axes P v, P a permutation with signs, leave only gravity and its slow turning::

    r(P) = C P v - C [w]x l - F - (v_0 + gamma t + gamma' t^2)

Differences of means over a second are linear in the entries of P, so that the sum of squares is a quadratic form in
them: all 48 candidates cost as much as one.
"""

from dataclasses import dataclass
from itertools import permutations, product

import numpy as np

from sonar_graph.calibration import Calibration
from sonar_graph.measurements import Dvl, Floats, Imu
from sonar_graph.navigation import is_partial
from sonar_graph.navigation.alignment import (
    InertialPath,
    cross_matrices,
    in_body_axes,
    means_over,
    stretches_of,
)

MEAN_OVER_S = 1.0
LEAST_GAIN = 60.0
"""Least drop of chi-square, by the noise that the best candidate leaves; 48 candidates come by chance to some 15."""
LEAST_RATIO = 1.3
"""Least ratio of the sums of squares as they are and at the best candidate."""
MOST_LEFT = 1.6
"""Largest ratio of the sum of squares at the best candidate and with any matrix: beyond it no candidate fits."""


@dataclass(frozen=True, eq=False)
class AxesMatch:
    """The candidate that fits best."""

    axes: Floats
    """P, shape (3, 3): the body's velocity is P times the one as read."""
    is_vertical_sure: bool
    """False where the sign of the vertical axis does not matter for the fit."""
    ratio: float
    """Typical misfit as read over that of the candidate."""

    @property
    def is_as_read(self) -> bool:
        """True where nothing need be changed."""
        return bool((self.axes == np.eye(3)).all())

    def names(self) -> str:
        """Such as ``x, -y, z``."""
        rows = [
            ("-" if row.sum() < 0 else "") + "xyz"[int(np.argmax(np.abs(row)))]
            for row in self.axes
        ]
        return ", ".join(rows)


def match_axes(imu: Imu, dvl: Dvl, calibration: Calibration) -> AxesMatch | None:
    """Find the axes; None where the motion does not determine them."""
    if not np.isfinite(imu.specific_force).all():
        return None
    form = quadratic_form(imu, dvl, calibration)
    if form is None:
        return None
    Q, freedom = form
    candidates = signed_permutations()
    squares = np.array(
        [np.append(1.0, P.ravel()) @ Q @ np.append(1.0, P.ravel()) for P in candidates]
    )
    best = int(np.argmin(squares))
    variance = squares[best] / freedom
    as_read = squares[int(np.argmax([np.trace(P) for P in candidates]))]
    whole = np.linalg.lstsq(Q[1:, 1:], -Q[1:, 0])[0]
    least = float(Q[0, 0] + whole @ Q[1:, 0])
    is_fit = squares[best] <= MOST_LEFT * max(least, 1e-12)
    if (
        as_read - squares[best] < LEAST_GAIN * variance
        or as_read < LEAST_RATIO * squares[best]
        or not is_fit
    ):
        return AxesMatch(np.eye(3), is_vertical_sure=True, ratio=1.0)
    # of candidates that fit as well the one that changes least
    close = np.flatnonzero(squares - squares[best] < LEAST_GAIN / 4 * variance)
    chosen = max(
        close.tolist(),
        key=lambda k: (
            np.trace(candidates[k]),
            np.linalg.det(candidates[k]),
            -squares[k],
        ),
    )
    axes = candidates[chosen]
    other = np.diag([1.0, 1.0, -1.0]) @ axes
    is_sure = not any((candidates[k] == other).all() for k in close)
    return AxesMatch(axes, is_sure, float(np.sqrt(as_read / squares[chosen])))


def signed_permutations() -> list[Floats]:
    """All 48 axes, shape (3, 3) each."""
    found = []
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        P = np.zeros((3, 3))
        P[np.arange(3), order] = signs
        found.append(P)
    return found


def quadratic_form(
    imu: Imu, dvl: Dvl, calibration: Calibration
) -> tuple[Floats, int] | None:
    """Q, shape (10, 10), of ``(1, P)``, and the number of differences less the parameters of the stretches."""
    path = InertialPath.of(in_body_axes(imu, calibration))
    seconds = path.since_origin(dvl.stamps_ns)
    inside = path.covers(seconds) & ~is_partial(dvl.velocity_cov)
    inside[1:] &= np.diff(seconds) > 0
    seconds = seconds[inside]
    v = dvl.velocity[inside] @ calibration.dvl.mounting.pose().rotation().matrix().T
    runs = list(stretches_of(seconds, path.parts_at(seconds)))
    if not runs:
        return None
    lever = np.subtract(
        calibration.dvl.mounting.translation_m, calibration.imu.mounting.translation_m
    )
    C = path.rotations_at(seconds)
    turning = C @ cross_matrices(path.linear_at(seconds, path.rate))
    rest = -path.linear_at(seconds, path.impulse) - turning @ lever
    by_entries = np.einsum("nai,nj->naij", C, v).reshape(len(seconds), 3, 9)
    columns = np.concatenate([rest[:, :, None], by_entries], axis=2)  # (n, 3, 10)
    Q = np.zeros((10, 10))
    freedom = -9
    for run in runs:
        since = seconds[run] - seconds[run].mean()
        together = max(1, round(MEAN_OVER_S / float(np.median(np.diff(since)))))
        changes = np.diff(means_over(columns[run], together), axis=0)  # (m, 3, 10)
        m = len(changes)
        if m < 6:
            continue
        slow = np.polynomial.legendre.legvander(np.linspace(-1, 1, m), 1)
        own = slow @ np.linalg.pinv(slow)
        left = changes - np.einsum("ij,jak->iak", own, changes)
        flat = left.reshape(-1, 10)
        Q += flat.T @ flat
        freedom += 3 * (m - 2)
    return (Q, freedom) if freedom > 0 else None
