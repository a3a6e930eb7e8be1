"""Write the tables of a batch as Markdown: ``python benchmarks/suites/open_tables.py FOLDER``.

The folder is what ``sonar-graph bench`` wrote. A number is the median of a log's runs; a run that failed makes it a
dash with the share of runs that ended, for a median over survivors would flatter.
"""

import statistics
import sys
from collections import defaultdict
from pathlib import Path

import pyarrow.parquet as pq

TABLES = (
    ("Causal position, m (aligned, RMS)", "causal.ate_se2_m", 3),
    ("Smoothed position, m", "smoothed.ate_se2_m", 3),
    ("Map, m", "landmarks.se2_m", 3),
    ("NEES of the causal position (1 fits)", "causal.nees_position", 3),
    ("99 % of the updates, ms", "time.update_p99_ms", 2),
    ("Memory that the run adds, MB", "memory.peak_mb", 2),
)


def name_of(row: dict) -> str:
    """Estimator, and its variant where it is not the default."""
    return (
        row["estimator"]
        if row["variant"] in (None, "", "default")
        else f"{row['estimator']}, {row['variant']}"
    )


def cell(of_runs: list[dict], key: str, digits: int) -> str:
    """Median of a score as a text."""
    ended = [row for row in of_runs if row["status"] == "ok"]
    if len(ended) < len(of_runs):
        return f"— ({len(ended)}/{len(of_runs)})"
    values = [row[key] for row in of_runs if row[key] is not None]
    if len(values) < len(of_runs):
        return ""
    return f"{float(f'{statistics.median(values):.{digits}g}'):g}"


rows = pq.read_table(Path(sys.argv[1]) / "results.parquet").to_pylist()
runs: dict[str, dict[str, list[dict]]] = defaultdict(lambda: defaultdict(list))
for row in rows:
    runs[row["log"]][name_of(row)].append(row)
names = list(dict.fromkeys(name for of_log in runs.values() for name in of_log))

for title, key, digits in TABLES:
    lines = []
    for log, of_log in runs.items():
        count = max(map(len, of_log.values()))
        cells = [
            cell(of_log[name], key, digits) if name in of_log else "" for name in names
        ]
        if any(cells):
            lines.append(
                " | ".join(
                    ["", f"{log}, {count} run{'s' * (count > 1)}", *cells, ""]
                ).strip()
            )
    print(
        f"| {title} | {' | '.join(names)} |\n|---{'|---' * len(names)}|",
        *lines,
        "",
        sep="\n",
    )
failures = defaultdict(list)
for row in rows:
    if row["status"] != "ok":
        reason = (
            row["reason"].split(": ", 1)[-1].split(".")[0].split(" near variable")[0]
        )
        failures[name_of(row), row["log"], reason].append(row["seed"])
print(
    *(
        f"- {name} on {log}: {len(seeds)} run(s), {why}"
        for (name, log, why), seeds in failures.items()
    ),
    sep="\n",
)
print(
    "\n"
    + ", ".join(
        f"{what} {rows[0][what]}"
        for what in ("sonar_graph", "gtsam", "numpy", "python", "machine")
    )
)
