"""The estimator against its batch solution, on the basin, on MRCLAM and on faulty streams."""

from dataclasses import replace
from functools import cache, partial
from itertools import product
from typing import Any

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L
from scipy.stats import chi2

from sonar_graph.errors import CalibrationError
from sonar_graph.evaluation.consistency import normalised_squares
from sonar_graph.logs.convert.mrclam import read_mrclam
from sonar_graph.measurements import Depth, Dvl, Floats, Imu, LandmarkDetections, Measurements
from sonar_graph.sequence import NS_PER_S, Sequence
from sonar_graph.simulation.basin import BasinOptions, simulate_basin
from sonar_graph.slam import Isam2
from sonar_graph.states import Estimate, Outcome
from sonar_graph.testing import check_consistent, laws
from sonar_graph.testing.drives import misnamed_world, small_world, still_world
from sonar_graph.testing.laws import unlike

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
    return replace(
        sequence,
        imu=sequence.imu.between(0, end_ns),
        dvl=sequence.dvl.between(0, end_ns),
        depth=sequence.depth.between(0, end_ns) if sequence.depth else None,
        detections=sequence.detections.between(0, end_ns) if sequence.detections else None,
    )


# At rest ------------------------------------------------------------------------------------------------------------


def noisy(sequence: Sequence, seed: int) -> Sequence:
    """The same with the noise that its calibration states."""
    rng, c = np.random.default_rng(seed), sequence.calibration
    imu_hz = NS_PER_S / np.diff(sequence.imu.stamps_ns)[0]

    def scatter(values: Floats, sigma) -> Floats:
        return values + sigma * rng.standard_normal(values.shape)

    rate = scatter(sequence.imu.angular_velocity, c.imu.gyro_noise_density * np.sqrt(imu_hz))
    force = scatter(sequence.imu.specific_force, c.imu.accel_noise_density * np.sqrt(imu_hz))
    velocity = scatter(sequence.dvl.velocity, np.array(c.dvl.velocity_sigma_m_s))
    return replace(
        sequence,
        imu=Imu(sequence.imu.stamps_ns, rate, force),
        dvl=Dvl(sequence.dvl.stamps_ns, velocity, sequence.dvl.velocity_cov),
        depth=Depth(sequence.depth.stamps_ns, scatter(sequence.depth.z_m, c.depth.sigma_m), sequence.depth.variance_m2),
    )


@pytest.mark.parametrize("seed", range(3))
def test_a_still_vehicle_with_noise_stays_within_its_doubt(seed):
    """A velocity of 1 cm/s at 5 Hz wanders by 1 cm/s x sqrt(0.2 s x 60 s) on each axis, and the filter knows it."""
    sequence = noisy(still_world(), seed)
    start = sequence.calibration.start.pose()
    _, estimates = ran(sequence)
    for estimate in estimates:
        off = gtsam.Pose3.Logmap(start.between(estimate.world_T_body))
        assert np.linalg.norm(off[:3]) < 0.01
        assert off @ np.linalg.solve(estimate.covariance, off) < chi2.ppf(0.9999, 6)
    R = estimates[-1].world_T_body.rotation().matrix()
    sigmas = np.sqrt(np.diag(R @ estimates[-1].covariance[3:, 3:] @ R.T))
    assert sigmas[:2] == pytest.approx([0.01 * np.sqrt(0.2 * 60)] * 2, rel=0.03)
    assert sigmas[2] < 0.01


# Against batch ------------------------------------------------------------------------------------------------------


def batch_solution(graph: gtsam.NonlinearFactorGraph, initial: gtsam.Values) -> gtsam.Values:
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(1e-9)
    return gtsam.LevenbergMarquardtOptimizer(graph, initial, params).optimize()


