from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

from sonar_graph.errors import EstimatorError, EvaluationError, UnknownEstimatorError
from sonar_graph.evaluation.comparison import compare
from sonar_graph.evaluation.results import RunResult
from sonar_graph.evaluation.run import run_estimator
from sonar_graph.evaluation.scores import detection_scores, resource_scores
from sonar_graph.measurements import Measurements
from sonar_graph.states import DetectionLog, Estimate, Outcome, Trajectory

from .conftest import Offset, straight_sequence

TRAJECTORY_KEYS = {
    *("ate_raw_m", "ate_yaw_m", "ate_se2_m", "ate_se3_m", "rpe_1s_m", "rpe_1s_rad", "rpe_10s_m", "rpe_10s_rad"),
    *("yaw_rmse_rad", "return_error_m", "nees_position", "nees_yaw"),
}
OTHER_KEYS = {
    *("landmarks.raw_m", "landmarks.se2_m", "landmarks.count", "landmarks.nees"),
    *("detections.used", "detections.refused", "detections.unnamed", "detections.nis"),
    *("time.update_median_ms", "time.update_p99_ms", "time.update_max_ms", "time.total_s", "time.real_time_factor"),
}


def test_scores_of_a_constant_offset_by_hand_each_with_unit_and_protocol(install):
    scores = compare(straight_sequence(), ["offset"], {"offset": {"offset_m": 0.4, "sigma_m": 0.1}}).scores["offset"]
    value = {key: score.value for key, score in scores.items()}
    assert value["causal.ate_raw_m"] == pytest.approx(0.4)
    assert value["smoothed.ate_raw_m"] == pytest.approx(0.2)
    for key in ("ate_yaw_m", "ate_se2_m", "ate_se3_m", "rpe_1s_m", "rpe_10s_m", "yaw_rmse_rad", "return_error_m"):
        assert value[f"causal.{key}"] == pytest.approx(0.0, abs=1e-9)
    assert value["causal.nees_position"] == pytest.approx(0.4**2 / 0.1**2 / 2)
    assert value["smoothed.nees_position"] == pytest.approx(0.2**2 / 0.1**2 / 2)
    assert value["landmarks.raw_m"] == pytest.approx(0.1)
    assert value["landmarks.se2_m"] == pytest.approx(0.0, abs=1e-12)
    assert value["landmarks.count"] == 3
    assert value["landmarks.nees"] == pytest.approx(0.1**2 / 0.01 / 2)
    assert (value["detections.used"], value["detections.refused"]) == (3, 1)
    assert value["detections.nis"] == pytest.approx((4.0 + 1.0) / 2 / 2)
    expected = {f"{kind}.{key}" for kind in ("causal", "smoothed") for key in TRAJECTORY_KEYS} | OTHER_KEYS
    assert set(scores) - {"memory.peak_mb"} == expected
    for key, score in scores.items():
        assert np.isfinite(score.value), key
        assert score.unit, key
        assert score.protocol.endswith("."), key
        assert ".." not in score.protocol, key
        assert score.protocol[0].isupper() or score.protocol[0].isdigit(), key
    assert "40 of 40 instants" in scores["causal.ate_se2_m"].protocol
    assert "SE(2)" in scores["causal.ate_se2_m"].protocol
    assert scores["smoothed.ate_raw_m"].protocol.startswith("Smoothed")


def test_truth_with_positions_only_scores_positions_alone(install):
    """Nothing that needs a true orientation is scored, drawn or summed up; what is scored has the same value."""
    whole = straight_sequence()
    positions = replace(whole, truth=Trajectory.of_positions(whole.truth.stamps_ns, whole.truth.positions))
    settings = {"offset": {"offset_m": 0.4, "sigma_m": 0.1}}
    full, partial = (compare(sequence, ["offset"], settings) for sequence in (whole, positions))
    lacking = {
        f"{kind}.{key}"
        for kind in ("causal", "smoothed")
        for key in ("yaw_rmse_rad", "nees_yaw", "rpe_1s_m", "rpe_10s_m", "rpe_1s_rad", "rpe_10s_rad")
    }
    scores = partial.scores["offset"]
    assert full.scores["offset"].keys() - {"memory.peak_mb"} - scores.keys() == lacking
    for key, score in scores.items():
        if not key.startswith(("time", "memory")):
            assert score.value == full.scores["offset"][key].value, key
    assert np.isnan(partial.errors["offset"]["causal"].yaw_rad).all()


def test_ignored_detections_are_neither_used_nor_refused():
    n = 3
    unpredicted = (np.full((n, 2), np.nan), np.full((n, 2, 2), np.nan))
    log = DetectionLog(np.arange(n), np.ones(n, int), *unpredicted, [Outcome.IGNORED] * 2 + [Outcome.NO_IDENTITY])
    scores = detection_scores(log)
    kinds = ("used", "refused", "unnamed")
    assert [scores[f"detections.{kind}"].value for kind in kinds] == [0, 0, 1]
    assert "of 3, 2 of which" in scores["detections.refused"].protocol
    assert "detections.nis" not in scores


