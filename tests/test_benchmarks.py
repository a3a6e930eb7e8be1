"""Every benchmark script runs in its short version and ends in one line of figures; what tables make of failed runs."""

import importlib
import importlib.util
import itertools
import json
import os
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


def run(script: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = {
        key: value for key, value in os.environ.items() if key != "SONAR_GRAPH_DATA"
    }
    command = [sys.executable, str(BENCHMARKS / script), *arguments]
    return subprocess.run(
        command, capture_output=True, text=True, timeout=600, env=environment
    )


def figures(script: str, *arguments: str) -> dict[str, Any]:
    done = run(script, "--quick", *arguments)
    assert done.returncode == 0, done.stderr
    last: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return last


@pytest.mark.slow
def test_what_cannot_be_run_is_one_line_and_exit_code_2(tmp_path):
    for command, told in (
        (("validation/mrclam.py",), "--data"),
        (("validation/mrclam.py", "--data", str(tmp_path)), "--data"),
        (
            ("validation/filter_consistency.py", "--basins", "nominal,deep"),
            "--basins, --estimators: unknown: deep",
        ),
    ):
        done = run(*command)
        assert (done.returncode, done.stdout, len(done.stderr.splitlines())) == (
            2,
            "",
            1,
        )
        assert told in done.stderr


class Quick(NamedTuple):
    """The short version of a script and what its figures must be."""

    arguments: tuple[str, ...] = ()
    names: tuple[str, ...] = ("passed",)
    ratios: tuple[tuple[str, str, str], ...] = ()
    """Figures that are ratios of two others, after these."""
    ascending: tuple[tuple[str | float, ...], ...] = ()
    """Figures and numbers, each above the one before."""


TWO_WORKERS = ("--workers", "2")
NESTED = [
    f"{kind}_{share}"
    for kind in ("detections", "diagnostics", "scans")
    for share in ("ratio", "shared_ratio")
]
# fmt: off
QUICK = {
    "performance/dense_log.py": Quick(  # landmarks known to half a metre are nearer to the batch than a third of that
        names=("max_update_ms", "p99_ms", "finish_s", "landmark_gap_m", "passed"),
        ascending=(("gap_sigmas", 0.3), (0.999, "sigma_ratio", 1.2), ("real_time_ratio", 1.0))),
    "performance/isam2_mission.py": Quick(  # both follow the truth, else their times would compare nothing
        names=("p99_ms", "decile_ratio", "passed"), ratios=(("ours_s", "plain_s", "plain_ratio"),),
        ascending=(("ours_error_m", 0.3), ("plain_error_m", 0.3))),
    "performance/long_mission.py": Quick(
        ("--hours", "0.05"), ("decile_ratio", "max_update_ms", "max_wall_ms", "memory_growth_ratio", "passed"),
        ascending=((0, "max_cpu_ms"), ("causal_error_m", 0.3), ("smoothed_error_m", 0.3))),
    "performance/nested_messages.py": Quick(names=("same", *NESTED)),
    "performance/log_reading.py": Quick(
        names=("agrees",), ratios=(
            ("ours_s", "limit_s", "limit_ratio"), ("rosbags_s", "ours_s", "rosbags_ratio"),
            ("mcap_ros2_s", "ours_s", "mcap_ros2_ratio")),
        ascending=((10, "peak_rss_mb", 150),)),
    "performance/ekf_step.py": Quick(  # a prediction a node is less work than one a sample, and ends in the same state
        names=("log_s", "passed"), ascending=((1, "filterpy_node_ratio", "filterpy_ratio"), ("difference", 1e-9))),
    "validation/mems_vehicle.py": Quick(  # on a short run the noise of the gyros hides little of an unbiased heading
        TWO_WORKERS, ("drawn_isam2_heading_nees", "worst_ratio", "passed"),
        ascending=((10, "drawn_ekf-slam_heading_nees"),)),
    "validation/recognition_scenes.py": Quick(("--workers", "1", "--cases", "0 dB"), ("cases", "passed")),
    "validation/recognition_model.py": Quick(("--workers", "1"), ("anew", "as_shipped", "basins", "passed")),
    "validation/sensor_faults.py": Quick(
        ("--workers", "1", "--only", "mission: (depth|gyro)"), ("cases", "failed", "unnamed", "passed"),
        ascending=((0, "cases"), (-1, "failed", 1))),
    "validation/basin_runs.py": Quick(TWO_WORKERS, names=("causal_m", "passed")),
    "validation/batch_gate.py": Quick(
        ("--workers", "1"), ("told_power_median", "power_20_percent_20_seeds", "false_alarms_allowed", "passed"),
        ascending=((0, "power_50_percent_3_seeds"),)),
    "validation/victoria_park.py": Quick(  # the other reading of the file's noise is another problem: it is told apart
        TWO_WORKERS, ascending=(
            (0.995, "cost_ratio", 1.005), ("landmark_rms_difference_m", 0.05), (1.015, "file_noise_cost_ratio"))),
}
# fmt: on


@pytest.mark.slow
@pytest.mark.parametrize("script", QUICK)
def test_a_script_names_its_figures(script):
    arguments, names, ratios, ascending = QUICK[script]
    found = figures(script, *arguments)
    assert set(names) <= set(found)
    assert all(found.get(name, True) for name in ("same", "agrees"))
    for above, below, name in ratios:
        assert found[name] == pytest.approx(found[above] / found[below], rel=1e-3)
    for chain in ascending:
        values = [found[one] if isinstance(one, str) else one for one in chain]
        assert all(lower < upper for lower, upper in pairwise(values)), chain
    assert found.get("false_alarms", 0) <= found.get("false_alarms_allowed", 0)


@pytest.mark.slow
def test_preintegration_names_its_figures():
    found = figures("performance/preintegration.py")
    assert found["gtsam_cpp_ratio"] == pytest.approx(
        found["ours_ns"] / found["gtsam_cpp_ns"], rel=1e-3
    )
    assert found["gtsam_python_ratio"] > 1
    assert found["gtsam_python_ratio"] > found["with_add_ratio"]
    assert len(found["factor_us"]) == 3
    assert (
        found["factor_us"]["OdometryWithBias (Python)"]
        > found["factor_us"]["BetweenFactorPose3 (compiled)"]
    )


@pytest.mark.slow
def test_preintegration_consistency_tells_rules_apart():
    found = figures("validation/preintegration_consistency.py", "--workers", "2")
    low, high = found["keyframe_pose_anees"]
    assert 0.7 < low < high < 1.2
    assert found["keyframe_coug_fgo_anees"][1] > 5
    assert found["keyframe_TURTLMap_anees"][1] > 5
    ours_mm, anees, gaps_mm, gaps_anees = found["brisk, 1 Hz rms_mm, anees, as gaps"]
    assert ours_mm > 2.5 * gaps_mm
    assert anees > 5 > 1.5 > gaps_anees
    assert {"chain_pose_anees", "brisk_displacement_anees", "passed"} <= set(found)


@pytest.mark.slow
def test_recognition_names_its_figures():
    found = figures("performance/recognition.py")
    parts = sum(
        found[f"{part}_ms"] for part in ("selection", "tracking", "look", "beliefs")
    )
    assert 0.5 * found["frame_ms"] < parts < found["frame_ms"]
    # landmarks were looked at, else the comparison with designs would cost nothing
    assert found["detections"] > 0
    assert found["median_ms"] < found["p99_ms"]
    assert found["rss_growth_mb"] < found["peak_rss_mb"]
    is_compared = importlib.util.find_spec("actag") is not None
    assert (found["actag_ratio"] is not None) == is_compared


@pytest.mark.slow
def test_actag_names_its_figures_or_the_extra():
    if importlib.util.find_spec("actag") is None:
        done = run("validation/actag_reading.py", "--quick")
        assert (done.returncode, done.stderr.count("\n")) == (2, 1)
        assert "sonar-graph[actag]" in done.stderr
        return
    found = figures("validation/actag_reading.py")
    assert found["tags_in_view"] > 10
    assert found["decoded_share"] > 0.4
    assert found["range_rms_m"] < 0.01


@pytest.mark.slow
def test_batch_intervals_tell_methods_apart():
    found = figures("validation/batch_intervals.py", "--workers", "1")
    assert found["pairs"] == [6, 10, 20, 50]
    for shares in found["held"].values():
        assert all(
            len(of_kind) == 4 and 0.2 < min(of_kind) <= max(of_kind) <= 1
            for of_kind in shares.values()
        )
    assert (
        found["held"]["BCa"]["normal"][0]
        < found["held"]["reported"]["normal"][0] - 0.03
    )
    assert found["length"]["Student"]["normal"] == [1.0] * 4
    assert (
        found["length"]["BCa"]["normal"][0]
        < 0.85
        < 1
        < found["length"]["reported"]["normal"][0]
    )


@pytest.mark.parametrize(
    ("changes", "of_full_run", "of_quick_run"),
    [
        ({}, 0, 0),
        ({"log_s": 0.501}, 1, 0),
        ({"filterpy_ratio": 49.9}, 1, 0),
        ({"filterpy_node_ratio": 5.0}, 0, 0),
        ({"difference": 1e-5}, 1, 1),
        ({"difference": float("inf")}, 1, 1),
    ],
)
def test_ekf_step_fails_when_a_full_run_misses_a_target(
    changes, of_full_run, of_quick_run, monkeypatch
):
    monkeypatch.syspath_prepend(str(BENCHMARKS / "performance"))
    ekf_step = importlib.import_module("ekf_step")
    met = {
        "log_s": 0.5,
        "filterpy_ratio": 50.0,
        "filterpy_node_ratio": 20.0,
        "difference": 1e-12,
    } | changes
    assert ekf_step.meets_targets(met) == (of_full_run == 0)
    assert ekf_step.exit_code(met, quick=False) == of_full_run
    assert ekf_step.exit_code(met, quick=True) == of_quick_run


@pytest.mark.slow
def test_consistency_names_its_figures_and_draws(tmp_path):
    picture = tmp_path / "anees.png"
    found = figures(
        "validation/consistency.py", "--workers", "2", "--out", str(picture)
    )
    for quantity in ("position", "yaw"):
        low, high = found[f"band_{quantity}"]
        assert low < 1 < high
        for estimator in ("ekf", "isam2"):
            assert found[f"{estimator}_{quantity}_anees"] > 0
            assert 0 <= found[f"share_inside_{estimator}_{quantity}"] <= 1
    assert picture.read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_filter_consistency_names_its_figures_and_tells_filters_apart():
    found = figures(
        "validation/filter_consistency.py",
        "--workers",
        "2",
        "--estimators",
        "ekf,invariant",
    )
    for basin in ("nominal", "hard", "hard_without_bias"):
        for quantity in ("position", "yaw"):
            low, high = found[f"{basin}_band_{quantity}"]
            assert low < 1 < high
            for estimator in ("ekf", "invariant"):
                value = found[f"{basin}_{estimator}_{quantity}_anees"]
                assert found[f"{basin}_{estimator}_{quantity}_inside"] == (
                    low <= value <= high
                )
        assert found[f"{basin}_ekf_yaw_anees"] != pytest.approx(
            found[f"{basin}_invariant_yaw_anees"], rel=1e-3
        )


@pytest.mark.slow
@pytest.mark.recording
def test_isam2_settings_names_what_they_do(recordings):
    found = figures(
        "validation/isam2_settings.py", "--data", str(recordings), "--workers", "2"
    )
    (frames, keyframes, updates, _), (_, dense, *_), (_, same, all_updates, _) = found[
        "effort"
    ]
    assert keyframes == same < dense
    assert updates < all_updates
    assert 0.9 * frames < dense < 1.1 * frames
    for world in ("basin", "mission"):
        ratio, _, sigmas = found[f"{world}, relinearised at 0.0001"]
        assert ratio == pytest.approx(1.0, abs=1e-3)
        assert sigmas < found[f"{world}, relinearised at 0.01"][2] < 0.2


@pytest.mark.slow
@pytest.mark.recording
def test_real_frames_names_its_figures(recordings, tmp_path):
    figure = tmp_path / "curve.png"
    arguments = ("--data", str(recordings), "--workers", "1", "--figure", str(figure))
    found = figures("validation/real_frames.py", *arguments)
    assert found["frames"] == 15
    assert {"ours", "soca", "soca_power", "median", "actag", "lead", "passed"} <= set(
        found
    )
    for low, high in zip(found["lead_from"], found["lead_to"], strict=True):
        assert -1 < low <= high < 1
    assert max(found["ours"]) > 0.8
    assert figure.stat().st_size > 10_000


@pytest.mark.slow
def test_golden_runs_are_kept_once_and_differ_in_what_was_changed(tmp_path):
    chosen = ("--logs", "basin-tracks", "--estimators", "ekf-slam")
    for folder in ("old", "new"):
        done = run(
            "validation/golden.py", "keep", str(tmp_path / folder), "--quick", *chosen
        )
        assert done.returncode == 0, done.stderr
    assert (
        "already kept"
        in run(
            "validation/golden.py", "keep", str(tmp_path / "new"), "--quick", *chosen
        ).stderr
    )
    same = run(
        "validation/golden.py", "compare", str(tmp_path / "old"), str(tmp_path / "new")
    )
    assert (same.returncode, same.stdout.splitlines()[-1]) == (
        0,
        "1 runs compared, tolerance 1e-09: equal",
    )
    kept = tmp_path / "new" / "basin-tracks" / "ekf-slam.npz"
    with np.load(kept) as content:
        arrays = dict(content)
    arrays["smoothed_positions"][3, 1] += 0.25
    arrays["detection_outcomes"][5] = "GATED"
    np.savez_compressed(kept, **arrays)
    other = run(
        "validation/golden.py", "compare", str(tmp_path / "old"), str(tmp_path / "new")
    )
    assert other.returncode == 1
    assert other.stdout.splitlines()[1].split()[2:10] == [
        "0",
        "0",
        "2.5e-01",
        "0",
        "0",
        "0",
        "0",
        "1",
    ]


def test_a_worse_ratio_of_speed_is_a_loss_in_both_directions(monkeypatch):
    for folder in (BENCHMARKS, BENCHMARKS / "performance"):
        monkeypatch.syspath_prepend(str(folder))
    speed = importlib.import_module("speed")
    lower, higher = speed.HEADLINES["plain_ratio"], speed.HEADLINES["filterpy_ratio"]
    assert speed.loss(lower, 0.10, 0.12) == pytest.approx(0.2)
    assert speed.loss(higher, 60.0, 50.0) == pytest.approx(0.2)
    assert speed.loss(higher, 50.0, 60.0) < 0


def test_every_script_is_listed():
    listed = (BENCHMARKS / "README.md").read_text(encoding="utf-8")
    for folder in ("performance", "validation"):
        for script in (BENCHMARKS / folder).glob("*.py"):
            if "__main__" in script.read_text(encoding="utf-8"):
                assert f"{folder}/{script.name}" in listed


@pytest.mark.slow
@pytest.mark.parametrize(
    ("script", "arguments"),
    [("damaged_logs.py", TWO_WORKERS), ("damaged_sonar_files.py", ())],
)
def test_damaged_files_end_in_no_crash_and_no_silent_error(script, arguments):
    found = figures(f"validation/{script}", *arguments)
    assert (
        found["files"],
        found["crashes"],
        found["hangs"],
        found["silent_errors"],
    ) == (60, 0, 0, 0)
    assert found["recovered_share"] == 1
    # flipped samples of sonar files are among the damages
    assert found.get("unseen_samples") != 0


@pytest.mark.slow
def test_hostile_input_ends_in_no_traceback_and_loses_nothing():
    found = figures("validation/hostile_input.py", "--seed", "5")
    names = (
        "cases",
        "tracebacks",
        "hangs",
        "silent_errors",
        "files_lost",
        "interrupts_missed",
    )
    assert [found[name] for name in names] == [32, 0, 0, 0, 0, 0]
    assert found["peak_rss_mb"] <= 1500


@pytest.mark.slow
def test_unknown_landmarks_finds_all_in_a_short_basin():
    found = figures("validation/unknown_landmarks.py", "--workers", "1")
    assert found["passed"]
    assert (
        found["basin"]["unknown"]["landmarks"]
        == found["basin"]["known"]["landmarks"]
        == 4
    )
    assert found["basin"]["unknown"]["used"] > 0.9 * found["basin"]["known"]["used"]


@pytest.mark.slow
@pytest.mark.recording
def test_mrclam_names_its_figures(recordings):
    found = figures("validation/mrclam.py", "--data", str(recordings), "--workers", "1")
    assert found["robots"] == [1]
    assert found["isam2_smoothed_ate_m"][0] < found["dead_reckoning_causal_ate_m"][0]
    assert {"ekf_causal_ate_m", "landmark_error_m", "passed"} <= set(found)


@pytest.mark.slow
def test_fairness_has_a_row_for_each_choice_and_tells_some_apart():
    worlds, names = (
        ("--worlds", "basin0.001", "--estimators", "ekf-slam,invariant-ekf"),
        ("default", "bias"),
    )
    rows = figures(
        "validation/fairness.py",
        *worlds,
        "--choices",
        ",".join(names),
        "--workers",
        "1",
    )["rows"]
    assert [(row["estimator"], row["choice"]) for row in rows] == [
        (estimator, name)
        for estimator, told in (("ekf-slam", "bias in Q"), ("invariant-ekf", "no bias"))
        for name in ("default", told)
    ]
    assert len({row["causal.ate_se2_m"] for row in rows}) >= 3


@pytest.fixture
def scenes(monkeypatch) -> Any:
    for folder in (BENCHMARKS, BENCHMARKS / "validation"):
        monkeypatch.syspath_prepend(str(folder))
    return importlib.import_module("recognition_scenes")


def a_run(rows: list[tuple[int, int, int, float, int]]) -> Any:
    """Passes of landmark 1, landmark 2, a weed and a lid, one after the other.

    Of each detection: second, track, name (0: none), probability, and what truly lies there.
    """
    kept = importlib.import_module("recognition_runs")
    begin_s = np.array([0.0, 100.0, 200.0, 300.0])
    passes = kept.Passes(
        np.array([1, 2, -1, -2]),
        np.array(["disc", "square", "weed", "lid"]),
        begin_s,
        begin_s + 50,
        np.full(4, 50),
    )
    second, track, named, probability, label = (
        np.array(column) for column in zip(*rows, strict=True)
    )
    error = np.tile([0.01, 0.0], (len(rows), 1))
    covariance = np.tile(np.eye(2), (len(rows), 1, 1))
    is_named = named > 0
    confidence = np.where(is_named, probability, 0.8)
    return kept.Run(
        passes,
        {
            "r": kept.Detections(
                second,
                track,
                named,
                probability,
                confidence,
                is_named,
                label,
                error,
                covariance,
            )
        },
    )


def test_scenes_count_passes_of_landmarks_and_of_each_group_of_strangers_and_judge_a_track_by_its_end(
    scenes,
):
    unjudged = importlib.import_module("recognition_runs").UNJUDGED
    run = a_run([
        (10, 1, 2, 0.90, 1), (20, 1, 1, 0.995, 1),  # wrong at first, right at its end
        (110, 2, 2, 0.40, 2), (120, 2, 0, 0.0, 2),  # never accepted; ends as none: wrong
        (210, 3, 0, 0.0, -1),  # a weed, refused
        (310, 4, 2, 0.995, -2),  # a lid, taken for a landmark
        (400, 5, 1, 0.60, unjudged),  # between things: accepted, not right, no track to judge
    ])  # fmt: skip
    found = scenes.summary([run, run], "r")
    counted = {
        name: (found[name]["hits"], found[name]["passes"])
        for name in ("recognised", "natural", "look_alikes")
    }
    assert counted == {"recognised": (2, 4), "natural": (0, 2), "look_alikes": (2, 2)}
    assert (found["accepted"], found["right"]) == (8, 0.25)
    assert (found["tracks"], found["wrong_above_99"]) == (8, (2, 4))
    assert found["range_bias_m"] == pytest.approx(0.01)
    assert found["nis"] == found["nis_of_reports"] == pytest.approx(0.01**2 / 2)
    assert not scenes.reaches("hard", found)
    fine = {name: {"hits": 19, "passes": 20} for name in ("recognised",)}
    fine |= {name: {"hits": 0, "passes": 20} for name in ("natural", "look_alikes")} | {
        "ece_of_tracks": 0.01
    }
    assert scenes.reaches("0 dB", fine)
    assert not scenes.reaches("0 dB", fine | {"recognised": {"hits": 18, "passes": 20}})
    assert scenes.reaches("-4.5 dB", fine | {"recognised": {"hits": 18, "passes": 20}})


def test_an_error_that_repeats_counts_as_often_as_it_is_reported(scenes, monkeypatch):
    class Model:
        report_interval_s = 10.0

    monkeypatch.setattr(scenes, "read_confusion", lambda _: Model)
    found = scenes.summary([a_run([(k, 1, 1, 0.9, 1) for k in range(21)])], "r")
    assert found["nis"] == pytest.approx(0.01**2 / 2)
    # rows 0, 10 and 20
    assert found["nis_of_reports"] == pytest.approx(3 * 0.01**2 / 2)


def test_wilsons_interval_is_the_published_one(scenes):
    # Newcombe 1998, table I
    assert scenes.wilson(81, 263) == pytest.approx((0.2553, 0.3662), abs=1e-4)
    assert scenes.wilson(0, 20) == pytest.approx((0.0, 0.1611), abs=1e-4)


FIGURES = ("smoothed", "causal", "landmarks", "time_s")


@pytest.fixture
def table(monkeypatch) -> Any:
    for folder in (BENCHMARKS, BENCHMARKS / "validation"):
        monkeypatch.syspath_prepend(str(folder))
    return importlib.import_module("identities")


@pytest.fixture
def kept(table) -> Any:
    return importlib.import_module("identity_runs")


@pytest.fixture
def falsified(table) -> Any:
    return importlib.import_module("mrclam_wrong_ids")


def judged(kept: Any, error_m: float | None) -> Any:
    nees = {"position": 1.0, "yaw": 2.0}
    if error_m is None:
        return kept.Judged(
            "failed", "of a sudden", None, None, None, 0, None, None, None
        )
    return kept.Judged("ok", "", error_m, error_m, error_m, 4, nees, nees, nees)


def runs(kept: Any, *errors_m: float | None) -> list[dict[str, Any]]:
    """Dead reckoning off by 0.3 m, and one policy."""
    return [
        {"dead reckoning": judged(kept, 0.3), "iSAM2, robust": judged(kept, error)}
        for error in errors_m
    ]


def test_a_mean_over_survivors_is_not_given(table, kept):
    clean = runs(kept, 0.1, 0.1, 0.1, 0.1)
    found = table.summarise(runs(kept, 0.1, None, 0.1, 2.0), clean, "iSAM2, robust")
    assert (found["failed"], found["lost"]) == (0.25, 0.5)
    for figure in (
        "smoothed_m",
        "causal_m",
        "landmarks_m",
        "above_clean_m",
        "loss",
        "final_nees_yaw",
    ):
        assert np.isnan(found[figure])
    whole = table.summarise(runs(kept, 0.1, 0.3, 0.1, 2.0), clean, "iSAM2, robust")
    assert (whole["failed"], whole["lost"], whole["final_nees_yaw"]) == (0.0, 0.25, 2.0)
    assert whole["smoothed_m"] == pytest.approx(0.625)


def test_differences_are_paired_by_seed(table, kept):
    clean, wrong = runs(kept, 0.1, 0.2, 0.3), runs(kept, 0.15, 0.25, 0.35)
    found = table.summarise(wrong, clean, "iSAM2, robust")
    assert found["above_clean_m"] == pytest.approx(0.05)
    assert found["above_clean_error_m"] == pytest.approx(0, abs=1e-12)
    assert found["smoothed_error_m"] == pytest.approx(0.1 / np.sqrt(3))
    assert found["loss"] == pytest.approx(0.25)


def test_the_best_policy_is_the_one_whose_worst_case_is_best(table, kept, monkeypatch):
    monkeypatch.setattr(
        table, "ESTIMATORS", dict.fromkeys(("EKF-SLAM", "iSAM2, a", "iSAM2, b"))
    )

    def told(
        ekf: float, a: float, b: float, b_map: float = 0.0
    ) -> dict[str, dict[str, float]]:
        losses = {"EKF-SLAM": (ekf, ekf), "iSAM2, a": (a, 0.0), "iSAM2, b": (b, b_map)}
        return {
            name: {"loss": track, "landmark_loss": map_, "more_missing": 0.0}
            for name, (track, map_) in losses.items()
        }

    figures = {
        kept.Case(0.1): told(0, 0.1, 0.2),
        kept.Case(0.1, 5.0): told(0, 0.9, 0.3),
        kept.Case(0.2): told(0, 0, 9),
    }
    assert table.best_policy(figures) == ("iSAM2, b", 0.3)
    figures[kept.Case(0.1, 5.0, 5.0)] = told(0, 0.1, 0.1, b_map=0.8)
    assert table.best_policy(figures) == ("iSAM2, b", 0.8)
    figures[kept.Case(0.1, 20.0)] = told(0, 0.1, float("nan"))
    assert table.best_policy(figures) == ("iSAM2, a", 0.9)
    figures[kept.Case(0.1)]["iSAM2, a"]["more_missing"] = 0.01
    assert table.best_policy(figures)[1] == np.inf


def test_landmarks_that_are_not_found_are_no_gain(table, kept):
    """One of four landmarks, the best: a small error of the map, and three missing."""
    clean, wrong = runs(kept, 0.1, 0.2), runs(kept, 0.1, 0.05)
    wrong[1]["iSAM2, robust"] = replace(wrong[1]["iSAM2, robust"], landmarks=1)
    found = table.summarise(wrong, clean, "iSAM2, robust")
    assert (found["missing"], found["more_missing"]) == (1.5, 1.5)
    assert found["landmark_loss"] < 0


def collected(falsified: Any, failing: dict[tuple[str, float], int]) -> dict[str, Any]:
    """Every run as good as any other, but for some robots' of some estimators and shares."""
    cases = list(
        itertools.product(
            falsified.ROBOTS, (0.0, falsified.SHARE), falsified.ESTIMATORS
        )
    )
    runs = [
        dict.fromkeys(
            FIGURES, np.nan if robot <= failing.get((label, share), 0) else 0.1
        )
        for robot, share, label in cases
    ]
    return falsified.collect(cases, runs)


def test_a_mean_of_recorded_runs_is_over_all_robots_and_none_that_counts_is_lost(
    falsified,
):
    share = falsified.SHARE
    figures = collected(falsified, {("isam2 robust", share): 1})
    assert figures["isam2_robust_smoothed_wrong"] is None
    assert figures["isam2_robust_growth"] is None
    assert (figures["isam2_robust_lost_wrong"], figures["isam2_robust_lost_right"]) == (
        1,
        0,
    )
    assert figures["isam2_gate_smoothed_wrong"] == pytest.approx(0.1)
    for failing, is_met in (
        ({}, True),
        ({("isam2 robust", share): 2, ("ekf-slam", 0.0): 5}, True),
        ({("isam2 max-mixture", share): 1}, False),
        ({("isam2 gate", 0.0): 1}, False),
    ):
        assert falsified.is_met(collected(falsified, failing)) is is_met


def test_what_is_kept_belongs_to_one_run_of_one_version(
    table, kept, tmp_path, monkeypatch
):
    job = kept.Job(kept.Case(0.1), 3, True, tmp_path)
    name = "iSAM2, robust"
    others = [
        replace(job, seed=4),
        replace(job, is_quick=False),
        replace(job, case=kept.Case(0.1, 5.0)),
    ]
    files = [other.file(name) for other in (job, *others)] + [job.file("iSAM2, gate")]
    monkeypatch.setattr(kept, "source_version", lambda: "another")
    assert len({*files, job.file(name)}) == 6
    assert replace(job, folder=None).file(name) is None


@pytest.mark.slow
def test_a_command_that_is_given_again_gives_the_same_table_from_what_is_kept(tmp_path):
    script = BENCHMARKS / "validation" / "identities.py"
    asked = [
        sys.executable,
        str(script),
        "--quick",
        "--seeds",
        "2",
        "--kinds",
        "0",
        "--workers",
        "2",
    ]
    asked += ["--keep", str(tmp_path)]
    first = subprocess.run(asked, capture_output=True, text=True, check=True).stdout
    files = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    lost = sorted(files)[0]
    lost.unlink()
    assert (
        subprocess.run(asked, capture_output=True, text=True, check=True).stdout
        == first
    )
    assert {
        path for path in tmp_path.iterdir() if path.stat().st_mtime_ns != files[path]
    } == {lost}
    assert json.loads(first.splitlines()[-1])["runs"] == 2
