"""Frames that must not be used: found before anything is made of them, each with its reason."""

from __future__ import annotations

import numpy as np

from sonar_graph.measurements import SonarFrames

SATURATED_SHARE = 0.5
"""Of the samples at the top of their type's scale, from which on a frame shows nothing."""


class FrameCheck:
    """Compares each frame with the newest one before it."""

    def __init__(self) -> None:
        self._stamp_ns: int | None = None
        self._shape: tuple[int, ...] | None = None

    def fault(self, frame: SonarFrames) -> str | None:
        """Why a frame (a block of one) must not be used; None for a good one, with which later ones are compared."""
        stamp_ns, image = int(frame.stamps_ns[0]), frame.intensity[0]
        reason = self._fault_of_stamp(stamp_ns) or self._fault_of_size(image.shape) or _fault_of_samples(image)
        if reason is None:
            self._stamp_ns, self._shape = stamp_ns, image.shape
        return reason

    def _fault_of_stamp(self, stamp_ns: int) -> str | None:
        if self._stamp_ns is None or stamp_ns > self._stamp_ns:
            return None
        return "duplicated: same stamp as the frame before" if stamp_ns == self._stamp_ns else "out of order"

    def _fault_of_size(self, shape: tuple[int, ...]) -> str | None:
        if self._shape is None or shape == self._shape:
            return None
        return f"wrong size: {shape[0]} x {shape[1]}, frames before had {self._shape[0]} x {self._shape[1]}"


def _fault_of_samples(image: np.ndarray) -> str | None:
    is_real = np.issubdtype(image.dtype, np.floating)
    if is_real and not np.isfinite(image).all():
        return "samples that are not finite"
    if not image.any():
        return "all samples are zero"
    top = image.max() if is_real else np.iinfo(image.dtype).max
    return "saturated" if np.count_nonzero(image == top) > SATURATED_SHARE * image.size else None
