"""Incremental smoothing at a bounded cost per update, and the solution of the whole graph on request.

Two solutions share the same factors (docs/theory/isam2.md). The *window* is GTSAM's iSAM2 over the poses of the last
``lag_s`` seconds, all landmarks and all biases. The *history* is every factor of the run, solved by Levenberg-Marquardt
when the smoothed result is asked for; when it is *bounded*, the window's factors and the marginals of what has left.

Marginalising freezes the linearisation of the landmarks that it touches. When one has since moved by more than
``stale_shift_m``, the history is solved and the window starts again from that solution, once a lag. The window also
starts again when a factor is taken out that has been marginalised, and whenever a step runs away.
"""

from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from typing import Annotated, Any, Literal, NamedTuple, Protocol

import gtsam
import numpy as np
from pydantic import Field

from sonar_graph.calibration import Section
from sonar_graph.errors import EstimatorError
from sonar_graph.measurements import Floats
from sonar_graph.slam.smoother.batch_solution import (
    JointCovariance,
    KeptCovariance,
    Marginals,
    Sightline,
    picked,
    solve_in_sight,
)
from sonar_graph.slam.smoother.factor_store import FactorGroup, Factors, FactorStore
from sonar_graph.slam.smoother.fixed_lag import FixedLagWindow, with_marginals
from sonar_graph.slam.smoother.observability import Blame, Withheld, variable_name
from sonar_graph.slam.smoother.submap_window import SubmapWindow
from sonar_graph.tagged_sections import tagged

MOST_MESSAGES = 1000
"""Kept of what was withheld."""
LEAST_RUN_AWAY_M = 10.0
"""Move of a keyframe or landmark in an update up to which no track is too short for it."""
ROUNDING_S = 1e-6
"""Margin for rounded times: a variable exactly as old as the lag stays."""


class SmootherParams(Section):
    """Settings of the incremental solution.

    Examples
    --------
    >>> from sonar_graph.slam import Isam2Params, SmootherParams
    >>> Isam2Params(smoother=SmootherParams(lag_s=60.0)).smoother.lag_s
    60.0
    """

    lag_s: float = Field(15.0, gt=0)
    """Age from which poses are marginalised out of the incremental solution; a large value keeps all of them."""
    relinearize_threshold: float = Field(0.001, gt=0)
    """Change of a component of a variable (rad or m) above which the variable is relinearised."""
    submap_keyframes: int = Field(10, ge=1)
    """Number of keyframes older than the lag that are marginalised together, in a submap; of a whole history."""
    stale_shift_m: float = Field(0.1, gt=0)
    """Distance that a landmark may move before a bounded window starts again from a solution of its graph."""
    waiting_gain: float = Field(5.0, ge=0)
    """New sightings and position fixes enter the estimate at the next keyframe, or as soon as their expected gain, the
    sum of predicted variance over noise variance, which counts fifty times of a fix, exceeds this. 0: always at
    once."""


class WholeHistory(Section):
    """Every factor is kept, for the batch solution in `Isam2.trajectory`.

    Examples
    --------
    >>> from sonar_graph.slam import Isam2Params, WholeHistory
    >>> Isam2Params().history == WholeHistory()
    True
    """

    policy: Literal["whole"] = "whole"


class BoundedHistory(Section):
    """Poses older than the lag are marginalised for good, so that time and memory do not grow with the run.

    Their information on landmarks and bias is kept; `Isam2.trajectory` is fixed-lag smoothed
    (docs/theory/bounded_memory.md).

    Examples
    --------
    >>> from sonar_graph import run_estimator
    >>> from sonar_graph.slam import BoundedHistory
    >>> from sonar_graph.testing import small_world
    >>> BoundedHistory().policy
    'bounded'
    >>> run_estimator(small_world(), "isam2", {"history.policy": "bounded"}).landmarks.ids
    array([ 4,  9, 11])
    """

    policy: Literal["bounded"] = "bounded"
    remembered_s: float | None = Field(None, gt=0)
    """Age from which `Isam2.trajectory` and `Isam2.detections` may drop entries; those older than 1.25 times this are
    dropped. None: all are kept."""


