"""Error of the causal pose on the estimator's own map: the place where a vehicle finds itself among its landmarks.

    e_j = | T_j p(t_j) - p_true(t_j) |,    T_j: the best alignment of the map known at t_j to the true landmarks

A smoother moves its whole map when it learns, and the path that it told before does not move with it. Raw and aligned
errors of the path count that; this one does not. Derivation: docs/theory/metrics.md.
"""

from collections.abc import Sequence as Many

import numpy as np

from sonar_graph.evaluation.metrics import align_map
from sonar_graph.evaluation.results import RunResult
from sonar_graph.measurements import Floats, Ints
from sonar_graph.sequence import Sequence

LEAST_LANDMARKS = 3
"""True landmarks that a map must name: of two, the errors alone would turn it."""


def own_map_errors(
    run: RunResult, sequence: Sequence, scored_ns: Ints
) -> tuple[Ints, Floats]:
    """Stamps and horizontal errors, shapes (k,), at those scored instants at which the run's map was kept.

    Instants at which the map names fewer than `LEAST_LANDMARKS` true landmarks are left out.
    """
    truth, true, path = sequence.truth, sequence.true_landmarks, run.causal
    stamps: list[int] = []
    errors: list[float] = []
    if truth is None or true is None or path is None:
        return np.array(stamps, dtype=np.int64), np.array(errors)
    is_level = (
        sequence.calibration.planar is not None or sequence.calibration.use_gravity
    )
    for known in run.maps:
        if (
            known.stamp_ns not in scored_ns
            or np.isin(known.landmarks.ids, true.ids).sum() < LEAST_LANDMARKS
        ):
            continue
        alignment = align_map(known.landmarks, true, is_level=is_level)
        assert alignment is not None
        position = path.positions[path.stamps_ns == known.stamp_ns]
        off = alignment.apply(position) - truth.at(np.array([known.stamp_ns])).positions
        stamps.append(known.stamp_ns)
        errors.append(float(np.linalg.norm(off[0, :2])))
    return np.array(stamps, dtype=np.int64), np.array(errors)


def shared_map_instants(
    runs: Many[RunResult], sequence: Sequence, scored_ns: Ints
) -> Ints:
    """Stamps at which every run that can be scored on its map at all can be, shape (k,)."""
    shared = scored_ns
    for stamps_ns in (own_map_errors(run, sequence, scored_ns)[0] for run in runs):
        if len(stamps_ns):
            shared = np.intersect1d(shared, stamps_ns)
    return shared
