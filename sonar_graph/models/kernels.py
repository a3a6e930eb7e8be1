"""Robust kernels: losses of an outlying range or azimuth, in smoother and filters (docs/theory/isam2.md)."""

import math
from collections.abc import Callable
from functools import partial
from typing import Annotated, Literal

import gtsam
import numpy as np
from pydantic import Field

from sonar_graph.calibration import Section, tagged
from sonar_graph.measurements import Floats

Robust = Callable[[gtsam.noiseModel.Base], gtsam.noiseModel.Base]
"""Wraps a noise model in a robust kernel, or returns it as it is."""


class Kernel(Section):
    """Loss ``rho(e)`` of a whitened range or azimuth error e."""

    def loss(self, e: Floats) -> Floats:
        """The loss of errors in standard deviations."""
        return 0.5 * np.abs(e) ** 2

    def estimator(self) -> gtsam.noiseModel.mEstimator.Base | None:
        """The loss as GTSAM has it; None for Gaussian noise."""
        return None

    def robust(self) -> Robust:
        """Function that gives a noise model this loss."""
        estimator = self.estimator()
        return (
            (lambda noise: noise)
            if estimator is None
            else partial(gtsam.noiseModel.Robust.Create, estimator)
        )

    @property
    def log_normaliser(self) -> float:
        """Logarithm of n, of a density ``n / sigma exp(-rho(e / sigma))``. A Cauchy kernel needs a width above 1."""
        from scipy.integrate import quad  # takes most of a second to load

        # a numeric integral serves kernels of any shape
        area, _ = quad(
            lambda e: math.exp(-float(self.loss(np.array(e)))), -math.inf, math.inf
        )
        return -math.log(area)


class GaussianKernel(Kernel):
    """No robust kernel: Gaussian noise.

    Examples
    --------
    >>> from sonar_graph.slam import GaussianKernel, Isam2Params
    >>> Isam2Params(kernel=GaussianKernel()).kernel.shape
    'none'
    """

    shape: Literal["none"] = "none"


class RobustKernel(Kernel):
    """A loss that grows more slowly than the square, so that outliers pull less.

    It may let an outlier at a landmark's first sighting be outvoted later, which a gate cannot, unless it lies too far
    off; where noise is Gaussian it costs next to nothing (measured in docs/theory/isam2.md).

    Examples
    --------
    >>> from sonar_graph.slam import Isam2Params, RobustKernel
    >>> Isam2Params(kernel=RobustKernel(shape="huber", width=1.345)).kernel
    RobustKernel(shape='huber', width=1.345)
    >>> Isam2Params().kernel
    RobustKernel(shape='cauchy', width=1.5)
    """

    shape: Literal["huber", "cauchy"] = "cauchy"
    width: float = Field(1.5, gt=0)
    """Width of the kernel, in standard deviations: larger errors pull less than with Gaussian noise."""

    def loss(self, e: Floats) -> Floats:
        """The loss of errors in standard deviations."""
        k = self.width
        size = np.abs(e)
        if self.shape == "huber":
            return np.where(size <= k, 0.5 * size**2, k * (size - 0.5 * k))
        # log1p keeps the digits of small errors, where the loss is that of Gaussian noise
        return 0.5 * k**2 * np.log1p((size / k) ** 2)

    def estimator(self) -> gtsam.noiseModel.mEstimator.Base:
        """The loss as GTSAM has it."""
        estimators = gtsam.noiseModel.mEstimator
        return (
            estimators.Huber if self.shape == "huber" else estimators.Cauchy
        ).Create(self.width)


KernelParams = Annotated[GaussianKernel | RobustKernel, *tagged("shape", "cauchy")]
