"""Detections of a straight dive: gate, first place of a landmark, noise of the motion, waiting; steps of a policy."""

from collections import Counter
from collections.abc import Callable
from typing import Any

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L, X
from scipy.stats import chi2

from sonar_graph.calibration import DvlCalibration, FloorPrior, SonarCalibration, Start
from sonar_graph.measurements import Floats
from sonar_graph.simulation.basin import BasinOptions, simulate_basin
from sonar_graph.slam import GaussianKernel, KeyframeParams, RobustKernel
from sonar_graph.slam.landmarks import (
    Decision,
    IdentityPolicy,
    LandmarkGraph,
    MixtureIdentities,
    NamelessLandmarks,
    TrackedIdentities,
)
from sonar_graph.slam.smoother import Smoother
from sonar_graph.states import Outcome

from .dive import CALIBRATION, FLOOR, NS, POLICY, SONAR, T0_NS, UNGATED, Dive, spherical
from .graphs import block_of, factors_of
from .late_identities import BASIN, POLICIES, SURE, TROUBLES, run, see
from .made import detected, polar, smoother_with

BEAM = np.array([np.cos(0.2) * np.cos(0.4), np.sin(0.2) * np.cos(0.4), -np.sin(0.4)])
"""Centre beam of a sonar that looks 0.4 rad down and 0.2 rad to the left."""
CERTAIN = Start(position_sigma_m=(1e-6,) * 3, rpy_sigma_rad=(1e-6,) * 3)


def dive_with(smoother: Smoother | None = None, **changes) -> Dive:
    return Dive(CALIBRATION.model_copy(update=changes), smoother=smoother)


def settle(dive: Dive, updates: int = 1) -> None:
    for _ in range(updates):
        dive.smoother.update(dive.keyframes.newest_s)


def test_innovation_and_its_covariance_are_those_of_the_joint_prediction():
    """S = H P H^T + R by numpy, with H by differences and P the window's joint covariance."""
    dive = Dive()
    truth = np.array([3.0, 0.8, -1.4])
    dive.see(0.0, (5, *spherical(0.0, truth)))
    settle(dive)
    landmark = dive.smoother.values.atPoint3(L(5))
    P = block_of(dive.smoother.joint_covariance([X(0), L(5)]), [X(0), L(5)])
    world_T_body = dive.smoother.values.atPose3(X(0))

    def expected(change: Floats) -> Floats:
        pose = world_T_body.compose(gtsam.Pose3.Expmap(change[:6])).compose(
            SONAR.mounting.pose()
        )
        return polar(pose, landmark + change[6:])

    H = np.column_stack(
        [(expected(1e-6 * a) - expected(-1e-6 * a)) / 2e-6 for a in np.eye(9)]
    )
    z = expected(np.zeros(9)) + np.array([0.03, -0.02])
    dive.see(0.0, (5, *z))
    log = dive.sightings.journal.log()
    assert log.outcomes[-1] is Outcome.USED
    assert log.innovations[-1] == pytest.approx([0.03, -0.02], abs=1e-9)
    assert np.allclose(
        log.innovation_covs[-1],
        H @ P @ H.T + np.diag([0.02**2, 0.01**2]),
        rtol=1e-5,
        atol=1e-10,
    )


def test_noise_of_the_motion_since_the_keyframe_is_added():
    """Dead ahead, 2 s after the keyframe, with a log of 0.2 m/s at 10 Hz: range has 0.2^2 x 0.1 s x 2 s more of it."""
    log = DvlCalibration(velocity_sigma_m_s=(0.2, 1e-6, 1e-6))
    dive = dive_with(
        dvl=log, sonar=SonarCalibration(range_sigma_m=0.02, azimuth_sigma_rad=0.01)
    )
    dive.keyframes.params = KeyframeParams(max_interval_s=100.0, motion_noise_share=1e9)
    dive.see(0.0, (5, 4.0, 0.0))
    dive.see(0.0, (5, 4.0, 0.0))
    dive.see(2.0, (5, 3.0, 0.0))
    _, before, later = dive.sightings.journal.log().innovation_covs
    motion_variance = 0.2**2 * 0.1 * 2.0
    assert before[0, 0] == pytest.approx(2 * 0.02**2, rel=1e-3)
    assert later[0, 0] == pytest.approx(1.5 * 0.02**2 + motion_variance, rel=1e-3)


