"""Gate for depth samples: heights that a vehicle can have reached.

Between samples t seconds apart the height changes by at most V t, V `VERTICAL_M_S`. The squared distance of a sample of
variance r from an earlier one of r_0, gated at `DEPTH_GATE`, with an error u `UNSTATED_M` that logs leave out::

    d = max(|z - z_0| - V t, 0)^2 / (r + r_0 + u^2)

A sample is used if it is within the gate of the last one used, at the start of the calibration's pose, with t at most
`LONG_NS` and `LONG_INTERVALS` of the log's own. Else it is refused, but forms a chain with refused ones that it can be
reached from. A chain is used from its last sample on when it has `FEWEST` samples and its first could be reached from
the last one used, or else has more samples than the chain of that one. A start that the calibration states is never
overruled. Nothing waits: a sample is judged by those stamped before it. docs/theory/gaps.md.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sonar_graph.calibration import Calibration
from sonar_graph.measurements import Depth, Floats, Ints
from sonar_graph.navigation.dvl_screening.dvl_gate import LONG_INTERVALS, LONG_NS
from sonar_graph.navigation.samples import EARLIEST_NS, LATEST_NS
from sonar_graph.numerics import compilable, compiled
from sonar_graph.states import Refusal, RefusedRow

VERTICAL_M_S = 3.0
"""A survey vehicle at 5 m/s with the bow 35 deg down; waves of 1 m and 5 s heave with 1.3 m/s."""
UNSTATED_M = 0.1
"""Sigma of a sample's error that its variance leaves out: resolution, waves over the port, pressure of the stream."""
DEPTH_GATE = 37.3
"""Chi-square quantile of 1 - 1e-9, 1 degree of freedom."""
FEWEST = 3
"""Least number of samples of a chain: where one sample in 20 is wrong, all by the same value, 3 in succession are wrong
once in 8000 times."""
MOST_CHAINS = 10
"""Number of refused chains that are remembered."""


class DepthChain(NamedTuple):
    """Depth samples that can each be reached from the one before: the last one, and their number."""

    stamp_ns: int
    z_m: float
    variance_m2: float
    length: int
    is_reachable: bool
    """True where a vehicle could get from the last sample used to the first of these."""


@compilable
def squared_distance(
    since: DepthChain, to: DepthChain, longest_ns: int = LATEST_NS
) -> float:
    """Squared distance d of the module's equation, with t at most ``longest_ns``."""
    t = min(to.stamp_ns - since.stamp_ns, longest_ns) * 1e-9
    beyond_m = max(abs(to.z_m - since.z_m) - VERTICAL_M_S * t, 0.0)
    return beyond_m * beyond_m / (since.variance_m2 + to.variance_m2 + UNSTATED_M**2)


USED, UNSOUND, LATE, REPEATED, OUT_OF_REACH = range(5)
"""Treatments of a sample; a repeated stamp is no late sample."""
REASONS = {
    UNSOUND: Refusal.UNSOUND,
    LATE: Refusal.LATE,
    OUT_OF_REACH: Refusal.OUT_OF_REACH,
}


class DepthSamples(NamedTuple):
    """Samples of a block. The gate fills the last two columns."""

    stamps_ns: Ints
    z_m: Floats
    variance_m2: Floats
    treatment: NDArray[np.int8]
    distance: Floats
    """Squared distance from the last sample used; NaN of a sample that is not judged."""

    def refused(self) -> list[RefusedRow]:
        """The samples that are not used, but for repeated ones."""
        columns = (
            self.stamps_ns.tolist(),
            self.treatment.tolist(),
            self.distance.tolist(),
        )
        return [
            RefusedRow("depth", stamp_ns, REASONS[treatment], distance)
            for stamp_ns, treatment, distance in zip(*columns, strict=True)
            if treatment in REASONS
        ]


