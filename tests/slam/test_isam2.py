"""The estimator against its batch solution, on the basin, on MRCLAM and on faulty streams; its settings."""

from dataclasses import replace
from functools import cache, partial
from itertools import product
from typing import Any

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L
from scipy.stats import chi2

from sonar_graph.errors import CalibrationError, EstimatorError
from sonar_graph.estimator import load_estimator, make_params, newest_landmarks_of
from sonar_graph.evaluation.consistency import normalised_squares
from sonar_graph.logs.convert.mrclam import read_mrclam
from sonar_graph.measurements import NS_PER_S, Floats, LandmarkDetections, Measurements
from sonar_graph.navigation import Odometry
from sonar_graph.sequence import Sequence
from sonar_graph.settings import nested, settings_of
from sonar_graph.simulation.basin import BasinOptions, simulate_basin
from sonar_graph.slam import Isam2, Isam2Params
from sonar_graph.states import Estimate, Outcome
from sonar_graph.testing import check_consistent, laws
from sonar_graph.testing.drives import misnamed_world, small_world, still_world
from sonar_graph.testing.laws import unlike

from .graphs import gtsams_solution
from .made import isam2_params, ran

BASIN_S = 130.0


@pytest.fixture(scope="module")
def basin() -> Sequence:
    return simulate_basin(BasinOptions(duration_s=BASIN_S, laps=1, seed=3))


def same(one: Estimate, other: Estimate) -> bool:
    return (
        one.stamp_ns == other.stamp_ns
        and np.array_equal(one.world_T_body.matrix(), other.world_T_body.matrix())
        and np.array_equal(one.covariance, other.covariance)
    )


def until(sequence: Sequence, end_ns: int) -> Sequence:
    """The log, had it been cut off there."""
    blocks = {
        name: getattr(sequence, name) for name in ("imu", "dvl", "depth", "detections")
    }
    return replace(
        sequence,
        **{
            name: rows.between(0, end_ns)
            for name, rows in blocks.items()
            if rows is not None
        },
    )


