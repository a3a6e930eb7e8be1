"""Axes and signs of gyros and Doppler log, by gravity and the accelerations that both share with the accelerometers.

With G and P permutations with signs, rates G w, velocities P v and the arm l from IMU to log, all in body axes, the
right ones leave only gravity and its slow turning::

    C <- C Exp(G w dt),    F = int C f dt,    r(G, P) = C P v - C [G w]x l - F - (v_0 + gamma t + gamma' t^2)

Differences of means over a second are linear in the entries of P: for each of 48 G the sum of squares is a quadratic
form in them, so that 48 P cost as much as one. A wrong G tilts gravity and turns accelerations, a wrong P only what the
Doppler log measures, so that the two differ where the vehicle turns and moves.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import permutations, product

import numpy as np
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import Calibration
from sonar_graph.devices import is_partial
from sonar_graph.diagnosis.motion_signals import holes_beside
from sonar_graph.measurements import Dvl, Floats, Imu
from sonar_graph.navigation.alignment import (
    cross_matrices,
    means_over,
    stretches_of,
)
from sonar_graph.numerics import columns_at, running_integral, running_rotations

MEAN_OVER_S = 1.0
LONGEST_S = 240.0
"""Rows in the middle of a longer log are enough for a choice among a few axes."""
STEP_S = 0.1
"""Longest step of the integrals: a vehicle turns by a tenth of a radian in it."""
FEWEST_CHANGES = 6
LEAST_GAIN = 60.0
"""Least drop of chi-square, by the noise that the best candidate leaves; 48 candidates come by chance to some 15."""
LEAST_RATIO = 1.3
"""Least ratio of the sums of squares as they are and at the best candidate."""
WORLD_GAIN = 100.0
WORLD_RATIO = 1.6
"""The same for velocities of the world, of which a vehicle that hardly turns shows little: right logs reach 66 and 1.4."""
LEAST_SECOND = 0.3
"""Second singular value of the matrix of velocities over its first, from which on they have two directions."""
OTHER_UNIT = 1.3
"""Scale, either way, from which on a unit is suspected."""
MOST_MISFIT = 0.05
"""Largest share of the squares of the accelerations that the best matrix leaves."""
OTHER_MATRIX = 10.0
"""Least ratio of the sums of squares as they are and at the best matrix, for a matrix that is no permutation."""
LEAST_FREEDOM = 27
"""Three differences for each entry of a matrix that is no permutation."""
MOST_LEFT = 1.6
"""Largest ratio of the sum of squares at the best candidate and with any matrix: beyond it no candidate fits."""
SMALL_SHARE = 0.01
"""Or the share of the squares that any matrix explains and the best candidate does not: a tenth of a velocity is a scale."""


@dataclass(frozen=True, eq=False)
class AxesMatch:
    """The candidates that fit best; by default nothing need be changed."""

    gyro: Floats = field(default_factory=partial(np.eye, 3))
    """G, shape (3, 3): the body's rate is G times the one as read."""
    dvl: Floats = field(default_factory=partial(np.eye, 3))
    """P, shape (3, 3): the body's velocity is P times the one as read."""
    ratio: float = 1.0
    """Typical misfit as read over that of the candidates."""
    is_vertical_sure: bool = True
    """False where the sign of the Doppler log's vertical axis does not matter for the fit."""
    scale: float = 1.0
    """The body's velocity is so many times the one as read; 1 where that is no other unit."""
    is_mixed: bool = False
    """True where a matrix fits that is no rotation."""


def signed_permutations() -> Floats:
    """All 48 axes, shape (48, 3, 3); as read first."""
    found = np.zeros((48, 3, 3))
    orders = product(permutations(range(3)), product((1.0, -1.0), repeat=3))
    for P, (order, signs) in zip(found, orders, strict=True):
        P[np.arange(3), order] = signs
    return found


