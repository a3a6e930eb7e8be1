"""Check of sonar frames before they are used; a refused frame has a reason.

The window of a sonar (number and place of beams and bins) may change while it works: an operator sets another range, or
the sonar alternates between two modes. A damaged header looks the same, once. So the first frame of a new window is not
used, and every later one is.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sonar_graph.calibration import SonarImage
from sonar_graph.errors import MeasurementError
from sonar_graph.images import SonarFrames
from sonar_graph.measurements import Floats

SATURATED_SHARE = 0.5
"""Share of samples at the largest value from which on a frame is saturated."""
SAME_PLACE = 0.5
"""Largest offset of bins and beams of one window, as a share of the distance between two."""
LEAST_BEAMS = 8
LEAST_BINS = 32
"""Smaller images show no landmark."""
MOST_WINDOWS = 64
"""Windows remembered."""


class RangeWindow(NamedTuple):
    """Ranges and azimuths of the samples of a frame."""

    ranges_m: Floats
    azimuths_rad: Floats

    def shares_arrays(self, other: RangeWindow | None) -> bool:
        """True for windows of one block of frames."""
        return other is not None and all(
            own is others for own, others in zip(self, other, strict=True)
        )

    def is_like(self, other: RangeWindow) -> bool:
        """True for the same bins and beams, up to rounding in a driver that computes them for every ping."""
        return self.shares_arrays(other) or all(
            len(own) == len(others)
            and bool(
                np.abs(own - others).max()
                <= SAME_PLACE * (abs(float(own[-1] - own[0])) / (len(own) - 1))
            )
            for own, others in zip(self, other, strict=True)
        )

    def fault(self) -> str | None:
        """Reason not to use frames with these ranges and azimuths."""
        ranges_m, azimuths_rad = self
        if len(azimuths_rad) < LEAST_BEAMS or len(ranges_m) < LEAST_BINS:
            size = f"{len(azimuths_rad)} x {len(ranges_m)}"
            return f"wrong size: {size}, expected at least {LEAST_BEAMS} beams and {LEAST_BINS} bins"
        if not (np.isfinite(ranges_m).all() and np.isfinite(azimuths_rad).all()):
            return "ranges or azimuths that are not finite"
        steps_m = np.diff(ranges_m)
        steps_rad = np.diff(azimuths_rad)
        # a damaged header has steps of several sizes
        is_even = np.abs(steps_m - steps_m.mean()).max() <= SAME_PLACE * abs(
            steps_m.mean()
        )
        if ranges_m[0] < 0 or not steps_m.mean() > 0 or not is_even:
            return "ranges that do not increase evenly from the sonar on"
        return (
            None
            if (steps_rad > 0).all() or (steps_rad < 0).all()
            else "azimuths that do not go one way"
        )

    def __str__(self) -> str:
        size = f"{len(self.azimuths_rad)} x {len(self.ranges_m)}"
        left, right = np.degrees([self.azimuths_rad.max(), self.azimuths_rad.min()])
        return f"{size}, {self.ranges_m[0]:.2f} m to {self.ranges_m[-1]:.2f} m, {right:.1f}° to {left:.1f}°"


def check_block(frame: SonarFrames) -> None:
    """Refuse a block that is not one frame.

    Raises `MeasurementError` when it has more frames, or none.
    """
    if len(frame) != 1:
        raise MeasurementError(
            f"a recogniser was given a block of {len(frame)} frames; give blocks of one, in order"
        )


class FrameVerdict(NamedTuple):
    """Verdict on a frame."""

    fault: str | None = None
    """Reason not to use it."""
    change: str | None = None
    """Change of window since the good frame before it."""


class FrameCheck:
    """Comparison of each frame with the good one before it; the scale of samples is decibels in bytes by default."""

    def __init__(self, image: SonarImage | None = None) -> None:
        self._scale = image or SonarImage()
        self._stamp_ns: int | None = None
        self._image: NDArray[np.generic] | None = None
        self._window: RangeWindow | None = None
        self._seen: list[RangeWindow] = []

    def judge(self, frame: SonarFrames) -> FrameVerdict:
        """Judge a frame (a block of one); later ones are compared with it if it is good."""
        stamp_ns = int(frame.stamps_ns[0])
        image = frame.intensity[0]
        window = RangeWindow(frame.ranges_m, frame.azimuths_rad)
        if self._stamp_ns == stamp_ns:
            return FrameVerdict("duplicated: same stamp as the frame before")
        if self._stamp_ns is not None and stamp_ns < self._stamp_ns:
            return FrameVerdict("out of order")
        # of one block of frames the window was judged with the first
        is_judged = window.shares_arrays(self._window)
        fault = (None if is_judged else window.fault()) or self._fault_of_samples(image)
        if fault is not None:
            return FrameVerdict(fault)
        is_change = self._window is not None and not window.is_like(self._window)
        if (self._window is None or is_change) and not any(
            window.is_like(seen) for seen in self._seen
        ):
            self._seen = [*self._seen[-MOST_WINDOWS + 1 :], window]
            # a damaged header looks like a new window, once: a window counts from its second frame on
            if len(self._seen) > 1:
                return FrameVerdict(
                    f"wrong size or window: {window}; used if it comes again"
                )
        self._stamp_ns = stamp_ns
        self._image = image
        self._window = window
        if is_change:
            return FrameVerdict(
                change=f"window changed: {window}; tracks that lie in it go on"
            )
        return FrameVerdict()

    def _fault_of_samples(self, image: NDArray[np.generic]) -> str | None:
        """Reason not to use these samples."""
        low = image.min()
        high = image.max()
        if (
            np.issubdtype(image.dtype, np.floating)
            and not max(abs(low), abs(high)) < np.finfo(np.float32).max
        ):
            return "samples that are not finite"
        if low == high < self._scale.full_scale:
            return "all samples are zero" if high == 0 else "all samples are the same"
        if self._scale.scale == "decibel" and high > self._scale.full_scale:
            return (
                f"samples over {self._scale.full_scale:g}, the full scale that the calibration states; "
                "correct sonar.image.full_scale or sonar.image.scale with --calibration"
            )
        # of a bright scene a few samples saturate; half of them is a wrong gain
        if np.count_nonzero(image == high) > SATURATED_SHARE * image.size:
            return "saturated"
        if self._image is not None and np.array_equal(image, self._image):
            return "duplicated: same samples as the frame before"
        return None
