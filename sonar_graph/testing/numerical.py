"""Numerical checks of derivatives and covariances: Jacobians by central differences, NEES by its two-sided band."""

import math
from collections.abc import Callable, Sequence

import gtsam
import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import chi2

from sonar_graph.measurements import Floats


def central_differences(
    function: Callable[[Floats], ArrayLike],
    at: ArrayLike,
    *,
    angles: Sequence[int] = (),
    step: float = 1e-5,
) -> Floats:
    """Derivative by differences, ``(f(x + step u_k) - f(x - step u_k)) / (2 step)`` along the last axis.

    Arguments as of `check_derivative`; shape that of the value, followed by (n,).
    """
    x = np.asarray(at, np.float64)
    columns = []
    for direction in np.eye(len(x)):
        change = np.subtract(
            function(x + step * direction),
            function(x - step * direction),
            dtype=np.float64,
        )
        for row in angles:
            change[row] = math.remainder(change[row], 2 * math.pi)
        columns.append(change / (2 * step))
    return np.stack(columns, axis=-1)


def check_derivative(
    function: Callable[[Floats], ArrayLike],
    jacobian: ArrayLike,
    at: ArrayLike,
    *,
    angles: Sequence[int] = (),
    step: float = 1e-5,
    tolerance: float = 1e-5,
) -> None:
    """Compare the derivative of a function of a vector with central differences.

    Parameters
    ----------
    function
        Function ``f`` of a vector, shape (n,); its value has any shape, such as (m,). A function of a pose is checked
        as one of its perturbation, at zero: ``lambda d: f(pose.retract(d))``.
    jacobian
        Stated derivative, shape (m, n): that of the value, followed by (n,).
    at
        Vector x at which it is stated, shape (n,).
    angles
        Rows of the value that are angles, whose differences are wrapped.
    step
        Length of the differences.
    tolerance
        Largest difference allowed in a row, relative to the largest entry of the row; absolute below 1.

    Raises
    ------
    ValueError
        When the Jacobian has another shape.
    AssertionError
        Naming row and column of the largest difference, with both numbers.

    Examples
    --------
    >>> import numpy as np
    >>> from sonar_graph.testing import check_derivative
    >>> def polar(p):
    ...     return np.array([np.hypot(*p), np.arctan2(p[1], p[0])])
    >>> check_derivative(polar, [[0.6, 0.8], [-0.16, 0.12]], at=[3.0, 4.0], angles=[1])
    >>> check_derivative(polar, [[0.6, 0.8], [0.16, 0.12]], at=[3.0, 4.0], angles=[1])
    Traceback (most recent call last):
        ...
    AssertionError: derivative of row 1 by direction 0: stated 0.16, by differences -0.16
    """
    stated = np.asarray(jacobian, np.float64)
    numeric = central_differences(function, at, angles=angles, step=step)
    if stated.shape != numeric.shape:
        raise ValueError(
            f"expected a Jacobian of shape {numeric.shape}, not {stated.shape}"
        )
    largest = np.fmax(np.abs(stated), np.abs(numeric)).max(axis=-1, keepdims=True)
    off = np.abs(stated - numeric) / np.fmax(1.0, largest)
    if not off.max() <= tolerance:
        *row, k = place = np.unravel_index(
            int(np.argmax(np.where(np.isnan(off), np.inf, off))), off.shape
        )
        raise AssertionError(
            f"derivative of row {', '.join(map(str, row)) or 0} by direction {k}:"
            f" stated {stated[tuple(place)]:.9g}, by differences {numeric[tuple(place)]:.9g}"
        )


