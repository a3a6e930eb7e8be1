"""Which new factors a smoother has to do without, and why, in words.

A landmark whose new factors leave a direction open cannot be solved for; a factor whose error is no number spoils all
variables, and marginals for good. Such factors are withheld, with the landmarks and biases that then have none, and the
rest goes on as if they had never come. A keyframe cannot be withheld, since later ones hang on it.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from sonar_graph.errors import EstimatorError
from sonar_graph.slam.determinacy import LEAST_SAID, Open, factor_names, left_open, not_finite, variable_name
from sonar_graph.slam.new_window import keys_of
from sonar_graph.slam.pending import Pending

MISSING = {
    "l": "an elevation, a floor prior or a view from elsewhere is missing",
    "b": "a prior or a walk from another bias is missing",
    "x": "odometry from another keyframe or a prior is missing",
}


@dataclass(frozen=True, eq=False)
class Withheld:
    """Factors that are not used, with variables that are not estimated."""

    handles: set[int]
    keys: set[int]
    message: str
    """The variable, its factors, and what is missing."""


def spoilt(pending: Pending, values: gtsam.Values, times_s: dict[int, float]) -> list[Withheld]:
    """New factors whose error is no number.

    Parameters
    ----------
    values, times_s
        See `undetermined`.
    """
    if np.isfinite(pending.graph.error(values)):
        return []
    return [_no_number(pending.handles[i], pending, times_s) for i in not_finite(pending.graph, values)]


def undetermined(
    pending: Pending, values: gtsam.Values, times_s: dict[int, float], least_said: float = 0.0
) -> list[Withheld]:
    """New landmarks and biases that their factors leave open, whatever becomes of the poses.

    Parameters
    ----------
    values
        Of the variables of the new factors.
    times_s
        Of the keyframes.
    least_said
        See `sonar_graph.slam.determinacy.left_open`.
    """
    found = []
    for key in keys_of(pending.values):
        if gtsam.symbolChr(key) != ord("x"):
            found += [
                _without(open_, pending, times_s) for open_ in left_open(pending.graph, values, [key], least_said)
            ]
    return found


def culprits(
    window: gtsam.NonlinearFactorGraph, pending: Pending, values: gtsam.Values, times_s: dict[int, float]
) -> list[Withheld]:
    """Why a window with new factors cannot be solved; nothing where it can, if with better arithmetic.

    Parameters
    ----------
    window
        Without what is pending.

    Raises
    ------
    EstimatorError
        When a keyframe, or what was in the window before, is left open.
    """
    graph = gtsam.NonlinearFactorGraph(window)
    graph.push_back(pending.graph)
    found: list[Withheld] = []
    used = set(graph.keyVector()) | set(keys_of(pending.values))
    for open_ in left_open(graph, values, sorted(used)):
        if gtsam.symbolChr(open_.key) == ord("x") or not pending.values.exists(open_.key):
            raise EstimatorError(f"isam2: {explained(open_, _on(open_.key, graph), times_s)}")
        found.append(_without(open_, pending, times_s))
    return found or undetermined(pending, values, times_s, LEAST_SAID)


def reasons(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, times_s: dict[int, float]) -> str:
    """Why a graph has no solution."""
    spoilt = [graph.at(i) for i in not_finite(graph, values)]
    if spoilt:
        where = _placed(list(spoilt[0].keys())[-1], spoilt, times_s)
        return f"{where}: {factor_names(spoilt)} gives an error that is no number; leave the measurement out"
    found = [explained(open_, _on(open_.key, graph), times_s) for open_ in left_open(graph, values, keys_of(values))]
    return "; ".join(found) or "the graph is determined too weakly for arithmetic of sixteen digits; narrow its priors"


def explained(open_: Open, factors: list[gtsam.NonlinearFactor], times_s: dict[int, float]) -> str:
    """The variable, its factors, the open directions, and what would close them."""
    kind = chr(gtsam.symbolChr(open_.key))
    return f"{_placed(open_.key, factors, times_s)}: {factor_names(factors)}; open: {open_.axes()}; {MISSING[kind]}"


def _placed(key: int, factors: list[gtsam.NonlinearFactor], times_s: dict[int, float]) -> str:
    """A variable by name, with the keyframes that its factors tie it to."""
    keyframes = sorted({k for factor in factors for k in list(factor.keys()) if gtsam.symbolChr(k) == ord("x")})
    if gtsam.symbolChr(key) == ord("x"):
        keyframes = [key]
    at = ", ".join(f"{variable_name(k)} at {times_s[k]:.3f} s" for k in keyframes if k in times_s)
    if gtsam.symbolChr(key) == ord("x"):
        return at or variable_name(key)
    return f"{variable_name(key)}, from {at}" if at else variable_name(key)


def _without(open_: Open, pending: Pending, times_s: dict[int, float]) -> Withheld:
    handles = pending.on(open_.key)
    factors = [pending.factor(handle) for handle in handles]
    return Withheld(set(handles), {open_.key}, f"{explained(open_, factors, times_s)}; withheld")


def _no_number(handle: int, pending: Pending, times_s: dict[int, float]) -> Withheld:
    factor = pending.factor(handle)
    key = max(list(factor.keys()), key=lambda k: gtsam.symbolChr(k) == ord("l"))
    where = _placed(key, [factor], times_s)
    return Withheld({handle}, set(), f"{where}: {factor_names([factor])} gives an error that is no number; withheld")


def _on(key: int, graph: gtsam.NonlinearFactorGraph) -> list[gtsam.NonlinearFactor]:
    return [graph.at(i) for i in range(graph.size()) if key in list(graph.at(i).keys())]
