"""Table of a batch, and the scores in it: their names, units and protocols, the same for every run.

``results.parquet`` has one row for each planned run. Its columns are in this order: the run, its ending, versions,
times, and then every score by its key, in alphabetical order. A value that was not measured is null. A run that was not
done has the status ``not run`` and no numbers. The suite's name, description, reference, metrics and rate
are JSON in the file's metadata, under ``sonar_graph.suite``.
"""

import json
import math
from dataclasses import dataclass
from pathlib import Path

from sonar_graph.batch.recorded import RESULTS, SUITE_METADATA
from sonar_graph.batch.store import NOT_RUN, PlannedRun, Row, Store
from sonar_graph.batch.suite import Suite
from sonar_graph.evaluation import DIRECTIONS, SCORES, ScoreKind, format_value
from sonar_graph.files import replacing

KINDS = ("causal", "smoothed")
# times that every run has
TIMINGS = ("wall_s", "read_s", "estimate_s", "cpu_s")


@dataclass(frozen=True)
class Metric:
    """One kind of score, of the causal and the smoothed estimate or of neither."""

    name: str
    """Key without its prefix, such as ``ate_se2_m``."""
    keys: dict[str, str]
    """Column of the results by estimate, ``Causal`` or ``Smoothed``; the key is empty for a score of neither."""

    @property
    def kind(self) -> ScoreKind:
        """The score, of either estimate; a number of another table is known by its name alone."""
        key = next(iter(self.keys.values()))
        return SCORES.get(key, ScoreKind(self.name, self.name, rule=""))

    @property
    def label(self) -> str:
        """Name for readers."""
        return self.kind.label

    @property
    def unit(self) -> str:
        """Unit of the stored value; empty for a number."""
        return self.kind.unit.removeprefix("1")

    @property
    def shown_unit(self) -> str:
        """Unit on the page: degrees for radians."""
        return "°" if self.unit == "rad" else self.unit

    @property
    def factor(self) -> float:
        """Factor from the stored to the shown value."""
        return math.degrees(1) if self.unit == "rad" else 1.0

    def text(self, value: float) -> str:
        """A value as people see it; words for infinity, which stands for runs without a value."""
        return "no value" if math.isinf(value) else format_value(value * self.factor)

    @property
    def direction(self) -> str:
        """Words for the better values."""
        return DIRECTIONS[self.kind.better]

    @property
    def is_error(self) -> bool:
        """True if smaller is better and a repeated run gives the same value, so that differences can be tested.

        Time and memory depend on the machine and its load: they are shown, and not tested.
        """
        return self.kind.better == "lower" and not any(
            map(is_timing, self.keys.values())
        )

    @property
    def protocol(self) -> str:
        """Definition in a sentence."""
        each = " Separately for the causal and the smoothed estimate."
        return (
            f"{self.label}, as compare defines it in the comparison.json of each run."
            f"{'' if '' in self.keys else each}"
        )


def is_timing(column: str) -> bool:
    """True for columns that may differ between two equal runs: time and memory."""
    return column in TIMINGS or column.startswith(("time.", "memory."))


def metrics_of(keys: list[str]) -> list[Metric]:
    """Metrics in the suite's order; a trajectory score that is named once is shown causal and smoothed."""
    found: dict[str, Metric] = {}
    for key in keys:
        prefix, _, name = key.partition(".")
        if prefix in KINDS:
            found[f"trajectory.{name}"] = Metric(
                name, {kind.capitalize(): f"{kind}.{name}" for kind in KINDS}
            )
        else:
            found[key] = Metric(name, {"": key})
    return list(found.values())


# fields of a planned run that are columns
DESCRIBED = ("key", "suite", "log", "seed", "variant", "estimator", "rate_hz")
TEXTS = ("key", "suite", "log", "generator", "options", "asked")
SETTINGS = (
    "variant",
    "params",
    "estimator",
    "status",
    "reason",
    "withheld",
    "log_file",
)
# notes of the comparison of a log's sensors with each other, as of `sonar-graph compare`
FINDINGS = ("doubtful", "sensors")
VERSIONS = (
    "sonar_graph",
    "source",
    "estimator_source",
    "gtsam",
    "numpy",
    "scipy",
    "numba",
    "python",
    "machine",
)
COLUMNS = {
    **dict.fromkeys(TEXTS, "string"),
    "seed": "int64",
    **dict.fromkeys(SETTINGS, "string"),
    **dict.fromkeys(FINDINGS, "string"),
    "rate_hz": "float64",
    **dict.fromkeys(VERSIONS, "string"),
    **dict.fromkeys(TIMINGS, "float64"),
    "scored_instants": "int64",
}


def write_results(store: Store, suite: Suite, runs: list[PlannedRun]) -> Path:
    """Write the table of all runs, also of those that are not done, in the order of the plan; whole or not at all."""
    import pyarrow as pa  # of the extra `bench`
    import pyarrow.parquet as pq

    rows: list[Row] = []
    for run in runs:
        landmarks = {} if run.landmarks is None else {"landmarks": run.landmarks}
        as_json = {
            "options": run.options | landmarks,
            "asked": run.asked,
            "params": run.params,
        }
        described: Row = {
            **{name: getattr(run, name) for name in DESCRIBED},
            "generator": run.kind,
            **{name: json.dumps(one, sort_keys=True) for name, one in as_json.items()},
            **{name: run.versions[name] for name in VERSIONS if name in run.versions},
            "log_file": store.log_file(run.key),
        }
        # a batch that ends early can be read without the code that planned it
        not_done: Row = {
            "status": NOT_RUN,
            "reason": "not done when this table was written",
            "log_file": None,
        }
        # versions are those that the run itself found
        rows.append(described | (store.row(run.key) or not_done))
    # scores differ from log to log; every table has all of them in one order
    scores = sorted({name for row in rows for name in row} - set(COLUMNS))
    types = COLUMNS | {
        name: "int64" if name.endswith("_dof") else "float64" for name in scores
    }
    about = suite.model_dump(
        mode="json", include={"name", "description", "reference", "metrics", "rate_hz"}
    )
    schema = pa.schema(
        [pa.field(name, pa.type_for_alias(kind)) for name, kind in types.items()],
        metadata={SUITE_METADATA: json.dumps(about).encode()},
    )
    path = store.folder / RESULTS
    with (
        replacing(path) as partial,
        partial.open("wb") as stream,
    ):  # pyarrow takes names of files in UTF-8 alone
        pq.write_table(pa.Table.from_pylist(rows, schema=schema), stream)
    return path
