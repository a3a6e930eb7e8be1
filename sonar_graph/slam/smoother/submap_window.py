"""Incremental solution over the whole run: the newest keyframes, submaps of the older ones, landmarks and biases.

iSAM2 holds the keyframes of the last ``lag_s`` seconds with their own factors, and of the older ones only each one
between two submaps (`submaps`, docs/theory/isam2.md). Two neighbours of the same size are joined, so that their number
grows with the logarithm of the run. Nothing is given up: a submap keeps its factors, takes in late ones, and is
linearised anew when its shape has changed. An update makes, joins or linearises anew one submap at most.
"""

from __future__ import annotations

import math
from collections import defaultdict, deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import islice, pairwise
from typing import Any

import gtsam
import numpy as np

from sonar_graph.slam.smoother.batch_solution import (
    JointCovariance,
    is_bias,
    is_landmark,
    is_pose,
    picked,
    tangent_size,
)
from sonar_graph.slam.smoother.fixed_lag import isam2_params, settle
from sonar_graph.slam.smoother.submaps import BLAS, Factor, Submap

MOST_LOOKS = 2
"""Submaps that an update looks at, and linearises anew where they are stale."""
MOST_ROWS = 120
"""Rows of what a joined submap shares with the rest, at most: it is dense."""
MOST_BENT = 0.1
"""Second-order term of a whitened sighting, over one sigma of its landmark's height: beyond it no submap is made."""


def bending(sighting: gtsam.NoiseModelFactor, lower: gtsam.Values, values: gtsam.Values, higher: gtsam.Values) -> float:
    """Second-order term of a whitened error, ``|e(l - sigma up) - 2 e(l) + e(l + sigma up)| / 2``."""
    below, at, above = map(sighting.unwhitenedError, (lower, values, higher))
    noise = sighting.noiseModel()
    white = noise.noise() if isinstance(noise, gtsam.noiseModel.Robust) else noise
    return 0.5 * float(np.linalg.norm(white.whiten(below - 2.0 * at + above)))


