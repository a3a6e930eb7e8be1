"""What leaves the window is given up, and nothing but that."""

import gc
from functools import cache

import numpy as np
import pytest
from gtsam.symbol_shorthand import L

from sonar_graph.navigation import Odometry
from sonar_graph.sequence import Sequence
from sonar_graph.simulation.mission import MissionOptions, simulate_mission
from sonar_graph.slam import Isam2
from sonar_graph.slam.smoother import Smoother
from sonar_graph.states import Estimate, Outcome

from .late_identities import SURE, on_the_rail
from .made import counted, isam2_params, ran
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


def test_causal_estimates_are_those_of_the_whole_history_to_a_fifth_of_their_sigmas():
    """They differ by what is linearised anew of a whole history alone."""
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


def test_poses_that_left_are_those_of_least_squares_as_far_as_the_lag_reached():
    """On the rail, with a keyframe a node: each pose is that of all that was measured until it left."""
    nodes, (sequence, numbers) = 31, rail(31)
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


def test_smoothed_poses_are_better_than_causal_ones_and_worse_than_those_of_the_whole():
    rms = {}
    for history in ("whole", "bounded"):
        estimator, causal = run(mission(), history)
        smoothed = estimator.trajectory()
        assert smoothed.stamps_ns.tolist() == [estimate.stamp_ns for estimate in causal]
        truth = mission().truth.at(smoothed.stamps_ns)
        rms[history] = np.sqrt(
            np.mean(np.sum((smoothed.positions - truth.positions) ** 2, axis=1))
        )
        assert np.linalg.eigvalsh(smoothed.covariances).min() > 0
        assert np.array_equal(
            smoothed.covariances, smoothed.covariances.transpose(0, 2, 1)
        )
        sigma = np.sqrt(np.trace(smoothed.covariances[:, 3:, 3:], axis1=1, axis2=2))
        before = np.sqrt([np.trace(estimate.covariance[3:, 3:]) for estimate in causal])
        assert np.all(sigma < 1.001 * before)
        assert np.median(sigma / before) < 0.999
    assert not np.isclose(rms["whole"], rms["bounded"], rtol=1e-6)


def held(estimator: Isam2) -> dict[str, int]:
    """Sizes of all that could grow with the run."""
    smoother, sightings = estimator._smoother, estimator._frontend
    window = smoother._window
    return {
        "values": smoother.values.size(),
        "factors": smoother.graph.size(),
        "slots": window.factors().size(),
        "groups": len(smoother._store.groups)
        + sum(map(len, smoother._store._leaving_with.values())),
        "expiring": len(smoother._times_s),
        "sightlines": sum(map(len, smoother._store.sightlines().values())),
        "sightings": sum(len(seen) for seen in sightings.landmarks._of.values()),
        "tracks": sum(
            len(t.waiting) + len(t.settled) for t in sightings.policy._tracks.values()
        ),
        "asked": len(estimator._poses._open),
    }


@pytest.mark.parametrize("tracks", [False, True])
def test_nothing_grows_with_the_run(tracks):
    """What is held after a minute and after four differs by less than a window; of a whole history it does not."""
    sequence = simulate_mission(
        MissionOptions(
            duration_s=240.0, tracks=tracks, id_delay_s=2.0 if tracks else 0.0
        )
    )
    sizes, counts = [], []
    params = isam2_params(history__policy="bounded", smoother__lag_s=LAG_S)
    estimator = Isam2(sequence.calibration, Odometry(sequence.calibration), params)
    for step in sequence.replay(sequence.instants(2.0)):
        estimator.process(step)
        if round((step.end_ns - sequence.start_ns) * 1e-9, 3) in (
            60.0,
            120.0,
            180.0,
            239.0,
        ):
            sizes.append(held(estimator))
            gc.collect()
            counts.append(len(gc.get_objects()))
    first, *later = sizes
    for name, size in first.items():
        assert max(each[name] for each in later) < 1.6 * size + 15, name
    assert later[-1]["expiring"] < 12
    assert counts[-1] - counts[1] < 1000
    whole, _ = run(sequence, "whole")
    assert whole.graph.size() > 5 * later[-1]["factors"]
    assert whole.values.size() > 3 * later[-1]["values"]


def seven_after(belief: list[float], frames: int) -> Sequence:
    """Landmark 7 is known after some frames in which something else is believed of it; 4 from the start."""
    return on_the_rail([belief] * frames + [SURE[7]], SURE[4])


