"""Consistency: NEES and NIS with their chi-square bounds.

NEES and NIS: docs/theory/metrics.md (Bar-Shalom, Li, Kirubarajan 2001, section 5.4).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sonar_graph.evaluation.metrics import yaw_errors_rad
from sonar_graph.evaluation.results import ErrorSeries
from sonar_graph.measurements import NS_PER_S, Floats
from sonar_graph.numerics import chi_square_quantile
from sonar_graph.states import DetectionLog, Outcome, Trajectory

# with fewer independent samples a small normalised error is no sign of caution: slow errors pass through zero
LEAST_SAMPLES = 10
GATED_SHARE = 0.2
"""Above this share of detections outside its gate an estimator is lost, or its noise is far too small; the innovations
inside the gate then say nothing about its covariances."""
SUCCESSIVE_S = 2.0
"""Time between two sightings of a landmark up to which their errors are compared."""


def error_series(
    estimate: Trajectory, truth: Trajectory, position_dof: int
) -> ErrorSeries:
    """Errors, their reported standard deviations and their NEES; estimate and truth have the same instants.

    The NEES of position takes x and y (``position_dof`` 2, planar motion), or also z (3).
    """
    # also checks that both are at the same instants
    yaw_error = yaw_errors_rad(estimate, truth)
    position_error = estimate.positions - truth.positions
    position_cov = world_position_covs(estimate)
    yaw_var = yaw_variances(estimate)
    # a vehicle in a plane reports a height without uncertainty, whose NEES would be infinite
    axes = slice(0, position_dof)

    position_unit = normalised(position_error[:, axes], position_cov[:, axes, axes])
    yaw_unit = normalised(yaw_error[:, None], yaw_var[:, None, None])
    return ErrorSeries(
        stamps_ns=estimate.stamps_ns,
        position_m=position_error,
        position_sigma_m=sigmas(np.diagonal(position_cov, axis1=1, axis2=2)),
        yaw_rad=yaw_error,
        yaw_sigma_rad=sigmas(yaw_var),
        nees_position=np.sum(position_unit**2, axis=1),
        nees_yaw=np.sum(yaw_unit**2, axis=1),
        position_dof=position_dof,
        position_samples=effective_samples(position_unit),
        yaw_samples=effective_samples(yaw_unit),
    )


def sigmas(variances: Floats) -> Floats:
    """Standard deviations; rounding below zero counts as zero."""
    return np.sqrt(np.maximum(variances, 0.0))


def world_position_covs(trajectory: Trajectory) -> Floats:
    """Covariance of the position in the world, shape (n, 3, 3), m².

    To first order ``mean @ Exp([theta, rho])`` has its origin at ``t + R rho``, so the covariance is ``R P_rho R^T``.
    """
    R = trajectory.matrices
    return R @ trajectory.covariances[:, 3:, 3:] @ R.transpose(0, 2, 1)


def yaw_variances(trajectory: Trajectory) -> Floats:
    """Variance of the heading ``atan2(R10, R00)``, shape (n,), rad².

    With ``R Exp(theta)`` its derivative is ``[0, R21, R22] / (R00² + R10²)``: a turn about the body's own z moves
    the heading of a level vehicle by as much, of a tilted one by another amount. NaN at a vertical x axis.
    """
    R = trajectory.matrices
    jacobian = np.zeros((len(trajectory), 3))
    # a vertical x axis has no heading: NaN is the answer, not a warning
    with np.errstate(divide="ignore", invalid="ignore"):
        jacobian[:, 1:] = R[:, 2, 1:] / (R[:, 0, 0] ** 2 + R[:, 1, 0] ** 2)[:, None]
        return np.einsum(
            "ni,nij,nj->n", jacobian, trajectory.covariances[:, :3, :3], jacobian
        )


def normalised_squares(errors: Floats, covs: Floats) -> Floats:
    """``e^T P^-1 e`` of every row of (n, d) and (n, d, d); NaN where P is unknown or not positive definite.

    Examples
    --------
    >>> import numpy as np
    >>> from sonar_graph.evaluation import normalised_squares
    >>> normalised_squares(np.array([[0.1, 0.0], [0.2, 0.2]]), np.array([0.01 * np.eye(2)] * 2))
    array([1., 8.])
    """
    return (normalised(errors, covs) ** 2).sum(axis=1)


def normalised(errors: Floats, covs: Floats) -> Floats:
    """``P^-1/2 e`` of every row, shape (n, d); NaN where P is unknown or not positive definite."""
    unit = np.full(errors.shape, np.nan)
    known = np.isfinite(covs).all(axis=(1, 2)) & np.isfinite(errors).all(axis=1)
    # P^-1/2 = V diag(1 / sqrt(variances)) V^T, with the eigenvectors V = axes
    variances, axes = np.linalg.eigh(covs[known])
    along = np.einsum("nji,nj->ni", axes, errors[known])
    # a covariance with a zero eigenvalue claims certainty and has no NEES
    definite = variances[:, 0] > 0
    scaled = along[definite] / np.sqrt(variances[definite])
    unit[np.flatnonzero(known)[definite]] = np.einsum(
        "nij,nj->ni", axes[definite], scaled
    )
    return unit


def effective_samples(unit: Floats) -> int:
    """Number of independent samples that the mean square of a series of normalised errors, shape (n, d), is worth.

    With the correlation C_k of the errors k rows apart (Bayley, Hammersley 1946; for squares of Gaussian errors)::

        N = n / (1 + 2 sum_k (1 - k/n) |C_k|^2 / d),    C_k = sum_i u_i u_{i+k}^T / (n - k) / mean |u|^2 d

    The sum ends at the first lag that is within two standard errors, 4/n, of none. No mean is subtracted: a consistent
    error has none, and a constant error is one sample. At least 1; 0 where no covariance is known.
    """
    u = unit[np.isfinite(unit).all(axis=1)]
    n, d = u.shape
    if not n or not u.any():
        return min(n, 1)
    # padded with n zeros: the correlation by FFT is circular, and the ends must not meet
    spectrum = np.fft.rfft(u, 2 * n, axis=0)
    sums = np.fft.irfft(
        np.einsum("fi,fj->fij", spectrum.conj(), spectrum), 2 * n, axis=0
    )[:n]
    lag = np.arange(n)
    # the fewer pairs of a long lag are made up for
    C = sums / (n - lag)[:, None, None] / (np.mean(u**2))
    shared = np.minimum((C**2).sum(axis=(1, 2)) / d, 1.0)
    # beyond the first lag in the noise a sum would add noise alone
    gone = np.flatnonzero(shared < 4 * d / n)
    last = gone[0] if gone.size else n
    return max(1, int(n / (1 + 2 * np.sum((1 - lag[1:last] / n) * shared[1:last]))))


def time_average_interval(samples: int, dof: int) -> tuple[float, float] | None:
    """Bounds of the average of one run that is worth so many independent samples; None for none.

    With fewer than `LEAST_SAMPLES` the lower bound is 0.
    """
    if not samples:
        return None
    # the mean of few slow errors is often near zero without caution of the estimator
    low, high = anees_interval(samples, dof)
    return low if samples >= LEAST_SAMPLES else 0.0, high


def nis(log: DetectionLog) -> Floats:
    """Normalised innovation squared of each detection that was used, shape (k,); 2 degrees of freedom.

    The first sight of a landmark has no prediction and is left out, as is what the gate refused.

    Examples
    --------
    >>> import numpy as np
    >>> from sonar_graph import run_estimator
    >>> from sonar_graph.evaluation import nis
    >>> from sonar_graph.testing import small_world
    >>> values = nis(run_estimator(small_world(), "ekf-slam").detections)
    >>> bool(0.5 < np.mean(values) / 2 < 2.0)
    True
    """
    squares = used_squares(log)
    return squares[np.isfinite(squares)]


def used_squares(log: DetectionLog) -> Floats:
    """Normalised innovation squared of each detection, shape (n,); NaN where it was not used or not predicted."""
    squares = normalised_squares(log.innovations, log.innovation_covs)
    # what the gate refused was chosen by its size, and would bias the mean
    return np.where(is_used(log), squares, np.nan)


def is_used(log: DetectionLog) -> NDArray[np.bool_]:
    """True for each detection that was used at once for a landmark that was known, shape (n,)."""
    return np.array([outcome is Outcome.USED for outcome in log.outcomes], dtype=bool)


class Likeness(NamedTuple):
    """Correlation of the innovations of successive sightings of a landmark."""

    correlation: Floats
    """Of range and of azimuth, shape (2,); 0 where innovations are white."""
    mean_square: Floats
    """Of the innovations over their sigmas, shape (2,)."""
    pairs: int
    """Number of pairs of sightings."""

    def sigma_factors(self) -> Floats:
        """Factors of the sigmas of range and azimuth by which means of such errors have their variance, shape (2,).

        The mean of errors with the correlation rho from one to the next has ``(1 + rho) / (1 - rho)`` times the variance
        that it has without (Bayley, Hammersley 1946).
        """
        rho = self.correlation
        return np.sqrt(self.mean_square * (1.0 + rho) / (1.0 - rho))


def likeness(log: DetectionLog) -> Likeness:
    """Correlation of innovations, over all landmarks and pairs of successive sightings that were used.

    With ``u`` the innovation of range, or of azimuth, over its sigma, and the next one of the same landmark at most
    `SUCCESSIVE_S` later::

        rho = sum u_k u_k+1 / sqrt(sum u_k^2 sum u_k+1^2)

    Innovations of a consistent filter are white (Bar-Shalom, Li, Kirubarajan 2001, section 5.4.2). Errors of sightings
    that last longer than the time between two of them are not: then covariances are too small, and NIS may still be
    below 1.

    Examples
    --------
    >>> from sonar_graph import run_estimator
    >>> from sonar_graph.evaluation import likeness
    >>> from sonar_graph.testing import small_world
    >>> bool((abs(likeness(run_estimator(small_world(), "ekf-slam").detections).correlation) < 0.5).all())
    True
    """
    known = is_used(log) & np.isfinite(log.innovation_covs).all(axis=(1, 2))
    variances = np.diagonal(log.innovation_covs[known], axis1=1, axis2=2)
    u = log.innovations[known] / np.sqrt(variances)  # (n, 2)
    ids = log.landmark_ids[known]
    stamps_ns = log.stamps_ns[known]
    in_turn = np.lexsort((stamps_ns, ids))
    before = in_turn[:-1]
    after = in_turn[1:]
    is_pair = ids[before] == ids[after]
    is_pair &= stamps_ns[after] - stamps_ns[before] <= SUCCESSIVE_S * NS_PER_S
    u_k = u[before[is_pair]]
    u_next = u[after[is_pair]]
    squares = np.sum(u_k**2, axis=0) * np.sum(u_next**2, axis=0)
    shared = np.sum(u_k * u_next, axis=0)
    correlation = np.divide(
        shared, np.sqrt(squares), out=np.zeros(2), where=squares > 0
    )
    mean_square = np.mean(u**2, axis=0) if len(u) else np.zeros(2)
    return Likeness(correlation, mean_square, int(is_pair.sum()))


def mean_normalised(squares: Floats, dof: int) -> float:
    """Mean of the known values divided by the degrees of freedom: 1 is consistent, above is over-confident.

    NaN without a known value.
    """
    known = squares[np.isfinite(squares)]
    return float(known.mean() / dof) if known.size else float("nan")


def anees_interval(
    runs: int, dof: int, probability: float = 0.95
) -> tuple[float, float]:
    """Two-sided bounds of the ANEES of a consistent estimator, per degree of freedom.

    The sum of the NEES of ``runs`` independent runs is chi-square with ``runs * dof`` degrees of freedom. Instants of
    one run are not independent: these bounds do not hold for an average over time.

    Examples
    --------
    Fifty runs of a position in space:

    >>> from sonar_graph.evaluation import anees_interval
    >>> low, high = anees_interval(50, 3)
    >>> print(f"{low:.2f} to {high:.2f}")
    0.79 to 1.24
    """
    total = runs * dof
    tail = (1 - probability) / 2
    low, high = (chi_square_quantile(share, total) for share in (tail, 1 - tail))
    return low / total, high / total
