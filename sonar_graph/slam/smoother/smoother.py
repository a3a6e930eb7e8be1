"""Incremental smoothing of the graph, and its batch solution on request.

Two solutions share the same factors (docs/theory/isam2.md). The *window* is GTSAM's iSAM2, updated with every keyframe.
Its estimate is causal. The *history* is the batch solution of the whole graph by Levenberg-Marquardt, computed when a
smoothed result is needed. With a bounded history, a fixed-lag smoother takes the place of iSAM2, and the history is
the graph of its window: newer factors and the marginals of older ones.

Two faults restart the window at the batch solution. An update has diverged if it increased the error of the graph. A
landmark is misplaced if most of its sightings contradict the place that its first ones gave it: a robust kernel has a
second minimum there, which no Gauss-Newton step leaves. A large correction, such as a position fix after a gap,
decreases the error and is kept.
"""

from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from itertools import compress
from typing import Annotated, Any, Literal, NamedTuple, Protocol

import gtsam
import numpy as np
from pydantic import Field

from sonar_graph.calibration import Section, tagged
from sonar_graph.errors import EstimatorError
from sonar_graph.measurements import Floats
from sonar_graph.slam.smoother.batch_solution import (
    JointCovariance,
    KeptCovariance,
    Marginals,
    misplaced,
    solve,
)
from sonar_graph.slam.smoother.factor_store import (
    FactorGroup,
    Factors,
    FactorStore,
    factors_in,
    is_pose,
    picked,
    variable_name,
)
from sonar_graph.slam.smoother.observability import Blame, Withheld
from sonar_graph.slam.smoother.window import FixedLagWindow, Thresholds, WholeWindow

MOST_MESSAGES = 1000
"""Messages about withheld factors that are kept."""
MOST_NOISE_SHARE = 0.2
"""Change of a position, as a share of the sonar's range noise, above which a keyframe is relinearised: iSAM2 computes
the weights of a robust kernel only when it linearises a factor."""
LEAST_SUSPICIOUS = 1.0
"""Step of the newest keyframe or of a landmark (rad or m) from which an update is tested for divergence."""
LEAST_ITERATED = 0.02
"""Step (rad or m) after which another Gauss-Newton step follows in the same update, for example at a loop closure."""
MOST_STEPS = 20
"""Further Gauss-Newton steps in an update, at most: each costs as much as an update. A robust kernel shortens steps, and
some 15 of them cross from a minimum that has vanished to the next (`benchmarks/validation/isam2_constants.py`)."""
REACH = 1.5
"""Distance of landmarks, in longest ranges, up to which the next frame may show them: the vehicle has moved by then. A
shorter reach needs a second covariance in many frames (`benchmarks/validation/isam2_constants.py`)."""
ROUNDING_S = 1e-6
"""Margin for rounded times: a variable exactly as old as the lag stays."""


class SmootherParams(Section):
    """Settings of the incremental solution.

    Examples
    --------
    >>> from sonar_graph.slam import Isam2Params, SmootherParams
    >>> Isam2Params(smoother=SmootherParams(relinearize_threshold=0.05)).smoother.relinearize_threshold
    0.05
    """

    lag_s: float = Field(15.0, gt=0)
    """Age from which a bounded history marginalises poses. A whole history keeps all poses."""
    relinearize_threshold: float = Field(0.01, gt=0)
    """Change of a component of a variable (rad or m) above which the variable is relinearised. For the position of a
    keyframe a fifth of the sonar's range noise, if that is less."""
    relinearize_interval_s: float = Field(1.0, ge=0)
    """Least time between two relinearisations. 0: every update may relinearise."""
    stale_shift_m: float = Field(0.1, gt=0)
    """Move of a landmark from which a bounded history begins its window again at the batch solution of its graph."""
    waiting_gain: float = Field(5.0, ge=0)
    """New sightings and position fixes enter the estimate at the next keyframe, or as soon as their expected gain, the
    sum of predicted variance over noise variance, exceeds this. A fix counts fifty times. 0: always at once."""


class WholeHistory(Section):
    """All poses stay in the graph, and `Isam2.trajectory` is the batch solution of the whole run.

    Examples
    --------
    >>> from sonar_graph.slam import Isam2Params, WholeHistory
    >>> Isam2Params().history == WholeHistory()
    True
    """

    policy: Literal["whole"] = "whole"