@pytest.mark.parametrize("beyond", [False, True])
def test_the_gate_is_the_chi_square_quantile(beyond):
    """An innovation just inside it is used; just outside it is refused and leaves the graph as it was."""
    dive = Dive()
    dive.see(0.0, (5, 3.0, 0.0))
    dive.see(0.0, (5, 9.0, 0.0))
    assert dive.outcomes == [Outcome.NEW, Outcome.GATED]
    before = dive.smoother.graph.size()
    information = np.linalg.inv(dive.sightings.journal.log().innovation_covs[-1])
    edge_m = np.sqrt(chi2.ppf(0.99, 2) / information[0, 0])
    dive.see(0.0, (5, 3.0 + edge_m * (1.001 if beyond else 0.999), 0.0))
    assert dive.outcomes[-1] is (Outcome.GATED if beyond else Outcome.USED)
    assert dive.smoother.graph.size() == before + (0 if beyond else 2)
    assert dive.sightings.journal.log().innovations[1] == pytest.approx(
        [6.0, 0.0], abs=1e-6
    )


def test_a_frame_before_the_start_is_unlocated():
    dive = Dive()
    dive.sightings.add(detected(T0_NS - 1, [(3.0, 0.0), (2.0, 0.0)], [[5], [6]], [0.9]))
    assert dive.outcomes == [Outcome.UNLOCATED] * 2
    assert dive.smoother.graph.size() == 0


@pytest.mark.parametrize(
    "share", [0.0, 1e9], ids=["keyframe in between", "no keyframe in between"]
)
def test_a_frame_older_than_what_was_processed_is_late(share):
    """Whether a keyframe was set since then or not: motion to it is no longer kept."""
    dive = Dive()
    dive.keyframes.params = POLICY.model_copy(update={"motion_noise_share": share})
    dive.see(3.0, (5, 3.0, 0.0))
    before = dive.smoother.graph.size()
    dive.see(2.99, (5, 3.0, 0.0), (6, 2.0, 0.0))
    assert dive.outcomes == [Outcome.NEW, Outcome.LATE, Outcome.LATE]
    assert dive.smoother.graph.size() == before
    assert len(dive.keyframes.stamps_ns) == (2 if share == 0 else 1)


def test_one_identity_twice_in_a_frame_counts_once():
    """The landmark is in one place; of equally probable rows the first is taken, whether it is new or known."""
    dive = Dive()
    dive.see(0.0, (5, 3.0, 0.0), (5, 3.01, 0.0), (6, 2.0, 0.1))
    log = dive.sightings.journal.log()
    assert log.outcomes == [Outcome.NEW, Outcome.REPEATED, Outcome.NEW]
    assert log.landmark_ids.tolist() == [5, 5, 6]
    assert dive.sightings.landmarks.ids == [5, 6]
    assert dive.smoother.graph.size() == 2 + 2 * 3
    dive.see(0.0, (5, 3.0, 0.0), (5, 3.01, 0.0))
    assert dive.outcomes[3:] == [Outcome.USED, Outcome.REPEATED]


@pytest.mark.parametrize("told", [None, np.diag([0.1**2, 0.05**2])])
def test_a_covariance_in_the_log_goes_before_that_of_the_calibration(told):
    dive = dive_with(start=CERTAIN)
    dive.see(0.0, (5, 3.0, 0.0), cov=told)
    dive.see(0.0, (5, 3.0, 0.0), cov=told)
    sigma = [0.02, 0.01] if told is None else [0.1, 0.05]
    S = dive.sightings.journal.log().innovation_covs[-1]
    assert np.sqrt(np.diag(S)) == pytest.approx(np.sqrt(2) * np.array(sigma), rel=0.01)


@pytest.mark.parametrize("kernel", ["huber", "cauchy"])
def test_a_kernel_keeps_an_outlier_from_pulling(kernel):
    pulls = []
    for noise in (GaussianKernel(), RobustKernel(shape=kernel, width=2.0)):
        dive = Dive(identity=UNGATED, kernel=noise)
        for _ in range(5):
            dive.see(0.0, (5, 3.0, 0.0))
        before = dive.smoother.values.atPoint3(L(5))
        dive.see(0.0, (5, 4.0, 0.0))
        settle(dive, 5)
        pulls.append(np.linalg.norm(dive.smoother.values.atPoint3(L(5)) - before))
    assert pulls[1] < 0.2 * pulls[0]


