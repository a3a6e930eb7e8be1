"""Frames that are tied to a keyframe over a gap of the Doppler log."""

from __future__ import annotations

import numpy as np
import pytest

from sonar_graph.calibration import Calibration, DvlCalibration, ImuCalibration
from sonar_graph.measurements import Dvl, Imu
from sonar_graph.navigation.preintegration.motion import PreintegratedMotion
from sonar_graph.slam.keyframes import KeyframeParams, Keyframes

from .made import smoother_with

NS = 1_000_000_000
G = 9.80665
GAPS_S = ((2.0, 6.0), (7.0, 10.0))


def stamps(seconds: np.ndarray) -> np.ndarray:
    return np.round(seconds * NS).astype(np.int64)


def keyframes_over_gaps() -> Keyframes:
    """Straight on at 0.5 m/s for twelve seconds, without bottom lock twice; no keyframe but the first is due."""
    calibration = Calibration(
        imu=ImuCalibration(gyro_bias_sigma=0.0), dvl=DvlCalibration(velocity_sigma_m_s=(0.01, 0.01, 0.01), gap_s=0.3)
    )
    t, s = np.arange(241) / 20, np.arange(61) / 5
    for lost_s, found_s in GAPS_S:
        s = s[(s <= lost_s) | (s >= found_s)]
    keyframes = Keyframes(
        calibration,
        KeyframeParams(max_interval_s=1e3, motion_noise_share=1e9, bias_interval_s=10.0),
        smoother_with(1e9, 0.01, 1e9),
    )
    keyframes.add(
        Imu(stamps(t), np.zeros((len(t), 3)), np.tile([0.0, 0.0, G], (len(t), 1))),
        Dvl(stamps(s), np.tile([0.5, 0.0, 0.0], (len(s), 1)), np.full((len(s), 3, 3), np.nan)),
        None,
    )
    return keyframes


def seen(keyframes: Keyframes, at_s: float) -> tuple[PreintegratedMotion, PreintegratedMotion]:
    """A frame comes: the motion as it is, and as it is told."""
    stamp_ns = round(at_s * NS)
    keyframes.advance(stamp_ns)
    motion = keyframes.motion_since_newest(stamp_ns)
    return motion, keyframes.set_for_frame(stamp_ns, motion)


def shares(keyframes: Keyframes, at_s: list[float]) -> list[float]:
    """Of the information of each motion, how much is told."""
    found = []
    for motion, told in (seen(keyframes, t) for t in at_s):
        ratio = np.diag(told.covariance) / np.diag(motion.covariance)
        assert ratio == pytest.approx(ratio[0])
        assert told.i_T_j.equals(motion.i_T_j, 0.0)
        found.append(1.0 / ratio[0])
    return found


def test_frames_over_one_gap_together_tell_ever_nearer_what_one_exact_frame_would_and_never_more():
    """A telescoping sum by hand: ``1 / (k (k + 1)) = 1 / k - 1 / (k + 1)``, so that n of them tell ``n / (n + 1)``."""
    told = np.cumsum(shares(keyframes_over_gaps(), (2.5 + 0.1 * np.arange(30)).tolist()))
    n = np.arange(1, 31)
    assert told == pytest.approx(n / (n + 1))


def test_each_gap_counts_anew_and_frames_between_gaps_tell_all():
    """With bottom lock, or only so long after it that velocity still counts as linear, frames share no such error."""
    keyframes = keyframes_over_gaps()
    told = shares(keyframes, [1.0, 2.2, 3.0, 4.0, 6.3, 6.7, 8.0, 9.0, 9.5, 11.0])
    assert told == pytest.approx([1, 1, 1 / 2, 1 / 6, 1, 1, 1 / 2, 1 / 6, 1 / 12, 1])


def test_a_gap_that_has_ended_before_a_frame_is_not_shared_with_it():
    """Its end is a node, even where that is no keyframe."""
    keyframes = keyframes_over_gaps()
    assert shares(keyframes, [4.0, 6.4]) == pytest.approx([1 / 2, 1])
    assert len(keyframes.stamps_ns) == 1
