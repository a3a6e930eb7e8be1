import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sonar_graph.batch import one_run
from sonar_graph.batch.one_run import perform
from sonar_graph.batch.result_table import COLUMNS, is_timing
from sonar_graph.batch.sources import (
    KINDS,
    LOG,
    LogOptions,
    SourceKind,
    fingerprint,
    read_source,
)
from sonar_graph.batch.store import PlannedRun
from sonar_graph.errors import BatchError
from sonar_graph.evaluation import SCORES, compare, read_comparison
from sonar_graph.sequence import Sequence
from sonar_graph.simulation import (
    BasinOptions,
    LandmarkOptions,
    MissionOptions,
    add_landmarks,
    simulate_basin,
    simulate_mission,
)


def numbers(row: dict[str, Any]) -> dict[str, Any]:
    """What two equal runs have in common."""
    return {name: value for name, value in row.items() if not is_timing(name)}


def test_scores_are_those_of_compare_bit_for_bit(planned, tmp_path):
    row = perform(planned("isam2"), tmp_path / "run")
    sequence = simulate_basin(BasinOptions(duration_s=120, laps=1))
    scores = compare(sequence, ["isam2"]).scores["isam2"]
    values = {key: score.value for key, score in scores.items()}
    assert set(scores) <= set(row) & set(SCORES)
    assert numbers({key: row[key] for key in scores}) == numbers(values)
    others = set(row) - set(SCORES) - set(COLUMNS)
    assert others == {name for name in row if name.endswith(("_dof", "_end"))}


def of_log(run: PlannedRun, log: Path) -> PlannedRun:
    options = {"log": str(log)}
    content = fingerprint(LOG, options)
    return replace(run, kind=LOG, options=options, content=content, seed=None)


def test_failed_logs_and_estimators_are_rows_with_a_reason(
    planned, misbehaving, tmp_path
):
    log = tmp_path / "dive.mcap"
    log.write_bytes(b"not a log")
    unread = r"while reading or simulating the log: LogError: .*dive\.mcap.*"
    for run, reason in (
        (of_log(planned(), log), unread),
        (planned("prints"), "((?!dive.mcap).)*RuntimeError: diverged"),
    ):
        row = perform(run, tmp_path / "run")
        assert row["status"] == "failed"
        assert re.fullmatch(reason, row["reason"])
        assert not [name for name in row if name.startswith("causal.")]


def test_a_log_is_that_of_the_plan_or_gives_no_result(planned, tmp_path, monkeypatch):
    """A process that has the old sequence in hand gets a run that was planned with the new file."""
    log = log_with_duration(tmp_path, monkeypatch, 20)
    planned_short = of_log(planned(), log)
    short = perform(planned_short, tmp_path / "short")
    log.write_text("30")
    long = perform(of_log(planned(), log), tmp_path / "long")
    assert long["scored_instants"] > short["scored_instants"] > 0
    changed = r"log \S+dive\.mcap: not what it was when the run was planned"
    with pytest.raises(BatchError, match=changed):
        perform(replace(planned_short, seed=1), tmp_path / "run")  # not in hand
    run = replace(of_log(planned(), log), landmarks={}, seed=0)
    read = one_run.read_source

    def read_and_changed(*given):
        sequence = read(*given)
        log.write_text("20")
        return sequence

    monkeypatch.setattr(one_run, "read_source", read_and_changed)
    with pytest.raises(BatchError, match=changed):
        perform(run, tmp_path / "run")


def mission(duration_s: int) -> Sequence:
    return simulate_mission(MissionOptions(duration_s=duration_s))


def log_with_duration(
    folder: Path, monkeypatch: pytest.MonkeyPatch, duration_s: int
) -> Path:
    """A file with a number in it, which is read as a simulated mission that lasts so long."""

    def read(options):
        return mission(int(Path(options.log).read_text()))

    monkeypatch.setitem(KINDS, "mcap", SourceKind(LogOptions, read))
    log = folder / "dive.mcap"
    log.write_text(str(duration_s))
    return log


def test_landmarks_on_a_log_are_those_of_the_seed(tmp_path, monkeypatch):
    log = log_with_duration(tmp_path, monkeypatch, 60)
    given = {"log": str(log)}
    found, other = (map_of(read_source(LOG, given, seed, {})) for seed in (1, 0))
    expected = map_of(add_landmarks(mission(60), LandmarkOptions(seed=1)))
    assert found == expected != other


def map_of(sequence: Sequence) -> list[list[float]]:
    return sequence.true_landmarks.positions.tolist()


def test_other_versions_than_planned_give_no_result(planned, tmp_path):
    run = planned()
    gtsam = r"a worker has gtsam 4\.3\S*, planned with gtsam 4\.2; install the same"
    source = r"a worker has source \w+, planned with source changed; "
    for changed, told in (
        ({"gtsam": "4.2"}, gtsam),
        ({"source": "changed"}, source),
    ):
        with pytest.raises(BatchError, match=told):
            perform(replace(run, versions=run.versions | changed), tmp_path / "run")
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match="file"):
        perform(run, tmp_path / "file")


def test_a_row_has_versions_and_the_errors_at_the_last_instant(planned, tmp_path):
    run = planned()
    row = perform(run, tmp_path / "a")
    other = perform(replace(run, seed=1), tmp_path / "b")
    assert other["causal.ate_raw_m"] != row["causal.ate_raw_m"]
    for name in ("gtsam", "numpy", "scipy", "numba"):
        assert row[name] == run.versions[name]
    causal = read_comparison(tmp_path / "a").errors[run.estimator]["causal"]
    nees = row["causal.nees_position_end"]
    assert nees == causal.nees_position[-1] / 3
    # the squares of the axes alone bound it from below
    share = causal.position_m[-1] / causal.position_sigma_m[-1]
    assert nees >= np.max(share**2) / 3 - 1e-12
    assert row["causal.nees_position_end_dof"] == row["causal.nees_position_dof"] == 3
    assert row["causal.nees_yaw_end_dof"] == 1
    assert row["scored_instants"] == len(causal.stamps_ns)
