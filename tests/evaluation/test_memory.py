from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sonar_graph.evaluation import run as memory
from sonar_graph.evaluation.run import PeakMemory

MEGABYTES = 80


def touch() -> float:
    return float(np.ones(MEGABYTES * 125_000).sum())


@pytest.mark.skipif(np.isnan(PeakMemory().rise_mb()), reason="this system does not tell a process's peak memory")
def test_peak_sees_what_was_freed_again_and_forgets_what_was_before() -> None:
    touch()
    quiet = PeakMemory()
    assert quiet.rise_mb() < MEGABYTES / 2
    loud = PeakMemory()
    touch()
    assert loud.rise_mb() > 0.8 * MEGABYTES


def test_unknown_where_the_system_does_not_tell(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(memory, "CLEAR_REFS", tmp_path / "absent" / "clear_refs")
    assert np.isnan(PeakMemory().rise_mb())