def assert_is_batch(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> None:
    """Cost within 1 % and poses within 1 cm of Levenberg-Marquardt on the identical factors."""
    batch = gtsams_solution(graph, values, 1e-9)
    assert graph.error(batch) <= graph.error(values) * (1 + 1e-9)
    assert graph.error(values) == pytest.approx(graph.error(batch), rel=0.01)
    for key in poses_in(values):
        assert (
            np.linalg.norm(
                values.atPose3(key).translation() - batch.atPose3(key).translation()
            )
            < 0.01
        )


def poses_in(values: gtsam.Values) -> list[int]:
    return [key for key in list(values.keys()) if gtsam.Symbol(key).chr() == ord("x")]


PRECISE = {"smoother__lag_s": 1e6, "smoother__waiting_gain": 0.0}


@pytest.mark.parametrize("kernel", ["none", "huber", "cauchy"])
@pytest.mark.parametrize("bias", [0.0, 1.0])
def test_incremental_equals_batch_in_the_basin(kernel, bias):
    """iSAM2's own estimate, when it keeps all poses and relinearises what moved by a tenth of a milliradian."""
    sequence = simulate_basin(
        BasinOptions(duration_s=BASIN_S, laps=1, seed=3, gyro_bias_scale=bias)
    )
    estimator, _ = ran(
        sequence, **PRECISE, kernel__shape=kernel, smoother__relinearize_threshold=1e-4
    )
    assert len(poses_in(estimator.values)) > 20
    assert_is_batch(estimator.graph, estimator.values)


@pytest.mark.recording
def test_incremental_equals_batch_on_mrclam(unpacked):
    folder = next(unpacked("mrclam_ds6.tar.xz").rglob("Barcodes.dat")).parent
    whole = read_mrclam(folder, 1)
    sequence = until(whole, whole.start_ns + 300 * NS_PER_S)
    estimator, _ = ran(sequence, **PRECISE, smoother__relinearize_threshold=1e-3)
    assert len(poses_in(estimator.values)) > 100
    assert_is_batch(estimator.graph, estimator.values)


def test_the_final_answer_is_the_batch_solution(basin):
    """Trajectory and landmarks with the default settings; the instants asked for are the keyframes' and others."""
    estimator, _ = ran(basin, 7.0)
    before = gtsam.Values(estimator.values)
    batch = gtsams_solution(estimator.graph, before, 1e-9)
    found, smoothed = estimator.landmarks(), estimator.trajectory()
    for landmark_id, position in zip(found.ids.tolist(), found.positions, strict=True):
        assert position == pytest.approx(batch.atPoint3(L(landmark_id)), abs=1e-3)
    batch_positions = np.array(
        [batch.atPose3(key).translation() for key in poses_in(batch)[1:]]
    )
    nearest = np.min(
        np.linalg.norm(smoothed.positions[None] - batch_positions[:, None], axis=2),
        axis=1,
    )
    assert np.median(nearest) < 1e-3
    assert estimator.values.equals(before, 0.0)


@pytest.mark.parametrize("cut_s", [17.3, 64.0])
def test_nothing_peeks_ahead(basin, cut_s):
    """Estimates until t are the same, to the bit, from a log that ends at t."""
    end_ns = basin.start_ns + round(cut_s * NS_PER_S)
    whole, cut = (ran(s)[1] for s in (basin, until(basin, end_ns)))
    assert len(cut) > 25
    assert all(same(a, b) for a, b in zip(whole, cut[:-1], strict=False))


def test_refused_detections_leave_everything_as_it_is():
    sequence = small_world()
    rows = sequence.detections
    doubtful = replace(rows, id_probability=0.1 * rows.id_probability)
    (refusing, refused), (blind, plain) = (
        ran(replace(sequence, detections=rows)) for rows in (doubtful, None)
    )
    assert refusing.detections().outcomes == [Outcome.NO_IDENTITY] * len(rows)
    assert refusing.graph.size() == blind.graph.size()
    assert all(same(a, b) for a, b in zip(refused, plain, strict=True))


def position_nees(sequence: Sequence, estimates: list[Estimate]) -> Floats:
    truth = sequence.truth.at(np.array([e.stamp_ns for e in estimates]))
    off = np.array([e.world_T_body.translation() for e in estimates]) - truth.positions
    rotations = [e.world_T_body.rotation().matrix() for e in estimates]
    covs = [
        R @ e.covariance[3:, 3:] @ R.T
        for R, e in zip(rotations, estimates, strict=True)
    ]
    return normalised_squares(off, np.array(covs))


def test_a_vehicle_stays_within_its_doubt_which_at_rest_is_the_random_walk_of_the_log():
    """A velocity of 1 cm/s at 5 Hz wanders by 1 cm/s x sqrt(0.2 s x 60 s) on each axis; depth holds the height."""
    world = small_world()
    assert position_nees(world, ran(world)[1]).max() < chi2.ppf(0.9999, 3)
    last = ran(still_world())[1][-1]
    R = last.world_T_body.rotation().matrix()
    sigmas = np.sqrt(np.diag(R @ last.covariance[3:, 3:] @ R.T))
    assert sigmas[:2] == pytest.approx([0.01 * np.sqrt(0.2 * 60)] * 2, rel=0.03)
    assert sigmas[2] < 0.01


@pytest.mark.slow
def test_twenty_basins_are_consistent():
    """Two-sided 99.9 % band of the mean over independent runs at the end of each, three degrees of freedom."""
    last = []
    for seed in range(20):
        sequence = simulate_basin(
            BasinOptions(duration_s=300.0, laps=1, seed=seed, gyro_bias_scale=0.0)
        )
        last.append(position_nees(sequence, ran(sequence, 1.0)[1])[-1])
    check_consistent(last, 3, confidence=0.999)


def test_time_does_not_go_back(basin):
    """The same instant again is the same estimate and one row of the trajectory; an earlier one gets none."""
    estimator, instants = (
        Isam2(basin.calibration, Odometry(basin.calibration)),
        basin.instants(1.0)[:20],
    )
    first = [estimator.process(m) for m in basin.replay(instants)][-1]
    again = estimator.process(Measurements(int(instants[-1])))
    assert again.world_T_body.equals(first.world_T_body, 1e-12)
    assert estimator.process(Measurements(int(instants[5]))) is None
    assert estimator.trajectory().stamps_ns.tolist() == instants.tolist()


@pytest.mark.parametrize(
    ("section", "name"), [("imu", "gyro_noise_density"), ("start", "position_sigma_m")]
)
def test_noise_of_zero_is_refused_by_name(basin, section, name):
    part = getattr(basin.calibration, section)
    zero = 0.0 if section == "imu" else (0.0, 0.0, 0.0)
    calibration = basin.calibration.model_copy(
        update={section: part.model_copy(update={name: zero})}
    )
    with pytest.raises(CalibrationError, match=f"{section}.{name}"):
        Isam2(calibration, Odometry(calibration))


LAG_S = 3.0
"""Much less than the worlds last: what is wrong leaves the window before it is known to be."""
IN_THE_GRAPH = {Outcome.NEW, Outcome.USED, Outcome.USED_LATER, Outcome.REASSIGNED}
QUICK = ["max-mixture whole ignore", "robust bounded associate", "robust whole ignore"]
ALL = [
    " ".join(of)
    for of in product(("gate", "robust"), ("whole", "bounded"), ("ignore", "associate"))
]
SLOW = [
    pytest.param(chosen, marks=pytest.mark.slow)
    for chosen in ALL
    if chosen not in QUICK
]


def settings(policy: str, history: str, unknown_landmarks: str) -> Any:
    unknown = (
        {"identity__unknown__policy": "associate"}
        if unknown_landmarks == "associate"
        else {}
    )
    return isam2_params(
        identity__policy=policy,
        history__policy=history,
        smoother__lag_s=LAG_S,
        **unknown,
    )


@pytest.mark.parametrize("chosen", [*QUICK, *SLOW])
def test_asking_changes_nothing(chosen: str) -> None:
    laws.asking_changes_nothing(partial(Isam2, params=settings(*chosen.split())))


def test_landmarks_list_and_covariances_are_of_one_choice() -> None:
    world = misnamed_world()
    estimator = Isam2(
        world.calibration,
        Odometry(world.calibration),
        settings("max-mixture", "whole", "ignore"),
    )
    differing = []
    for step in world.replay(world.instants(1.0)):
        estimator.process(step)
        found, log = estimator.landmarks(), estimator.detections()
        used = [
            i
            for i, said in zip(log.landmark_ids.tolist(), log.outcomes, strict=True)
            if said in IN_THE_GRAPH
        ]
        assert set(used) == set(found.ids.tolist())
        for landmark_id, cov in zip(found.ids.tolist(), found.covariances, strict=True):
            np.testing.assert_array_equal(
                estimator.marginal(landmark=landmark_id, over="history"), cov
            )
        window = [
            estimator.values.atPoint3(L(i))
            for i in found.ids.tolist()
            if estimator.values.exists(L(i))
        ]
        if len(window) == len(found) > 0:
            differing.append(not np.allclose(window, found.positions, atol=0.1))
    assert any(differing), "else it is not seen which is asked"


def test_the_newest_landmarks_are_those_of_the_window_and_within_their_doubt_of_the_solution(
    basin,
) -> None:
    """For a live run, whose map must not wait for the solution of the whole graph; asking leaves no trace."""
    estimator, _ = ran(basin, 7.0)
    newest, solved = estimator.newest_landmarks(), estimator.landmarks()
    np.testing.assert_array_equal(newest.ids, solved.ids)
    assert len(newest) == 4
    for landmark_id, position, cov in zip(
        newest.ids.tolist(), newest.positions, newest.covariances, strict=True
    ):
        np.testing.assert_array_equal(
            position, estimator.values.atPoint3(L(landmark_id))
        )
        np.testing.assert_allclose(
            cov, estimator.marginal(landmark=landmark_id, over="window"), rtol=1e-9
        )
    off = newest.positions - solved.positions
    nees = np.einsum("ni,nij,nj->n", off, np.linalg.inv(newest.covariances), off)
    assert nees.max() < 1.0
    ratio = np.trace(newest.covariances, axis1=1, axis2=2) / np.trace(
        solved.covariances, axis1=1, axis2=2
    )
    assert ((ratio > 0.8) & (ratio < 1.25)).all()
    assert (
        estimator.newest_landmarks().positions.tobytes() == newest.positions.tobytes()
    )


def test_estimators_without_a_quick_map_give_the_whole_one(basin) -> None:
    kind = load_estimator("ekf-slam")
    estimator = kind(basin.calibration, Odometry(basin.calibration))
    for step in basin.replay(basin.instants(1.0)):
        estimator.process(step)
    assert (
        newest_landmarks_of(estimator).positions.tobytes()
        == estimator.landmarks().positions.tobytes()
    )


LANDMARK, BEFORE = 2, 1


@cache
def basin_of_first_sightings() -> Sequence:
    return simulate_basin(BasinOptions(seed=2, duration_s=130.0, laps=1))


def sightings_of(landmark: int) -> list[int]:
    ids, posterior = basin_of_first_sightings().detections.most_probable()
    return np.flatnonzero((ids == landmark) & (posterior > 0.7)).tolist()


def named_wrongly() -> LandmarkDetections:
    """One sighting of the landmark before, called by the name of one that has not been seen yet."""
    detections, row = basin_of_first_sightings().detections, sightings_of(BEFORE)[5]
    ids = detections.candidate_ids.copy()
    ids[row] = np.select(
        [ids[row] == BEFORE, ids[row] == LANDMARK], [LANDMARK, BEFORE], ids[row]
    )
    return replace(detections, candidate_ids=ids)


def ranged_wrongly(by_m: float) -> LandmarkDetections:
    """The first of the landmark's sightings is too long."""
    detections = basin_of_first_sightings().detections
    is_first = np.arange(len(detections)) == sightings_of(LANDMARK)[0]
    return replace(detections, range_m=detections.range_m + by_m * is_first)


def error_and_sigma_m(
    detections: LandmarkDetections, **settings: str
) -> tuple[float, float]:
    """Of the landmark at the end: how far it is from where it lies, horizontally, and what is said of that."""
    sequence = replace(basin_of_first_sightings(), detections=detections)
    found, true = ran(sequence, 1.0, **settings)[0].landmarks(), sequence.true_landmarks
    at, truly = (
        int(np.argmax(found.ids == LANDMARK)),
        int(np.argmax(true.ids == LANDMARK)),
    )
    offset = (found.positions[at] - true.positions[truly])[:2]
    return float(np.linalg.norm(offset)), float(
        np.sqrt(np.trace(found.covariances[at][:2, :2]))
    )


def test_a_whole_history_takes_a_wrong_first_identity_back_and_a_bounded_one_keeps_it_and_is_sure():
    whole_m, _ = error_and_sigma_m(named_wrongly(), history__policy="whole")
    bounded_m, sigma_m = error_and_sigma_m(named_wrongly(), history__policy="bounded")
    assert whole_m < 0.05
    assert bounded_m == pytest.approx(5.4, abs=0.2)
    assert sigma_m < 0.06


@pytest.mark.parametrize("by_m", [1.0, 3.0, 30.0])
def test_twenty_two_right_sightings_outvote_a_first_range_however_wrong_it_is(
    by_m: float,
):
    """From three metres on what they say has no pull, and the landmark begins anew (`misplaced`)."""
    assert len(sightings_of(LANDMARK)) == 23
    assert error_and_sigma_m(ranged_wrongly(by_m))[0] < 0.05


def test_answers_that_differ_in_one_bit_are_unlike() -> None:
    one, other = (
        laws.run(partial(Isam2, params=isam2_params()), small_world()) for _ in range(2)
    )
    assert unlike(one, other) == []
    other.trajectory.positions[3, 1] += 1e-15
    other.landmarks.covariances[0, 0, 0] *= 1 + 1e-15
    other.detections.outcomes[0] = other.detections.outcomes[-1]
    assert unlike(one, other) == ["trajectory()", "landmarks()", "detections()"]
    del other.estimates[-1]
    assert "causal estimates" in unlike(one, other)


REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "gate without its policy": (
        {"identity.gate_probability": 0.9},
        'identity.gate_probability: there is no such field with policy = "robust"; identity.policy = "gate" has it',
    ),
    "mixture without its policy": (
        {"identity.view_range_m": 5.0},
        'policy = "max-mixture" has it',
    ),
    "unknown landmarks in a mixture": (
        {"identity.policy": "max-mixture", "identity.unknown.policy": "associate"},
        'no such field with policy = "max-mixture"; identity.policy = "robust" or "gate" has it',
    ),
    "association without its policy": (
        {"identity.unknown.sightings": 3},
        'identity.unknown.policy = "associate" has',
    ),
    "belief in a mixture": (
        {"identity.policy": "max-mixture", "identity.minimum_probability": 0.9},
        '"gate" has it',
    ),
    "memory of a whole history": (
        {"history.remembered_s": 30.0},
        'history.policy = "bounded" has it',
    ),
    "width of no kernel": (
        {"kernel.shape": "none", "kernel.width": 2.0},
        'kernel.shape = "huber" or "cauchy" has it',
    ),
    "mixture in a bounded history": (
        {"identity.policy": "max-mixture", "history.policy": "bounded"},
        'history.policy = "bounded" cannot be with identity.policy = "max-mixture", which chooses anew in the whole',
    ),
    "a mixture in a bounded history": (
        {"identity.policy": "max-mixture", "history.policy": "bounded"},
        'policy = "max-mixture", which',
    ),
    "no such policy": (
        {"identity.policy": "gcn"},
        "identity.policy: there is no 'gcn'; there are: robust, gate, max-",
    ),
    "a policy for its section": (
        {"identity": "gate"},
        'identity: expected a section with policy = "gate"',
    ),
    "no such section": (
        {"smother.lag_s": 3},
        "smother: there is no such field; did you mean smoother?",
    ),
    "no such setting": (
        {"smoother": {"lag": 3}},
        "smoother.lag: there is no such field; did you mean lag_s? smoother has",
    ),
    "its section is missing": (
        {"unknown.density_m2": 1, "lag_s": 20},
        "lag_s: there is no such field; did you mean smoother.lag_s? it has: keyframes, smoother, history, kernel",
    ),
    "out of range": (
        {"identity.policy": "gate", "identity.gate_probability": 2},
        "identity.gate_probability: expected a number",
    ),
}