@compiled
def judge_until_refused(
    samples: DepthSamples,
    first: int,
    used: DepthChain,
    newest_ns: int,
    interval_ns: int,
    unknown_m2: float,
) -> tuple[int, DepthChain, int, int]:
    """Judge samples from one on, until one is out of reach.

    Parameters
    ----------
    used
        The chain of the last sample used.
    newest_ns
        Stamp of the last sample that was judged.
    interval_ns
        Shortest interval between samples; `LATEST_NS` before the second.
    unknown_m2
        Variance of samples that have none.

    Returns
    -------
    The number of the next sample, and the three values after the last one.
    """
    for k in range(first, len(samples.stamps_ns)):
        stamp_ns = samples.stamps_ns[k]
        variance_m2 = samples.variance_m2[k]
        if math.isnan(variance_m2):
            variance_m2 = unknown_m2
        if not 0.0 < variance_m2 < math.inf:
            samples.treatment[k] = UNSOUND
            samples.distance[k] = math.nan
            continue
        if stamp_ns <= newest_ns:
            samples.treatment[k] = LATE if stamp_ns < newest_ns else REPEATED
            samples.distance[k] = math.nan
            continue
        longest_ns = LONG_NS
        # the intervals of a slow log are long
        if interval_ns < LATEST_NS:
            longest_ns = max(LONG_NS, LONG_INTERVALS * interval_ns)
        if newest_ns > EARLIEST_NS:
            interval_ns = min(interval_ns, stamp_ns - newest_ns)
        else:
            # the start counts as used so long before the first sample
            used = DepthChain(
                stamp_ns - LONG_NS, used.z_m, used.variance_m2, used.length, False
            )
        newest_ns = stamp_ns
        sample = DepthChain(
            stamp_ns, samples.z_m[k], variance_m2, used.length + 1, False
        )
        # t is bounded for a sample alone: after a minute the gate would let 180 m pass
        samples.distance[k] = squared_distance(used, sample, longest_ns)
        if not samples.distance[k] <= DEPTH_GATE:
            samples.treatment[k] = OUT_OF_REACH
            return k + 1, used, newest_ns, interval_ns
        samples.treatment[k] = USED
        used = sample
    return len(samples.stamps_ns), used, newest_ns, interval_ns


class DepthGate:
    """Judges depth samples in the order of their stamps."""

    def __init__(self, calibration: Calibration) -> None:
        start = calibration.start
        world_p_port = start.pose().transformFrom(np.array(calibration.depth.port_m))
        z_m = world_p_port[2]
        is_stated = "position_m" in start.model_fields_set and start.source == "stated"
        length = LATEST_NS // 2 if is_stated else FEWEST - 1
        self._used = DepthChain(
            EARLIEST_NS, z_m, start.position_sigma_m[2] ** 2, length, False
        )
        self._newest_ns: int = EARLIEST_NS
        self._interval_ns: int = LATEST_NS
        self._unknown_m2 = calibration.depth.sigma_m**2
        self._refused: list[DepthChain] = []

    def judge(self, depth: Depth) -> DepthSamples:
        """Treatment of each sample."""
        n = len(depth)
        samples = DepthSamples(
            depth.stamps_ns,
            depth.z_m,
            depth.variance_m2,
            np.zeros(n, np.int8),
            np.empty(n),
        )
        k = 0
        while k < n:
            # a sample out of reach ends the compiled loop: chains are rare
            before_ns = self._used.stamp_ns
            k, self._used, self._newest_ns, self._interval_ns = judge_until_refused(
                samples,
                k,
                self._used,
                self._newest_ns,
                self._interval_ns,
                self._unknown_m2,
            )
            if self._used.stamp_ns > before_ns:
                # chains of refused samples end where a sample is used: they were wrong
                self._refused = []
            if samples.treatment[k - 1] == OUT_OF_REACH and self._continues(
                samples, k - 1
            ):
                samples.treatment[k - 1] = USED
        return samples

    def _continues(self, samples: DepthSamples, row: int) -> bool:
        """True where a sample out of reach completes a chain of refused samples, which then replaces the used one."""
        used = self._used
        variance_m2 = samples.variance_m2[row]
        if math.isnan(variance_m2):
            variance_m2 = self._unknown_m2
        sample = DepthChain(
            int(samples.stamps_ns[row]), samples.z_m[row], variance_m2, 1, False
        )
        near = [
            chain
            for chain in self._refused
            if squared_distance(chain, sample) <= DEPTH_GATE
        ]
        if near:
            before = max(near, key=lambda chain: chain.length)
            self._refused.remove(before)
            sample = sample._replace(
                length=before.length + 1, is_reachable=before.is_reachable
            )
        else:
            sample = sample._replace(
                is_reachable=squared_distance(used, sample) <= DEPTH_GATE
            )
        # a chain out of reach replaces the used one only where it is the longer
        if sample.length > (FEWEST - 1 if sample.is_reachable else used.length):
            self._used = sample
            self._refused = []
            return True
        self._refused = [*self._refused, sample][-MOST_CHAINS:]
        return False