def assert_is_batch(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> None:
    """Cost within 1 % and poses within 1 cm of Levenberg-Marquardt on the identical factors."""
    batch = batch_solution(graph, values)
    assert graph.error(batch) <= graph.error(values) * (1 + 1e-9)
    assert graph.error(values) == pytest.approx(graph.error(batch), rel=0.01)
    for key in poses_in(values):
        assert np.linalg.norm(values.atPose3(key).translation() - batch.atPose3(key).translation()) < 0.01


def poses_in(values: gtsam.Values) -> list[int]:
    return [key for key in list(values.keys()) if gtsam.Symbol(key).chr() == ord("x")]


PRECISE = {"smoother__lag_s": 1e6, "smoother__waiting_gain": 0.0}


@pytest.mark.parametrize("kernel", ["none", "huber", "cauchy"])
@pytest.mark.parametrize("bias", [0.0, 1.0])
def test_incremental_equals_batch_in_the_basin(kernel, bias):
    """iSAM2's own estimate, when it keeps all poses and relinearises what moved by a tenth of a milliradian."""
    sequence = simulate_basin(BasinOptions(duration_s=BASIN_S, laps=1, seed=3, gyro_bias_scale=bias))
    estimator, _ = ran(sequence, **PRECISE, kernel__shape=kernel, smoother__relinearize_threshold=1e-4)
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
    batch = batch_solution(estimator.graph, before)
    found, smoothed = estimator.landmarks(), estimator.trajectory()
    for landmark_id, position in zip(found.ids.tolist(), found.positions, strict=True):
        assert position == pytest.approx(batch.atPoint3(L(landmark_id)), abs=1e-3)
    batch_positions = np.array([batch.atPose3(key).translation() for key in poses_in(batch)[1:]])
    nearest = np.min(np.linalg.norm(smoothed.positions[None] - batch_positions[:, None], axis=2), axis=1)
    assert np.median(nearest) < 1e-3
    assert estimator.values.equals(before, 0.0)


# Causality and bookkeeping ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cut_s", [17.3, 64.0])
def test_nothing_peeks_ahead(basin, cut_s):
    """Estimates until t are the same, to the bit, from a log that ends at t."""
    end_ns = basin.start_ns + round(cut_s * NS_PER_S)
    whole, cut = (ran(s)[1] for s in (basin, until(basin, end_ns)))
    assert len(cut) > 25
    assert all(same(a, b) for a, b in zip(whole, cut[:-1], strict=False))


def test_motion_and_depth_that_arrive_early_are_not_used_early():
    """All rows but the detections at once: the estimates are those of rows that come in time."""
    sequence = small_world()
    early = Isam2(sequence.calibration)
    for k, (step, expected) in enumerate(zip(sequence.replay(sequence.instants(2.0)), ran(sequence)[1], strict=True)):
        blocks = (None, None, None) if k else (sequence.imu, sequence.dvl, sequence.depth)
        assert same(expected, early.process(Measurements(step.end_ns, *blocks, step.detections)))


def test_every_detection_has_one_row_in_the_order_of_frames(basin):
    estimator, _ = ran(basin)
    log = estimator.detections()
    seen = basin.detections.between(0, int(log.stamps_ns[-1]))
    assert np.array_equal(log.stamps_ns, seen.stamps_ns)
    rows = list(zip(log.stamps_ns.tolist(), log.landmark_ids.tolist(), strict=True))
    assert sorted(rows) == sorted(zip(seen.stamps_ns.tolist(), seen.most_probable()[0].tolist(), strict=True))
    counts = {outcome: log.outcomes.count(outcome) for outcome in set(log.outcomes)}
    assert counts[Outcome.NEW] == 4
    assert counts[Outcome.USED] > 0.8 * len(log)
    assert counts.get(Outcome.NO_IDENTITY, 0) == int(np.sum(seen.most_probable()[1] < 0.7))


def test_refused_detections_leave_everything_as_it_is():
    sequence = small_world()
    rows = sequence.detections
    doubtful = replace(rows, id_probability=0.1 * rows.id_probability)
    (refusing, refused), (blind, plain) = (ran(replace(sequence, detections=rows)) for rows in (doubtful, None))
    assert refusing.detections().outcomes == [Outcome.NO_IDENTITY] * len(rows)
    assert refusing.graph.size() == blind.graph.size()
    assert all(same(a, b) for a, b in zip(refused, plain, strict=True))


def test_a_detection_far_off_is_gated_and_changes_nothing():
    sequence = small_world()
    last = sequence.detections.rows(slice(len(sequence.detections) - 1, None))
    ghost = replace(
        last,
        stamps_ns=last.stamps_ns + NS_PER_S // 10,
        range_m=last.range_m + 2.0,
        id_probability=last.id_probability * 0 + 1,
    )
    more = replace(sequence, detections=LandmarkDetections.concatenate([sequence.detections, ghost]))
    gated = {"identity__policy": "gate", "identity__gate_probability": 0.999}
    (haunted, ends), (plain, expected) = ran(more, **gated), ran(sequence, **gated)
    assert haunted.detections().outcomes[-1] is Outcome.GATED
    assert np.abs(gtsam.Pose3.Logmap(ends[-1].world_T_body.between(expected[-1].world_T_body))).max() < 1e-3
    assert len(haunted.detections()) == len(plain.detections()) + 1


# Consistency --------------------------------------------------------------------------------------------------------


def position_nees(sequence: Sequence, estimates: list[Estimate]) -> Floats:
    truth = sequence.truth.at(np.array([e.stamp_ns for e in estimates]))
    off = np.array([e.world_T_body.translation() for e in estimates]) - truth.positions
    covs = []
    for e in estimates:
        R = e.world_T_body.rotation().matrix()
        covs.append(R @ e.covariance[3:, 3:] @ R.T)
    return normalised_squares(off, np.array(covs))


@pytest.mark.slow
def test_twenty_basins_are_consistent():
    """Two-sided 99.9 % band of the mean over independent runs at the end of each, three degrees of freedom."""
    last = []
    for seed in range(20):
        sequence = simulate_basin(BasinOptions(duration_s=300.0, laps=1, seed=seed, gyro_bias_scale=0.0))
        last.append(position_nees(sequence, ran(sequence, 1.0)[1])[-1])
    check_consistent(last, 3, confidence=0.999)


def test_time_does_not_go_back(basin):
    """The same instant again is the same estimate and one row of the trajectory; an earlier one gets none."""
    estimator = Isam2(basin.calibration)
    instants = basin.instants(1.0)[:20]
    first = [estimator.process(m) for m in basin.replay(instants)][-1]
    again = estimator.process(Measurements(int(instants[-1])))
    assert again.world_T_body.equals(first.world_T_body, 1e-12)
    assert estimator.process(Measurements(int(instants[5]))) is None
    assert estimator.trajectory().stamps_ns.tolist() == instants.tolist()


@pytest.mark.parametrize(("section", "name"), [("imu", "gyro_noise_density"), ("start", "position_sigma_m")])
def test_noise_of_zero_is_refused_by_name(basin, section, name):
    part = getattr(basin.calibration, section)
    zero = 0.0 if section == "imu" else (0.0, 0.0, 0.0)
    calibration = basin.calibration.model_copy(update={section: part.model_copy(update={name: zero})})
    with pytest.raises(CalibrationError, match=f"{section}.{name}"):
        Isam2(calibration)


LAG_S = 3.0
"""Much less than the worlds last: what is wrong leaves the window before it is known to be."""
IN_THE_GRAPH = {Outcome.NEW, Outcome.USED, Outcome.USED_LATER, Outcome.REASSIGNED}
QUICK = ["max-mixture whole ignore", "gnc whole ignore", "robust bounded associate", "robust whole ignore"]
ALL = [" ".join(of) for of in product(("gate", "robust"), ("whole", "bounded"), ("ignore", "associate"))]
SLOW = [pytest.param(chosen, marks=pytest.mark.slow) for chosen in ALL if chosen not in QUICK]


def settings(policy: str, history: str, unknown_landmarks: str) -> Any:
    unknown = {"identity__unknown__policy": "associate"} if unknown_landmarks == "associate" else {}
    return isam2_params(identity__policy=policy, history__policy=history, smoother__lag_s=LAG_S, **unknown)


@pytest.mark.parametrize("chosen", [*QUICK, *SLOW])
def test_asking_changes_nothing(chosen: str) -> None:
    laws.asking_changes_nothing(partial(Isam2, params=settings(*chosen.split())))


def test_landmarks_list_and_covariances_are_of_one_choice() -> None:
    world = misnamed_world()
    estimator = Isam2(world.calibration, settings("max-mixture", "whole", "ignore"))
    differing = []
    for step in world.replay(world.instants(1.0)):
        estimator.process(step)
        found, log = estimator.landmarks(), estimator.detections()
        used = [i for i, said in zip(log.landmark_ids.tolist(), log.outcomes, strict=True) if said in IN_THE_GRAPH]
        assert set(used) == set(found.ids.tolist())
        for landmark_id, cov in zip(found.ids.tolist(), found.covariances, strict=True):
            np.testing.assert_array_equal(estimator.marginal(landmark=landmark_id, over="history"), cov)
        window = [estimator.values.atPoint3(L(i)) for i in found.ids.tolist() if estimator.values.exists(L(i))]
        if len(window) == len(found) > 0:
            differing.append(not np.allclose(window, found.positions, atol=0.1))
    assert any(differing), "else it is not seen which is asked"


LANDMARK, BEFORE = 2, 1


@cache
def basin_of_first_sightings() -> Sequence:
    return simulate_basin(BasinOptions(seed=2, duration_s=130.0, laps=1))


def sightings_of(landmark: int) -> tuple[LandmarkDetections, list[int]]:
    detections = basin_of_first_sightings().detections
    assert detections is not None
    ids, posterior = detections.most_probable()
    return detections, np.flatnonzero((ids == landmark) & (posterior > 0.7)).tolist()


def named_wrongly() -> LandmarkDetections:
    """One sighting of the landmark before, called by the name of one that has not been seen yet."""
    detections, rows = sightings_of(BEFORE)
    ids = detections.candidate_ids.copy()
    row = ids[rows[5]]
    ids[rows[5]] = np.select([row == BEFORE, row == LANDMARK], [LANDMARK, BEFORE], row)
    return replace(detections, candidate_ids=ids)


def ranged_wrongly(by_m: float) -> LandmarkDetections:
    """The first of the landmark's sightings is too long."""
    detections, rows = sightings_of(LANDMARK)
    range_m = detections.range_m.copy()
    range_m[rows[0]] += by_m
    return replace(detections, range_m=range_m)


def error_and_sigma_m(detections: LandmarkDetections, **settings: str) -> tuple[float, float]:
    """Of the landmark at the end: how far it is from where it lies, horizontally, and what is said of that."""
    sequence = replace(basin_of_first_sightings(), detections=detections)
    estimator, _ = ran(sequence, 1.0, **settings)
    found, true = estimator.landmarks(), sequence.true_landmarks
    assert true is not None
    at, truly = int(np.argmax(found.ids == LANDMARK)), int(np.argmax(true.ids == LANDMARK))
    offset = (found.positions[at] - true.positions[truly])[:2]
    return float(np.linalg.norm(offset)), float(np.sqrt(np.trace(found.covariances[at][:2, :2])))


def test_a_whole_history_takes_a_wrong_first_identity_back_and_a_bounded_one_keeps_it_and_is_sure():
    whole_m, _ = error_and_sigma_m(named_wrongly(), history__policy="whole")
    bounded_m, sigma_m = error_and_sigma_m(named_wrongly(), history__policy="bounded")
    assert whole_m < 0.05
    assert bounded_m == pytest.approx(5.4, abs=0.2)
    assert sigma_m < 0.06


def test_the_kernel_outvotes_a_first_range_that_is_wrong_by_a_metre_but_not_by_three():
    """Although twenty-two right sightings follow: what they say has no pull so far away."""
    assert len(sightings_of(LANDMARK)[1]) == 23
    assert error_and_sigma_m(ranged_wrongly(1.0))[0] < 0.05
    error_m, sigma_m = error_and_sigma_m(ranged_wrongly(3.0))
    assert error_m == pytest.approx(2.6, abs=0.2)
    assert sigma_m < 0.25


def test_answers_that_differ_in_one_bit_are_unlike() -> None:
    one, other = (laws.run(partial(Isam2, params=isam2_params()), small_world()) for _ in range(2))
    assert unlike(one, other) == []
    other.trajectory.positions[3, 1] += 1e-15
    other.landmarks.covariances[0, 0, 0] *= 1 + 1e-15
    other.detections.outcomes[0] = other.detections.outcomes[-1]
    assert unlike(one, other) == ["trajectory()", "landmarks()", "detections()"]
    del other.estimates[-1]
    assert "causal estimates" in unlike(one, other)