class SubmapWindow:
    """Incremental solution over the whole run, by Cholesky, and by QR once that has given up."""

    def __init__(self, relinearize_threshold: float, lag_s: float, submap_keyframes: int) -> None:
        self._threshold = relinearize_threshold
        self._height_sigmas_m: dict[int, float] = {}
        self.lag_s = lag_s
        """Age (s) from which on keyframes may leave for submaps."""
        self.size = submap_keyframes
        self.is_by_qr = False
        self._begin_empty()

    def _begin_empty(self) -> None:
        self._isam = gtsam.ISAM2(isam2_params(self._threshold, is_by_qr=self.is_by_qr))
        # a reference: as long as it is held GTSAM hands factors in Python this object, else a copy of all values each
        self._theta = self._isam.getLinearizationPoint()
        self._slots: dict[Factor, int] = {}
        self._gone: list[int] = []
        self._marginals: dict[Factor, None] = {}
        self._times_s: dict[int, float] = {}
        self._on: dict[int, dict[Factor, None]] = defaultdict(dict)
        self._submaps: list[Submap] = []
        self._inside: dict[Submap, gtsam.Values] = {}
        self._whole: list[Submap] = []
        self._of: dict[int, Submap] = {}
        self._waiting: deque[list[int]] = deque()
        self._newest: Submap | None = None
        self._stale = self._stale_in_turn()
        self._newest_bias = 0

    @property
    def marginals(self) -> gtsam.ISAM2:
        """Source of covariances."""
        return self._isam

    @property
    def factors(self) -> gtsam.NonlinearFactorGraph:
        """Factors, with those of submaps; some places may be empty."""
        return self._isam.getFactorsUnsafe()

    @property
    def linearised_at(self) -> gtsam.Values:
        """Where the variables are linearised."""
        return self._theta

    def estimate(self) -> gtsam.Values:
        """Estimate of the variables in the window."""
        return self._isam.calculateEstimate()

    def holds(self, key: int) -> bool:
        """True for a keyframe with its own factors, and for any other variable."""
        return self._isam.valueExists(key) and (not is_pose(key) or key in self._times_s)

    def begin(
        self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, times_s: Mapping[Any, float], time_s: float
    ) -> None:
        """Begin anew at a time with all factors, linearised at the values.

        A RuntimeError where even QR finds no solution.
        """
        self._begin_empty()
        self._times_s = {key: t for key, t in times_s.items() if is_pose(key)}
        self._newest_bias = max(filter(is_bias, times_s), default=0)
        factors = [graph.at(i) for i in range(graph.size())]
        self._register(factors)
        while self._grow(values, time_s) or self._next_old(time_s):
            pass
        rest = gtsam.NonlinearFactorGraph()
        for factor in factors:
            if self._submap_of(factor) is None:
                rest.add(factor)
        try:
            self._feed(rest, picked(values, [key for key in list(values.keys()) if key not in self._of]))
        except RuntimeError:
            if self.is_by_qr:
                raise
            self.is_by_qr = True
            self.begin(graph, values, times_s, time_s)

    def update(
        self,
        graph: gtsam.NonlinearFactorGraph,
        values: gtsam.Values,
        times_s: Mapping[Any, float],
        time_s: float,
        removed: Sequence[Factor] = (),
    ) -> gtsam.Values:
        """Estimate with new factors and variables, without some of the factors; with keyframes of what was touched."""
        touched, outside = dict[Submap, None](), list[Factor]()
        self._inside.clear()
        for factor in removed:
            if submap := self._submap_of(factor):
                del submap.factors[factor]
                touched |= dict.fromkeys(submap.lineage())
            else:
                self._take_out(factor)
        for factor in (graph.at(i) for i in range(graph.size())):
            if submap := self._submap_of(factor):
                submap.factors[factor] = None
                touched |= dict.fromkeys(submap.lineage())
            else:
                outside.append(factor)
        self._register(outside)
        for key in values.keys():  # noqa: SIM118
            self._height_sigmas_m.pop(key, None)
        self._newest_bias = max(filter(is_bias, times_s), default=self._newest_bias)
        known = gtsam.Values(values)
        known.insert_or_assign(self.estimate())
        self._linearise_in_order(touched, known)
        if not touched and not self._grow(known, time_s):
            for submap in filter(None, islice(self._stale, MOST_LOOKS)):
                self._linearise(submap, known)
        self._times_s |= {key: t for key, t in times_s.items() if is_pose(key)}
        new = gtsam.NonlinearFactorGraph()
        for factor in outside:
            if self._submap_of(factor) is None:
                new.add(factor)
        self._feed(new, values)
        estimate = self.estimate()
        for submap in touched:
            estimate.insert_or_assign(submap.present(self._around(submap, estimate)))
        return estimate

    def _submap_of(self, factor: Factor) -> Submap | None:
        """The submap that a factor belongs to: of several, each a part of the next, the innermost."""
        owners = [self._of[key] for key in list(factor.keys()) if key in self._of]
        return min(owners, key=lambda submap: submap.level, default=None)

    def _register(self, factors: Iterable[Factor]) -> None:
        """Take note of factors on what may leave for a submap."""
        for factor in factors:
            for key in list(factor.keys()):
                if not is_landmark(key):
                    self._on[key][factor] = None

    def _take_out(self, factor: Factor) -> None:
        """Take a factor out of the window."""
        for key in list(factor.keys()):
            if key in self._on:
                self._on[key].pop(factor, None)
        if factor in self._slots:
            self._gone.append(self._slots.pop(factor))

    def _around(self, submap: Submap, estimate: gtsam.Values) -> gtsam.Values:
        """Estimate, with the interior of the submaps that a submap is part of, kept while nothing changes."""
        if submap.parent is None:
            return estimate
        if submap.parent not in self._inside:
            values = gtsam.Values(self._around(submap.parent, estimate))
            values.insert_or_assign(submap.parent.present(values))
            self._inside[submap.parent] = values
        return self._inside[submap.parent]

    def _linearise(self, submap: Submap, estimate: gtsam.Values) -> None:
        """Linearise a submap anew; the one that it is part of is not settled then."""
        old, parent = submap.marginals, submap.parent
        submap.linearise(self._around(submap, estimate))
        self._inside.clear()
        if parent is not None:
            for factor in old:
                del parent.factors[factor]
            parent.factors |= dict.fromkeys(submap.marginals)
            parent.is_settled = False

    def _linearise_in_order(self, submaps: Iterable[Submap], estimate: gtsam.Values) -> None:
        """Linearise submaps anew, parts before the whole."""
        for submap in sorted(submaps, key=lambda submap: submap.level):
            self._linearise(submap, estimate)

    def _stale_in_turn(self) -> Iterator[Submap | None]:
        """Stale submaps; one answer for each that is looked at, and one an update where none has changed."""
        while True:
            yield None
            for submap in list(self._submaps):
                yield from self._stale_of(submap)
                yield None

    def _stale_of(self, submap: Submap) -> Iterator[Submap | None]:
        """Submaps to be linearised anew, of one and its parts, parts before the whole; None for those that are not."""
        if submap.has_changed(self._around(submap, self.estimate())):
            for part in submap.parts:
                yield from self._stale_of(part)
            yield submap if submap.is_stale(self._around(submap, self.estimate())) else None

    def _next_old(self, time_s: float) -> list[int]:
        """Keyframes older than the lag that may become the next submap, with the one before and the one after it."""
        keys = list(self._times_s)[: self.size + 2]
        old = sum(t < time_s - self.lag_s for t in self._times_s.values())
        return keys if old > self.size and len(keys) == self.size + 2 else []

    def _grow(self, estimate: gtsam.Values, time_s: float) -> bool:
        """Make one submap: of the newest and its equal beside it, else of keyframes older than the lag."""
        if self._newest is not None:
            place = self._submaps.index(self._newest)
            for pair in pairwise(self._submaps[max(place - 1, 0) : place + 2]):
                (first, middle), (joint, last) = (part.ends for part in pair)
                shared = {key for part in pair for factor in part.marginals for key in list(factor.keys())}
                fits = middle == joint and sum(map(tangent_size, shared)) <= MOST_ROWS
                if fits and pair[0].level == pair[1].level:
                    self._add([middle], (first, last), pair, estimate)
                    return True
            self._newest = None
        if keys := self._next_old(time_s):
            self._waiting.appendleft(keys)
            for key in keys[:-1]:
                del self._times_s[key]
        if not self._waiting:
            return False
        keys = self._waiting.popleft()
        if self._is_bent(keys, estimate):
            self._waiting.append(keys)
            return False
        self._add(keys[1:-1], (keys[0], keys[-1]), (), estimate)
        return True

    def _is_bent(self, keys: list[int], estimate: gtsam.Values) -> bool:
        """True where keyframes see a landmark whose height is so little known that its range bends (`MOST_BENT`).

        Its height above the first keyframe. While they are not in the window, which is begun anew, the sigma last asked
        for counts.
        """
        sightings = [
            (factor, key)
            for factor in dict.fromkeys(factor for key in keys[1:-1] for factor in self._on[key])
            if isinstance(factor, gtsam.NoiseModelFactor)
            for key in filter(is_landmark, list(factor.keys()))
        ]
        first, seen = keys[0], sorted({key for _, key in sightings})
        if seen and all(map(self._isam.valueExists, [first, *seen])):
            joint, up = JointCovariance.of(self._isam, [first, *seen]), estimate.atPose3(first).rotation().matrix()[2]
            of_pose = up @ joint.at(first, first)[3:, 3:] @ up
            for key in seen:
                variance = of_pose - 2 * up @ joint.at(first, key)[3:, 2] + joint.at(key, key)[2, 2]
                self._height_sigmas_m[key] = math.sqrt(max(0.0, variance))
        elif not self._height_sigmas_m.keys() >= set(seen):
            return True
        at = picked(estimate, {key for factor, _ in sightings for key in list(factor.keys())})
        lower, higher = gtsam.Values(at), gtsam.Values(at)
        for key in seen:
            sigma_m = np.array([0.0, 0.0, self._height_sigmas_m[key]])
            lower.update(key, at.atPoint3(key) - sigma_m)
            higher.update(key, at.atPoint3(key) + sigma_m)
        return any(not bending(factor, lower, at, higher) <= MOST_BENT for factor, _ in sightings)

    def _add(
        self, interior: list[int], ends: tuple[int, int], parts: tuple[Submap, ...], estimate: gtsam.Values
    ) -> None:
        """Add a submap of keyframes, with biases on which nothing else hangs, and all factors on them."""
        factors = {factor: None for part in parts for factor in part.marginals}
        factors |= {factor: None for key in interior for factor in self._on[key]}
        shared = {
            key for whole in self._submaps if whole not in parts for f in whole.marginals for key in list(f.keys())
        }
        biases = sorted({key for factor in factors for key in list(factor.keys()) if is_bias(key)})
        for key in biases:
            alone = all(factor in factors or not any(map(is_pose, list(factor.keys()))) for factor in self._on[key])
            if alone and key not in shared and key != self._newest_bias:
                interior = [*interior, key]
                factors |= self._on[key]
        submap = Submap(interior, factors, picked(estimate, interior), ends, parts)
        place = sum(submap.ends[1] <= ends[0] for submap in self._submaps)
        self._submaps[place : place + len(parts)] = [submap]
        self._whole.append(submap)
        self._newest = submap
        self._of |= dict.fromkeys(interior, submap)
        for factor in factors:
            self._take_out(factor)
        for key in interior:
            self._on.pop(key, None)
        submap.linearise(estimate)

    def _feed(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> None:
        """Bring the factors of submaps in line, and update."""
        present = {factor: None for submap in self._submaps for factor in submap.marginals}
        for factor in self._marginals:
            if factor not in present:
                self._take_out(factor)
        for factor in present:
            if factor not in self._slots:
                graph.add(factor)
        self._marginals = present
        gone, self._gone = self._gone, []
        self._inside.clear()
        with BLAS.limit(limits=1, user_api="blas"):
            result = self._isam.update(graph, values, gone)
        self._slots |= {graph.at(i): slot for i, slot in enumerate(result.getNewFactorsIndices())}

    def settle(self) -> None:
        """Update, and linearise stale submaps anew, until nothing would be relinearised any more; ten times at most.

        Each time with all that they are part of, so that what they say reaches the rest.
        """
        for _ in range(10):
            settle(self._isam.update, self._isam, self._threshold)
            self._inside.clear()
            looked_at = [stale for submap in self._submaps for stale in self._stale_of(submap)]
            stale = dict.fromkeys(whole for submap in looked_at if submap is not None for whole in submap.lineage())
            if not stale:
                break
            self._linearise_in_order(stale, self.estimate())
            self._feed(gtsam.NonlinearFactorGraph(), gtsam.Values())

    def carried(self, values: gtsam.Values) -> gtsam.Values:
        """Values, with the keyframes of submaps moved with these."""
        carried = gtsam.Values(values)
        for submap in reversed(self._whole):
            carried.update(submap.present(carried))
        return carried
