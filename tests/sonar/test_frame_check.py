from __future__ import annotations

import numpy as np
import pytest

from sonar_graph.measurements import SonarFrames
from sonar_graph.sonar.frame_check import FrameCheck


def _frame(stamp_ns: int = 1, image: np.ndarray | None = None, beams: int = 4) -> SonarFrames:
    image = np.random.default_rng(0).integers(1, 200, (beams, 6)).astype(np.uint8) if image is None else image
    return SonarFrames(
        np.array([stamp_ns]), image[None], np.linspace(1, 2, image.shape[1]), np.linspace(0, 1, len(image))
    )


def test_good_frames_have_no_fault():
    check = FrameCheck()
    assert [check.fault(_frame(stamp)) for stamp in (1, 2, 3)] == [None, None, None]


@pytest.mark.parametrize(
    ("frame", "word"),
    [
        (_frame(1), "duplicated"),
        (_frame(0), "out of order"),
        (_frame(2, beams=5), "wrong size: 5 x 6"),
        (_frame(2, np.zeros((4, 6), np.uint8)), "zero"),
        (_frame(2, np.full((4, 6), 255, np.uint8)), "saturated"),
        (_frame(2, np.full((4, 6), np.nan)), "not finite"),
    ],
)
def test_a_bad_frame_is_named_and_does_not_become_the_measure_of_the_next(frame, word):
    check = FrameCheck()
    assert check.fault(_frame(1)) is None
    assert word in (check.fault(frame) or "")
    assert check.fault(_frame(2)) is None


def test_some_saturated_samples_are_no_fault():
    image = np.full((4, 6), 100, np.uint8)
    image[0] = 255
    assert FrameCheck().fault(_frame(1, image)) is None
