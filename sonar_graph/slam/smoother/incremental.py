"""Incremental smoothing at a bounded cost per update, and the solution of the whole graph on request.

Two solutions share the same factors (docs/theory/isam2.md):

* the *window*: GTSAM's iSAM2 over the poses of the last ``lag_s`` seconds, all landmarks and all biases; older poses
  are marginalised.
* the *history*: every factor of the run, solved by Levenberg-Marquardt when the smoothed result is asked for.

Marginalising freezes the linearisation of the landmarks that it touches. When one has since moved by more than
``stale_shift_m``, the history is solved and the window starts again from that solution; the graph must have grown by
`RESTART_GROWTH` since, so that all restarts together cost some times the last one. The window also starts again when a
factor is taken out that has been marginalised. A *bounded* history consists of the window's factors and the marginals
of what has left; a new window then begins from those, with the older linearisations.
"""

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from typing import Annotated, Any, Literal

import gtsam
import numpy as np
from pydantic import Field

from sonar_graph.calibration import Section, tagged
from sonar_graph.errors import EstimatorError
from sonar_graph.measurements import Floats
from sonar_graph.slam.smoother.batch_solution import (
    JointCovariance,
    KeptCovariance,
    Sightlines,
    marginals_of,
    solve_in_sight,
)
from sonar_graph.slam.smoother.factor_store import GraphEdit, History, Pending, Recent
from sonar_graph.slam.smoother.fixed_lag import SmootherWindow, joined, keys_of, picked, split, without
from sonar_graph.slam.smoother.observability import Withheld, culprits, reasons, spoilt, undetermined, variable_name

RESTART_GROWTH = 1.25
"""Number of factors, relative to that at the last restart, before the next one."""
FIRST_RESTART = 100
"""Number of factors before the first restart."""
MOST_MESSAGES = 1000
"""Kept of what was withheld."""
ROUNDING_S = 1e-6
"""Margin for rounded times: a variable exactly as old as the lag stays."""


class SmootherParams(Section):
    """Settings of the incremental solution."""

    lag_s: float = Field(15.0, gt=0)
    """Age from which poses are marginalised out of the incremental solution; a large value keeps all of them."""
    relinearize_threshold: float = Field(0.001, gt=0)
    """Change of a component of a variable (rad or m) above which the variable is relinearised."""
    stale_shift_m: float = Field(0.1, gt=0)
    """Distance that a landmark may move before the window starts again from a solution of the whole graph."""
    waiting_gain: float = Field(5.0, ge=0)
    """New sightings enter the estimate at the next keyframe, or as soon as their expected gain, the sum of predicted
    variance over noise variance, exceeds this. 0: always at once."""


class WholeHistory(Section):
    """Every factor is kept, for the batch solution in `Isam2.trajectory`."""

    policy: Literal["whole"] = "whole"


class BoundedHistory(Section):
    """Poses older than the lag are marginalised for good, so that time and memory do not grow with the run.

    Their information on landmarks and bias is kept; `Isam2.trajectory` is fixed-lag smoothed
    (docs/theory/bounded_memory.md).
    """

    policy: Literal["bounded"] = "bounded"
    remembered_s: float | None = Field(None, gt=0)
    """Age from which `Isam2.trajectory` and `Isam2.detections` may drop entries; those older than 1.25 times this are
    dropped. None: all are kept."""


HistoryParams = Annotated[WholeHistory | BoundedHistory, *tagged("policy", "whole")]


