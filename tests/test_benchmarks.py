"""Every benchmark script runs in its short version and ends in one line of figures."""

from __future__ import annotations

import importlib
import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


def run(script: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = {key: value for key, value in os.environ.items() if key != "SONAR_GRAPH_DATA"}
    command = [sys.executable, str(BENCHMARKS / script), *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=600, env=environment)


def figures(script: str, *arguments: str) -> dict[str, Any]:
    done = run(script, "--quick", *arguments)
    assert done.returncode == 0, done.stderr
    last: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return last


@pytest.mark.slow
def test_missing_recordings_are_one_line_and_exit_code_2(tmp_path):
    for arguments in ((), ("--data", str(tmp_path))):
        done = run("validation/mrclam.py", *arguments)
        assert done.returncode == 2
        assert len(done.stderr.splitlines()) == 1
        assert "--data" in done.stderr
        assert done.stdout == ""


@pytest.mark.slow
def test_isam2_mission_names_its_figures():
    found = figures("performance/isam2_mission.py")
    assert {"plain_ratio", "p99_ms", "decile_ratio", "ours_s", "plain_s", "passed"} <= set(found)
    assert found["plain_ratio"] == pytest.approx(found["ours_s"] / found["plain_s"])
    # Both follow the truth, else their times would compare nothing.
    assert found["ours_error_m"] < 0.3
    assert found["plain_error_m"] < 0.3


@pytest.mark.slow
def test_long_mission_names_its_figures():
    found = figures("performance/long_mission.py", "--hours", "0.05")
    assert {"decile_ratio", "max_update_ms", "memory_growth_ratio", "passed"} <= set(found)
    assert 0 < found["max_cpu_ms"] <= found["max_wall_ms"] + 1
    assert found["causal_error_m"] < 0.3
    assert found["smoothed_error_m"] < 0.3


@pytest.mark.slow
def test_preintegration_names_its_figures():
    found = figures("performance/preintegration.py")
    assert found["gtsam_cpp_ratio"] == pytest.approx(found["ours_ns"] / found["gtsam_cpp_ns"], rel=1e-3)
    assert found["gtsam_python_ratio"] > 1
    assert len(found["factor_us"]) == 5
    assert found["factor_us"]["odometry_with_bias (Python)"] > found["factor_us"]["BetweenFactorPose3 (compiled)"]


@pytest.mark.slow
def test_preintegration_consistency_tells_rules_apart():
    found = figures("validation/preintegration_consistency.py", "--workers", "2")
    low, high = found["keyframe_joint_anees"]
    assert 0.8 < low < high < 1.2
    assert found["keyframe_coug_fgo_anees"][1] > 5
    assert found["keyframe_TURTLMap_anees"][1] > 5
    assert {"chain_joint_anees", "brisk_linear_anees", "passed"} <= set(found)


@pytest.mark.slow
def test_nested_messages_are_the_same_in_both_libraries():
    found = figures("performance/nested_messages.py")
    assert found["same"]
    kinds = ("detections", "diagnostics", "scans")
    assert {f"{kind}_{share}" for kind in kinds for share in ("ratio", "shared_ratio")} <= set(found)


@pytest.mark.slow
def test_log_reading_names_its_figures_and_agrees_with_rosbags():
    found = figures("performance/log_reading.py")
    assert found["agrees"]
    assert found["limit_ratio"] == pytest.approx(found["ours_s"] / found["limit_s"], rel=1e-3)
    assert found["rosbags_ratio"] == pytest.approx(found["rosbags_s"] / found["ours_s"], rel=1e-3)
    assert found["mcap_ros2_ratio"] == pytest.approx(found["mcap_ros2_s"] / found["ours_s"], rel=1e-3)
    assert 10 < found["peak_rss_mb"] < 150


@pytest.mark.slow
def test_recognition_names_its_figures():
    found = figures("performance/recognition.py")
    parts = sum(found[f"{part}_ms"] for part in ("selection", "tracking", "look", "beliefs"))
    assert 0.5 * found["frame_ms"] < parts < found["frame_ms"]
    assert found["detections"] > 0  # landmarks were looked at, else the comparison with designs would cost nothing
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
        assert all(len(of_kind) == 4 and 0.2 < min(of_kind) <= max(of_kind) <= 1 for of_kind in shares.values())
    assert found["held"]["BCa"]["normal"][0] < found["held"]["reported"]["normal"][0] - 0.03
    assert found["length"]["Student"]["normal"] == [1.0] * 4
    assert found["length"]["BCa"]["normal"][0] < 0.85 < 1 < found["length"]["reported"]["normal"][0]


@pytest.mark.slow
@pytest.mark.parametrize("script", ["damaged_logs.py", "damaged_sonar_files.py"])
def test_damaged_files_end_in_no_crash_and_no_silent_error(script):
    found = figures(f"validation/{script}", *(["--workers", "2"] if script == "damaged_logs.py" else []))
    assert found["files"] == 60
    assert (found["crashes"], found["hangs"], found["silent_errors"]) == (0, 0, 0)
    assert found["recovered_share"] == 1
    assert found.get("unseen_samples") != 0  # flipped samples of sonar files are among the damages


@pytest.mark.slow
def test_ekf_step_names_its_figures():
    found = figures("performance/ekf_step.py")
    assert {"log_s", "filterpy_ratio", "passed"} <= set(found)
    # A prediction a node is less work than one a sample, and ends in the same state.
    assert 1 < found["filterpy_node_ratio"] < found["filterpy_ratio"]
    assert found["difference"] < 1e-9


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
def test_ekf_step_fails_when_a_full_run_misses_a_target(changes, of_full_run, of_quick_run, monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS / "performance"))
    ekf_step = importlib.import_module("ekf_step")
    met = {"log_s": 0.5, "filterpy_ratio": 50.0, "filterpy_node_ratio": 20.0, "difference": 1e-12} | changes
    assert ekf_step.meets_targets(met) == (of_full_run == 0)
    assert ekf_step.exit_code(met, quick=False) == of_full_run
    assert ekf_step.exit_code(met, quick=True) == of_quick_run


