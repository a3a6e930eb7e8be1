"""Max-mixture in the window: a fixed point that another solver finds, and choices that follow the estimate."""

from collections import Counter
from dataclasses import replace
from itertools import product

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L, X
from scipy.stats import multivariate_normal

from sonar_graph import run_estimator
from sonar_graph.calibration import FloorPrior, SonarCalibration
from sonar_graph.measurements import Floats
from sonar_graph.models import Kernel
from sonar_graph.slam import (
    GaussianKernel,
    KeyframeParams,
    MixtureIdentity,
    RobustIdentity,
    RobustKernel,
)
from sonar_graph.slam.landmarks import mixture
from sonar_graph.slam.landmarks import mixture_policy as doubtful_identities
from sonar_graph.slam.landmarks.landmark_graph import (
    UNCHANGED,
    AmendableJournal,
    Assignment,
    LandmarkGraph,
)
from sonar_graph.slam.landmarks.mixture import (
    Choices,
    IdentityPosterior,
    Mixture,
    RecogniserErrors,
    TrackedObject,
)
from sonar_graph.slam.landmarks.mixture_policy import MixtureIdentities
from sonar_graph.slam.landmarks.sighting import Sighting, SightingFactors
from sonar_graph.slam.smoother import Sightline
from sonar_graph.states import Outcome
from sonar_graph.testing import misnamed_world

from . import dive as dive_module
from . import test_mixture as small
from .dive import CALIBRATION, FLOOR, T0_NS, Dive, spherical
from .graphs import gtsams_solution
from .made import (
    counted,
    graph_of,
    plain,
    pose_prior,
    scattered,
    smoother_with,
    values_of,
)

PLACES = {
    7: np.array([2.6, 0.5, -1.0]),
    4: np.array([2.9, 1.4, -1.0]),
    9: np.array([3.2, 0.1, -1.0]),
}
"""Of landmarks, in the world of `Dive`: on the floor, within its sonar's fan."""
ERRORS = RecogniserErrors()
GAUSSIAN = GaussianKernel()
MIXTURE = Mixture(ERRORS, GAUSSIAN)


def dive(policy: str, kernel: Kernel = GAUSSIAN) -> Dive:
    identity = RobustIdentity() if policy == "robust" else MixtureIdentity()
    return Dive(CALIBRATION.model_copy(update={"floor": FLOOR}), identity, kernel)


def watch(
    world: Dive,
    after_s: float,
    said: dict[int, int],
    rng: np.random.Generator,
    track: int = -1,
    surely: float = 1.0,
) -> None:
    """A frame with the landmarks that are the keys, each named as the value says."""
    z = [
        spherical(0.5 * after_s, PLACES[i]) + [0.02, 0.01] * rng.standard_normal(2)
        for i in said
    ]
    show(world, after_s, z, list(said.values()), [track] * len(z), surely)


def show(
    world: Dive,
    after_s: float,
    z,
    named: list[int],
    tracks: list[int],
    surely: float = 1.0,
) -> None:
    world.show(
        T0_NS + round(after_s * 1e9), z, np.array(named)[:, None], [surely], tracks
    )


def misnamed(
    policy: str, kernel: Kernel = GAUSSIAN, share: float = 0.25
) -> tuple[Dive, list[int]]:
    """Thirty frames in which a share of the names, not of the first two frames, is wrong; the true ones in order."""
    world, rng, truth = dive(policy, kernel), np.random.default_rng(5), []
    for k in range(30):
        named = {i: i for i in PLACES}
        if k > 1 and rng.random() < 3 * share:
            wrong = int(rng.choice(list(PLACES)))
            others = [i for i in PLACES if i != wrong]
            named = {wrong: int(rng.choice(others))} | {i: i for i in others}
        watch(world, 0.1 * (k + 1), named, rng)
        truth += list(named)
    return world, truth


