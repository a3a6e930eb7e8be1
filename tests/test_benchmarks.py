"""Every benchmark script runs in its short version and ends in one line of figures; what tables make of failed runs."""

import importlib
import importlib.util
import json
import os
import subprocess
import sys
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
    zero: tuple[str, ...] = ()
    ascending: tuple[tuple[str | float, ...], ...] = ()
    """Figures and numbers, each above the one before."""


TWO_WORKERS = ("--workers", "2")
NESTED = [
    f"{kind}_{share}"
    for kind in ("detections", "diagnostics", "scans")
    for share in ("ratio", "shared_ratio")
]
# fmt: off
UNDAMAGED: Any = {
    "zero": ("crashes", "hangs", "silent_errors"),
    "ascending": ((59, "files", 61), (0.999, "recovered_share", 1.001)),
}
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
    "validation/victoria_park.py": Quick(  # the other reading of the file's noise is another problem: it is distinguished
        TWO_WORKERS, ascending=(
            (0.995, "cost_ratio", 1.005), ("landmark_rms_difference_m", 0.05), (1.015, "file_noise_cost_ratio"))),
    "performance/preintegration.py": Quick(
        names=("gtsam_python_ratio",), ratios=(("ours_ns", "gtsam_cpp_ns", "gtsam_cpp_ratio"),)
    ),
    "validation/preintegration_consistency.py": Quick(
        TWO_WORKERS, ("chain_pose_anees", "brisk_displacement_anees", "passed")
    ),
    "performance/recognition.py": Quick(
        names=("actag_ratio",),
        ascending=((0, "detections"), ("median_ms", "p99_ms"), ("rss_growth_mb", "peak_rss_mb")),
    ),
    "validation/batch_intervals.py": Quick(("--workers", "1"), ("pairs", "held", "length")),
    "validation/consistency.py": Quick(
        TWO_WORKERS, ("band_position", "band_yaw"), ascending=((0, "isam2_yaw_anees"),)
    ),
    "validation/filter_consistency.py": Quick(
        (*TWO_WORKERS, "--estimators", "ekf,invariant"),
        ("hard_ekf_yaw_inside",),
        ascending=((0, "nominal_invariant_yaw_anees"),),
    ),
    "validation/damaged_logs.py": Quick(TWO_WORKERS, **UNDAMAGED),
    "validation/damaged_sonar_files.py": Quick(**UNDAMAGED),
    "validation/hostile_input.py": Quick(
        ("--seed", "5"),
        zero=("tracebacks", "hangs", "silent_errors", "files_lost", "interrupts_missed"),
        ascending=((31, "cases", 33), ("peak_rss_mb", 1500)),
    ),
    "validation/unknown_landmarks.py": Quick(("--workers", "1"), ("basin", "passed")),
    "validation/fairness.py": Quick(
        ("--worlds", "basin0.001", "--choices", "default,bias", "--workers", "1"), ("rows",)
    ),
}
WITH_DATA = {
    "validation/mrclam.py": Quick(("--workers", "1"), ("landmark_error_m", "passed")),
    "validation/isam2_settings.py": Quick(TWO_WORKERS, ("effort",)),
    "validation/real_frames.py": Quick(("--workers", "1"), ("ours", "lead", "passed")),
}
# fmt: on


def assert_names_its_figures(script: str, quick: Quick, *data: str) -> None:
    found = figures(script, *data, *quick.arguments)
    assert set(quick.names) <= set(found)
    assert all(found.get(name, True) for name in ("same", "agrees"))
    assert [name for name in quick.zero if found[name] != 0] == []
    for above, below, name in quick.ratios:
        assert found[name] == pytest.approx(found[above] / found[below], rel=1e-3)
    for chain in quick.ascending:
        values = [found[one] if isinstance(one, str) else one for one in chain]
        assert all(lower < upper for lower, upper in pairwise(values)), chain
    assert found.get("false_alarms", 0) <= found.get("false_alarms_allowed", 0)


@pytest.mark.slow
@pytest.mark.parametrize("script", QUICK)
def test_a_script_names_its_figures(script):
    assert_names_its_figures(script, QUICK[script])


@pytest.mark.slow
@pytest.mark.recording
@pytest.mark.parametrize("script", WITH_DATA)
def test_a_script_on_recordings_names_its_figures(script, recordings):
    assert_names_its_figures(script, WITH_DATA[script], "--data", str(recordings))


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
    lower = speed.HEADLINES["plain_ratio"]
    higher = speed.HEADLINES["filterpy_ratio"]
    assert speed.loss(lower, 0.10, 0.12) == pytest.approx(0.2)
    assert speed.loss(higher, 60.0, 50.0) == pytest.approx(0.2)
    assert speed.loss(higher, 50.0, 60.0) < 0


def test_every_script_is_listed():
    listed = (BENCHMARKS / "README.md").read_text(encoding="utf-8")
    for folder in ("performance", "validation"):
        for script in (BENCHMARKS / folder).glob("*.py"):
            if "__main__" in script.read_text(encoding="utf-8"):
                assert f"{folder}/{script.name}" in listed


@pytest.fixture
def scenes(monkeypatch) -> Any:
    for folder in (BENCHMARKS, BENCHMARKS / "validation"):
        monkeypatch.syspath_prepend(str(folder))
    return importlib.import_module("recognition_scenes")


def test_wilsons_interval_is_the_published_one(scenes):
    # Newcombe 1998, table I
    assert scenes.wilson(81, 263) == pytest.approx((0.2553, 0.3662), abs=1e-4)
    assert scenes.wilson(0, 20) == pytest.approx((0.0, 0.1611), abs=1e-4)