@pytest.mark.slow
def test_consistency_names_its_figures_and_draws(tmp_path):
    picture = tmp_path / "anees.png"
    found = figures("validation/consistency.py", "--workers", "2", "--out", str(picture))
    for quantity in ("position", "yaw"):
        low, high = found[f"band_{quantity}"]
        assert low < 1 < high
        for estimator in ("ekf", "isam2"):
            assert found[f"{estimator}_{quantity}_anees"] > 0
            assert 0 <= found[f"share_inside_{estimator}_{quantity}"] <= 1
    assert picture.read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_filter_consistency_names_its_figures_and_tells_filters_apart():
    found = figures("validation/filter_consistency.py", "--workers", "2", "--estimators", "ekf,invariant")
    for basin in ("nominal", "hard", "hard_without_bias"):
        for quantity in ("position", "yaw"):
            low, high = found[f"{basin}_band_{quantity}"]
            assert low < 1 < high
            for estimator in ("ekf", "invariant"):
                value = found[f"{basin}_{estimator}_{quantity}_anees"]
                assert found[f"{basin}_{estimator}_{quantity}_inside"] == (low <= value <= high)
        assert found[f"{basin}_ekf_yaw_anees"] != pytest.approx(found[f"{basin}_invariant_yaw_anees"], rel=1e-3)


@pytest.mark.slow
def test_filter_consistency_refuses_basins_that_it_does_not_know():
    done = run("validation/filter_consistency.py", "--basins", "nominal,deep")
    assert (done.returncode, done.stderr.strip()) == (2, "--basins, --estimators: unknown: deep")


