"""A suite: the logs or simulations, seeds, estimators and variants to run, and how they are compared.

::

    name = "smoke"
    reference = "dead-reckoning"

    [[logs]]
    name = "short basin"
    generator = "basin"
    options = { duration_s = 130, laps = 1 }
    grid = { wrong_id_rate = [0.0, 0.05] }
    seeds = 3

    [[estimators]]
    name = "isam2"
    grid = { smoother.lag_s = [5, 15] }

    [[estimators]]
    name = "dead-reckoning"

Mistakes are found before anything runs and reported with file, line and key.
"""

from __future__ import annotations

import os
import tomllib
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NoReturn

from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    ValidationError,
    field_validator,
    model_validator,
)

from sonar_graph.calibration import Section
from sonar_graph.errors import BatchError
from sonar_graph.evaluation import SCORES
from sonar_graph.files import parsed_toml, text_of
from sonar_graph.settings import choice, faults_in, flattened

# names of tables and keys, and indices of the entries of arrays, from the top of the file
Place = tuple[int | str, ...]
# environment variable: folder of data sets that do not lie beside the suite
DATA_VARIABLE = "SONAR_GRAPH_DATA"
DEFAULT_METRICS = (
    "causal.ate_se2_m",
    "causal.ate_raw_m",
    "causal.rpe_10s_m",
    "causal.yaw_rmse_rad",
    "smoothed.ate_se2_m",
    "smoothed.ate_raw_m",
    "landmarks.se2_m",
    "time.update_median_ms",
)
MOST_SEEDS = 1_000_000
# largest integer that a column of the results can hold
LARGEST_SEED = 2**63 - 1


# values by name; names of nested settings are dotted
Grid = Annotated[
    dict[str, list[Any]],
    BeforeValidator(
        lambda given: flattened(given) if isinstance(given, dict) else given
    ),
]


def _printable(name: str) -> str:
    if not name.isprintable():
        raise ValueError("expected a name without control characters")
    return name


Name = Annotated[str, AfterValidator(_printable)]


class LogEntry(Section):
    """One log, data set or generator; with a grid, several of them."""

    name: Name = Field(min_length=1)
    """Label in tables."""
    log: str | None = None
    """MCAP file, relative to the suite's folder; its ``options``: `sonar_graph.batch.sources.LogOptions`."""
    dataset: str | None = None
    """Name of a public data set."""
    generator: str | None = None
    """Name of a simulator."""
    options: dict[str, Any] = Field(default_factory=dict)
    grid: Grid = Field(default_factory=dict)
    """Options that take each of several values, in every combination."""
    seeds: int | list[int] | None = None
    """Seeds of a generator or of ``landmarks``: their number, from 0 on, or a list."""
    landmarks: dict[str, Any] | None = None
    """Options of landmarks to be simulated on a recorded log."""
    obtain: str = ""
    """Source of the log or data set: where its files are absent the batch goes on without it, and the page says so."""

    @field_validator("seeds", mode="before")
    @classmethod
    def _check_seeds(cls, value: Any) -> Any:
        if value is None:
            return None
        seeds = value if isinstance(value, list) else [value]
        # a number of seeds is a number of runs, and a million is a mistake
        largest = LARGEST_SEED if isinstance(value, list) else MOST_SEEDS
        are_numbers = all(type(seed) is int and 0 <= seed <= largest for seed in seeds)
        if not are_numbers or len(set(seeds)) < len(seeds):
            raise ValueError(
                f"expected the number of seeds, up to {MOST_SEEDS}, or a list of different whole numbers from 0 to "
                f"{LARGEST_SEED}"
            )
        return value

    @model_validator(mode="after")
    def _check(self) -> LogEntry:
        if [self.log, self.dataset, self.generator].count(None) != 2:
            raise ValueError("expected exactly one of log, dataset and generator")
        if self.landmarks is not None and self.generator is not None:
            raise ValueError(
                "landmarks are put on a log or dataset; a generator has its own"
            )
        if self.seeds is not None and self.generator is None and self.landmarks is None:
            raise ValueError(
                "seeds are for a generator, or for landmarks simulated on a log"
            )
        return self

    @property
    def kind(self) -> str:
        """Name of the source in `sonar_graph.batch.sources.KINDS`."""
        return self.generator or self.dataset or "mcap"

    def seed_list(self) -> list[int | None]:
        """Seeds to run; one None if nothing is random."""
        if self.generator is None and self.landmarks is None:
            return [None]
        if isinstance(self.seeds, int):
            return list(range(self.seeds))
        return [0] if self.seeds is None else [*self.seeds]


