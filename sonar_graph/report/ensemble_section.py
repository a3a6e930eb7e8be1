"""Section of a report on many runs of the same experiment: sentences and a table of means with bands.

The mean of the final errors has its 95 % interval (Hall 1992), the ANEES at an instant the chi-square band of
independent runs. Equations: docs/theory/metrics.md, docs/theory/batch_statistics.md.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from sonar_graph.evaluation import Ensemble, anees_interval, format_value
from sonar_graph.measurements import Floats
from sonar_graph.table import Column, Table, absent, number, words

HEADLINE = "causal.ate_se2_m"
SHOWN = {
    HEADLINE: "Causal",
    "smoothed.ate_se2_m": "Smoothed",
    "causal.own_map_m": "On its own map",
    "landmarks.se2_m": "Map",
}
DOF: dict[Literal["position", "yaw"], int] = {"position": 3, "yaw": 1}
CAUSAL = " (causal: told at once, from what was measured until then; after the best shift and turn of the whole path, SE(2))"
WORSE = (
    " Here ekf-slam is worse than dead-reckoning, which only adds up motion. That can be: as published the filter has"
    " no gyro bias in its state and believes identities, and a landmark taken for another moves path and map for good."
)


def mean_text(values: Floats) -> str:
    """Mean of the runs with its 95 % interval, metres; the number of runs without a value where there are any."""
    # loads the simulators, which one comparison does not need
    from sonar_graph.batch import (
        paired,
    )

    lost = int(np.isinf(values).sum())
    if lost:
        return f"{lost} of {len(values)} runs without"
    low, high = paired(values, np.zeros_like(values)).interval
    mean = format_value(float(values.mean()))
    return (
        mean
        if np.isnan(low)
        else f"{mean} ({format_value(max(low, 0.0))} to {format_value(high)})"
    )


def ensemble_sentences(ensembles: list[Ensemble]) -> list[str]:
    """What the runs teach: mean errors under each condition, and how often a single run has them in another order."""
    said = []
    for place, ensemble in enumerate(ensembles):
        values = {name: ensemble.of(name, HEADLINE) for name in ensemble.values}
        order = sorted(
            values, key=lambda name: (np.isinf(values[name]).sum(), values[name].mean())
        )
        listed = ", ".join(f"{name} {mean_text(values[name])}" for name in order)
        opening = "" if place == 0 else "Under other conditions it may be otherwise: "
        said.append(
            f"{opening}{len(ensemble.seeds)} runs {ensemble.condition}: mean {'causal ' if place else ''}position "
            f"error{'' if place else CAUSAL} in metres, with its 95 % interval: {listed}."
        )
        if len(order) > 1:
            first, second = order[:2]
            wins = int((values[first] < values[second]).sum())
            turned = len(ensemble.seeds) - wins
            either = (
                f"{wins} of them, {second} in {turned}: one run could have said either"
            )
            said[-1] += (
                f" {first} has the smaller error {f'in {either}' if turned else 'in every one of them'}."
            )
        names = {"ekf-slam", "dead-reckoning"} & set(order)
        if len(names) == 2 and order.index("ekf-slam") > order.index("dead-reckoning"):
            said[-1] += WORSE
    return said


def ensemble_table(ensemble: Ensemble, name: str) -> Table:
    """Mean errors with intervals, and ANEES at the last instant beside its 95 % band, by estimator."""
    # loads the simulators, which one comparison does not need
    from sonar_graph.batch import anees

    columns = [Column("estimator", "Estimator", is_number=False)]
    columns += [
        Column(key, heading, "Mean of the runs (95 %), m")
        for key, heading in SHOWN.items()
    ]
    for what, dof in DOF.items():
        low, high = anees_interval(len(ensemble.seeds), dof)
        columns.append(
            Column(
                f"anees_{what}",
                f"{what.capitalize()} ({low:.2f} to {high:.2f})",
                "ANEES at the end",
            )
        )
    rows = []
    for index, (estimator, scores) in enumerate(ensemble.values.items()):
        cells = [words(estimator, run=index)]
        for key in SHOWN:
            values = ensemble.of(estimator, key)
            known = any(value is not None for value in scores[key])
            mean, _, interval = mean_text(values).partition(" (")
            cells.append(
                number(float(values.mean()), mean, note=interval.removesuffix(")"))
                if known
                else absent()
            )
        for what, dof in DOF.items():
            found = anees(ensemble.nees_at_end(estimator, what), dof)
            cells.append(
                number(found.mean, format_value(found.mean), note=found.verdict)
            )
        rows.append(cells)
    title = f"{len(ensemble.seeds)} runs {ensemble.condition}"
    return Table(
        name,
        title,
        "Detections are simulated; every run has other seeds of everything random.",
        columns,
        rows,
    )