@pytest.mark.slow
def test_victoria_park_agrees_with_the_batch_solution():
    found = figures("validation/victoria_park.py", "--workers", "2")
    assert found["cost_ratio"] == pytest.approx(1, abs=5e-3)
    assert found["landmark_rms_difference_m"] < 0.05
    # The other reading of the file's odometry noise is another problem: the comparison can tell two problems apart.
    assert found["file_noise_cost_ratio"] > found["cost_ratio"] + 0.01


@pytest.mark.slow
@pytest.mark.recording
def test_mrclam_names_its_figures(recordings):
    found = figures("validation/mrclam.py", "--data", str(recordings), "--workers", "1")
    assert found["robots"] == [1]
    assert found["isam2_smoothed_ate_m"][0] < found["dead_reckoning_causal_ate_m"][0]
    assert {"ekf_causal_ate_m", "landmark_error_m", "passed"} <= set(found)


@pytest.mark.slow
@pytest.mark.recording
def test_isam2_settings_names_what_they_do(recordings):
    found = figures("validation/isam2_settings.py", "--data", str(recordings), "--workers", "2")
    (frames, keyframes, updates, _), (_, dense, *_), (_, same, all_updates, _) = found["effort"]
    assert keyframes == same < dense
    assert updates < all_updates
    assert 0.9 * frames < dense < 1.1 * frames
    for world in ("basin", "mission"):
        ratio, _, sigmas = found[f"{world}, relinearised at 0.0001"]
        assert ratio == pytest.approx(1.0, abs=1e-3)
        assert sigmas < found[f"{world}, relinearised at 0.01"][2] < 0.2


@pytest.mark.slow
@pytest.mark.recording
def test_odometry_rows_names_what_accelerometers_add(recordings):
    found = figures("validation/odometry_rows.py", "--data", str(recordings), "--workers", "2")
    linear_mm, inertial_mm, gap_mm, linear_nees, inertial_nees, gap_nees = found["brisk, 1 Hz rms_mm, nees"]
    assert linear_mm > 4 * max(inertial_mm, gap_mm)
    assert linear_nees > 10
    assert 0.7 < min(inertial_nees, gap_nees) <= max(inertial_nees, gap_nees) < 1.3
    assert 0.8 < found["basin 12"][0] < 1.2
    # An IMU in the wrong place and an Earth at rest show in chi-square, the right calibration does not.
    assert found["A-KIT IMU at the reference's point"][0] > found["A-KIT Earth at rest"][0] > 2 > found["A-KIT 12"][0]


@pytest.mark.slow
@pytest.mark.recording
def test_real_frames_names_its_figures(recordings, tmp_path):
    figure = tmp_path / "curve.png"
    arguments = ("--data", str(recordings), "--workers", "1", "--figure", str(figure))
    found = figures("validation/real_frames.py", *arguments)
    assert found["frames"] == 15
    assert {"ours", "soca", "soca_power", "actag", "ahead", "passed"} <= set(found)
    assert max(found["ours"]) > 0.8
    assert figure.stat().st_size > 10_000


@pytest.mark.slow
def test_batch_gate_names_its_figures():
    found = figures("validation/batch_gate.py", "--workers", "1")
    assert found["false_alarms"] <= found["false_alarms_allowed"]
    assert found["power_50_percent_3_seeds"] > 0
    assert {"told_power_median", "power_20_percent_20_seeds", "passed"} <= set(found)


def test_every_script_is_listed():
    listed = (BENCHMARKS / "README.md").read_text(encoding="utf-8")
    for folder in ("performance", "validation"):
        for script in (BENCHMARKS / folder).glob("*.py"):
            if "__main__" in script.read_text(encoding="utf-8"):
                assert f"{folder}/{script.name}" in listed


@pytest.mark.slow
def test_unknown_landmarks_finds_all_in_a_short_basin():
    found = figures("validation/unknown_landmarks.py", "--workers", "1")
    assert found["passed"]
    assert found["basin"]["unknown"]["landmarks"] == found["basin"]["known"]["landmarks"] == 4
    assert found["basin"]["unknown"]["used"] > 0.9 * found["basin"]["known"]["used"]
