"""Which watches the window chooses anew, when, and from what; worlds in which one of the rules decides."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import X

from sonar_graph.calibration import FloorPrior, SonarCalibration
from sonar_graph.measurements import Floats
from sonar_graph.slam import KeyframeParams, MixtureIdentity
from sonar_graph.slam.landmarks.association import IdentityPosterior
from sonar_graph.slam.landmarks.mixture import TrackedObject
from sonar_graph.slam.landmarks.mixture_policy import DoubtfulIdentities
from sonar_graph.slam.landmarks.sighting import LandmarkSightings, Sighting, SightingFactors
from sonar_graph.slam.smoother.batch_solution import Sightline
from sonar_graph.states import DetectionJournal, Outcome

from . import dive as dive_module
from .dive import CALIBRATION, FLOOR, Dive, spherical
from .made import smoother_with
from .test_doubtful_identities import MIXTURE, PLACES, dive, show

LAG_S = 1.0
AFAR = np.array([0.06, 0.0])
"""Three standard deviations in range: too far to be of a landmark that is not named, near enough for one that is."""


def at(after_s: float, landmark_id: int, off: Floats | None = None) -> Floats:
    """What is seen, without noise."""
    return np.array([spherical(0.5 * after_s, PLACES[landmark_id])]) + (0.0 if off is None else off)


def short_lived(monkeypatch: pytest.MonkeyPatch) -> Dive:
    """A keyframe each frame, a second in the window."""
    monkeypatch.setattr(dive_module, "POLICY", KeyframeParams(max_interval_s=1.0, motion_noise_share=0.0))
    return Dive(CALIBRATION.model_copy(update={"floor": FLOOR}), MixtureIdentity(), lag_s=LAG_S)


def test_all_of_the_window_is_chosen_anew_and_not_only_the_newest() -> None:
    """Two that were perhaps of landmark 4, of which nothing was known; then one surely is."""
    world = dive("max-mixture")
    for k in (1, 2):
        show(world, 0.3 * k, at(0.3 * k, 4), [4], [-1], surely=0.3)
    assert world.outcomes == [Outcome.UNFIT] * 2
    show(world, 0.9, at(0.9, 4), [4], [-1])
    assert world.outcomes == [Outcome.REASSIGNED] * 2 + [Outcome.NEW]


def test_choices_that_follow_from_choices_are_made_at_once() -> None:
    """A track, alone with its name, is given another; a single one that was perhaps of that one follows it."""
    world = dive("max-mixture")
    show(world, 0.3, at(0.3, 9, AFAR), [9], [-1], surely=0.3)
    for k in (2, 3, 4):
        show(world, 0.3 * k, at(0.3 * k, 9), [4], [2])
    assert world.sightings.ids == {4}
    assert world.outcomes[0] is Outcome.UNFIT
    show(world, 1.5, at(1.5, 9), [9], [2])
    assert world.sightings.ids == {9}
    assert world.outcomes[0] is Outcome.REASSIGNED


def test_a_track_that_gets_another_name_is_chosen_anew_also_where_it_has_left_the_window(monkeypatch) -> None:
    """An equal one, of no track and as wrongly named, is not."""
    world = short_lived(monkeypatch)
    for k in (1, 2):
        show(world, 0.3 * k, at(0.3 * k, 7), [4], [2])
    for k in range(3, 12):
        show(world, 0.3 * k, at(0.3 * k, 9), [9], [-1])
    first = world.sightings._doubtful.watches[0]
    assert first.landmark_id == 4
    assert not world.smoother.in_window([first.sightings[0].line.pose_key])
    show(world, 3.6, at(3.6, 7), [7], [2])
    assert first.landmark_id == 7
    assert world.sightings.ids == {7, 9}


@pytest.mark.parametrize(("name", "is_waiting"), [(-1, True), (7, False)])
def test_keyframes_of_what_waits_are_held_and_of_what_is_known_are_not(
    name: int, is_waiting: bool, monkeypatch
) -> None:
    world = short_lived(monkeypatch)
    show(world, 0.3, at(0.3, 7), [name], [2])
    (first,) = world.sightings._doubtful.watches
    for k in range(2, 12):
        show(world, 0.3 * k, at(0.3 * k, 9), [9], [-1])
    key = first.sightings[0].line.pose_key
    assert (world.smoother.in_window([key]) == [key]) is is_waiting
    show(world, 3.6, at(3.6, 7), [7], [2])
    assert first.landmark_id == 7
    assert len(first.sightings) == 2


def test_what_waited_in_a_frame_that_shows_the_landmark_already_is_not_of_it(monkeypatch) -> None:
    """Before anything is chosen anew: what was surer in that frame has it."""
    monkeypatch.setattr(DoubtfulIdentities, "reconsider", lambda *_: None)
    world = dive("max-mixture")
    for k in (1, 2):
        show(world, 0.3 * k, np.vstack([at(0.3 * k, 7), at(0.3 * k, 7, AFAR / 3)]), [7, -1], [-1, 2])
    show(world, 0.9, at(0.9, 4), [-1], [2])
    show(world, 1.2, at(1.2, 7), [7], [2])
    stamps = [s.stamp_ns for s in world.sightings._landmarks.sightings(7)]
    assert len(set(stamps)) == len(stamps) == 4
    assert world.outcomes == [
        *(Outcome.NEW, Outcome.UNFIT, Outcome.USED, Outcome.UNFIT),
        *(Outcome.USED_LATER, Outcome.USED),
    ]


@pytest.mark.parametrize(("sigma_m", "stays"), [(0.01, False), (0.5, True)])
def test_a_misfit_is_one_of_the_identity_only_where_the_estimate_is_sure(sigma_m: float, stays: bool) -> None:
    """Seen 0.3 m off from a second pose: as it stands, it is of nothing; expected with the pose's error, it may be."""
    smoother = smoother_with(1e9, 0.1, 1e9)
    landmarks = LandmarkSightings(smoother, SightingFactors(SonarCalibration(), lambda noise: noise))
    for k, sigma in enumerate((0.001, sigma_m)):
        smoother.add_pose(X(k), gtsam.Pose3(), float(k))
        sigmas = np.array([1e-3] * 3 + [sigma] * 3)
        smoother.add([gtsam.PriorFactorPose3(X(k), gtsam.Pose3(), gtsam.noiseModel.Diagonal.Sigmas(sigmas))])
    smoother.update(1.0)
    floor, noise = FloorPrior(z_m=0.0, sigma_m=0.01), np.diag([4e-4, 1e-4])
    for k in range(2):
        first = Sighting(k, k, Sightline(X(0), gtsam.Pose3(), np.array([3.0, 0.1])), noise, floor)
        landmarks.exchange([], [(first, 7)], 1.0)
    off = Sighting(2, 2, Sightline(X(1), gtsam.Pose3(), np.array([3.3, 0.1])), noise, floor)
    landmarks.enter(off, 7, ())
    seen, journal = TrackedObject(IdentityPosterior({7: 0.9}), [off]), DetectionJournal()
    off.row = journal.record(off.stamp_ns, 7, Outcome.USED)
    doubtful = DoubtfulIdentities(landmarks, journal, MixtureIdentity(), MIXTURE)
    doubtful.watches.append(seen)
    assert MIXTURE.best([seen], smoother.values, [7], landmarks.sizes()) == [None]
    doubtful.reconsider(1.0)
    assert seen.landmark_id == (7 if stays else None)
    assert journal.log().outcomes == [Outcome.USED if stays else Outcome.UNFIT]
