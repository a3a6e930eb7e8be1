"""Images of an imaging sonar, as recorded: what the recogniser sees and no estimator does."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sonar_graph.calibration import SonarImage
from sonar_graph.errors import MeasurementError
from sonar_graph.measurements import Floats, Ints

IN_PLANE = "landmarks are compared in the plane of the image, where they look less like their designs"
NO_HEIGHT = f"the height of the floor is not known: {IN_PLANE}; state [floor] z_m and sigma_m in a --calibration file"
NO_DEPTH = f"no depth comes: the height over the floor is not known, and {IN_PLANE}"
NO_TILT = (
    f"height and tilt are not known: {IN_PLANE}; state [floor] z_m, sigma_m and [start] position_m, rpy_rad in a "
    "--calibration file"
)
"""What is lacking where a sonar is not known to look at a floor."""


@dataclass(frozen=True, eq=False)
class SonarFrames:
    """Polar images of an imaging sonar, as recorded; frames of one block share their beams and range bins.

    ``intensity[i, b, r]`` is the sample of frame i in the beam at ``azimuths_rad[b]`` and the bin at ``ranges_m[r]``.
    ``calibration.sonar.image`` states whether samples are decibels or amplitudes, and their full scale. A single frame
    is a block with n = 1: ``image[None]``.

    Raises
    ------
    MeasurementError
        When there is no frame, or the shapes do not belong together.

    Examples
    --------
    >>> import numpy as np
    >>> frames = SonarFrames(
    ...     stamps_ns=np.array([0]),
    ...     intensity=np.zeros((1, 96, 512), np.uint8),
    ...     ranges_m=np.linspace(1.26, 2.51, 512),
    ...     azimuths_rad=np.linspace(0.25, -0.25, 96),
    ... )
    >>> len(frames)
    1
    """

    stamps_ns: Ints
    """Time at which each ping was sent, shape (n,), integer nanoseconds, not decreasing."""
    intensity: NDArray[Any]
    """Shape (n, beams, bins), in the sonar's own type and scale."""
    ranges_m: Floats
    """Middle of each range bin, shape (bins,)."""
    azimuths_rad: Floats
    """Azimuth of each beam, ``atan2(y, x)`` in the sonar frame, positive to the left, shape (beams,)."""

    def __post_init__(self) -> None:
        expected = (len(self.stamps_ns), len(self.azimuths_rad), len(self.ranges_m))
        if self.intensity.shape != expected or 0 in expected:
            raise MeasurementError(
                f"SonarFrames.intensity: shape {self.intensity.shape}; stamps, beams and bins are {expected}"
            )
        if np.any(self.stamps_ns[1:] < self.stamps_ns[:-1]):
            raise MeasurementError(
                "SonarFrames: stamps run backwards; sort the frames by stamp"
            )

    def __len__(self) -> int:
        return len(self.stamps_ns)


def decibels(samples: NDArray[Any], image: SonarImage) -> NDArray[np.float32]:
    """Levels of samples in dB over the smallest one; only differences have a meaning.

    ``samples * decibel_span / full_scale``, or ``20 / gamma log10(samples)`` of linear ones; linear samples of 0
    count as one count, real ones below 1/100000 of the full scale as that.
    """
    if image.scale == "decibel":
        return np.multiply(
            samples, np.float32(image.decibel_span / image.full_scale), dtype=np.float32
        )
    # the logarithm of zero: one count, or the smallest amplitude worth drawing
    least = 1.0 if np.issubdtype(samples.dtype, np.integer) else 1e-5 * image.full_scale
    ratio = np.maximum(samples, np.float32(least)) / np.float32(least)
    return np.float32(20.0 / image.gamma) * np.log10(ratio, dtype=np.float32)