@pytest.mark.parametrize(("frames", "is_corrected"), [(3, True), (12, False)])
def test_a_wrong_identity_is_taken_back_as_far_as_the_window_reaches(
    frames, is_corrected
):
    """Landmark 7 is taken for 6 at first. Corrected within the lag the run is the right one; else 6 stays."""
    late, _ = run(
        seven_after([0.0, 0.0, 1.0, 0.0], frames),
        "bounded",
        **EXACT,
        smoother__lag_s=4.0,
    )
    right, _ = run(seven_after([], 0), "bounded", **EXACT, smoother__lag_s=4.0)
    maps = [
        dict(
            zip(e.landmarks().ids.tolist(), e.landmarks().positions[:, 0], strict=True)
        )
        for e in (late, right)
    ]
    assert (maps[0].keys() == maps[1].keys()) == is_corrected
    assert set(maps[0]) - set(maps[1]) == (set() if is_corrected else {6})
    assert late.values.exists(L(6)) is not is_corrected
    if is_corrected:
        assert maps[0] == pytest.approx(maps[1], abs=1e-6)
        assert late.trajectory().positions == pytest.approx(
            right.trajectory().positions, abs=1e-6
        )
    outcomes = late.detections().outcomes
    assert outcomes.count(Outcome.MOVED) == (
        frames if is_corrected else outcomes.count(Outcome.MOVED)
    )
    assert outcomes.count(Outcome.MOVED) <= frames
    assert all(np.isfinite(late.trajectory().covariances).ravel())


def test_sightings_that_left_while_nobody_knew_them_are_not_used_later():
    """Landmark 7 is first taken for none; nothing holds the window open for it, and the first ones leave."""
    both = (
        run(seven_after([0.0] * 4, 10), of, **EXACT, smoother__lag_s=2.0)[0]
        for of in ("whole", "bounded")
    )
    whole, bounded = (estimator.detections().outcomes for estimator in both)
    assert whole.count(Outcome.USED_LATER) == 10
    assert 0 < bounded.count(Outcome.USED_LATER) < 8
    assert bounded.count(Outcome.USED_LATER) + bounded.count(Outcome.NO_IDENTITY) == 10
    assert Outcome.WAITING not in bounded


def test_a_window_that_begins_anew_says_the_same():
    """On the rail all is linear: QR and a restart change nothing."""
    sequence, _ = rail(31)
    plain, expected = run(sequence, "bounded", **LINEAR, smoother__lag_s=2.0)
    params = isam2_params(history__policy="bounded", **LINEAR, smoother__lag_s=2.0)
    estimator = Isam2(sequence.calibration, Odometry(sequence.calibration), params)
    for k, step in enumerate(sequence.replay(sequence.instants(2.0))):
        estimate = estimator.process(step)
        assert estimate is not None
        if k in (8, 20):
            estimator._smoother._give_up_cholesky(estimator._keyframes.newest_s)
        assert estimate.world_T_body.equals(expected[k].world_T_body, 1e-7)
        assert np.allclose(
            estimate.covariance[3, 3], expected[k].covariance[3, 3], rtol=1e-5
        )
    assert estimator._smoother._is_by_qr
    assert np.allclose(
        estimator.trajectory().positions,
        plain.trajectory().positions,
        rtol=0,
        atol=1e-7,
    )


def test_what_need_not_be_remembered_is_forgotten_and_nothing_else_changes():
    """Poses and outcomes of the last half minute, and up to a quarter more, are left."""
    (everything, causal), (recent, same) = (
        run(mission(), "bounded", history__remembered_s=s) for s in (None, 30.0)
    )
    assert all(
        np.array_equal(a.covariance, b.covariance)
        for a, b in zip(causal, same, strict=True)
    )
    whole, part = everything.trajectory(), recent.trajectory()
    assert 30 <= (part.stamps_ns[-1] - part.stamps_ns[0]) * 1e-9 < 30 * 1.25 + LAG_S + 2
    assert np.array_equal(part.positions, whole.positions[-len(part) :])
    assert np.array_equal(part.covariances, whole.covariances[-len(part) :])
    log, rest = everything.detections(), recent.detections()
    assert 0 < len(rest) < 0.5 * len(log)
    assert np.array_equal(
        rest.innovations, log.innovations[-len(rest) :], equal_nan=True
    )
    assert rest.outcomes == log.outcomes[-len(rest) :]
    assert np.array_equal(
        recent.landmarks().positions, everything.landmarks().positions
    )


def test_landmarks_that_have_moved_are_linearised_anew_once_a_lag(monkeypatch):
    restarts = counted(monkeypatch, Smoother, "_restart")
    run(mission(), "bounded", smoother__stale_shift_m=1e-6)
    assert len(restarts) > 5
    assert np.diff([time_s for _, time_s in restarts]).min() >= LAG_S
    many = len(restarts)
    run(mission(), "bounded", smoother__stale_shift_m=1e9)
    assert len(restarts) == many