def check_jacobians(
    factor: gtsam.NoiseModelFactor,
    values: gtsam.Values,
    *,
    step: float = 1e-5,
    tolerance: float = 1e-5,
) -> None:
    """Compare the Jacobians of a factor with central differences of its error, by `check_derivative`.

    With ``x (+) d`` the retraction of GTSAM and ``u_k`` the unit vector of tangent direction k, column k of a Jacobian
    must be ``(e(x (+) step u_k) - e(x (+) -step u_k)) / (2 step)``.

    Parameters
    ----------
    factor
        Any factor with a Gaussian noise model, native or `gtsam.CustomFactor`; wrapped in no robust kernel.
    values
        Point of linearisation; has all variables of the factor. Check random and near-identity states, and states
        near a wrap-around of the error, farther from its jump than ``step``.
    step
        Length of the differences, in the tangent space (rad, m).
    tolerance
        Largest difference allowed in a row, relative to the largest entry of the row; absolute below 1.

    Raises
    ------
    ValueError
        When the factor names a variable twice.
    TypeError
        When the noise model is missing, robust (a kernel weights Jacobian and error) or constrained.
    AssertionError
        Naming the variable, row and column of the largest difference, with both numbers.

    Examples
    --------
    >>> import gtsam, numpy as np
    >>> from sonar_graph.testing import check_jacobians
    >>> measured = gtsam.Pose3(gtsam.Rot3.Yaw(0.3), np.array([1.0, 0.0, 0.0]))
    >>> factor = gtsam.BetweenFactorPose3(0, 1, measured, gtsam.noiseModel.Isotropic.Sigma(6, 0.1))
    >>> values = gtsam.Values()
    >>> values.insert(0, gtsam.Pose3())
    >>> values.insert(1, gtsam.Pose3(gtsam.Rot3.RzRyRx(0.1, -0.2, 0.4), np.array([1.1, 0.1, -0.1])))
    >>> check_jacobians(factor, values)
    """
    noise = factor.noiseModel()
    models = gtsam.noiseModel
    is_constrained = isinstance(noise, models.Constrained)
    if is_constrained or not isinstance(noise, models.Gaussian):
        advice = "; leave out its kernel" if isinstance(noise, models.Robust) else ""
        raise TypeError(
            f"expected a factor with a Gaussian noise model, not {type(noise).__name__}{advice}"
        )
    if len(set(factor.keys())) < len(factor.keys()):
        raise ValueError("expected a factor of different variables; one is named twice")
    whitened = np.asarray(factor.linearize(values).jacobian()[0])
    # linearize gives R J, R^T R the information
    jacobians = np.linalg.solve(np.asarray(noise.R()), whitened)
    zeros = values.zeroVectors()
    column = 0
    for key in factor.keys():  # noqa: SIM118  # no dictionary

        def error_after(change: Floats, key: int = key) -> Floats:
            step_of_one = gtsam.VectorValues()
            step_of_one.insert(key, change)
            return np.asarray(factor.unwhitenedError(values.retract(step_of_one)))

        zero = zeros.at(key)
        try:
            stated = jacobians[:, column : column + len(zero)]
            check_derivative(error_after, stated, zero, step=step, tolerance=tolerance)
        except AssertionError as error:
            raise AssertionError(
                f"variable {gtsam.DefaultKeyFormatter(key)}: {error}"
            ) from None
        column += len(zero)


def check_consistent(nees: ArrayLike, dof: int, *, confidence: float = 0.99) -> None:
    """Check that squared normalised errors fit their covariances: neither too large nor too small in the mean.

    The sum of n independent NEES of ``dof`` degrees of freedom each is chi-squared with ``n dof`` degrees of freedom;
    it must lie inside the two-sided interval of this probability (Bar-Shalom et al., *Estimation with Applications to
    Tracking and Navigation*, 2001, section 5.4.2).

    Parameters
    ----------
    nees
        ``e^T P^-1 e`` of independent errors, shape (n,): of runs with different seeds, not of instants of one run.
    dof
        Length of each error.
    confidence
        Probability with which a consistent estimator passes.

    Raises
    ------
    AssertionError
        With the mean per degree of freedom and the interval; also where there is no NEES, or one is not finite or
        negative, as of an indefinite covariance.
    ValueError
        When ``nees`` has another shape, or ``dof`` is below 1.

    Examples
    --------
    >>> import numpy as np
    >>> from sonar_graph.testing import check_consistent
    >>> errors = np.random.default_rng(1).standard_normal((200, 3))
    >>> check_consistent((errors**2).sum(axis=1), dof=3)
    >>> check_consistent((0.5 * errors**2).sum(axis=1), dof=3)
    Traceback (most recent call last):
        ...
    AssertionError: NEES per degree of freedom is 0.451, below 0.858 to 1.155 (99%): covariances are too large
    """
    squares: Floats = np.asarray(nees, np.float64)
    if squares.ndim != 1 or dof < 1:
        raise ValueError(
            f"expected NEES of shape (n,) and dof >= 1, not {squares.shape} and {dof}"
        )
    impossible = squares[~(np.isfinite(squares) & (squares >= 0))]
    if not len(squares) or len(impossible):
        raise AssertionError(
            f"expected finite NEES of at least 0, not {impossible.tolist() or 'none'}"
        )
    total_dof = len(squares) * dof
    lowest, highest = np.divide(chi2.interval(confidence, total_dof), total_dof)
    mean = float(squares.mean() / dof)
    if not lowest <= mean <= highest:
        side, sizes = ("below", "large") if mean < lowest else ("above", "small")
        raise AssertionError(
            f"NEES per degree of freedom is {mean:.3f}, {side} {lowest:.3f} to {highest:.3f} ({100 * confidence:g}%):"
            f" covariances are too {sizes}"
        )
