"""Draw paths and landmarks of a comparison in one picture: ``python map_of_comparison.py FOLDER PICTURE.png``.

The folder is what ``sonar-graph compare`` wrote. Where there is a truth of the path, each causal path is turned and
moved onto it (SE(2), as for `ate_se2_m`), and its landmarks with it.
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from sonar_graph.evaluation import read_comparison

COLOURS = {"isam2": "#0072b2", "ekf-slam": "#d55e00", "dead-reckoning": "#00805e"}
SAME_NS = 500_000_000
"""Stamps of path and truth that count as one instant."""


def motion_onto(moved: np.ndarray, fixed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Turn R (2, 2) and shift t (2,) that bring points onto others in least squares."""
    a, b = moved - moved.mean(axis=0), fixed - fixed.mean(axis=0)
    angle = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
    R = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return R, fixed.mean(axis=0) - R @ moved.mean(axis=0)


folder, picture = map(Path, sys.argv[1:])
comparison = read_comparison(folder)
truth = comparison.sequence.truth
figure, axes = plt.subplots(figsize=(7.2, 5.4), layout="constrained")
if truth is not None:
    axes.plot(
        *truth.positions[:, :2].T,
        color="#8b9198",
        linewidth=3.5,
        alpha=0.6,
        label="truth",
    )
for run in comparison.runs:
    path, colour = run.causal, COLOURS.get(run.estimator, "black")
    if path is None:
        continue
    R, t = np.eye(2), np.zeros(2)
    if truth is not None:
        near = np.clip(
            np.searchsorted(truth.stamps_ns, path.stamps_ns), 0, len(truth) - 1
        )
        both = np.abs(truth.stamps_ns[near] - path.stamps_ns) < SAME_NS
        R, t = motion_onto(path.positions[both, :2], truth.positions[near[both], :2])
    axes.plot(
        *(R @ path.positions[:, :2].T + t[:, None]),
        color=colour,
        linewidth=1.2,
        label=run.estimator,
    )
    if run.landmarks is not None and len(run.landmarks):
        places = R @ run.landmarks.positions[:, :2].T + t[:, None]
        axes.plot(*places, ".", color=colour, markersize=5)
axes.set(xlabel="x (m)", ylabel="y (m)", aspect="equal")
axes.grid(color="#d5d9dd", linewidth=0.6)
axes.legend(frameon=False)
figure.savefig(picture, dpi=110)
print(picture)
