"""What is done, under which limits, and what comes of it: the words that batch, workers and processes share."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

Status = Literal["ok", "failed", "timeout", "memory", "killed"]
NOT_RUN = "not run"
"""In place of the status of a run that is planned and was not done: the table has a row for it too."""
Row = dict[str, str | int | float | None]
"""Of the table of results, by column."""


@dataclass(frozen=True)
class PlannedRun:
    """One run: all that a process needs to do it, and nothing that it would have to ask for."""

    key: str
    """Of everything that decides its outcome: content of the log or options of the simulator, seed, estimator,
    settings, rate, versions, source. Equal keys, equal numbers."""
    suite: str
    log: str
    """Name with the values of its grid."""
    kind: str
    """Generator, data set, or ``mcap``."""
    options: dict[str, Any]
    content: dict[str, Any]
    """`sonar_graph.batch.sources.fingerprint` of kind and options when the run was planned."""
    landmarks: dict[str, Any] | None
    seed: int | None
    estimator: str
    variant: str
    overrides: dict[str, Any]
    """Settings that were given; an estimator may tell them from equal defaults."""
    params: dict[str, Any]
    """All settings; of an estimator that cannot be loaded those that were given."""
    rate_hz: float
    versions: dict[str, str]
    asked: dict[str, Any]
    """What the suite states of it, of files their content, without what it leaves to defaults: two runs of one name are
    comparable where these are equal, though a default or the code was changed between them."""


@dataclass(frozen=True)
class Preparation:
    """What a process is asked before the first run of an estimator, and before the clock of that run starts."""

    run: PlannedRun


@dataclass(frozen=True)
class Limits:
    """What a run may take."""

    timeout_s: float
    memory_mb: float | None = None
    """Resident memory of its process and of those that it starts, 10⁶ bytes; None: no limit but the machine's."""


@dataclass(frozen=True)
class Outcome:
    """What a run left: a row of what was measured, files by their path within its folder, and its log."""

    row: Row
    files: dict[str, bytes] = field(default_factory=dict)
    log: str = ""