class BoundedHistory(Section):
    """Poses older than the lag are marginalised for good, so that time and memory do not grow with the run.

    Their information on landmarks and biases is kept; `Isam2.trajectory` is fixed-lag smoothed
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

    def leave(
        self, keys: set[int], values: "Estimates", marginals: gtsam.ISAM2
    ) -> None:
        """Variables that leave, with estimates and covariances of the window, as long as they are in it."""
        ...


class Changed(NamedTuple):
    """Changes of the graph by an update or an exchange."""

    added: list[int]
    """Handles of groups that an exchange added."""
    withheld: set[int]
    """Handles of groups that could not be used and were removed."""
    left: set[int]
    """Keys of variables that left a bounded window."""


class Estimates:
    """Newest estimate of each variable, computed when it is needed and kept until the next update.

    Has the accessors of `gtsam.Values`. iSAM2 computes one variable in 15 µs, but all of a long run in milliseconds.
    """

    def __init__(self) -> None:
        self.new = gtsam.Values()
        """First estimates of variables that the window has not taken up yet."""
        self._window: WholeWindow | FixedLagWindow | None = None
        self._known: dict[int, gtsam.Pose3 | Floats] = {}
        self._gone: set[int] = set()

    def renew(self, window: WholeWindow | FixedLagWindow) -> None:
        """Forget estimates after an update of the window, which took up the new variables."""
        self._window = window
        self._known = {}
        self._gone = set()
        self.new = gtsam.Values()

    def forget(self, key: int) -> None:
        """Forget a variable that the next update removes."""
        self._known.pop(key, None)
        if self.new.exists(key):
            self.new.erase(key)
        else:
            self._gone.add(key)

    def exists(self, key: int) -> bool:
        """True for a variable of the graph."""
        if self.new.exists(key):
            return True
        return (
            self._window is not None
            and key not in self._gone
            and self._window.holds(key)
        )

    def is_taken_up(self, key: int) -> bool:
        """True for a variable that is in the window, not only about to be."""
        return self.exists(key) and not self.new.exists(key)

    def _at(self, key: int) -> Any:
        # a frame uses the same few variables several times
        known = self._known.get(key)
        if known is None:
            source = self.new
            if not source.exists(key) and self._window is not None:
                source = self._window.estimate([key])
            known = source.atPose3(key) if is_pose(key) else source.atVector(key)
            self._known[key] = known
        return known

    atPose3 = _at
    """Pose of a keyframe; these names are GTSAM's."""
    atPoint3 = _at
    """Position of a landmark."""
    atVector = _at
    """Biases."""

    def all(self) -> gtsam.Values:
        """All variables, as a copy."""
        values = gtsam.Values(self.new)
        if self._window is None:
            return values
        estimate = self._window.estimate()
        # the window still has them: only its next update removes their factors
        for key in self._gone:
            estimate.erase(key)
        values.insert(estimate)
        return values