def worst_landmark_m(world: Dive) -> float:
    values = world.sightings.smoothed().values
    return max(
        float(np.linalg.norm(values.atPoint3(L(i)) - p)) for i, p in PLACES.items()
    )


def max_mixture(world: Dive) -> gtsam.NonlinearFactorGraph:
    """The same with Python factors that look for their largest component at every linearisation."""
    policy = world.sightings.policy
    landmarks = world.sightings.landmarks
    handles = {
        landmarks.state(s).handle for w in policy.objects for s in w.sightings
    } - {None}
    graph, chosen = world.smoother.graph_without(handles), policy.history()
    pairs = list(zip(chosen.objects, chosen.choices, strict=True))
    firsts = {
        i: min(w.sightings[0].row for w, choice in pairs if choice == i) for i in PLACES
    }
    for w in policy.objects:
        (sighting,) = w.sightings
        first_of = next((i for i, row in firsts.items() if row == sighting.row), None)
        maker = landmarks.factors
        if (
            first_of is not None
        ):  # what is said once of a landmark does not depend on a choice
            for factor in list(
                maker.make(sighting, L(first_of), is_first=True).values()
            )[2:]:
                graph.push_back(factor)
        graph.push_back(
            largest(
                w.posterior.favourite,
                {i: maker.make(sighting, L(i), is_first=False) for i in PLACES},
                sighting,
            )
        )
    return graph


def largest(named: int, components: dict[int, dict], sighting) -> gtsam.CustomFactor:
    keys = [sighting.line.pose_key, *(L(i) for i in PLACES)]
    q, u = 0.05, 1.0 / (10.0 * 2.0)
    peak = 1.0 / (2.0 * np.pi * np.sqrt(np.linalg.det(sighting.noise)))
    least = -2.0 * np.log((q / 2) * u / ((1 - q + q / 40) * peak))

    def error(_, values, jacobians):
        best, cost = None, least
        for i, factors in components.items():
            weight = (1 - q) * (i == named) + q / 40
            own = 2 * sum(f.error(values) for f in factors.values()) - 2 * np.log(
                weight / (1 - q + q / 40)
            )
            if own < cost:
                best, cost = i, own
        e, blocks = (
            np.zeros(4),
            {key: np.zeros((4, 6 if key == keys[0] else 3)) for key in keys},
        )
        e[3] = np.sqrt(least)
        if best is not None:
            e[3] = np.sqrt(
                max(
                    cost - 2 * sum(f.error(values) for f in components[best].values()),
                    0.0,
                )
            )
            camera, distance = components[best].values()
            for rows, factor in ((slice(0, 2), camera), (slice(2, 3), distance)):
                A, b = factor.linearize(values).jacobian()
                e[rows], column = -b, 0
                for key in list(factor.keys()):
                    width = 6 if key == keys[0] else 3
                    blocks[key][rows] = A[:, column : column + width]
                    column += width
        if jacobians is not None:
            for k, key in enumerate(keys):
                jacobians[k] = blocks[key]
        return e

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(4), keys, error)


def test_the_end_is_a_fixed_point_of_the_max_mixture_that_another_solver_finds() -> (
    None
):
    world, truth = misnamed("max-mixture")
    values = world.sightings.smoothed().values
    start = scattered(
        values, np.random.default_rng(1), {"x": 3e-3, "l": 3e-3, "b": 0.0}
    )
    found = gtsams_solution(max_mixture(world), start)
    for i in PLACES:
        assert np.linalg.norm(start.atPoint3(L(i)) - values.atPoint3(L(i))) > 1e-3
        np.testing.assert_allclose(
            found.atPoint3(L(i)), values.atPoint3(L(i)), atol=1e-5
        )
    log = world.sightings.log()
    assert log.landmark_ids.tolist() == truth
    assert set(log.outcomes) == {Outcome.NEW, Outcome.USED, Outcome.REASSIGNED}


