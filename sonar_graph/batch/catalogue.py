"""Scores that a batch compares: their names, units and protocols, the same for every run."""

from __future__ import annotations

import math
from dataclasses import dataclass

from sonar_graph.evaluation.score_table import LABELS
from sonar_graph.evaluation.scores import ESTIMATES

KINDS = ("causal", "smoothed")
UNITS = {"m": "m", "rad": "rad", "ms": "ms", "s": "s", "mb": "MB"}
PROTOCOLS = {
    "ate_raw_m": "Not aligned: root of the mean square of 3-D position errors.",
    "ate_yaw_m": "Aligned by yaw and translation without scale (Umeyama 1991): rms of 3-D position errors.",
    "ate_se2_m": "Aligned by SE(2) without scale (Umeyama 1991): rms of horizontal position errors.",
    "ate_se3_m": "Aligned by SE(3) without scale (Umeyama 1991): rms of 3-D position errors.",
    "rpe_1s_m": "Rms of the error of body-frame displacement over 1 s, overlapping pairs.",
    "rpe_10s_m": "Rms of the error of body-frame displacement over 10 s, overlapping pairs.",
    "rpe_1s_rad": "Rms of the error of heading change over 1 s, overlapping pairs.",
    "rpe_10s_rad": "Rms of the error of heading change over 10 s, overlapping pairs.",
    "yaw_rmse_rad": "Not aligned: rms of wrapped heading errors.",
    "return_error_m": "Not aligned: norm of estimated minus true displacement from the first to the last instant.",
    "raw_m": "Map at the end, landmarks matched by identity, not aligned: rms of horizontal errors.",
    "se2_m": "Map at the end, landmarks matched by identity, aligned by SE(2): rms of horizontal errors.",
    "nees_position": "Normalised squared error of position per degree of freedom, mean over the instants of a run.",
    "nees_yaw": "Normalised squared error of heading, mean over the instants of a run.",
}
HIGHER_IS_BETTER = {"real_time_factor"}
NO_BETTER = {"count", "used", "refused", "unnamed"}
INSIDE = {"nees", "nis", "nees_position", "nees_yaw"}
TIMINGS = (
    *("wall_s", "read_s", "estimate_s", "cpu_s", "peak_memory_mb"),
    *("update_p50_ms", "update_p99_ms", "finish_s"),
)
"""Columns of the results that every run has, of time and memory."""


@dataclass(frozen=True)
class Metric:
    """One kind of score, of the causal and the smoothed estimate or of neither."""

    name: str
    """Key without its prefix, such as ``ate_se2_m``."""
    keys: dict[str, str]
    """Column of the results by what it is of: ``Causal``, ``Smoothed``; empty where there is no such distinction."""

    @property
    def label(self) -> str:
        """For people."""
        return LABELS.get(self.name, self.name)

    @property
    def unit(self) -> str:
        """Of the stored value."""
        return UNITS.get(self.name.rpartition("_")[2], "")

    @property
    def shown_unit(self) -> str:
        """Of the value on the page: degrees for radians."""
        return "°" if self.unit == "rad" else self.unit

    @property
    def factor(self) -> float:
        """From the stored to the shown value."""
        return math.degrees(1) if self.unit == "rad" else 1.0

    @property
    def direction(self) -> str:
        """Which values are better."""
        if self.name in INSIDE:
            return "1 is consistent"
        if self.name in NO_BETTER:
            return ""
        return "higher is better" if self.name in HIGHER_IS_BETTER else "lower is better"

    @property
    def is_error(self) -> bool:
        """Whether smaller is better and the same run always gives it, so that differences can be tested.

        Time and memory depend on the machine and on what else it does: they are shown, and not tested.
        """
        return self.direction == "lower is better" and not any(map(is_timing, self.keys.values()))

    @property
    def protocol(self) -> str:
        """How it was got, in a sentence."""
        said = PROTOCOLS.get(self.name, f"As compare writes it: the run's comparison.json, {self.name}.")
        if set(self.keys) <= {""}:
            return said
        return f"{said} Separately for the causal and the smoothed estimate."


def is_timing(column: str) -> bool:
    """Whether a column may differ between two runs of the same: time and memory."""
    return column in TIMINGS or column.startswith(("time.", "memory."))


def metrics_of(keys: list[str]) -> list[Metric]:
    """Metrics in the order in which a suite names them; a trajectory score named once is shown causal and smoothed."""
    found: dict[str, Metric] = {}
    for key in keys:
        prefix, _, name = key.partition(".")
        if prefix in KINDS:
            found[f"trajectory.{name}"] = Metric(name, {kind.capitalize(): f"{kind}.{name}" for kind in KINDS})
        else:
            found[key] = Metric(name, {"": key})
    return list(found.values())


def estimate_sentences() -> list[str]:
    """What causal and smoothed mean."""
    return [f"{sentence}." for sentence in ESTIMATES.values()]