HistoryParams = Annotated[WholeHistory | BoundedHistory, *tagged("policy", "whole")]


class Departures(Protocol):
    """Takes note of variables before they leave a bounded window for good."""

    def leave(self, keys: set[int], values: gtsam.Values, marginals: gtsam.ISAM2) -> None:
        """Variables that leave, with all estimates and covariances of the window, as long as they are in it."""
        ...


class Changed(NamedTuple):
    """Changes of the graph by an update or an exchange."""

    added: list[int]
    """Handles of groups that an exchange put in."""
    withheld: set[int]
    """Handles of groups that could not be used and are out again."""
    left: set[int]
    """Keys of variables that left a bounded window."""


class Smoother:
    """Growing graph with a bounded incremental solution; plain iSAM2 over the whole history where the lag is infinite.

    Parameters
    ----------
    departures
        Makes the history bounded: factors that leave the window become marginals for good, and their variables, of
        which this takes note, are forgotten. None: the whole history is kept.
    """

    def __init__(self, params: SmootherParams, departures: Departures | None = None) -> None:
        self.params = params
        self.values = gtsam.Values()
        """The newest estimate of every variable; of those that left the window, the last one there."""
        self.withheld: deque[str] = deque(maxlen=MOST_MESSAGES)
        """The newest of what was withheld, and why."""
        self._departures = departures
        self._store = FactorStore()
        self._new_values = gtsam.Values()
        self._new_times_s: dict[int, float] = {}
        self._waiting_gain = 0.0
        self._refused: set[int] = set()
        self._left: set[int] = set()
        self._restarted_s = self._newest_s = -np.inf
        self._newest_pose = 0
        self._expiring: dict[int, float] = {}
        self._held: dict[int, float] = {}
        self._landmarks: list[int] = []
        self._bias: list[int] = []
        self._window: FixedLagWindow | SubmapWindow
        if departures is None:
            self._window = SubmapWindow(params.relinearize_threshold, params.lag_s, params.submap_keyframes)
        else:
            self._window = FixedLagWindow(params.relinearize_threshold, params.lag_s)
        self._taken_up = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self._kept_covariance = KeptCovariance()
        self._solved: tuple[gtsam.Values, Marginals] | None = None

    @property
    def is_bounded(self) -> bool:
        """True when what leaves the window is given up."""
        return self._departures is not None

    @property
    def graph(self) -> gtsam.NonlinearFactorGraph:
        """Every factor of the run; of a bounded one those of the window, marginals among them."""
        if not self.is_bounded:
            return self._store.graph()
        graph = with_marginals(*self._taken_up, self._store.gone)
        graph.push_back(self._store.new_graph)
        return graph

    def graph_without(self, handles: set[int]) -> gtsam.NonlinearFactorGraph:
        """Every factor of the run, of which the whole history is kept, but those of some handles."""
        return self._store.graph(left_out=handles)

    def add_pose(self, key: int, pose: gtsam.Pose3, time_s: float) -> None:
        """Add a keyframe with its first estimate; an `EstimatorError` where the key is taken or time runs back."""
        if time_s < self._newest_s:
            raise EstimatorError(
                f"isam2: {variable_name(key)} at {time_s:.3f} s is older than the one before ({self._newest_s:.3f} s);"
                " give keyframes in the order of time"
            )
        self._insert(key, pose)
        self._newest_pose = key
        self._newest_s = self._new_times_s[key] = self._expiring[key] = time_s

    def add_landmark(self, key: int, point: Floats) -> None:
        """Add a landmark, which never leaves the window, with its first estimate."""
        self._insert(key, point)
        self._landmarks.append(key)

    def add_bias(self, key: int, bias: Floats) -> None:
        """Add a gyro bias with its first estimate. It stays in the window until the lag after the next one."""
        self._insert(key, bias)
        self._bias = [key]

    def _insert(self, key: int, first: gtsam.Pose3 | Floats) -> None:
        """A first estimate, for the window and for who asks meanwhile."""
        if self.values.exists(key):
            raise EstimatorError(f"isam2: {variable_name(key)} is in the graph already; give each its own key")
        self._new_values.insert(key, first)
        self.values.insert(key, first)

    def add(self, factors: Factors, seen: tuple[int, Sightline] | None = None, *, gain: float = 0.0) -> int:
        """Add factors that are used together or not at all (`FactorGroup`), at the next update; their handle.

        ``gain``: what they have to tell, predicted variance over noise variance.
        """
        self._waiting_gain += gain
        self._solved = None
        return self._store.add(FactorGroup(factors, seen))

    def hold(self, until_s: dict[int, float]) -> None:
        """Keep keyframes, and all later ones (iSAM2 marginalises in order), in the window until times; no others."""
        self._held = until_s

    @property
    def is_due(self) -> bool:
        """True when variables wait for an update, or factors that would change the estimate."""
        return self._new_values.size() > 0 or self._waiting_gain > self.params.waiting_gain

    def update(self, time_s: float) -> Changed:
        """Bring the window's estimate up to date with what was added; what is older than the lag leaves it."""
        if not self._withhold_unusable() or self.is_due:
            self._update(time_s, self._lag_at(time_s))
        return self._changed()

    def flush(self, time_s: float) -> Changed:
        """Update with the factors that wait, if any; a bounded window keeps its variables."""
        self._flush(time_s)
        return self._changed()

    def _flush(self, time_s: float) -> None:
        self._withhold_unusable()
        if self._store.new:
            self._update(time_s, self._lag_at(time_s, keeps_all=self.is_bounded))

    def exchange(
        self,
        time_s: float,
        removed: Sequence[int] = (),
        added: Sequence[FactorGroup] = (),
        new_landmarks: Mapping[int, Floats] | None = None,
        lost_landmarks: Sequence[int] = (),
    ) -> Changed:
        """Take groups of factors out by their handles, put others in, and update the window.

        New landmarks come with first estimates; lost are those on which no factor is left.
        """
        self._flush(time_s)
        gone = self._store.factors(removed)
        self._forget(lost_landmarks)
        self._store.remove(removed)
        for key, point in (new_landmarks or {}).items():
            self.add_landmark(key, point)
        handles = [self.add(group.factors, group.seen) for group in added]
        self._withhold_unusable()
        keys = self._store.new_graph.keyVector()
        self._window.lag_s = self._lag_at(time_s, keeps_all=self.is_bounded)
        known = [key for key in keys if not self._new_values.exists(key)]
        window = self._window
        if isinstance(window, FixedLagWindow) and (lost_landmarks or not window.can_exchange(gone, known)):
            self._kept_covariance.renew(self._landmarks)
            self._restart(time_s)
        else:
            self._update(time_s, self._window.lag_s, gone)
            self.settle(time_s)
        return self._changed(handles)

    def settle(self, time_s: float) -> None:
        """Gauss-Newton steps until nothing would be relinearised any more, ten at most."""
        try:
            self._window.settle()
        except RuntimeError:
            self._give_up_cholesky(time_s)
        self._kept_covariance.outdate()
        self._take(self._window.estimate())

    def _changed(self, added: Sequence[int] = ()) -> Changed:
        """Changes since the last answer."""
        changed = Changed(list(added), self._refused, self._left)
        self._refused, self._left = set(), set()
        return changed

    def _lag_at(self, time_s: float, *, keeps_all: bool = False) -> float:
        """Age (s) from which on poses leave the window.

        ``keeps_all``: none leaves, as between what an exchange takes out of a bounded window and what it puts in.
        """
        held = self._expiring if keeps_all else [key for key, until_s in self._held.items() if time_s <= until_s]
        return max([self.params.lag_s, *(time_s - self._expiring[key] + ROUNDING_S for key in held)])

    def in_window(self, keys: list[int]) -> list[int]:
        """Keys of variables that are in the window, or about to be."""
        return [key for key in keys if self._window.holds(key) or self._new_values.exists(key)]

    def _forget(self, landmark_keys: Iterable[int]) -> None:
        for key in landmark_keys:
            self._landmarks.remove(key)
            self.values.erase(key)

    def _update(self, time_s: float, lag_s: float, removed: Sequence[gtsam.NonlinearFactor] = ()) -> None:
        """Update the window, without some of its factors, and restart a bounded one where it is stale."""
        self._expiring |= dict.fromkeys(self._bias, time_s)
        if self._departures is not None:
            old = (key for key, t in self._expiring.items() if t < time_s - lag_s)
            if leaving := {key for key in old if not self._new_values.exists(key)}:
                self._departures.leave(leaving, self.values, self.marginals)
        self._window.lag_s = lag_s
        graph, times = self._store.new_graph, self._times(self._new_times_s, time_s)
        try:
            estimate = self._window.update(graph, self._new_values, times, time_s, removed)
        except RuntimeError:
            if not self._go_without(time_s):
                self._give_up_cholesky(time_s)
                return
            estimate = self._window.estimate()
        self._kept_covariance.renew(self._landmarks)
        if self._has_run_away(estimate):
            self._restart(time_s, solves=time_s >= self._restarted_s + self.params.lag_s)
            return
        self._clear_new()
        self._take(estimate)
        window, may_restart = self._window, time_s >= self._restarted_s + self.params.lag_s
        if isinstance(window, FixedLagWindow) and may_restart:
            shift_m = window.largest_shift(self._landmarks)
            if shift_m > self.params.stale_shift_m:
                self._restart(time_s)

    def _has_run_away(self, estimate: gtsam.Values) -> bool:
        """True when Gauss-Newton moved the newest keyframe, or a landmark, by more than the extent of track and map.

        It diverges then; damped steps of the whole history from before do not.
        """
        if not all(map(estimate.exists, [self._newest_pose, *self._landmarks])):
            return False
        before, after = (
            np.array([v.atPose3(self._newest_pose).translation(), *map(v.atPoint3, self._landmarks)])
            for v in (self.values, estimate)
        )
        moved_m = float(np.linalg.norm(after - before, axis=1).max())
        if moved_m <= LEAST_RUN_AWAY_M:
            return False
        positions = np.vstack([before, gtsam.utilities.extractPose3(self.values)[:, 9:]])
        return not moved_m <= float(np.linalg.norm(np.ptp(positions, axis=0)))

    def _times(self, poses_s: dict[int, float], time_s: float) -> dict[Any, float]:
        """When variables were last seen, from those of poses: landmarks and the newest bias are seen now."""
        return poses_s | dict.fromkeys(self._landmarks + self._bias, time_s)

    def _blame(self) -> Blame:
        return Blame(self._store, list(self._new_values.keys()), self._expiring)

    def _withhold_unusable(self) -> bool:
        """Take new factors out again that the window could not be solved with; whether there were any."""
        blame = self._blame()
        values = picked(self.values, blame.graph.keyVector())
        if found := blame.spoilt(values):
            self._withhold(found)
            blame = self._blame()
        more = blame.undetermined(values)
        self._withhold(more)
        return bool(found or more)

    def _withhold(self, found: list[Withheld]) -> None:
        for withheld in found:
            self.withheld.append(withheld.message)
            handles = withheld.handles.intersection(self._store.new)
            self._refused |= handles
            self._store.remove(handles)
            for key in withheld.keys:
                if self._new_values.exists(key):
                    self._new_values.erase(key)
            self._forget(key for key in withheld.keys if key in self._landmarks)

    def _go_without(self, time_s: float) -> bool:
        """Solve the window without those new factors that are to blame; whether there are any.

        The window is made anew of the other factors: a bounded one with the same linearisation, so that nothing else
        changes, else at the estimate.
        """
        new = {factor for group in self._store.new.values() for factor in group}
        theta = gtsam.Values(self._new_values)
        theta.insert_or_assign(self._window.linearised_at if self.is_bounded else self.values)
        before = with_marginals(self._window.factors, theta, new)
        if not (found := self._blame().culprits(before, theta)):
            return False
        self._withhold(found)
        for key in set().union(*(withheld.keys for withheld in found)):
            theta.erase(key)
        before.push_back(self._store.new_graph)
        graph = before if self.is_bounded else self._store.graph()
        times_s = {key: self._expiring.get(key, time_s) for key in list(theta.keys())}
        try:
            self._window.begin(graph, theta, self._times(times_s, time_s), time_s)
        except RuntimeError as error:
            raise EstimatorError(f"isam2: {self._blame().reasons(graph, theta)}") from error
        return True

    def _take(self, estimate: gtsam.Values) -> None:
        """Take over the estimate of the window; a bounded one forgets what has left."""
        self._solved = None  # who asked before must not decide where the next solution starts
        if not self.is_bounded:
            self.values.update(estimate)
            return
        self.values = estimate
        left = [key for key in self._expiring if not estimate.exists(key)]
        for key in left:
            del self._expiring[key]
        self._left.update(left)
        self._store.leave(left)
        # copies: an update that fails or runs away would change GTSAM's own
        self._taken_up = gtsam.NonlinearFactorGraph(self._window.factors), gtsam.Values(self._window.linearised_at)

    def _give_up_cholesky(self, time_s: float) -> None:
        """Go on by QR after Cholesky met a pose far less certain than its step; `EstimatorError` where QR fails too."""
        self._window.is_by_qr = True
        self._kept_covariance.renew(self._landmarks)
        self._restart(time_s)

    def _clear_new(self) -> None:
        """The window has taken up all that was new."""
        self._store.take_up()
        self._new_values, self._new_times_s, self._waiting_gain = gtsam.Values(), {}, 0.0

    def _restart(self, time_s: float, *, solves: bool = True) -> None:
        """Solve the history, or leave the estimate as it is; start the window from that."""
        graph = self.graph
        self._clear_new()
        if solves:
            self._restarted_s = time_s
            self.values = solve_in_sight(graph, self.values, self._store.sightlines())
        times_s = self._expiring | dict.fromkeys(self._landmarks, time_s)
        try:
            self._window.begin(graph, self.values, times_s, time_s)
        except RuntimeError as error:
            raise EstimatorError(f"isam2: {self._blame().reasons(graph, self.values)}") from error
        estimate = self._window.estimate()
        self._take(picked(self.values, estimate.keys()) if self._has_run_away(estimate) else estimate)

    @property
    def landmark_ids(self) -> list[int]:
        """Identities of the landmarks in the graph, ascending."""
        return sorted(gtsam.Symbol(key).index() for key in self._landmarks)

    @property
    def marginals(self) -> gtsam.ISAM2:
        """Source of covariances of variables in the window."""
        return self._window.marginals

    def joint_covariance(self, keys: list[int]) -> JointCovariance:
        """Joint marginal covariance of variables in the window, and possibly of more of them."""
        return self._kept_covariance.of(self.marginals, keys)

    def joint_covariance_of_any(self, keys: list[int]) -> JointCovariance:
        """Joint marginal covariance of any variables; it costs a solution of the history if one has left the window."""
        if len(self.in_window(keys)) == len(keys):
            return self.joint_covariance(keys)
        return JointCovariance.of(self.solve_history()[1], keys)

    def solve_history(self) -> tuple[gtsam.Values, Marginals]:
        """Solve the whole graph from the present values; the solution, and what gives its marginal covariances.

        Ask that for ``marginalCovariance(key)`` or ``jointMarginalCovariance(keys)``.
        """
        if self._solved is None:
            graph = self.graph
            start = self._window.carried(self.values) if isinstance(self._window, SubmapWindow) else self.values
            values = solve_in_sight(graph, start, self._store.sightlines())
            self._solved = values, Marginals(graph, values)
        return self._solved