def test_factors_of_a_frame_off_its_keyframe_carry_the_noise_of_the_motion():
    """0.35 s of a Doppler log of 0.2 m/s: the range factor has the noise of `PredictedView.blurred`."""
    sigmas = []
    for after_s in (0.0, 0.35):
        off_it = dive_with(dvl=DvlCalibration(velocity_sigma_m_s=(0.2, 0.2, 0.2)))
        off_it.see(after_s, (5, 3.0, 0.0))
        ranges = [
            f
            for f in factors_of(off_it.smoother.graph)
            if isinstance(f, gtsam.RangeFactorWithTransform3D)
        ]
        sigmas += [factor.noiseModel().sigma() for factor in ranges]
    motion = off_it.keyframes.motion_since_newest(T0_NS + round(0.35 * NS))
    assert sigmas[0] == pytest.approx(SONAR.range_sigma_m)
    assert sigmas[1] == pytest.approx(
        np.sqrt(SONAR.range_sigma_m**2 + motion.covariance[3, 3]), rel=1e-2
    )
    assert sigmas[1] > 1.5 * sigmas[0]


def test_a_first_sighting_places_a_landmark_on_the_centre_beam():
    dive = Dive()
    dive.see(0.0, (5, 3.0, 0.0))
    assert dive.outcomes == [Outcome.NEW]
    assert dive.smoother.values.atPoint3(L(5)) == pytest.approx(
        np.array([0.3, 0.1, -0.1]) + 3.0 * BEAM
    )


def test_a_known_floor_gives_the_elevation():
    dive = dive_with(floor=FLOOR)
    truth = np.array([2.6, 0.9, FLOOR.z_m])
    dive.see(0.0, (5, *spherical(0.0, truth)))
    assert dive.smoother.values.atPoint3(L(5)) == pytest.approx(truth, abs=1e-9)
    assert dive.smoother.graph.size() == 2 + 4
    settle(dive)
    assert np.sqrt(
        dive.smoother.marginals.marginalCovariance(L(5))[2, 2]
    ) == pytest.approx(FLOOR.sigma_m, rel=1e-3)


DOUBTFUL_HEIGHT = Start(
    position_sigma_m=(0.05, 0.02, 2.0), rpy_sigma_rad=(0.01, 0.01, 0.03)
)


@pytest.mark.parametrize(
    ("below_rad", "start"),
    [(0.6, CALIBRATION.start), (0.9, DOUBTFUL_HEIGHT)],
    ids=["near", "far, of a doubtful height"],
)
def test_a_floor_out_of_the_aperture_is_accepted_all_the_same(
    below_rad: float, start: Start
):
    """0.2 rad below the centre beam, where half the aperture is 0.12 rad: first put on the beam, then on the floor."""
    floor = FloorPrior(z_m=-0.1 - 3.0 * np.sin(below_rad), sigma_m=0.01)
    dive = dive_with(floor=floor, start=start)
    dive.see(0.0, (5, 3.0, 0.0))
    settle(dive, 5)
    assert dive.outcomes == [Outcome.NEW]
    assert dive.smoother.values.atPoint3(L(5))[2] == pytest.approx(floor.z_m, abs=1e-2)
    assert dive.smoother.values.atPose3(X(0)).equals(gtsam.Pose3(), 1e-3) == (
        start is CALIBRATION.start
    )


def test_a_landmark_that_cannot_stand_on_the_floor_does_not_drag_the_vehicle_there():
    """0.5 rad below the centre beam is seven sigmas of the aperture, which has a factor then, and the floor none."""
    dive, without = (
        dive_with(floor=FloorPrior(z_m=-0.1 - 3.0 * np.sin(0.9), sigma_m=0.01)),
        Dive(),
    )
    for each in (dive, without):
        each.see(0.0, (5, 3.0, 0.0))
        settle(each)
    assert dive.smoother.graph.equals(without.smoother.graph, 1e-12)
    assert dive.smoother.values.atPose3(X(0)).equals(gtsam.Pose3(), 1e-9)


def test_elevation_is_one_factor_a_landmark():
    """It does not vary as noise would: many sightings from one place leave its height as unknown as the first."""
    dive = dive_with(start=CERTAIN)
    for k in range(9):
        dive.see(0.01 * k, (5, 3.0, 0.0))
    settle(dive)
    up = np.array([np.cos(0.2) * np.sin(0.4), np.sin(0.2) * np.sin(0.4), np.cos(0.4)])
    cov = dive.smoother.marginals.marginalCovariance(L(5))
    elevation_sigma = SONAR.elevation_aperture_rad / np.sqrt(12)
    assert np.sqrt(up @ cov @ up) == pytest.approx(
        3.0 * np.tan(elevation_sigma), rel=0.01
    )
    assert dive.outcomes == [Outcome.NEW] + [Outcome.USED] * 8


def waiting(greatest_gain: float) -> Dive:
    """A landmark that has been seen once by a vehicle that is sure of where it is."""
    dive = dive_with(smoother_with(waiting_gain=greatest_gain), start=CERTAIN)
    dive.see(0.0, (5, 3.0, 0.0))
    return dive