def match_axes(imu: Imu, dvl: Dvl, calibration: Calibration) -> AxesMatch | None:
    """Find the axes; None where the motion does not determine them."""
    rows = SharedRows.of(imu, dvl, calibration)
    if rows is None:
        return None
    candidates = signed_permutations()
    handed = np.linalg.det(candidates)
    ones = np.ones((len(candidates), 1))
    entries = np.hstack([ones, candidates.reshape(-1, 9)])  # (48, 10)
    squares = np.empty((48, 48))
    least = np.empty((48, 48))
    for k, G in enumerate(candidates):
        Q = rows.quadratic_form(G)
        squares[k] = np.einsum("ki,ij,kj->k", entries, Q, entries)
        least[k], _ = least_of(Q)
    if squares[0, 0] > LEAST_RATIO * squares.min():
        with_force_axes(rows, candidates, squares, least)
    best = squares.min()
    variance = best / rows.freedom
    as_read = squares[0, 0]
    is_better = as_read - best > LEAST_GAIN * variance
    least_left = least.flat[squares.argmin()]
    # what any matrix explains, and how much of it the best candidate does not
    is_fit = best <= MOST_LEFT * least_left
    is_fit |= best - least_left <= SMALL_SHARE * (as_read - least_left)
    if not (is_better and as_read > LEAST_RATIO * best and is_fit):
        right_handed = candidates[handed > 0]
        return other_matrix(rows, right_handed[squares[0, handed > 0].argmin()])
    # of candidates that fit as well the one that changes least
    changes_least = np.trace(candidates, axis1=1, axis2=2)
    close = np.argwhere(squares - best < LEAST_GAIN / 4 * variance).tolist()

    def preference(pair: list[int]) -> tuple[float, float, float]:
        kept = changes_least[pair].sum()
        return kept, handed[pair].sum(), -squares[tuple(pair)]

    g, p = max(close, key=preference)
    other = np.diag([1.0, 1.0, -1.0]) @ candidates[p]
    is_sure = not any(k == g and (candidates[j] == other).all() for k, j in close)
    ratio = np.sqrt(as_read / squares[g, p])
    return AxesMatch(candidates[g], candidates[p], ratio, is_sure)


def with_force_axes(
    rows: "SharedRows", candidates: Floats, squares: Floats, least: Floats
) -> None:
    """Put in the sums of squares of candidates that stand for other axes of the accelerometers, shapes (48, 48).

    Rates and velocities that change together, ``G = det(P) P``, are right, and so is the arm: ``P (v - w x l)`` is the
    velocity at the IMU in the axes of the accelerometers.
    """
    at_imu = rows.at_imu()
    for k in np.flatnonzero(np.linalg.det(candidates) > 0).tolist():
        Q = at_imu.quadratic_form(candidates[k])
        for j, P in enumerate(candidates):
            # gravity is felt upwards: of the accelerometers only level axes can be wrong
            if P[2, 2] == 1.0 and is_of_force(candidates[k], P):
                squares[k, j] = square_of(Q, P)
                least[k, j], _ = least_of(Q)


def is_of_force(gyro: Floats, dvl: Floats) -> bool:
    """True where gyros and Doppler log agree with each other: rates are reflected the other way than velocities."""
    return bool((gyro == np.linalg.det(dvl) * dvl).all())


def other_matrix(rows: "SharedRows", near: Floats) -> AxesMatch:
    """Scale or rotation of the Doppler log, near a candidate, that no permutation describes; as read where they fit badly.

    Such as those of a log in knots, or of one that looks down and is turned by 45 degrees. A matrix that is neither, and
    leaves little, mixes axes, as velocities along beams are mixed.
    """
    if rows.freedom < LEAST_FREEDOM:
        return AxesMatch()
    Q = rows.quadratic_form(np.eye(3))
    least, _ = least_of(Q)
    as_read = square_of(Q, np.eye(3))
    most = MOST_LEFT * least
    # late rows fit badly in any axes
    if as_read < OTHER_MATRIX * least or least > MOST_MISFIT * Q[0, 0]:
        return AxesMatch()
    ratio = np.sqrt(as_read / least)
    identity = np.eye(3).ravel()
    scale = -float(Q[0, 1:] @ identity) / float(identity @ Q[1:, 1:] @ identity)
    of_scale = square_of(Q, scale * np.eye(3))
    if of_scale < most:
        # in a turn the force is w v: a wrong scale of the gyro about the vertical looks alike but for changes of speed
        with_gyro = rows.quadratic_form(np.diag([1.0, 1.0, scale]))
        is_of_dvl = of_scale < square_of(with_gyro, np.eye(3))
        if scale < 0 and is_of_dvl:
            # level motion hardly shows the sense along z: then a turn
            senses = (np.diag([-1.0, -1.0, 1.0]), -np.eye(3))
            P = min(senses, key=lambda P: square_of(Q, -scale * P))
            return AxesMatch(dvl=P, ratio=ratio)
        is_other = not 1 / OTHER_UNIT < scale < OTHER_UNIT
        is_unit = scale > 0 and is_other and is_of_dvl
        return AxesMatch(ratio=ratio, scale=scale if is_unit else 1.0)
    R = turned(Q, near)
    left = square_of(Q, R)
    # level motion hardly shows a tilt, and a turn about the vertical is that of the fit of mountings
    if left < most and R[2, 2] < 0:
        return AxesMatch(dvl=R, ratio=ratio)
    return AxesMatch(ratio=ratio, is_mixed=left > OTHER_MATRIX * least)