@pytest.mark.parametrize(("given", "fault"), REFUSED.values(), ids=REFUSED)
def test_what_a_policy_does_not_read_is_refused_by_name(
    given: dict[str, Any], fault: str
) -> None:
    with pytest.raises(EstimatorError) as refused:
        make_params(Isam2, given, "isam2")
    assert fault in str(refused.value)


def test_a_section_keeps_its_default_policy_where_none_is_given() -> None:
    params = Isam2Params(
        **nested({"identity.longest_wait_s": 3.0, "kernel.width": 2.0})
    )
    assert params.identity.policy == "robust"
    assert params.identity.longest_wait_s == 3.0
    assert params.model_dump()["kernel"] == {"shape": "cauchy", "width": 2.0}
    assert Isam2Params(**params.model_dump(mode="json")) == params


def test_the_listing_has_every_setting_once_with_its_policy() -> None:
    listed = {setting.name: setting for setting in settings_of(Isam2Params)}
    assert len(listed) == len(settings_of(Isam2Params)) == 24
    assert listed["smoother.lag_s"].default == 15.0
    assert listed["identity.policy"].default == "robust"
    assert listed["identity.gate_probability"].meaning.endswith(
        'Only with policy = "gate".'
    )
    assert listed["identity.minimum_probability"].meaning.endswith(
        'Only with policy = "robust" or "gate".'
    )