def range_variance(dive: Dive) -> float:
    return float(BEAM @ dive.smoother.marginals.marginalCovariance(L(5)) @ BEAM)


def test_sightings_wait_until_together_they_add_enough_information():
    """After n sightings range and azimuth are known to 1/n of the noise: the next adds 1/n, but a refused one 0."""
    dive, known, waited = waiting(0.45), [], []
    for _ in range(6):
        known.append(0.02**2 / range_variance(dive))
        dive.see(0.0, (5, 3.0, 0.0))
        waited.append(dive.smoother._waiting_gain)
    assert known == pytest.approx([1, 2, 3, 3, 5, 5], rel=1e-3)
    assert waited == pytest.approx([0, 0, 1 / 3, 0, 1 / 5, 2 / 5], rel=1e-3, abs=1e-9)
    dive.see(0.0, (5, 9.0, 0.0))
    assert dive.smoother._waiting_gain == waited[-1]
    assert dive.outcomes == [Outcome.NEW] + [Outcome.USED] * 6 + [Outcome.GATED]


@pytest.mark.parametrize("what", ["keyframe", "landmark"])
def test_what_waits_is_used_with_the_next_keyframe_or_landmark(what):
    dive = waiting(1e9)
    for _ in range(3):
        dive.see(0.0, (5, 3.0, 0.0))
    assert range_variance(dive) == pytest.approx(0.02**2, rel=1e-3)
    if what == "keyframe":
        dive.keyframes.advance(T0_NS + 5 * NS)
        dive.keyframes.update_if_due()
    else:
        dive.see(0.0, (6, 3.0, 0.3))
    assert range_variance(dive) == pytest.approx(0.02**2 / 4, rel=0.01)


STEPS = ["retract", "associate", "rivals", "judge", "held", "reconsider", "forget"]
DECIDING = [TrackedIdentities, NamelessLandmarks, MixtureIdentities]


def watched(
    monkeypatch: pytest.MonkeyPatch,
    watch: Callable[[IdentityPolicy, str, Callable[[], Any]], Any],
) -> None:
    """From now on each step of a policy runs in ``watch(policy, name, step)``."""

    def wrapped(name: str, step: Callable[..., Any]) -> Callable[..., Any]:
        return lambda policy, *given: watch(policy, name, lambda: step(policy, *given))

    for kind in DECIDING:
        for name in STEPS:
            monkeypatch.setattr(kind, name, wrapped(name, getattr(kind, name)))


@pytest.mark.parametrize("policy", POLICIES)
def test_a_policy_only_decides_and_graph_landmarks_and_journal_change_between_its_steps(
    policy: str, monkeypatch
):
    sequence = simulate_basin(
        BasinOptions(**BASIN, **TROUBLES["late and wrong"], anonymous_share=0.3)
    )
    decided: Counter[str] = Counter()

    def seen(landmarks: LandmarkGraph) -> tuple:
        log = landmarks.journal.log()
        return (
            landmarks.sizes(),
            landmarks.smoother.graph.size(),
            log.outcomes,
            log.landmark_ids.tolist(),
        )

    def watch(deciding: IdentityPolicy, name: str, step: Callable[[], Any]) -> Any:
        before = seen(deciding.landmarks)
        found = step()
        assert seen(deciding.landmarks) == before
        decided[name] += isinstance(found, Decision) and not found.is_empty
        return found

    watched(monkeypatch, watch)
    run(sequence, **POLICIES[policy])
    assert decided["judge"] > 10
    assert decided["reconsider" if policy == "max-mixture" else "associate"] > 0


def test_a_renamed_track_is_retracted_then_associated_and_then_judged(monkeypatch):
    """Each in a decision of its own, so that the landmark begins where the right sightings put it."""
    world, steps = Dive(identity=UNGATED), []

    def watch(_: IdentityPolicy, name: str, step: Callable[[], Any]) -> Any:
        found = step()
        if isinstance(found, Decision) and not found.is_empty:
            steps.append(
                (name, [(each.outcome, each.landmark_id) for each in found.assignments])
            )
        return found

    see(world, 0.0, SURE[5])
    see(world, 0.5, SURE[5])
    watched(monkeypatch, watch)
    see(world, 1.0, SURE[7])
    assert steps == [
        ("retract", [(Outcome.TAKEN_BACK, None)] * 2),
        ("associate", [(Outcome.MOVED, 7)] * 2),
        ("judge", [(Outcome.USED, 7)]),
    ]
    assert world.sightings.landmarks.ids == [7]