@pytest.mark.parametrize("kernel", [GaussianKernel(), RobustKernel()])
def test_wrong_names_cost_nothing_and_accepting_them_does(kernel: Kernel) -> None:
    right_m = worst_landmark_m(misnamed("robust", share=0.0)[0])
    assert worst_landmark_m(misnamed("max-mixture", kernel)[0]) < right_m + 0.02
    assert worst_landmark_m(misnamed("robust")[0]) > right_m + 0.1


def test_right_names_give_the_graph_of_a_policy_that_accepts_them() -> None:
    worlds = [misnamed(policy, share=0.0)[0] for policy in ("max-mixture", "robust")]
    assert worlds[0].outcomes == worlds[1].outcomes
    for i in PLACES:
        np.testing.assert_allclose(
            *(w.sightings.smoothed().values.atPoint3(L(i)) for w in worlds), atol=1e-3
        )


@pytest.mark.parametrize("can_move", [True, False])
def test_a_landmark_that_begins_in_a_wrong_place_is_moved_by_those_who_name_it(
    can_move: bool, monkeypatch
) -> None:
    if not can_move:
        monkeypatch.setattr(
            doubtful_identities, "supporters_elsewhere", lambda *_: None
        )
    world, rng = dive("max-mixture"), np.random.default_rng(2)
    watch(world, 0.3, {4: 7}, rng)
    for k in range(2, 8):
        watch(world, 0.3 * k, {7: 7}, rng)
    values, _ = world.smoother.solve_history()
    off_m = float(np.linalg.norm(values.atPoint3(L(7)) - PLACES[7]))
    assert (off_m < 0.1) is can_move
    assert world.outcomes.count(Outcome.UNFIT) == (1 if can_move else 6)


def sighting(
    k: int, z: list[float], pose: int = 0, floor: FloorPrior | None = None
) -> Sighting:
    return Sighting(
        k,
        k,
        Sightline(X(pose), gtsam.Pose3(), np.array(z)),
        np.diag([4e-4, 1e-4]),
        floor,
    )


@pytest.mark.parametrize(
    ("off_sigma", "is_of_7"), [(0.0, True), (1.5, True), (3.0, False)]
)
def test_many_sightings_of_another_object_do_not_prove_it_to_be_a_landmark(
    off_sigma: float, is_of_7: bool, monkeypatch
) -> None:
    """Something unnamed, seen again and again a little beside a landmark whose place is known."""
    values = values_of(X0=gtsam.Pose3(), L7=np.array([3.0, 0.0, 0.0]))
    seen = TrackedObject(
        IdentityPosterior({}), [sighting(k, [3.0, 0.01 * off_sigma]) for k in range(20)]
    )
    assert MIXTURE.best([seen], values, [None], {7: 50}) == [7 if is_of_7 else None]
    monkeypatch.setattr(mixture, "REPEATED_LOSS", 1e3)
    assert MIXTURE.best([seen], values, [None], {7: 50}) == [7], (
        "as if each sighting were anywhere"
    )


def test_a_landmark_that_alone_was_named_wrongly_gets_its_name_with_all_sightings() -> (
    None
):
    """A landmark 4 that nothing else was seen of becomes 9 when its track is named so."""
    world, rng = dive("max-mixture"), np.random.default_rng(2)
    for k in range(1, 4):
        watch(world, 0.3 * k, {7: 7}, rng)
    for k, name in enumerate([4, 4, 4, 9, 9], start=4):
        watch(world, 0.3 * k, {9: name}, rng, track=2)
    assert world.sightings.landmarks.ids == [7, 9]
    assert len(world.sightings.landmarks.sightings(9)) == 5
    values = world.sightings.smoothed().values
    assert np.linalg.norm(values.atPoint3(L(9)) - PLACES[9]) < 0.1