class Smoother:
    """Growing graph with an incremental solution.

    Parameters
    ----------
    params
        Settings.
    history
        What is kept of poses older than the lag.
    departures
        Takes note of variables that leave a bounded history.
    range_sigma_m
        Noise of the sonar's range, which bounds the threshold of positions (`MOST_NOISE_SHARE`).
    """

    def __init__(
        self,
        params: SmootherParams,
        history: HistoryParams | None = None,
        departures: Departures | None = None,
        range_sigma_m: float = np.inf,
    ) -> None:
        self.params = params
        position_m = min(params.relinearize_threshold, MOST_NOISE_SHARE * range_sigma_m)
        self._thresholds = Thresholds(position_m, params.relinearize_threshold)
        self.history = history or WholeHistory()
        self.estimates = Estimates()
        """The newest estimate of every variable in the window."""
        self.withheld: deque[str] = deque(maxlen=MOST_MESSAGES)
        """Messages about factors that were withheld, and why."""
        self._departures = departures
        self._store = FactorStore()
        self._is_by_qr = False
        self._waiting_gain = 0.0
        self._longest_range_m = 0.0
        self._removed: list[int] = []
        self._newest_s = -np.inf
        self._relinearised_s = -np.inf
        self._restarted_s = -np.inf
        self._newest_pose: int | None = None
        self._times_s: dict[int, float] = {}
        self._held: dict[int, float] = {}
        self._landmarks: list[int] = []
        self._in_reach: list[int] = []
        """Landmarks in reach at the last step."""
        self._newest_bias: int | None = None
        self._refused: set[int] = set()
        self._left: set[int] = set()
        self._tested: dict[int, int] = {}
        """Number of sightings of a landmark when it was last tested (`_has_misplaced`)."""
        self._kept_covariance = KeptCovariance()
        self._solved: tuple[gtsam.Values, Marginals] | None = None
        self._window = self._empty_window()
        self._taken_up = gtsam.NonlinearFactorGraph()

    def _empty_window(self) -> WholeWindow | FixedLagWindow:
        if isinstance(self.history, BoundedHistory):
            return FixedLagWindow(self._thresholds, is_by_qr=self._is_by_qr)
        return WholeWindow(self._thresholds, is_by_qr=self._is_by_qr)

    # ---------------------------------------------------------------- what the graph is made of

    @property
    def is_bounded(self) -> bool:
        """True when variables older than the lag are marginalised."""
        return isinstance(self._window, FixedLagWindow)

    @property
    def graph(self) -> gtsam.NonlinearFactorGraph:
        """Every factor of the run; with a bounded history those of the window, marginals among them."""
        if not self.is_bounded:
            return self._store.graph()
        graph = gtsam.NonlinearFactorGraph()
        for factor in factors_in(self._taken_up):
            # removed by an exchange, which the window has not made yet
            if factor not in self._store.gone:
                graph.add(factor)
        graph.push_back(self._store.new_graph)
        return graph

    @property
    def values(self) -> gtsam.Values:
        """The newest estimate of all variables in the window; a copy."""
        return self.estimates.all()

    def graph_without(self, handles: set[int]) -> gtsam.NonlinearFactorGraph:
        """Every factor of a run with a whole history but those of some handles."""
        return self._store.graph(left_out=handles)

    @property
    def landmark_ids(self) -> list[int]:
        """Identities of the landmarks in the graph, ascending."""
        return sorted(gtsam.Symbol(key).index() for key in self._landmarks)

    def in_window(self, keys: list[int]) -> list[int]:
        """Keys of variables that are in the window, or about to be."""
        return [key for key in keys if self.estimates.exists(key)]

    def add_pose(self, key: int, pose: gtsam.Pose3, time_s: float) -> None:
        """Add a keyframe with its first estimate; an `EstimatorError` where the key is taken or time runs back."""
        if time_s < self._newest_s:
            raise EstimatorError(
                f"isam2: {variable_name(key)} at {time_s:.3f} s is older than the one before ({self._newest_s:.3f} s);"
                " give keyframes in the order of time"
            )
        self._insert(key, pose)
        # covariances, iteration and the test for divergence use the newest keyframe
        self._newest_pose = key
        self._newest_s = time_s
        self._times_s[key] = time_s

    def add_landmark(self, key: int, point: Floats) -> None:
        """Add a landmark, which never leaves the window, with its first estimate."""
        self._insert(key, point)
        self._landmarks.append(key)

    def add_bias(self, key: int, bias: Floats) -> None:
        """Add biases with their first estimate. They stay in the window until the lag after the next ones."""
        self._insert(key, bias)
        self._newest_bias = key

    def _insert(self, key: int, first: gtsam.Pose3 | Floats) -> None:
        if self.estimates.exists(key):
            raise EstimatorError(
                f"isam2: {variable_name(key)} is in the graph already; give each its own key"
            )
        self.estimates.new.insert(key, first)

    def add(
        self,
        factors: Factors | FactorGroup,
        *,
        gain: float = 0.0,
    ) -> int:
        """Add factors that are used together or not at all, at the next update; returns their handle.

        ``gain``: expected information, predicted variance over noise variance.
        """
        group = factors if isinstance(factors, FactorGroup) else FactorGroup(factors)
        self._waiting_gain += gain
        # the batch solution lacks these factors
        self._solved = None
        if group.seen is not None:
            # stands for the range of the sonar, which the calibration does not contain
            range_m = group.seen[1].z[0]
            self._longest_range_m = max(self._longest_range_m, range_m)
        return self._store.add(group)

    def hold(self, until_s: dict[int, float]) -> None:
        """Keep these keyframes, and all later ones, in a bounded window until the given times."""
        self._held = until_s

    # ---------------------------------------------------------------- updates

    @property
    def is_due(self) -> bool:
        """True when variables wait for an update, or factors that would change the estimate."""
        return (
            self.estimates.new.size() > 0
            or self._waiting_gain > self.params.waiting_gain
        )

    def update(self, time_s: float) -> Changed:
        """Update the window with all that was added; variables older than the lag leave a bounded one."""
        # where all that was new is withheld there is nothing to update
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
            self._update(time_s, self._lag_that_keeps_all(time_s))

    def exchange(
        self,
        time_s: float,
        removed: Sequence[int] = (),
        added: Sequence[FactorGroup] = (),
        new_landmarks: Mapping[int, Floats] | None = None,
        lost_landmarks: Sequence[int] = (),
    ) -> Changed:
        """Remove groups of factors by their handles, add others, and update the window.

        New landmarks come with first estimates. Lost are the landmarks that keep no factor.
        """
        # handles of removed groups must be known to the window
        self._flush(time_s)
        self._store.remove(removed)
        self._removed.extend(removed)
        self._forget(lost_landmarks)
        for key, point in (new_landmarks or {}).items():
            self.add_landmark(key, point)
        handles = [self.add(group) for group in added]
        self._withhold_unusable()
        if lost_landmarks and self.is_bounded:
            # GTSAM's fixed-lag smoother keeps a variable that lost its factors: begin again without it
            self._restart(time_s)
        else:
            self._update(time_s, self._lag_that_keeps_all(time_s))
            # a changed identity may move the estimate farther than one step reaches
            self.settle(time_s)
        return self._changed(handles)

    def settle(self, time_s: float) -> None:
        """Gauss-Newton steps until no landmark and not the newest keyframe would be relinearised (`MOST_STEPS`)."""
        self._iterate(time_s, self.params.relinearize_threshold)

    def _changed(self, added: Sequence[int] = ()) -> Changed:
        """Changes since the last answer."""
        changed = Changed(list(added), self._refused, self._left)
        self._refused = set()
        self._left = set()
        return changed

    def _lag_at(self, time_s: float) -> float:
        """Age (s) from which poses leave a bounded window; held keyframes stay."""
        if not isinstance(self.history, BoundedHistory):
            return np.inf
        held = [key for key, until_s in self._held.items() if time_s <= until_s]
        ages_s = [time_s - self._times_s[key] + ROUNDING_S for key in held]
        return max([self.params.lag_s, *ages_s])

    def _lag_that_keeps_all(self, time_s: float) -> float:
        """Age (s) at which no variable leaves the window, for example while factors are being exchanged."""
        if not self.is_bounded:
            return np.inf
        ages_s = [time_s - t + ROUNDING_S for t in self._times_s.values()]
        return max([self._lag_at(time_s), *ages_s])

    def _update(self, time_s: float, lag_s: float) -> None:
        """Update the window with all that is new, and iterate after a large step."""
        self._solved = None  # an earlier question must not decide where the next batch solution starts
        relinearises = (
            time_s >= self._relinearised_s + self.params.relinearize_interval_s
        )
        seen = self._store.newly_seen()
        # GTSAM counts updates, but their rate depends on what the sonar sees
        if relinearises:
            self._relinearised_s = time_s
        is_solved = self._step(time_s, lag_s, relinearises=relinearises)
        if not is_solved:
            return
        self._iterate(time_s, LEAST_ITERATED)
        if not self.is_bounded and self._has_misplaced(seen):
            self._restart(time_s)
        # marginals of a bounded window stay linearised where their poses left
        if isinstance(self._window, FixedLagWindow):
            may_restart = time_s >= self._restarted_s + self.params.lag_s
            shift_m = self._largest_shift(self._landmarks)
            if may_restart and shift_m > self.params.stale_shift_m:
                self._restart(time_s)

    def _iterate(self, time_s: float, least: float) -> None:
        """Further Gauss-Newton steps while the last one was large (rad or m); a restart where they diverge."""
        for _ in range(MOST_STEPS):
            newest = [] if self._newest_pose is None else [self._newest_pose]
            step = self._largest_shift([*self._landmarks, *newest])
            # not <= : also where the step is no number
            if not step <= LEAST_SUSPICIOUS and self._has_diverged():
                self._restart(time_s)
                return
            if step <= least:
                return
            # old variables left in the first step of this update: keep the others
            is_solved = self._step(
                time_s, self._lag_that_keeps_all(time_s), relinearises=True
            )
            if not is_solved:
                return

    def _step(self, time_s: float, lag_s: float, *, relinearises: bool) -> bool:
        """One Gauss-Newton step of the window; False where it failed, and the window was restarted."""
        window = self._window
        store = self._store
        self._in_reach = self._landmarks_in_reach()
        try:
            if isinstance(window, WholeWindow):
                window.update(
                    store.new,
                    self.estimates.new,
                    removed=self._removed,
                    relinearises=relinearises,
                    last=self._asked_next(),
                )
            else:
                # their covariances exist only before the update
                self._take_leave(time_s - lag_s)
                times_s = self._used_at(time_s)
                window.update(
                    store.new, self.estimates.new, times_s, lag_s, removed=self._removed
                )
        except RuntimeError:
            if not self._go_without(time_s):
                self._give_up_cholesky(time_s)
            return False
        self._clear_new()
        return True

    def _clear_new(self) -> None:
        """The window has taken up all that was new."""
        self._store.take_up()
        self._removed = []
        self._waiting_gain = 0.0
        self.estimates.renew(self._window)
        self._kept_covariance.renew()
        if isinstance(self._window, FixedLagWindow):
            self._leave(self._window)

    # ---------------------------------------------------------------- divergence

    def _largest_shift(self, keys: Sequence[int]) -> float:
        """Largest component by which some variables have moved from their linearisation point, rad or m."""
        return np.abs(self._window.delta().vector(keys)).max() if keys else 0.0

    def _has_diverged(self) -> bool:
        """True when the estimate has a larger error than the linearisation point, from which the step started."""
        graph = self.graph
        error_before = graph.error(self._window.linearised_at)
        error_after = graph.error(self.estimates.all())
        # an error that is no number has increased too
        return not error_after <= error_before

    def _has_misplaced(self, keys: set[int]) -> bool:
        """True when one of these landmarks is not where its sightings place it (`misplaced`).

        A landmark is tested at its third sighting, and when its sightings have doubled since the last test. So a
        restart that leaves it where it was, because most of its sightings are wrong, is rarely repeated.
        """
        due = {}
        for key in keys:
            count = self._store.sighting_count(key)
            if count > 2 * self._tested.get(key, 1):
                due[key] = self._store.sightlines_of(key)
                self._tested[key] = count
        return bool(misplaced(self.estimates, due))

    def _restart(self, time_s: float) -> None:
        """Begin the window again at the batch solution of the graph."""
        graph = self.graph
        values = solve(graph, self._before_update(), self._store.sightlines())
        self._restarted_s = time_s
        self._begin(graph, values, time_s)

    def _begin(
        self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, time_s: float
    ) -> None:
        """Begin a new window with all groups of factors at given values; `EstimatorError` where that is impossible."""
        # QR last: it refuses only what is not determined
        for is_by_qr in (self._is_by_qr, True):
            self._is_by_qr = is_by_qr
            window = self._empty_window()
            try:
                if isinstance(window, WholeWindow):
                    window.begin(self._store.groups, values)
                else:
                    window.begin(
                        graph, self._store.groups, values, self._kept_at(time_s)
                    )
                break
            except RuntimeError as error:
                if is_by_qr:
                    raise EstimatorError(
                        f"isam2: {self._blame().reasons(graph, values)}"
                    ) from error
        self._window = window
        self._clear_new()

    # ---------------------------------------------------------------- a bounded history

    def _used_at(self, time_s: float) -> dict[int, float]:
        """Times at which the variables of a bounded window were last used: landmarks and newest biases now."""
        if self._newest_bias is not None:
            self._times_s[self._newest_bias] = time_s
        return self._times_s | dict.fromkeys(self._landmarks, time_s)

    def _kept_at(self, time_s: float) -> dict[int, float]:
        """Variables of a bounded window that begins again, and when they were last used."""
        oldest_s = time_s - self._lag_that_keeps_all(time_s)
        return {key: t for key, t in self._used_at(time_s).items() if t >= oldest_s}

    def _take_leave(self, oldest_s: float) -> None:
        """Let `Departures` take note of the variables that the next update marginalises."""
        leaving = {
            key
            for key, t in self._times_s.items()
            if t < oldest_s and not self.estimates.new.exists(key)
        }
        # the biases in use are older than the poses that they hold for
        leaving.discard(self._newest_bias)
        if leaving and self._departures is not None:
            self._departures.leave(leaving, self.estimates, self.marginals)

    def _leave(self, window: FixedLagWindow) -> None:
        """Forget variables that left a bounded window, and the groups of factors that left with them."""
        left = [key for key in self._times_s if not window.holds(key)]
        for key in left:
            del self._times_s[key]
        self._left.update(left)
        window.forget(self._store.leave(left))
        # a copy: an update that fails would change GTSAM's own
        self._taken_up = window.factors()

    # ---------------------------------------------------------------- factors that cannot be used

    def _blame(self) -> Blame:
        return Blame(self._store, list(self.estimates.new.keys()), self._times_s)

    def _withhold_unusable(self) -> bool:
        """Withhold new factors with which the window could not be solved; True if there were any."""
        blame = self._blame()
        # only the variables of new factors: their number does not grow with the run
        keys = blame.graph.keyVector()
        values = picked(self.estimates, keys)
        spoilt = blame.spoilt(values)
        if spoilt:
            self._withhold(spoilt)
            blame = self._blame()
        undetermined = blame.undetermined(values)
        self._withhold(undetermined)
        return bool(spoilt or undetermined)

    def _withhold(self, found: list[Withheld]) -> None:
        for withheld in found:
            self.withheld.append(withheld.message)
            handles = withheld.handles.intersection(self._store.new)
            self._refused |= handles
            self._store.remove(handles)
            self._forget(withheld.keys)

    def _forget(self, keys: Iterable[int]) -> None:
        for key in keys:
            self.estimates.forget(key)
            if key in self._landmarks:
                self._landmarks.remove(key)

    def _go_without(self, time_s: float) -> bool:
        """Solve the window without the new factors that made its update fail; True if there were any."""
        values = self._before_update()
        # the window was solved without the new factors, so that the fault is in them
        before = (
            self._taken_up
            if self.is_bounded
            else self._store.graph(left_out=self._store.new)
        )
        found = self._blame().culprits(before, values)
        if not found:
            return False
        self._withhold(found)
        for withheld in found:
            for key in withheld.keys:
                values.erase(key)
        self._begin(self.graph, values, time_s)
        return True

    def _give_up_cholesky(self, time_s: float) -> None:
        """Continue by QR: Cholesky failed on a pose that is far less certain than its step."""
        self._is_by_qr = True
        self._restart(time_s)

    def _before_update(self) -> gtsam.Values:
        """Values before a failed or diverged update: the linearisation point, near the last good estimate.

        iSAM2 takes in new variables before it eliminates, so that they are there after a failure too.
        """
        return gtsam.Values(self._window.linearised_at)

    # ---------------------------------------------------------------- covariances and the batch solution

    @property
    def marginals(self) -> gtsam.ISAM2:
        """Source of covariances of variables in the window."""
        return self._window.isam

    def joint_covariance(self, keys: list[int]) -> JointCovariance:
        """Joint marginal covariance of variables in the window, and possibly of more of them."""
        return self._kept_covariance.of(self.marginals, keys, self._likely)

    def _likely(self) -> list[int]:
        """Landmarks in the window that the next frame may show."""
        return [key for key in self._in_reach if self.estimates.is_taken_up(key)]

    def _asked_next(self) -> list[int]:
        """Variables whose covariance is needed next: newest keyframe and biases, and landmarks in reach."""
        # first factors may have been withheld together with their variable
        newest = [
            key for key in (self._newest_pose, self._newest_bias) if key is not None
        ]
        return self.in_window(newest) + self._in_reach

    def _landmarks_in_reach(self) -> list[int]:
        """Landmarks within `REACH` times the longest range measured so far from the newest keyframe."""
        if self._newest_pose is None or not self._landmarks:
            return []
        reach_m = REACH * self._longest_range_m
        new = self.estimates.new
        new_keys = set(new.keys())
        # within the relinearisation threshold of the estimate, and known without back-substitution
        linearised_at = self._window.linearised_at
        position_m = self.estimates.atPose3(self._newest_pose).translation()
        points_m = [
            (new if key in new_keys else linearised_at).atPoint3(key)
            for key in self._landmarks
        ]
        d = np.array(points_m) - position_m
        is_near = np.vecdot(d, d) <= reach_m**2
        return list(compress(self._landmarks, is_near.tolist()))

    def joint_covariance_of_any(self, keys: list[int]) -> JointCovariance:
        """Joint marginal covariance of any variables, from the batch solution if one has left the window."""
        if len(self.in_window(keys)) == len(keys):
            return self.joint_covariance(keys)
        return JointCovariance.of(self.solve_history()[1], keys)

    def solve_history(self) -> tuple[gtsam.Values, Marginals]:
        """Batch solution of the whole graph from the present estimate, and the source of its marginal covariances.

        The source has ``marginalCovariance(key)`` and ``jointMarginalCovariance(keys)``.
        """
        if self._solved is None:
            graph = self.graph
            values = solve(graph, self.estimates.all(), self._store.sightlines())
            self._solved = values, Marginals(graph, values)
        return self._solved
