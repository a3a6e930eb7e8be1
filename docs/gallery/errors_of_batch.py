"""Draw the errors of all runs of a batch: ``python errors_of_batch.py FOLDER SCORE PICTURE.png``.

The folder is what ``sonar-graph bench`` wrote; a score is a column of its table, such as ``causal.ate_raw_m``. A run
that failed, or has no such score, is not drawn; the number beside the name says how many are.
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import pyarrow.parquet as pq

folder, score, picture = Path(sys.argv[1]), sys.argv[2], Path(sys.argv[3])
groups: dict[tuple[str, str], list[float]] = {}
for row in pq.read_table(folder / "results.parquet").to_pylist():
    groups.setdefault((row["log"], row["estimator"]), []).extend(
        [row[score]] if row[score] is not None else []
    )
figure, axes = plt.subplots(
    figsize=(7.2, 0.55 * len(groups) + 1.0), layout="constrained"
)
for height, values in enumerate(groups.values()):
    axes.plot(
        values,
        [height] * len(values),
        "o",
        alpha=0.5,
        color="#0072b2",
        markeredgewidth=0,
    )
axes.set_yticks(
    range(len(groups)),
    [f"{log}\n{name} ({len(values)})" for (log, name), values in groups.items()],
)
axes.invert_yaxis()
axes.set(xscale="log", xlabel=score)
axes.grid(axis="x", color="#d5d9dd", linewidth=0.6)
figure.savefig(picture, dpi=110)
print(picture)