@pytest.mark.parametrize(
    ("surely", "where"), [(0.3, 7), (0.9, 4)], ids=["not named", "named"]
)
def test_what_names_no_landmark_has_no_vote_on_its_place(
    surely: float, where: int
) -> None:
    """Landmark 7 is seen three times; then another thing thirty times, which is more or less surely said to be 7."""
    world, rng = dive("max-mixture"), np.random.default_rng(2)
    for k in range(1, 4):
        watch(world, 0.3 * k, {7: 7}, rng)
    for k in range(4, 34):
        watch(world, 0.3 * k, {4: 7}, rng, surely=surely)
    assert (
        np.linalg.norm(world.sightings.smoothed().values.atPoint3(L(7)) - PLACES[where])
        < 0.1
    )


def test_a_landmark_begins_with_one_of_those_that_name_it() -> None:
    """The longest; where the others are is only known then, and one far from it is of no landmark."""
    values = values_of(X0=gtsam.Pose3())
    single = TrackedObject(IdentityPosterior({7: 0.9}), [sighting(0, [3.0, 0.4])])
    longest = TrackedObject(
        IdentityPosterior({7: 0.9}), [sighting(k, [3.0, 0.0]) for k in range(1, 4)]
    )
    assert MIXTURE.best([single, longest], values, [None, None], {}) == [None, 7]
    values.insert(L(7), np.array([3.0, 0.0, 0.0]))
    assert MIXTURE.best([single, longest], values, [None, 7], {7: 3}) == [None, 7]


LAG_S = 1.0
AFAR = np.array([0.06, 0.0])
"""Three standard deviations in range: too far to be of a landmark that is not named, near enough for one that is."""


def at(after_s: float, landmark_id: int, off: Floats = np.zeros(2)) -> Floats:  # noqa: B008
    """What is seen, without noise."""
    return np.array([spherical(0.5 * after_s, PLACES[landmark_id]) + off])


def short_lived(monkeypatch: pytest.MonkeyPatch) -> Dive:
    """A keyframe each frame, a second in the window."""
    monkeypatch.setattr(
        dive_module,
        "POLICY",
        KeyframeParams(max_interval_s=1.0, motion_noise_share=0.0),
    )
    return Dive(
        CALIBRATION.model_copy(update={"floor": FLOOR}), MixtureIdentity(), lag_s=LAG_S
    )


def test_choices_of_the_whole_window_are_revised_and_not_only_the_newest() -> None:
    """Two that were perhaps of landmark 4, of which nothing was known; then one surely is."""
    world = dive("max-mixture")
    for k in (1, 2):
        show(world, 0.3 * k, at(0.3 * k, 4), [4], [-1], surely=0.3)
    assert world.outcomes == [Outcome.UNFIT] * 2
    show(world, 0.9, at(0.9, 4), [4], [-1])
    assert world.outcomes == [Outcome.REASSIGNED] * 2 + [Outcome.NEW]


def test_a_track_that_gets_another_name_is_revised_also_where_it_has_left_the_window(
    monkeypatch,
) -> None:
    """An equal one, of no track and as wrongly named, is not."""
    world = short_lived(monkeypatch)
    for k in (1, 2):
        show(world, 0.3 * k, at(0.3 * k, 7), [4], [2])
    for k in range(3, 12):
        show(world, 0.3 * k, at(0.3 * k, 9), [9], [-1])
    first = world.sightings.policy.objects[0]
    assert world.sightings.policy.landmark_of(first) == 4
    show(world, 3.6, at(3.6, 7), [7], [2])
    assert world.sightings.policy.landmark_of(first) == 7
    assert world.sightings.landmarks.ids == [7, 9]


