"""Instants at which estimators are scored and maps are kept, and the published numbers of the 2014 paper.

Scored instants are the same for all estimators; those left out are counted with the reason (docs/design/0007).

The paper: "Experimental Results of Real-time Sonar-based Underwater Localization Using Landmarks", 2014. Landmark
positions from its Table I (in centimetres), times of maps from its Fig. 4. It states no errors; those of its map are
computed from the table. Its vehicle had no reference for its own path.
"""

from dataclasses import dataclass

import numpy as np

from sonar_graph.devices import OWN_DESIGNS
from sonar_graph.evaluation.results import RunResult
from sonar_graph.measurements import Ints
from sonar_graph.sequence import Sequence
from sonar_graph.states import LandmarkMap, Trajectory

IDS = np.array([1, 2, 3, 4])
TRUE_XY_M = np.array([[5.00, 0.00], [7.00, -5.00], [2.00, -7.00], [0.00, -2.00]])
ESTIMATED_XY_M = np.array([[4.81, -0.07], [6.74, -5.01], [1.85, -6.85], [-0.14, -1.82]])
DURATION_S = 2039.0
MAP_TIMES_S = (833.1, 1369.4, 2039.0)
"""Times of path and map in Fig. 4."""
# instants, evenly over the run, at which maps are kept beside those of Fig. 4: each costs a smoother a solution
MAPS_KEPT = 20
# a true landmark this near to the published one in x and in y is that landmark
SAME_PLACE_M = 1e-3
# between truth samples farther apart than this the truth is not interpolated (an occluded tracking system)
TRUTH_GAP_S = 0.5
# the gap is at least this many times the truth's median spacing: a truth may be sparse throughout
GAP_TO_SPACING = 1.5


def published_maps() -> tuple[LandmarkMap, LandmarkMap]:
    """Table I as maps: estimated and true. Heights and covariances are not published: 0 and NaN."""
    unknown = np.full((len(IDS), 3, 3), np.nan)
    # the paper gives no heights
    estimated, true = (
        LandmarkMap(IDS, np.c_[xy, np.zeros(len(IDS))], unknown)
        for xy in (ESTIMATED_XY_M, TRUE_XY_M)
    )
    return estimated, true


def repeats_published(sequence: Sequence) -> bool:
    """True where a sequence has the paper's true landmarks, by identity and horizontal position.

    Landmarks of other designs in the same places are another experiment.
    """
    true = sequence.true_landmarks
    if (
        true is None
        or OWN_DESIGNS in sequence.notes
        or not np.array_equal(true.ids, IDS)
    ):
        return False
    return bool(np.abs(true.positions[:, :2] - TRUE_XY_M).max() < SAME_PLACE_M)


@dataclass(frozen=True, eq=False)
class ScoredInstants:
    """The instants that count, and the numbers of those left out."""

    stamps_ns: Ints
    """Shape (n,)."""
    asked: int
    outside_truth: int
    """Before the truth's first or after its last sample."""
    in_truth_gap: int
    gap_s: float
    """Length from which a gap of the truth counts, seconds."""
    not_estimated: int
    """Of the rest, those at which some run that did not fail returned no estimate."""

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def __str__(self) -> str:
        """The clause that protocols quote."""
        left_out = (
            (self.outside_truth, "outside the truth's time span"),
            (self.in_truth_gap, f"in gaps of the truth longer than {self.gap_s:.2g} s"),
            (self.not_estimated, "without an estimate from every estimator"),
        )
        reasons = ", ".join(f"{count} {why}" for count, why in left_out if count)
        why = f" (left out: {reasons})" if reasons else ""
        return f"{len(self)} of {self.asked} instants{why}"


def scored_instants(
    asked_ns: Ints, truth: Trajectory, runs: list[RunResult]
) -> ScoredInstants:
    """The instants with truth nearby and an estimate from each run that did not fail."""
    inside = (asked_ns >= truth.stamps_ns[0]) & (asked_ns <= truth.stamps_ns[-1])
    # a line between truth samples far apart is no truth
    gap_s = gap_limit_s(truth)
    # an instant of a truth sample has this sample on both sides, and so is in no gap
    after = np.searchsorted(truth.stamps_ns, asked_ns).clip(max=len(truth) - 1)
    before = np.searchsorted(truth.stamps_ns, asked_ns, side="right").clip(min=1) - 1
    in_gap = (truth.stamps_ns[after] - truth.stamps_ns[before]) * 1e-9 > gap_s
    covered = inside & ~in_gap
    estimated = np.ones(len(asked_ns), dtype=bool)
    for run in runs:
        # all runs are scored at the same instants, so one that is silent takes them from all
        if run.causal is not None:
            estimated &= np.isin(asked_ns, run.causal.stamps_ns)
    return ScoredInstants(
        stamps_ns=asked_ns[covered & estimated],
        asked=len(asked_ns),
        outside_truth=int((~inside).sum()),
        in_truth_gap=int((inside & ~covered).sum()),
        gap_s=gap_s,
        not_estimated=int((covered & ~estimated).sum()),
    )


def map_instants(asked_ns: Ints, start_ns: int) -> Ints:
    """The instants nearest to the published times, scaled to the run's length; the last one included."""
    if not len(asked_ns):
        return asked_ns
    length_ns = asked_ns[-1] - start_ns
    wanted_ns = start_ns + length_ns * np.array(MAP_TIMES_S) / DURATION_S
    apart_ns = np.abs(asked_ns[None, :] - wanted_ns[:, None])
    return np.unique(asked_ns[apart_ns.argmin(axis=1)])


def kept_map_instants(asked_ns: Ints, start_ns: int) -> Ints:
    """The `map_instants`, and `MAPS_KEPT` others at equal distances."""
    # evenly in time, because the instants are
    rows = np.linspace(0, len(asked_ns), MAPS_KEPT + 1)[1:].astype(np.int64) - 1
    return np.union1d(map_instants(asked_ns, start_ns), asked_ns[rows[rows >= 0]])


def gap_limit_s(truth: Trajectory) -> float:
    """The distance between truth samples beyond which nothing is interpolated, seconds."""
    if len(truth) < 2:
        return TRUTH_GAP_S
    spacing_s = float(np.median(np.diff(truth.stamps_ns) * 1e-9))
    return max(TRUTH_GAP_S, GAP_TO_SPACING * spacing_s)


def rows_at(trajectory: Trajectory, stamps_ns: Ints) -> Trajectory:
    """The rows of a trajectory that has all of these stamps."""
    return trajectory.rows(np.searchsorted(trajectory.stamps_ns, stamps_ns))