def test_only_independent_samples_get_a_band_and_spatial_runs_score_height_too(install):
    comparison = compare(straight_sequence(planar=False), ["offset"])
    scores = comparison.scores["offset"]
    assert comparison.errors["offset"]["causal"].position_dof == 3
    assert scores["causal.nees_position"].value == pytest.approx(1 / 3)
    assert scores["causal.nees_position"].interval is None
    assert "correlated" in scores["causal.nees_position"].protocol
    assert scores["detections.nis"].interval == pytest.approx(tuple(chi2.ppf([0.025, 0.975], 4) / 4))


def test_all_are_scored_at_the_instants_that_all_have(install):
    class Late(Offset):
        def process(self, measurements: Measurements) -> Estimate | None:
            return None if measurements.end_ns < 4_000_000_000 else super().process(measurements)

    install(late=Late)
    comparison = compare(straight_sequence(), ["offset", "late"])
    for name in ("offset", "late"):
        assert comparison.errors[name]["causal"].stamps_ns[0] == 4_000_000_000
        assert "5 without an estimate" in comparison.scores[name]["causal.ate_raw_m"].protocol
    assert len(comparison.runs[0].causal or ()) == 40


def test_a_failed_run_is_a_row_and_does_not_disturb_the_others(install):
    together, alone = compare(straight_sequence(), ["broken", "offset"]), compare(straight_sequence(), ["offset"])
    assert [(run.estimator, run.status) for run in together.runs] == [("broken", "failed"), ("offset", "ok")]
    assert together.scores["broken"] == {}
    assert together.errors["broken"] == {}
    assert together.scores["offset"]["causal.ate_raw_m"] == alone.scores["offset"]["causal.ate_raw_m"]


def test_without_truth_or_with_too_little_the_rest_is_scored_and_it_is_said(install):
    comparison = compare(straight_sequence(truth=False), ["offset"])
    keys = set(comparison.scores["offset"])
    assert not any(key.startswith(("causal.", "smoothed.")) for key in keys)
    assert {"landmarks.count", "detections.used", "time.total_s"} <= keys
    assert "landmarks.raw_m" not in keys
    assert comparison.errors == {}
    assert "no truth" in comparison.environment["scored instants"]
    sequence = straight_sequence()
    comparison = compare(replace(sequence, truth=sequence.truth.rows(slice(0, 7))), ["offset"])
    assert comparison.errors == {}, "one instant is too little"
    assert comparison.environment["scored instants"].startswith("1 of 40 instants")


def test_an_estimator_without_covariances_has_errors_but_no_nees(install):
    class Modest(Offset):
        def beside(self, stamp_ns: int, offset_m: float) -> Estimate:
            return replace(super().beside(stamp_ns, offset_m), covariance=np.full((6, 6), np.nan))

    install(modest=Modest)
    scores = compare(straight_sequence(), ["modest"]).scores["modest"]
    assert "causal.ate_raw_m" in scores
    assert "causal.nees_position" not in scores


@pytest.mark.parametrize(
    ("arguments", "error", "said"),
    [
        (([],), EvaluationError, "no estimator"),
        ((["offset", "offset"],), EvaluationError, "more than once: offset"),
        ((["offset"], {"ekf": {}}), EvaluationError, "settings for ekf"),
        ((["offset", "nobody"],), UnknownEstimatorError, "nobody"),
        ((["offset"], {"offset": {"colour": 1}}), EstimatorError, "colour"),
        (("offset",), TypeError, r"names is a list: give \['offset'\]"),
    ],
)
def test_mistakes_of_the_user_are_raised_before_anything_runs(install, arguments, error, said):
    calls: list[Any] = []
    with pytest.raises(error, match=said):
        compare(straight_sequence(), *arguments, progress=lambda *call: calls.append(call))
    assert calls == []
    for call in (lambda log: compare(log, ["offset"]), lambda log: run_estimator(log, "offset")):
        with pytest.raises(TypeError, match="expected a Sequence, not str; read_log gives one"):
            call("dive.mcap")


def test_times_by_hand():
    run = RunResult("by hand", {}, "ok", update_s=np.array([0.001, 0.002, 0.003, 0.010]), finish_s=0.984)
    value = {key: score.value for key, score in resource_scores(run, log_s=50.0).items()}
    assert value["time.update_median_ms"] == pytest.approx(2.5)
    assert value["time.update_p99_ms"] == pytest.approx(3.0 + 0.97 * 7.0)
    assert value["time.update_max_ms"] == pytest.approx(10.0)
    assert value["time.total_s"] == pytest.approx(1.0)
    assert value["time.real_time_factor"] == pytest.approx(50.0)
    assert "memory.peak_mb" not in value


def test_progress_names_the_estimator_and_the_environment_versions_machine_date_and_command(install):
    install(one=Offset, two=Offset)
    calls: list[tuple[str, int, int]] = []
    comparison = compare(straight_sequence(2.0), ["one", "two"], rate_hz=1.0, progress=lambda *call: calls.append(call))
    assert calls == [("one", 1, 2), ("one", 2, 2), ("two", 1, 2), ("two", 2, 2)]
    expected = {"sonar_graph", "python", "numpy", "gtsam", "machine", "date", "command"}
    assert expected <= set(comparison.environment)
    assert comparison.environment["numpy"] == np.__version__
