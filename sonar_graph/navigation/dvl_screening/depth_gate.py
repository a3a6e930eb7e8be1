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

from typing import NamedTuple

import numpy as np

from sonar_graph.calibration import Calibration
from sonar_graph.navigation.dvl_screening.dvl_gate import LONG_INTERVALS, LONG_NS
from sonar_graph.navigation.samples import EARLIEST_NS, LATEST_NS

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
    is_reachable: bool = False
    """True where a vehicle could get from the last sample used to the first of these."""

    def distance(self, to: "DepthChain", longest_ns: int = LATEST_NS) -> float:
        """Squared distance d of the module's equation, with t at most ``longest_ns``."""
        t = min(to.stamp_ns - self.stamp_ns, longest_ns) * 1e-9
        beyond_m = max(abs(to.z_m - self.z_m) - VERTICAL_M_S * t, 0.0)
        return beyond_m * beyond_m / (self.variance_m2 + to.variance_m2 + UNSTATED_M**2)


class DepthGate:
    """Judges depth samples in the order of their stamps."""

    def __init__(self, calibration: Calibration) -> None:
        start = calibration.start
        world_p_port = start.pose().transformFrom(np.array(calibration.depth.port_m))
        z_m = float(world_p_port[2])
        is_stated = "position_m" in start.model_fields_set and start.source == "stated"
        length = LATEST_NS if is_stated else FEWEST - 1
        self._used = DepthChain(
            EARLIEST_NS, z_m, start.position_sigma_m[2] ** 2, length
        )
        self._refused: list[DepthChain] = []
        self.newest_ns: int = EARLIEST_NS
        """Stamp of the last sample that was judged."""
        self._interval_ns: int | None = None

    def distance(self, stamp_ns: int, z_m: float, variance_m2: float) -> float | None:
        """None for a sample that is used, else its squared distance from the last one used."""
        longest_ns = max(LONG_NS, LONG_INTERVALS * (self._interval_ns or 0))
        if self.newest_ns > EARLIEST_NS:
            self._interval_ns = min(
                self._interval_ns or LATEST_NS, stamp_ns - self.newest_ns
            )
        else:
            self._used = self._used._replace(stamp_ns=stamp_ns - LONG_NS)
        self.newest_ns = stamp_ns
        # t is bounded for a sample alone: after a minute the gate would let 180 m pass
        used = self._used
        sample = DepthChain(stamp_ns, z_m, variance_m2, 1)
        distance = used.distance(sample, longest_ns)
        if distance <= DEPTH_GATE:
            # chains of refused samples end where a sample is used: they were wrong
            self._use(sample._replace(length=used.length + 1))
            return None
        # refused as it is; it may continue a chain of refused samples
        near = [
            chain for chain in self._refused if chain.distance(sample) <= DEPTH_GATE
        ]
        if near:
            before = max(near, key=lambda chain: chain.length)
            self._refused.remove(before)
            sample = sample._replace(
                length=before.length + 1, is_reachable=before.is_reachable
            )
        else:
            sample = sample._replace(is_reachable=used.distance(sample) <= DEPTH_GATE)
        # a chain out of reach replaces the used one only where it is the longer
        if sample.length > (FEWEST - 1 if sample.is_reachable else used.length):
            self._use(sample)
            return None
        self._refused = [*self._refused, sample][-MOST_CHAINS:]
        return distance

    def _use(self, sample: DepthChain) -> None:
        self._used = sample
        self._refused = []
