"""Velocities from one or two Doppler beams, completed by the velocity just before.

A row that leaves a direction unmeasured (`sonar_graph.doppler_beams`) is joined with what the row before lets expect.
The velocity in the body's axes is taken for a random walk of spectral density q, ``velocity_walk_density``²::

    P- = P_k + q T I,    P = (P-^-1 + R^-1)^-1,    A = P P-^-1,    v = A v_k + P R^-1 z               (1)

z, R the row. Where the beams measure this is the row itself, elsewhere it is the velocity before, the less certain the
longer ago.

Errors of successive completed rows are no longer independent, ``e_k+1 = A e_k + ...``, whereas odometry takes each
row's noise as white. A displacement sums them with weights w (half the intervals either side), so that each completed
row is given, beside its own covariance, what it shares with all before it::

    X_k+1 = A (X_k + w_k P_k),    cov_k+1 = P + (X_k+1 + X_k+1^T) / w_k+1                            (2)

Then ``sum w² cov`` is the variance of the summed displacement, at every row and without looking ahead. X is 0 at a row
with three beams or more, which stays as it is to the bit.

A partial row that comes longer after the last one than velocities are linear over, before the first whole one, or late,
is passed over: there the IMU knows more.
"""

from __future__ import annotations

import numpy as np

from sonar_graph.doppler_beams import is_partial
from sonar_graph.measurements import Floats, Ints


class PartialVelocities:
    """Completes rows in their order, one block after the other.

    Parameters
    ----------
    walk_density
        Of the vehicle's velocity, m/s/√s.
    longest_ns
        Longest time since the row before.
    """

    def __init__(self, walk_density: float, longest_ns: int) -> None:
        self._q = walk_density**2
        self._longest_ns = longest_ns
        self._stamp_ns: int | None = None
        self._before_s = 0.0
        self._velocity: Floats = np.zeros(3)
        self._P: Floats = np.zeros((3, 3))
        self._shared: Floats = np.zeros((3, 3))

    def completed(self, stamps_ns: Ints, velocity: Floats, covs: Floats) -> tuple[Ints, Floats, Floats]:
        """The rows that can be used, all with a whole velocity.

        Parameters
        ----------
        stamps_ns, velocity, covs
            Shapes (n,), (n, 3), (n, 3, 3), m/s; no NaN.
        """
        partial = is_partial(covs)
        if not partial.any():
            self._remember_last(stamps_ns, velocity, covs)
            return stamps_ns, velocity, covs
        velocity, covs = velocity.copy(), covs.copy()
        used = np.ones(len(stamps_ns), dtype=bool)
        for k, stamp_ns in enumerate(stamps_ns.tolist()):
            if partial[k]:
                used[k] = self._stamp_ns is not None and 0 < stamp_ns - self._stamp_ns <= self._longest_ns
                if used[k]:
                    velocity[k], covs[k] = self._complete(stamp_ns, velocity[k], covs[k])
            else:
                self._remember(stamp_ns, velocity[k], covs[k])
        return stamps_ns[used], velocity[used], covs[used]

    def _remember_last(self, stamps_ns: Ints, velocity: Floats, covs: Floats) -> None:
        for k in range(max(len(stamps_ns) - 2, 0), len(stamps_ns)):
            self._remember(int(stamps_ns[k]), velocity[k], covs[k])

    def _remember(self, stamp_ns: int, velocity: Floats, P: Floats) -> None:
        """A whole row shares nothing with those before; one that comes late is not the newest."""
        if self._stamp_ns is not None and stamp_ns <= self._stamp_ns:
            return
        self._advance(stamp_ns)
        self._velocity, self._P, self._shared = velocity, P, np.zeros((3, 3))

    def _advance(self, stamp_ns: int) -> float:
        """The time since the row before."""
        interval_ns = 0 if self._stamp_ns is None else min(stamp_ns - self._stamp_ns, self._longest_ns)
        self._stamp_ns, self._before_s = stamp_ns, interval_ns * 1e-9
        return self._before_s

    def _complete(self, stamp_ns: int, z: Floats, R: Floats) -> tuple[Floats, Floats]:
        """Equations (1) and (2)."""
        half_before_s = 0.5 * self._before_s
        interval_s = self._advance(stamp_ns)
        weight_s = half_before_s + 0.5 * interval_s
        expected = np.linalg.inv(self._P + self._q * interval_s * np.eye(3))
        measured = np.linalg.inv(R)
        P = np.linalg.inv(expected + measured)
        A = P @ expected
        self._shared = A @ (self._shared + weight_s * self._P)
        self._velocity = A @ self._velocity + P @ measured @ z
        self._P = 0.5 * (P + P.T)
        return self._velocity, _positive(self._P + (self._shared + self._shared.T) / interval_s)


def _positive(cov: Floats) -> Floats:
    """The nearest covariance: turned noise may leave a direction below zero, and none is better than its smallest."""
    variances, axes = np.linalg.eigh(cov)
    return np.asarray((axes * np.maximum(variances, 1e-12)) @ axes.T)