def turned(Q: Floats, near: Floats) -> Floats:
    """Rotation near a candidate that fits best, shape (3, 3)."""
    from scipy.optimize import minimize

    def square(rotvec: Floats) -> float:
        return square_of(Q, Rotation.from_rotvec(rotvec).as_matrix() @ near)

    found = minimize(square, np.zeros(3))
    return Rotation.from_rotvec(found.x).as_matrix() @ near


def square_of(Q: Floats, P: Floats) -> float:
    """Sum of squares of r(1, P), by the quadratic form of `SharedRows`."""
    entries = np.append(1.0, P)  # (10,)
    return float(entries @ Q @ entries)


def turns_less_than_body(imu: Imu, dvl: Dvl, calibration: Calibration) -> float | None:
    """Find velocities that do not turn with the body: in axes of the world, C P v of r is Q v with one matrix Q.

    Returns
    -------
    Typical misfit as velocities of the body over that as velocities of the world, each with the matrix that fits best;
    None where the second is not much smaller.
    """
    rows = SharedRows.of(imu, dvl, calibration)
    if rows is None:
        return None
    of_body, _ = least_of(rows.quadratic_form(np.eye(3)))
    of_world, matrix = least_of(rows.quadratic_form(np.eye(3), is_in_world=True))
    gain = (of_body - of_world) * rows.freedom / of_world
    # of a way straight up and down the level velocities are noise, which a matrix of one direction leaves out
    first, second, _ = np.linalg.svd(matrix, compute_uv=False)
    has_level_way = second > LEAST_SECOND * first
    is_closer = of_body > WORLD_RATIO * of_world and gain > WORLD_GAIN
    if is_closer and has_level_way:
        return np.sqrt(of_body / of_world)
    return None


def least_of(Q: Floats) -> tuple[float, Floats]:
    """The least of a quadratic form of `SharedRows`, and the matrix that leaves it, shape (3, 3)."""
    free = np.linalg.lstsq(Q[1:, 1:], -Q[1:, 0])[0]
    least = float(max(Q[0, 0] + free @ Q[1:, 0], 1e-12))
    return least, np.asarray(free.reshape(3, 3), np.float64)


