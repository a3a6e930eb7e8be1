"""Settings and smoothers in few words."""

from __future__ import annotations

from typing import Any

from sonar_graph.settings import nested
from sonar_graph.slam import Isam2Params
from sonar_graph.slam.smoother import Smoother, SmootherParams


def isam2_params(**given: Any) -> Isam2Params:
    """By dotted names, with two underscores for a dot: ``smoother__lag_s``."""
    return Isam2Params(**nested({name.replace("__", "."): value for name, value in given.items()}))


def smoother_with(
    lag_s: float = 1e9,
    relinearize_threshold: float = 1e-6,
    stale_shift_m: float = 1e9,
    waiting_gain: float = 0.0,
    *,
    is_bounded: bool = False,
) -> Smoother:
    """One that keeps all poses, never restarts and lets nothing wait, unless told so."""
    params = SmootherParams(
        lag_s=lag_s, relinearize_threshold=relinearize_threshold, stale_shift_m=stale_shift_m, waiting_gain=waiting_gain
    )
    return Smoother(params, is_bounded=is_bounded)