def test_what_waited_in_a_frame_that_shows_the_landmark_already_is_not_of_it(
    monkeypatch,
) -> None:
    """Before choices are revised: what was surer in that frame has it."""
    monkeypatch.setattr(MixtureIdentities, "reconsider", lambda _: UNCHANGED)
    world = dive("max-mixture")
    for k in (1, 2):
        show(
            world,
            0.3 * k,
            np.vstack([at(0.3 * k, 7), at(0.3 * k, 7, AFAR / 3)]),
            [7, -1],
            [-1, 2],
        )
    show(world, 0.9, at(0.9, 4), [-1], [2])
    show(world, 1.2, at(1.2, 7), [7], [2])
    stamps = [s.stamp_ns for s in world.sightings.landmarks.sightings(7)]
    assert len(set(stamps)) == len(stamps) == 4
    assert world.outcomes == [
        *(Outcome.NEW, Outcome.UNFIT, Outcome.USED, Outcome.UNFIT),
        *(Outcome.USED_LATER, Outcome.USED),
    ]


def test_a_detection_of_a_known_track_gets_its_landmark_also_where_another_is_nearer(
    monkeypatch,
) -> None:
    """Before choices are revised; without a track it is of the nearer landmark."""
    monkeypatch.setattr(MixtureIdentities, "reconsider", lambda _: UNCHANGED)
    world = dive("max-mixture")
    show(world, 0.3, np.vstack([at(0.3, 7), at(0.3, 9)]), [7, 9], [2, -1])
    for after_s, track in ((0.6, 2), (0.9, -1)):
        show(world, after_s, at(after_s, 9), [-1], [track])
    assert world.sightings.journal.log().landmark_ids.tolist() == [7, 9, 7, 9]


def recorded(journal: AmendableJournal, seen: Sighting) -> Sighting:
    return replace(seen, row=journal.record(seen.stamp_ns, 7, Outcome.WAITING))


@pytest.mark.parametrize(("sigma_m", "stays"), [(0.01, False), (0.5, True)])
def test_a_misfit_is_one_of_the_identity_only_where_the_estimate_is_sure(
    sigma_m: float, stays: bool
) -> None:
    """Seen 0.3 m off from a second pose: as it stands, it is of nothing; expected with the pose's error, it may be."""
    smoother = smoother_with(1e9, 0.1, 1e9)
    landmarks = LandmarkGraph(
        smoother,
        SightingFactors(SonarCalibration(), plain),
        journal := AmendableJournal(),
    )
    for k, sigma in enumerate((0.001, sigma_m)):
        smoother.add_pose(X(k), gtsam.Pose3(), float(k))
        sigmas = np.array([1e-3] * 3 + [sigma] * 3)
        smoother.add(
            {
                "prior": gtsam.PriorFactorPose3(
                    X(k), gtsam.Pose3(), gtsam.noiseModel.Diagonal.Sigmas(sigmas)
                )
            }
        )
    smoother.update(1.0)
    floor = FloorPrior(z_m=0.0, sigma_m=0.01)
    for k in range(2):
        landmarks.apply(
            [
                Assignment(
                    recorded(journal, sighting(k, [3.0, 0.1], floor=floor)),
                    Outcome.USED,
                    7,
                )
            ],
            1.0,
        )
    smoother.flush(1.0)
    off = recorded(journal, sighting(2, [3.3, 0.1], 1, floor))
    landmarks.apply([Assignment(off, Outcome.USED, 7)], 1.0)
    seen = TrackedObject(IdentityPosterior({7: 0.9}), [off])
    policy = MixtureIdentities(landmarks, MixtureIdentity(), GAUSSIAN)
    policy.objects.append(seen)
    assert MIXTURE.best([seen], smoother.values, [7], landmarks.sizes()) == [None]
    while not (decision := policy.reconsider()).is_empty:
        if decision.settles:
            landmarks.settle(1.0)
        for changes in decision.rounds:
            landmarks.apply(changes, 1.0)
    assert policy.landmark_of(seen) == (7 if stays else None)
    assert journal.log().outcomes[2:] == [Outcome.USED if stays else Outcome.UNFIT]


# A small world, in which all choices can be tried --------------------------------------------------------------------

IDS = (7, 4, None)
POSES = [small.world().atPose3(X(k)) for k in range(6)]
KNOWN = graph_of(pose_prior(X(k), pose, 0.01) for k, pose in enumerate(POSES))


