"""What leaves the window is given up, and nothing but that."""

from functools import cache

import numpy as np
import pytest

from sonar_graph.sequence import Sequence
from sonar_graph.simulation import (
    BasinOptions,
    MissionOptions,
    simulate_basin,
    simulate_mission,
)
from sonar_graph.slam import Isam2
from sonar_graph.states import Estimate, Outcome

from .late_identities import SURE, on_the_rail
from .made import ran
from .rail import STEP_S, rail

LAG_S = 5.0
LINEAR = {"kernel__shape": "none", "smoother__waiting_gain": 0.0}
EXACT = LINEAR | {"keyframes__motion_noise_share": 0.0}


@cache
def mission(duration_s: float = 120.0) -> Sequence:
    return simulate_mission(MissionOptions(duration_s=duration_s))


def run(
    sequence: Sequence, history: str, rate_hz: float = 2.0, **params
) -> tuple[Isam2, list[Estimate]]:
    return ran(
        sequence,
        rate_hz,
        history__policy=history,
        **{"smoother__lag_s": LAG_S, **params},
    )


def test_causal_estimates_are_near_those_of_the_whole_history():
    """They differ by what is re-linearised of a whole history alone."""
    (_, whole), (_, bounded) = (run(mission(), of) for of in ("whole", "bounded"))
    assert len(whole) == len(bounded) > 200
    for one, other in zip(whole, bounded, strict=True):
        sigmas = np.sqrt(np.diag(one.covariance))
        assert (
            np.abs(one.world_T_body.localCoordinates(other.world_T_body)) < 0.2 * sigmas
        ).all()
        assert np.diag(other.covariance) == pytest.approx(
            np.diag(one.covariance), rel=0.1
        )


def test_poses_that_left_are_least_squares_as_far_as_the_lag_reached():
    """On the rail, with a keyframe a node: each pose is that of all that was measured until it left."""
    nodes = 31
    sequence, numbers = rail(31)
    settings = EXACT | {
        "smoother__lag_s": 3.25 * STEP_S,
        "keyframes__max_interval_s": STEP_S,
    }
    estimator, _ = run(sequence, "bounded", 1 / STEP_S, **settings)
    found = estimator.trajectory()
    assert len(found) == nodes - 1
    for k, (position, cov) in enumerate(
        zip(found.positions, found.covariances, strict=True), start=1
    ):
        mean, variance = numbers.solution(min(k + 4, nodes))
        assert position[0] == pytest.approx(mean[f"x{k}"], abs=1e-7)
        assert cov[3, 3] == pytest.approx(variance[f"x{k}"], rel=1e-5)
    all_mean, _ = numbers.solution(nodes)
    assert abs(found.positions[5, 0] - all_mean["x6"]) > 1e-4
    assert estimator.landmarks().positions[:, 0] == pytest.approx(
        [all_mean["l4"], all_mean["l7"]], abs=1e-7
    )


def seven_after(belief: list[float], frames: int) -> Sequence:
    """Landmark 7 is known after some frames in which something else is believed of it; 4 from the start."""
    return on_the_rail([belief] * frames + [SURE[7]], SURE[4])


@pytest.mark.parametrize(("frames", "is_corrected"), [(3, True), (12, False)])
def test_a_wrong_identity_is_taken_back_as_far_as_the_window_reaches(
    frames, is_corrected
):
    """Landmark 7 is taken for 6 at first. Corrected within the lag the run is the right one; else 6 stays."""
    late, right = (
        run(
            seven_after([0.0, 0.0, 1.0, 0.0], n), "bounded", **EXACT, smoother__lag_s=4
        )[0]
        for n in (frames, 0)
    )
    found = late.landmarks()
    known = right.landmarks()
    assert known.ids.tolist() == [4, 7]
    assert found.ids.tolist() == ([4, 7] if is_corrected else [4, 6, 7])
    moved = late.detections().outcomes.count(Outcome.MOVED)
    assert moved == frames if is_corrected else moved <= frames
    if is_corrected:
        assert found.positions[:, 0] == pytest.approx(known.positions[:, 0], abs=1e-6)
        assert late.trajectory().positions == pytest.approx(
            right.trajectory().positions, abs=1e-6
        )
    assert np.isfinite(late.trajectory().covariances).all()


def test_what_need_not_be_remembered_is_forgotten_and_nothing_else_changes():
    """Poses and outcomes of the last half minute, and up to a quarter more, are left."""
    (everything, causal), (recent, same) = (
        run(mission(), "bounded", history__remembered_s=s) for s in (None, 30.0)
    )
    assert all(
        np.array_equal(a.covariance, b.covariance)
        for a, b in zip(causal, same, strict=True)
    )
    whole = everything.trajectory()
    part = recent.trajectory()
    assert 30 <= (part.stamps_ns[-1] - part.stamps_ns[0]) * 1e-9 < 30 * 1.25 + LAG_S + 2
    assert np.array_equal(part.positions, whole.positions[-len(part) :])
    assert np.array_equal(part.covariances, whole.covariances[-len(part) :])
    log = everything.detections()
    rest = recent.detections()
    assert 0 < len(rest) < 0.5 * len(log)
    assert np.array_equal(
        rest.innovations, log.innovations[-len(rest) :], equal_nan=True
    )
    assert rest.outcomes == log.outcomes[-len(rest) :]
    assert np.array_equal(
        recent.landmarks().positions, everything.landmarks().positions
    )


def test_what_waits_keeps_its_keyframe_when_the_window_begins_again():
    """A window that began again in an exchange let go of keyframes older than the lag, and the run stopped."""
    options = BasinOptions(
        duration_s=150.0,
        laps=1,
        seed=3,
        tracks=True,
        id_delay_s=2.0,
        wrong_id_rate=1.0,
        wrong_id_share=0.6,
        anonymous_share=0.3,
        false_detections_per_frame=0.1,
    )
    _, estimates = run(simulate_basin(options), "bounded", smoother__lag_s=4.0)
    assert len(estimates) > 200