class Smoother:
    """Growing graph with a bounded incremental solution; plain iSAM2 over the whole history where the lag is infinite.

    When bounded, factors that leave the window become marginals for good, and their variables are forgotten.
    """

    def __init__(self, params: SmootherParams, *, is_bounded: bool = False) -> None:
        self.params = params
        self._restart_size = FIRST_RESTART
        self.is_bounded = is_bounded
        self._history: History | Recent = Recent() if is_bounded else History()
        self._restarted_s = self._newest_s = -np.inf
        self.withheld: deque[str] = deque(maxlen=MOST_MESSAGES)
        """The newest of what was withheld, and why."""
        self.when_leaving: Callable[[set[int]], None] = lambda _: None
        """Called with the keys of variables before they leave a bounded window, while they are still in it."""
        self.values = gtsam.Values()
        """The newest estimate of every variable; of those that left the window, the last one there."""
        self.sightlines = Sightlines()
        """Where each landmark was seen from."""
        self.waiting_gain = 0.0
        """Expected gain of the factors added since the last update: sum of predicted variances over noise variances."""
        self.when_withheld: Callable[[Withheld], set[int]] = lambda _: set()
        """Called when new factors cannot be used; returns the handles of others that are nothing without them."""
        self._pending = Pending()
        self._expiring: dict[int, float] = {}
        self._held: dict[int, float] = {}
        self._landmarks: list[int] = []
        self._bias: list[int] = []
        self._window = SmootherWindow(params.relinearize_threshold, params.lag_s)
        self._kept_covariance = KeptCovariance()
        self._solved: tuple[gtsam.Values, gtsam.Marginals | gtsam.ISAM2] | None = None
        self._solved_changes = 0

    @property
    def graph(self) -> gtsam.NonlinearFactorGraph:
        """Every factor of the run; of a bounded one those of the window, marginals among them."""
        return self._history.graph

    def add_pose(self, key: int, pose: gtsam.Pose3, time_s: float) -> None:
        """Add a keyframe with its first estimate; an `EstimatorError` where the key is taken or time runs back."""
        self._check_new(key)
        if time_s < self._newest_s:
            raise EstimatorError(
                f"isam2: {variable_name(key)} at {time_s:.3f} s is older than the one before ({self._newest_s:.3f} s);"
                " give keyframes in the order of time"
            )
        self._newest_s = time_s
        self._insert(key, pose)
        self._pending.times_s[key] = time_s
        self._expiring[key] = time_s

    def add_landmark(self, key: int, point: Floats) -> None:
        """Add a landmark, which never leaves the window, with its first estimate."""
        self._check_new(key)
        self._insert(key, point)
        self._landmarks.append(key)

    def add_bias(self, key: int, bias: Floats) -> None:
        """Add a gyro bias with its first estimate. It stays in the window until the lag after the next one."""
        self._check_new(key)
        self._insert(key, bias)
        self._bias = [key]

    def _check_new(self, key: int) -> None:
        if self.values.exists(key):
            raise EstimatorError(f"isam2: {variable_name(key)} is in the graph already; give each its own key")

    def _insert(self, key: int, first: gtsam.Pose3 | Floats) -> None:
        """A first estimate, for the window and for who asks meanwhile."""
        self._pending.values.insert(key, first)
        self.values.insert(key, first)

    def add(self, factors: Iterable[gtsam.NonlinearFactor]) -> list[int]:
        """New factors, used at the next update; the handles by which they can be taken out."""
        handles = []
        for factor in factors:
            handles.append(self._history.add(factor))
            self._pending.add(factor, handles[-1])
        return handles

    def hold(self, until_s: dict[int, float]) -> None:
        """Keep keyframes, and all later ones (iSAM2 marginalises in order), in the window until times; no others."""
        self._held = until_s

    def flush(self, time_s: float) -> None:
        """Update with the factors that wait, if any; a bounded window keeps its variables."""
        self._withhold_unusable()
        if self._pending.handles:
            self._update(time_s, self._exchange_lag_s(time_s))

    def exchange(
        self, what: GraphEdit, time_s: float, entered: Callable[[list[list[int]]], None] = lambda _: None
    ) -> list[list[int]]:
        """Take factors out, put others in, and update the window; the handles of each group put in.

        ``entered`` gets these handles before anything is solved: `when_withheld` may be about one of them.
        """
        self.flush(time_s)
        slots = self._window.slots([self._history.factor(handle) for handle in what.removed])
        self._forget(what.lost_landmarks)
        self._history.remove(what.removed)
        for key, point in what.new_landmarks.items():
            self.add_landmark(key, point)
        handles = [self.add(group) for group in what.added]
        entered(handles)
        self._withhold_unusable()
        keys = self._pending.graph.keyVector()
        self._window.lag_s = self._exchange_lag_s(time_s)
        if slots is None or what.lost_landmarks or len(self.in_window(keys)) < len(keys):
            self._clear_pending()
            self._restart(time_s)
        else:
            self._update(time_s, self._window.lag_s, slots)
            self.settle(time_s)
        return handles

    def _exchange_lag_s(self, time_s: float) -> float:
        """Nothing leaves a bounded window between what an exchange takes out and what it puts in."""
        inside_s = [time_s - t + ROUNDING_S for t in self._expiring.values()] if self.is_bounded else []
        return max([self._lag_at(time_s), *inside_s])

    def in_window(self, keys: list[int]) -> list[int]:
        """Keys of variables that are in the window, or about to be."""
        inside = self._window.isam.getLinearizationPoint() if keys else gtsam.Values()
        return [key for key in keys if inside.exists(key) or self._pending.values.exists(key)]

    def _forget(self, landmark_keys: list[int]) -> None:
        for key in landmark_keys:
            self._landmarks.remove(key)
            self.values.erase(key)

    def graph_without(self, handles: set[int]) -> gtsam.NonlinearFactorGraph:
        """Every factor of the run but those of some handles."""
        gone, graph, rest = (
            {self._history.factor(handle) for handle in handles},
            self.graph,
            gtsam.NonlinearFactorGraph(),
        )
        for i in range(graph.size()):
            if graph.at(i) not in gone:
                rest.push_back(graph.at(i))
        return rest

    def settle(self, time_s: float) -> None:
        """Gauss-Newton steps until nothing would be relinearised any more, ten at most."""
        try:
            self._window.settle()
        except RuntimeError:
            self._give_up_cholesky(time_s)
        self._kept_covariance.outdate()
        self._take(self._window.isam.calculateEstimate())

    @property
    def is_due(self) -> bool:
        """True when variables wait for an update, or factors that would change the estimate."""
        return self._pending.values.size() > 0 or self.waiting_gain > self.params.waiting_gain

    def update(self, time_s: float) -> None:
        """Bring the window's estimate up to date with what was added; what is older than the lag leaves it."""
        if not self._withhold_unusable() or self.is_due:
            self._update(time_s, self._lag_at(time_s))

    def _update(self, time_s: float, lag_s: float, removed_slots: Sequence[int] = ()) -> None:
        """The same without what is in some places of the window."""
        self._expiring |= dict.fromkeys(self._bias, time_s)
        if self.is_bounded:
            old = (key for key, t in self._expiring.items() if t < time_s - lag_s)
            if leaving := {key for key in old if not self._pending.values.exists(key)}:
                self.when_leaving(leaving)
        self._window.lag_s = lag_s
        times = self._times(self._pending.times_s, time_s)
        try:
            self._window.update(self._pending.graph, self._pending.values, times, removed_slots)
            estimate = self._window.isam.calculateEstimate()
        except RuntimeError:
            if not self._go_without(time_s):
                self._give_up_cholesky(time_s)
                return
            estimate = self._window.isam.calculateEstimate()
        self._clear_pending()
        self._take(estimate)
        since_s = self._restarted_s + self.params.lag_s
        may_restart = time_s >= since_s if self.is_bounded else self.graph.size() >= self._restart_size
        if may_restart and self._window.largest_shift(self._landmarks) > self.params.stale_shift_m:
            self._restart(time_s)

    def _times(self, poses_s: dict[int, float], time_s: float) -> dict[Any, float]:
        """When variables were last seen, from those of poses: landmarks and the newest bias are seen now."""
        return poses_s | dict.fromkeys(self._landmarks + self._bias, time_s)

    def _withhold_unusable(self) -> bool:
        """Take new factors out again that the window could not be solved with; whether there were any."""
        values = picked(self.values, self._pending.graph.keyVector())
        self._withhold(found := spoilt(self._pending, values, self._expiring))
        self._withhold(more := undetermined(self._pending, values, self._expiring))
        return bool(found or more)

    def _withhold(self, found: list[Withheld]) -> None:
        for withheld in found:
            handles = (withheld.handles | self.when_withheld(withheld)).intersection(self._pending.handles)
            self.withheld.append(withheld.message)
            self._history.remove(handles)
            self._pending.drop(handles, withheld.keys)
            self._forget([key for key in withheld.keys if key in self._landmarks])

    def _go_without(self, time_s: float) -> bool:
        """Solve the window without those new factors that are to blame; whether there are any.

        The window is made anew of the same factors with the same linearisation: nothing else changes.
        """
        theta = joined(self._window.isam.getLinearizationPoint(), self._pending.values)
        before = without(self._window.isam.getFactors(), theta, self._pending.factors)
        if not (found := culprits(before, self._pending, theta, self._expiring)):
            return False
        self._withhold(found)
        for key in set().union(*(withheld.keys for withheld in found)):
            theta.erase(key)
        before.push_back(self._pending.graph)
        kept_s = {key: self._expiring.get(key, time_s) for key in keys_of(theta)}
        try:
            self._window.begin(before, theta, self._times(kept_s, time_s))
        except RuntimeError as error:
            raise EstimatorError(f"isam2: {reasons(before, theta, self._expiring)}") from error
        return True

    def _take(self, estimate: gtsam.Values) -> None:
        """The window's; a bounded one forgets what has left."""
        self._solved = None  # who asked before must not decide where the next solution starts
        if not self.is_bounded:
            self.values.update(estimate)
            return
        self.values = estimate
        left = [key for key in self._expiring if not estimate.exists(key)]
        for key in left:
            del self._expiring[key]
        self.sightlines.leave(set(left))
        self._history.keep(self._window.isam.getFactors(), self._window.isam.getLinearizationPoint(), left)

    def _give_up_cholesky(self, time_s: float) -> None:
        """Go on by QR after Cholesky met a pose far less certain than its step; `EstimatorError` where QR fails too."""
        self._window.is_by_qr = True
        self._clear_pending()
        self._restart(time_s)

    def _lag_at(self, time_s: float) -> float:
        """Age (s) from which on poses leave the window."""
        held = (time_s - self._expiring[key] + ROUNDING_S for key, until_s in self._held.items() if time_s <= until_s)
        return max([self.params.lag_s, *held])

    def _clear_pending(self) -> None:
        self._pending = Pending()
        self.waiting_gain = 0.0
        self._kept_covariance.renew(self._landmarks)

    def _restart(self, time_s: float) -> None:
        """Solve the history; start a window whose prior is the marginal of all that lies before it."""
        self._restart_size, self._restarted_s = max(FIRST_RESTART, int(RESTART_GROWTH * self.graph.size())), time_s
        self.values = self._solve()
        kept_s = {key: t for key, t in self._expiring.items() if t >= time_s - self._window.lag_s}
        times: dict[Any, float] = kept_s | dict.fromkeys(self._landmarks, time_s)
        inside, outside = split(self.graph, set(times))
        try:
            self._window.begin_after(outside, self.values, inside, picked(self.values, times), times)
        except RuntimeError as error:
            raise EstimatorError(f"isam2: {reasons(self.graph, self.values, self._expiring)}") from error
        self._take(self._window.isam.calculateEstimate())

    def _solve(self) -> gtsam.Values:
        return solve_in_sight(self.graph, self.values, self.sightlines)

    @property
    def landmark_ids(self) -> list[int]:
        """Identities of the landmarks in the graph, ascending."""
        return sorted(gtsam.Symbol(key).index() for key in self._landmarks)

    @property
    def marginals(self) -> gtsam.ISAM2:
        """Source of covariances of variables in the window."""
        return self._window.isam.getISAM2()

    def covariance(self, key: int) -> Floats:
        """Marginal covariance of a variable in the window."""
        return self._window.isam.marginalCovariance(key)

    def joint_covariance(self, keys: list[int]) -> JointCovariance:
        """Joint marginal covariance of variables in the window, and possibly of more of them."""
        return self._kept_covariance.of(self.marginals, keys)

    def joint_covariance_of_any(self, keys: list[int]) -> JointCovariance:
        """Joint marginal covariance of any variables; it costs a solution of the history if one has left the window."""
        if len(self.in_window(keys)) == len(keys):
            return self.joint_covariance(keys)
        return JointCovariance.of(self.solve_history()[1], keys)

    def solve_history(self) -> tuple[gtsam.Values, gtsam.Marginals | gtsam.ISAM2]:
        """Solve the whole graph from the present values; the solution, and what gives its marginal covariances.

        Ask that for ``marginalCovariance(key)`` or ``jointMarginalCovariance(keys)``.
        """
        if self._solved is None or self._solved_changes != self._history.changes:
            values = self._solve()
            self._solved, self._solved_changes = (values, marginals_of(self.graph, values)), self._history.changes
        return self._solved
