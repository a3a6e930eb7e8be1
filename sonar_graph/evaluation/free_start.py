"""Truth in the world of the estimates, where the start is not stated.

Estimators begin at the start of the calibration. Where that is not stated, the world of the estimates is turned and
moved against that of the truth by an unknown amount, and errors without alignment would be of that, not of the
estimator. So the truth is brought into the estimates' world, once for all runs::

    p_true -> R p_true + t,    R about the vertical,    sum_i | R p_true(t_i) + t - p(t_i) |^2 least in x and y,

where t brings the beginning of the truth to that of the path, as covariances count from there. The path is that of the
run that it fits best. A heading that the log measured at the start is kept: then R = 1.

All scores and pictures are after that, and are labelled so (`sonar_graph.evaluation.tables.unaligned`). Where a start
is stated the truth stays: the start is part of what is judged.
"""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import Calibration
from sonar_graph.evaluation.metrics import Alignment, yaw_rad
from sonar_graph.evaluation.results import RunResult
from sonar_graph.evaluation.scored_instants import rows_at, scored_instants
from sonar_graph.evaluation.tables import FITTED
from sonar_graph.measurements import Floats, Ints
from sonar_graph.sequence import Sequence

# instants of a fit, and of its beginning, whose mean counts
FEWEST = 3


def free_start(calibration: Calibration) -> tuple[bool, bool]:
    """True for the heading and for the position at the start where they are not stated."""
    if "start" not in calibration.model_fields_set:
        return True, True
    start = calibration.start
    if start.source == "map":
        # a map states the world, but for one that a dive without a stated start has made
        has_own_world = calibration.map is not None and calibration.map.has_own_world
        return has_own_world, has_own_world
    if start.source != "stated":
        return start.source == "vehicle", start.source != "fixes"
    said = start.model_fields_set
    return False, "rpy_rad" in said and "position_m" not in said


def with_fitted_truth(
    sequence: Sequence, instants_ns: Ints, runs: list[RunResult]
) -> Sequence:
    """Bring the truth into the world of the estimates, where the start is free; else the same sequence.

    The note `FITTED` has the motion, and the run whose path it was fitted to.
    """
    is_turned, is_moved = free_start(sequence.calibration)
    truth = sequence.truth
    if not truth or not is_moved or FITTED in sequence.notes:
        return sequence
    at_ns = scored_instants(instants_ns, truth, runs).stamps_ns
    # a fit to one or two positions would take the error away that is to be shown
    if len(at_ns) < FEWEST:
        return sequence
    true = truth.at(at_ns).positions
    fits: list[tuple[float, str, Alignment]] = []
    for run in runs:
        if run.smoothed is not None:
            # the smoothed path has the least drift to disturb the fit
            path = rows_at(run.smoothed, at_ns).positions
            fit = fit_from_beginning(true, path, is_turned=is_turned)
            off_m = np.linalg.norm(fit.apply(true) - path, axis=1)
            fits.append((float(np.median(off_m)), run.estimator, fit))
    if not fits:
        return sequence
    # one fit for all runs: a fit for each would hide which one begins wrong
    _, name, fit = min(fits, key=lambda one: one[0])
    (turn_deg,) = np.degrees(yaw_rad(fit.rotation[None]))
    what = "no start" if is_turned else "no position of the start"
    moved = ", ".join(f"{metres:.2f}" for metres in fit.translation)
    note = (
        f"the log states {what}, so the truth was brought into the world of the estimates: turned by {turn_deg:.1f}° "
        f"and then moved by ({moved}) m, by the smoothed path of {name}; all errors are after that"
    )
    landmarks = sequence.true_landmarks
    return replace(
        sequence,
        truth=fit.path(truth),
        true_landmarks=None if landmarks is None else fit.map(landmarks),
        notes={**sequence.notes, FITTED: note},
    )


def fit_from_beginning(true: Floats, path: Floats, *, is_turned: bool) -> Alignment:
    """The motion of the truth, shape (n, 3), that begins where the path does and turns about the vertical to fit it."""
    # one sample alone would bring its noise into all errors
    begin = true[:FEWEST].mean(axis=0)
    begin_path = path[:FEWEST].mean(axis=0)
    turn = 0.0
    if is_turned:
        x, y = (true - begin).T[:2]
        u, v = (path - begin_path).T[:2]
        # the turn with the largest sum of scalar products, which is the least-squares fit in the plane
        turn = float(np.arctan2(np.sum(x * v - y * u), np.sum(x * u + y * v)))
    R = Rotation.from_euler("z", turn).as_matrix()
    return Alignment(R, begin_path - R @ begin)