@dataclass(frozen=True, eq=False)
class SharedRows:
    """Increments of the IMU over steps of at most `STEP_S`, and the Doppler log's rows among them."""

    turn: Floats
    """Integral of the rate over each step, shape (n - 1, 3), body axes, rad."""
    impulse: Floats
    """Integral of the specific force, shape (n - 1, 3), m/s."""
    seconds: Floats
    """Of the rows of the Doppler log, shape (k,)."""
    row: np.ndarray
    """Step at which each of them is, shape (k,)."""
    rate: Floats
    """At the rows of the Doppler log, shape (k, 3), rad/s."""
    velocity: Floats
    """Shape (k, 3), body axes, m/s."""
    lever: Floats
    """From IMU to Doppler log, shape (3,), m."""
    runs: list[tuple[slice, int]]
    """Rows without a gap or a hole, and how many of them are averaged."""

    @classmethod
    def of(cls, imu: Imu, dvl: Dvl, calibration: Calibration) -> "SharedRows | None":
        """Rows in the middle of the log; None where too few are without a hole."""
        if not np.isfinite(imu.specific_force).all():
            return None
        stamps_ns, first = np.unique(imu.stamps_ns, return_index=True)
        imu_s = (stamps_ns - stamps_ns[0]) * 1e-9
        t = (dvl.stamps_ns - stamps_ns[0]) * 1e-9
        inside = (t >= 0) & (t <= imu_s[-1]) & ~is_partial(dvl.velocity_cov)
        inside[1:] &= np.diff(t) > 0
        holes, until = holes_beside(stamps_ns, imu_s, t)
        # in a hole of the IMU nothing is known of the motion
        inside &= holes == until
        if not inside.any():
            return None
        # a choice among a few axes needs no more, and costs with the length
        inside &= np.abs(t - np.median(t[inside])) <= LONGEST_S / 2
        t = t[inside]
        runs = list(runs_of(t, holes[inside]))
        if not runs:
            return None
        # rows of the Doppler log are among the ends of the steps, so that nothing is interpolated
        steps = np.maximum(np.ceil(np.diff(t) / STEP_S), 1).astype(int)
        row = np.concatenate([[0], np.cumsum(steps)])
        grid_s = np.interp(np.arange(row[-1] + 1), row, t)
        body_R_imu = calibration.imu.mounting.rotation_matrix()
        w = imu.angular_velocity[first] @ body_R_imu.T
        f = imu.specific_force[first] @ body_R_imu.T
        body_R_dvl = calibration.dvl.mounting.rotation_matrix()
        return cls(
            np.diff(columns_at(grid_s, imu_s, running_integral(imu_s, w)), axis=0),
            np.diff(columns_at(grid_s, imu_s, running_integral(imu_s, f)), axis=0),
            t,
            row,
            columns_at(t, imu_s, w),
            dvl.velocity[inside] @ body_R_dvl.T,
            np.subtract(
                calibration.dvl.mounting.translation_m,
                calibration.imu.mounting.translation_m,
            ),
            runs,
        )

    def at_imu(self) -> "SharedRows":
        """The same with the velocities of the IMU's place, and no arm."""
        moved = self.velocity - np.cross(self.rate, self.lever)
        return replace(self, velocity=moved, lever=np.zeros(3))

    @property
    def freedom(self) -> int:
        """Number of differences less the parameters of the stretches and of P."""
        changes = [(r.stop - r.start) // together - 1 for r, together in self.runs]
        return sum(3 * (m - 2) for m in changes) - 9

    def quadratic_form(self, G: Floats, *, is_in_world: bool = False) -> Floats:
        """Q, shape (10, 10), of ``(1, P)``: the sum of squares of r(G, P), or with velocities in axes of the world."""
        turn = self.turn @ G.T
        C = running_rotations(turn)  # (n, 3, 3)
        # the body turns during a step: its force is felt at the middle
        half = Rotation.from_rotvec(turn / 2).apply(self.impulse)
        steps = np.einsum("nij,nj->ni", C[:-1], half)
        F = np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])
        C = C[self.row]  # (k, 3, 3)
        turning = C @ (cross_matrices(self.rate @ G.T) @ self.lever)[:, :, None]
        rest = -F[self.row][:, :, None] - turning
        turned = np.broadcast_to(np.eye(3), C.shape) if is_in_world else C
        by_entries = np.einsum("nai,nj->naij", turned, self.velocity)
        columns = np.concatenate([rest, by_entries.reshape(len(C), 3, 9)], axis=2)
        Q = np.zeros((10, 10))
        for run, together in self.runs:
            changes = np.diff(means_over(columns[run], together), axis=0)
            flat = changes.reshape(len(changes), 30)
            # gravity and its turning, which gain the more the longer rows are apart, are of no interest
            since = self.seconds[run] - self.seconds[run].mean()
            gained = np.column_stack([since, since**2])
            slow = np.diff(means_over(gained, together), axis=0)
            left = flat - slow @ (np.linalg.pinv(slow) @ flat)
            left = left.reshape(-1, 10)
            Q += left.T @ left
        return Q


def runs_of(t: Floats, holes: np.ndarray) -> Iterator[tuple[slice, int]]:
    """Stretches with enough differences of means over `MEAN_OVER_S`, and the number of rows in a mean."""
    for run in stretches_of(t, holes):
        interval_s = float(np.median(np.diff(t[run])))
        together = max(1, round(MEAN_OVER_S / interval_s))
        if (run.stop - run.start) // together > FEWEST_CHANGES:
            yield run, together