def named(k: int, place: int, said: int, values: gtsam.Values) -> TrackedObject:
    """One sighting from pose k of landmark 7 or 4, surely named."""
    found = small.watch(values, small.PLACES[place], [k], np.zeros((1, 2)), {said: 0.9})
    floor = FloorPrior(z_m=float(small.PLACES[place][2]), sigma_m=0.05)
    found.sightings[0] = replace(found.sightings[0], floor=floor)
    return found


def cost_of(policy: MixtureIdentities, values: gtsam.Values, choices: Choices) -> float:
    """The error of the graph that was chosen, and logarithms of densities and weights; by scipy."""
    found, sizes = (
        policy.graph(KNOWN, policy.objects, choices).error(values),
        Counter(choices),
    )
    for seen, choice in zip(policy.objects, choices, strict=True):
        weight, none = small.log_weights(seen.posterior.probability, choice or 0)
        if choice is None:
            found -= none + small.LOG_U
        elif sizes[choice] == 1:  # its landmark is where it says: of unknown place
            found -= weight + small.LOG_U
        else:
            R = seen.sightings[0].noise
            found -= weight + float(
                multivariate_normal.logpdf(np.zeros(2), np.zeros(2), R)
            )
    return float(found)


@pytest.mark.parametrize(
    "said",
    [[7, 4, 7, 4, 7, 4], [7, 4, 4, 4, 7, 4], [7, 4, 7, 7, 7, 4], [7, 4, 4, 7, 7, 4]],
    ids=["right", "a wrong 4", "a wrong 7", "exchanged"],
)
def test_the_choices_that_settle_are_the_cheapest_of_all(said: list[int]) -> None:
    """Three sightings of each of two landmarks, from nothing: each begins with one, and gets the others then."""
    places = [7, 4, 7, 4, 7, 4]
    smoother = smoother_with()
    for k, pose in enumerate(POSES):
        smoother.add_pose(X(k), pose, float(k))
        smoother.add({"prior": KNOWN.at(k)})
    smoother.update(5.0)
    landmarks = LandmarkGraph(
        smoother,
        SightingFactors(SonarCalibration(elevation_aperture_rad=0.3), plain),
        AmendableJournal(),
    )
    policy = MixtureIdentities(landmarks, MixtureIdentity(), GAUSSIAN)
    stated = enumerate(zip(places, said, strict=True))
    policy.objects += [
        named(k, place, name, small.world()) for k, (place, name) in stated
    ]
    found = policy.history()
    assert found.choices == places
    others = [list(c) for c in product(IDS, repeat=6) if list(c) != places]
    rng, start = np.random.default_rng(0), smoother.values
    for other in [others[k] for k in rng.choice(len(others), 60, replace=False)]:
        worse = policy.solution(KNOWN, policy.objects, start, other)
        assert (
            cost_of(policy, worse, other) > cost_of(policy, found.values, places) + 1.0
        )


@pytest.mark.parametrize("rivals", [1, 2])
def test_far_landmarks_that_are_not_named_change_no_choice(rivals: int, monkeypatch):
    """Of a map of more than `MOST_RIVALS` landmarks only the nearest are compared; here of three, one or two."""
    world, settings = (
        misnamed_world(),
        {"identity.policy": "max-mixture", "identity.wrong_id_probability": 0.2},
    )
    whole = run_estimator(world, "isam2", settings)
    monkeypatch.setattr(doubtful_identities, "MOST_RIVALS", rivals)
    judged = counted(monkeypatch, MixtureIdentities, "judge")
    nearest = run_estimator(world, "isam2", settings)
    assert any(len(seen.keys) < len(policy.landmarks.ids) for policy, seen in judged), (
        "no landmark was left out"
    )
    np.testing.assert_allclose(
        nearest.causal.positions, whole.causal.positions, atol=1e-9
    )
    assert nearest.landmarks.ids.tolist() == whole.landmarks.ids.tolist()