class EstimatorEntry(Section):
    """One estimator; with a grid, several variants of it."""

    name: str
    """Name of the installed estimator."""
    variant: Name = ""
    """Label of these settings in tables."""
    params: dict[str, Any] = Field(default_factory=dict)
    """Settings that differ from the defaults."""
    grid: Grid = Field(default_factory=dict)
    """Settings that take each of several values, in every combination."""


class Suite(Section):
    """Content of a suite's file."""

    name: Name = Field(min_length=1)
    description: str = ""
    rate_hz: float = Field(2.0, gt=0, le=1000)
    """Rate at which every estimator is asked for its estimate."""
    reference: str
    """Estimator with which the others are compared: its name, or ``name/variant``."""
    metrics: tuple[str, ...] = Field(DEFAULT_METRICS, min_length=1)
    """Keys of the scores that are compared; all are recorded."""
    timeout_s: float = Field(3600.0, gt=0)
    """A run that takes longer is ended."""
    memory_mb: float | None = Field(None, gt=0)
    """A run whose process needs more (10⁶ bytes) is ended; None: no limit but the machine's."""
    logs: list[LogEntry] = Field(min_length=1)
    estimators: list[EstimatorEntry] = Field(min_length=1)


@dataclass(frozen=True)
class SuiteFile:
    """A suite with the text that it was read from."""

    path: Path
    text: str
    suite: Suite

    def refuse(self, place: Place, fault: str) -> NoReturn:
        """Raise for a mistake at a place of the file.

        Raises `BatchError` with file, line and key.
        """
        raise BatchError(
            f"{self.path}, line {line_of(self.text, place)}: {'.'.join(map(str, place))}: {fault}"
        )

    def holds(self, name: str) -> bool:
        """True if a file or folder is where `find` looks for it."""
        return bool(self._found(name))

    def find(self, place: Place, name: str) -> str:
        """Absolute path of a file or folder, relative to the suite's folder or else to the folder of data sets.

        Raises `BatchError` when it is in neither.
        """
        found = self._found(name)
        if not found:
            looked = " or ".join(str(root.resolve()) for root in self._roots())
            more = f"; {DATA_VARIABLE} can name another folder to look in"
            if len(self._roots()) > 1:
                more = ""
            self.refuse(place, f"{name} is not in {looked}{more}")
        # files beside the suite go before those of a folder for all suites
        return str(found[0].resolve())

    def _found(self, name: str) -> list[Path]:
        return [root / name for root in self._roots() if (root / name).exists()]

    def _roots(self) -> list[Path]:
        data = os.environ.get(DATA_VARIABLE)
        return [self.path.parent, *([Path(data)] if data else [])]


def read_suite(path: Path) -> SuiteFile:
    """Read a suite and check its values one by one; `plan_runs` checks what they refer to.

    Raises
    ------
    BatchError
        When it cannot be read, is no TOML, or a value is missing, unknown or does not fit.

    Examples
    --------
    >>> from pathlib import Path
    >>> from sonar_graph.batch import read_suite
    >>> text = '''
    ... name = "lap"
    ... reference = "dead-reckoning"
    ... [[logs]]
    ... name = "basin"
    ... generator = "basin"
    ... seeds = 2
    ... [[estimators]]
    ... name = "dead-reckoning"
    ... '''
    >>> written = Path("lap.toml").write_text(text)
    >>> read_suite(Path("lap.toml")).suite.name
    'lap'
    """
    try:
        text = text_of(path)
    except (OSError, UnicodeDecodeError) as error:
        raise BatchError(f"{path}: cannot be read: {error}") from error
    values = parsed_toml(text, path, BatchError)
    try:
        suite = Suite.model_validate(values)
    except ValidationError as error:
        line = line_of(text, error.errors()[0]["loc"])
        raise BatchError(f"{path}, line {line}: {faults_in(error, Suite)}") from error
    found = SuiteFile(path, text, suite)
    for number, metric in enumerate(suite.metrics):
        if metric not in SCORES:
            found.refuse(
                ("metrics", number),
                f"there is no score {metric!r}{choice(metric, SCORES)}",
            )
    return found


def line_of(text: str, place: Place) -> int:
    """Line, counted from 1, of a key in a valid TOML document, or of the nearest table or array around it.

    The first lines of a TOML document are a valid document too, unless a value continues below them. A key therefore
    begins after the longest valid part that lacks it.
    """
    lines = text.splitlines(keepends=True)
    for length in range(len(place), 0, -1):
        begin = 1
        for count in range(1, len(lines) + 1):
            try:
                values: Any = tomllib.loads("".join(lines[:count]))
            except tomllib.TOMLDecodeError:
                continue
            with suppress(KeyError, IndexError, TypeError):
                for name in place[:length]:
                    values = values[name]
                return begin
            begin = count + 1
    return 1
