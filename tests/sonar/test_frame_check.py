from typing import Any

import numpy as np
import pytest

from sonar_graph.calibration import SonarImage
from sonar_graph.images import SonarFrames
from sonar_graph.sonar import FrameCheck
from sonar_graph.sonar.frame_check import FrameVerdict

GOOD = FrameVerdict()

BEAMS = 10
BINS = 40


def _noise(seed: int, beams: int = BEAMS, bins: int = BINS) -> np.ndarray:
    return np.random.default_rng(seed).integers(1, 200, (beams, bins)).astype(np.uint8)


def _frame(
    stamp_ns: int = 1, image: np.ndarray | None = None, *, end_m: float = 2.0, **places
) -> SonarFrames:
    image = _noise(stamp_ns) if image is None else image
    ranges_m = places.get("ranges_m", np.linspace(1, end_m, image.shape[1]))
    azimuths_rad = places.get("azimuths_rad", np.linspace(-0.2, 0.2, len(image)))
    return SonarFrames(np.array([stamp_ns]), image[None], ranges_m, azimuths_rad)


def _changed(where: Any, value: float) -> np.ndarray:
    image = _noise(9).astype(float if np.isnan(value) else np.uint8)
    image[where] = value
    return image


# fmt: off
BAD = {
    "same stamp": (_frame(1), "duplicated: same stamp"),
    "same samples": (_frame(2, _noise(1)), "duplicated: same samples"),
    "earlier": (_frame(0), "out of order"),
    "more beams": (_frame(2, _noise(2, BEAMS + 1)), "wrong size or window: 11 x 40"),
    "half a bin longer": (_frame(2, end_m=2.0 + 0.6 / (BINS - 1)), "wrong size or window: 10 x 40"),
}
BAD_IN_ITSELF = {
    "one beam": (_frame(2, _noise(2, 1)), "wrong size: 1 x 40"),
    "few bins": (_frame(2, _noise(2, bins=5)), "wrong size: 10 x 5"),
    "zero": (_frame(2, 0 * _noise(2)), "all samples are zero"),
    "constant": (_frame(2, 0 * _noise(2) + 17), "all samples are the same"),
    "mostly white": (_frame(2, _changed(np.s_[:6], 255)), "saturated"),
    "nan": (_frame(2, _changed((3, 3), np.nan)), "not finite"),
    "huge": (_frame(2, _noise(2) * 1e300), "not finite"),
    "over the scale": (_frame(2, _noise(2) * np.uint16(100)), "samples over 255"),
    "nan ranges": (_frame(2, ranges_m=np.full(BINS, np.nan)), "ranges or azimuths that are not finite"),
    "uneven": (_frame(2, ranges_m=np.geomspace(0.01, 2, BINS)), "do not increase evenly"),
    "to and fro": (_frame(2, azimuths_rad=np.sin(np.arange(BEAMS))), "do not go one way"),
}
# fmt: on


@pytest.mark.parametrize("name", [*BAD, *BAD_IN_ITSELF])
def test_a_bad_frame_is_named_and_does_not_become_the_measure_of_the_next(name):
    frame, words = (BAD | BAD_IN_ITSELF)[name]
    check = FrameCheck()
    assert name in BAD or words in (FrameCheck().judge(frame).fault or "")
    assert check.judge(_frame(1)) == GOOD
    verdict = check.judge(frame)
    assert words in (verdict.fault or "")
    assert verdict.change is None
    assert check.judge(_frame(2)) == GOOD


def test_good_frames_have_no_fault_on_the_scale_of_the_calibration():
    wide = _noise(1) * np.uint16(100)
    some_saturated = _changed(np.s_[:4], 255)
    assert FrameCheck().judge(_frame(1, some_saturated)) == GOOD
    for scale in (SonarImage(scale="linear"), SonarImage(full_scale=65535)):
        assert FrameCheck(scale).judge(_frame(1, wide)) == GOOD
    assert "sonar.image.full_scale" in (
        FrameCheck(SonarImage(full_scale=4095)).judge(_frame(1, wide)).fault or ""
    )


def test_a_new_window_is_used_from_its_second_frame_on():
    check = FrameCheck()
    assert check.judge(_frame(1)) == GOOD
    first, second, third = (check.judge(_frame(n, end_m=3.0)) for n in (2, 3, 4))
    assert first.fault
    assert first.change is None
    assert second.fault is None
    assert "10 x 40, 1.00 m to 3.00 m" in second.change
    assert third == GOOD


@pytest.mark.parametrize(("wider_m", "lost"), [(1.0, [1]), (0.4 / (BINS - 1), [])])
def test_windows_that_alternate_lose_one_frame(wider_m, lost):
    """Less than half a bin is none."""
    check = FrameCheck()
    verdicts = [
        check.judge(_frame(n, end_m=2.0 + wider_m * (n % 2))) for n in range(1, 20)
    ]
    assert [k for k, one in enumerate(verdicts) if one.fault] == lost
    assert lost or set(verdicts) == {GOOD}
