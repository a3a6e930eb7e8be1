"""Submaps against the marginals and solutions of all factors."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L, X

from sonar_graph.slam import factors
from sonar_graph.slam.smoother import FactorGroup, incremental, submap_window
from sonar_graph.slam.smoother.batch_solution import picked
from sonar_graph.slam.smoother.submap_window import Submap, bending

from .fed import Fed, assert_is_least_squares, in_the_basin, on_the_rail
from .graphs import off_sigmas
from .made import graph_of, huber, isotropic, motion_of, plain, point_prior, pose_prior, values_of
from .rail import STEP_S, rail


def basin_submap(*more: gtsam.NonlinearFactor) -> tuple[Submap, gtsam.Values]:
    """Keyframes 3 to 7 of the basin with all that touches them."""
    fed, interior = in_the_basin(12, 1e9), [X(k) for k in range(3, 8)]
    values = fed.smoother.solve_history()[0]
    factors = [f for f in [*fed.given, *more] if not set(interior).isdisjoint(f.keys())]
    submap = Submap(interior, dict.fromkeys(factors), picked(values, interior))
    submap.linearise(values)
    return submap, values


def driven_on(values: gtsam.Values) -> gtsam.Values:
    """All moved as one in the plane, by a right angle and some metres."""
    motion, moved = gtsam.Pose3(gtsam.Rot3.Rz(1.6), np.array([4.0, -7.0, 0.0])), gtsam.Values(values)
    for key in list(values.keys()):
        if gtsam.symbolChr(key) == ord("x"):
            moved.update(key, motion.compose(values.atPose3(key)))
        elif gtsam.symbolChr(key) == ord("l"):
            moved.update(key, motion.transformFrom(values.atPoint3(key)))
    return moved


def test_a_submap_that_moves_as_a_whole_stays_exact():
    """Odometry, ranges and azimuths say the same of it anywhere; a fix of a position, once moved, does not.

    So that one must be noticed, although its shape is as it was.
    """
    fix = pose_prior(X(5), gtsam.Pose3(), 0.1)
    for more, is_relative in (((), True), ((fix,), False)):
        submap, values = basin_submap(*more)
        (factor,) = submap.marginals
        moved = driven_on(values)
        anew, _ = basin_submap(*more)
        anew.values = picked(moved, anew.interior)
        anew.summary = None
        anew.linearise(moved)
        found, expected = (f.linearize(moved).augmentedInformation() for f in (factor, anew.marginals[0]))
        assert submap.has_changed(moved) != is_relative
        assert submap.is_stale(moved) != is_relative
        assert not submap.is_stale(values)
        scale = np.abs(expected).max()
        assert np.allclose(found[:-1, :-1], expected[:-1, :-1], atol=1e-6 * scale) == is_relative
        assert (factor.error(moved) == pytest.approx(factor.error(values), abs=1e-6)) == is_relative


def test_joined_submaps_are_least_squares():
    """Joined two by two until few are left; late ranges come to, and go from, keyframes inside and between them."""
    nodes = 31
    _, numbers = rail(nodes)
    fed = on_the_rail(nodes, 2.6)
    window = fed.smoother._window
    levels = [submap.level for submap in window._submaps]
    assert levels == sorted(levels, reverse=True)
    assert max(levels) == 3
    assert len(window._submaps) < len(window._whole) / 4
    assert_is_least_squares(fed, numbers, nodes)
    kept = [r for r in numbers.ranges if not 7 <= r[0] <= 12]
    gone = [handle for k, i, _ in numbers.ranges if 7 <= k <= 12 for handle in fed.handles_on(X(k), L(i))]
    assert gone
    fed.smoother.exchange((nodes - 1) * STEP_S, gone)
    numbers = type(numbers)(numbers.displacements_m, kept)
    assert_is_least_squares(fed, numbers, nodes)
    mean, _ = numbers.solution(nodes)
    for k in range(nodes):
        x = fed.smoother.solve_history()[0].atPose3(X(k)).translation()[0]
        assert x == pytest.approx(mean[f"x{k}"], abs=1e-8)


@pytest.mark.parametrize("bias_steps", [7, 1000])
@pytest.mark.parametrize("most_rows", [0, 1000])
def test_in_the_basin_the_window_stays_near_the_batch(monkeypatch, most_rows, bias_steps):
    """After three circles, submaps joined and not: landmarks to half their sigmas, joint covariances to a tenth.

    That is the median of four runs, since it depends on which submap was linearised anew last.
    """
    monkeypatch.setattr(submap_window, "MOST_ROWS", most_rows)
    off, landmarks_off, keys = [], [], [X(79), L(3), L(5), L(8)]
    for seed in range(4):
        fed = in_the_basin(80, 4.0, seed=seed, bias_steps=bias_steps)
        assert (len(fed.smoother._window._submaps) < 10) == (most_rows > 0)
        batch, _ = fed.smoother.solve_history()
        landmarks_off.append(sigmas_off(fed))
        off.append(off_sigmas(fed.joint(*keys), fed.dense(batch, *keys)))
    assert np.median(landmarks_off) < 0.5
    assert np.median(off) < 0.1


@pytest.fixture
def heights_do_not_matter(monkeypatch):
    """A submap is made of keyframes as soon as they are old enough."""
    monkeypatch.setattr(submap_window, "MOST_BENT", np.inf)


def jumps_m(seed: int, height_m: float) -> float:
    """Root mean square distance of live poses, by a level sonar, from those of a smoother that keeps all poses."""
    tracks = []
    for lag_s in (4.0, 1e9):
        fed = in_the_basin(60, lag_s, seed=seed, height_m=height_m, sonar=gtsam.Pose3())
        tracks.append(np.array([pose.translation() for pose in fed.live]))
    return float(np.sqrt(np.square(tracks[0] - tracks[1]).sum(axis=1).mean()))


def test_among_landmarks_at_its_height_a_live_estimate_is_near_that_with_all_poses_kept(monkeypatch):
    """A range tells the square of such a height: in submaps it would go up and down without end."""
    found = [jumps_m(seed, -0.05) for seed in range(3)]
    monkeypatch.setattr(submap_window, "MOST_BENT", np.inf)
    control = [jumps_m(seed, -0.05) for seed in range(3)]
    assert np.median(found) < 0.02
    assert np.median(control) > 0.1


def test_a_range_bends_by_the_square_of_a_height_whatever_its_kernel():
    """At the sonar's own height, ``(sqrt(r^2 + h^2) - r) / sigma`` for a step h up or down; a kernel is of outliers."""
    heights = [values_of(X1=gtsam.Pose3(), L1=np.array([10.0, 0.0, z_m])) for z_m in (-1.0, 0.0, 1.0)]
    for kernel in (plain, huber):
        seen = gtsam.RangeFactor3D(X(1), L(1), 12.0, kernel(isotropic(1, 0.05)))
        assert bending(seen, *heights) == pytest.approx((np.sqrt(101.0) - 10.0) / 0.05, rel=1e-9)


def test_what_waits_for_heights_does_not_depend_on_the_axes_of_the_body():
    """Rolled, a pose has the same height, but another share of it in each of the body's own axes."""
    found = []
    for roll_rad in (0.0, 1.5):
        window = in_the_basin(40, 4.0, height_m=-0.6, sonar=gtsam.Pose3(), roll_rad=roll_rad).smoother._window
        found.append(([keys[0] for keys in window._waiting], [submap.ends for submap in window._submaps]))
    level, rolled = found
    assert rolled == level
    assert all(level)


def test_a_window_begun_anew_waits_for_landmarks_whose_heights_it_has_never_asked_for():
    fed = in_the_basin(12, 2.0)
    window, smoother = submap_window.SubmapWindow(1e-6, 2.0, 1), fed.smoother
    times_s = {X(k): float(k) for k in range(12)}
    window.begin(graph_of(fed.given), smoother.solve_history()[0], times_s, 11.0)
    assert not window._submaps
    assert window._waiting


def test_keyframes_become_a_submap_once_the_heights_of_what_they_see_are_known():
    """In the order of time, whenever that is, and joined; the estimate stays that of all factors."""
    fed = in_the_basin(40, 4.0, height_m=-0.05, sonar=gtsam.Pose3())
    window = fed.smoother._window
    waited = len(window._waiting)
    assert waited > 5
    for i in (3, 5, 8):
        fed.add({"height": factors.floor_prior(L(i), -0.05, 0.01)})
    for _ in range(3 * waited):
        fed.smoother.exchange(39.0)
    ends = [submap.ends for submap in window._submaps]
    assert ends == sorted(ends)
    assert len(window._waiting) < waited / 2
    assert sigmas_off(fed) < 0.1


def sigmas_off(fed: Fed) -> float:
    """Largest deviation of a landmark of the basin from the batch solution, in standard deviations of all factors."""
    batch, _ = fed.smoother.solve_history()
    found = []
    for i in (3, 5, 8):
        off = fed.smoother.values.atPoint3(L(i)) - batch.atPoint3(L(i))
        found.append(np.sqrt(off @ np.linalg.solve(fed.dense(batch, L(i)), off)))
    return max(found)


def running_away(monkeypatch) -> list[float]:
    """Let each update of a window throw a landmark ten kilometres off; the times when the history is solved."""
    update, solve, now_s, solved_s = submap_window.SubmapWindow.update, incremental.solve_in_sight, [0.0], list[float]()

    def overshooting(window, graph, values, times_s, time_s, *more) -> gtsam.Values:
        now_s[0], estimate = time_s, update(window, graph, values, times_s, time_s, *more)
        estimate.update(L(5), np.array([1e4, 0.0, 0.0]))
        return estimate

    def noted(*arguments) -> gtsam.Values:
        solved_s.append(now_s[0])
        return solve(*arguments)

    monkeypatch.setattr(submap_window.SubmapWindow, "update", overshooting)
    monkeypatch.setattr(incremental, "solve_in_sight", noted)
    return solved_s


def test_where_gauss_newton_runs_away_the_live_estimate_is_that_of_damped_steps(monkeypatch):
    """Farther than the extent of track and map, as by a Doppler log that looks astern."""
    fed = in_the_basin(12, 4.0)
    running_away(monkeypatch)
    fed.add({"prior": point_prior(L(3), fed.smoother.values.atPoint3(L(3)), 0.1)})
    fed.smoother.flush(11.0)
    batch, _ = fed.smoother.solve_history()
    assert fed.smoother.values.atPoint3(L(5)) == pytest.approx(batch.atPoint3(L(5)), abs=1e-3)


def test_while_gauss_newton_runs_away_the_history_is_solved_once_a_lag_and_odometry_goes_on_in_between(monkeypatch):
    """So that measurements which contradict each other for long do not cost a solution of all of them an update."""
    fed, moved = in_the_basin(12, 4.0), gtsam.Pose3(gtsam.Rot3(), np.array([0.5, 0.0, 0.0]))
    solved_s, cov = running_away(monkeypatch), 1e-4 * np.eye(6)
    for k in range(12, 22):
        expected = fed.smoother.values.atPose3(X(k - 1)).compose(moved)
        fed.smoother.add_pose(X(k), expected, float(k))
        fed.add({"odometry": factors.odometry(X(k - 1), X(k), motion_of(moved, cov))})
        fed.smoother.update(float(k))
        assert k in solved_s or fed.smoother.values.atPose3(X(k)).equals(expected, 1e-3)
        assert fed.joint(X(k)).shape == (6, 6)
    assert solved_s == [12.0, 16.0, 20.0]


@pytest.mark.usefixtures("heights_do_not_matter")
def test_settled_all_submaps_are_as_their_parts_are_now_however_deep(monkeypatch):
    """When none has been linearised anew since it was made."""
    monkeypatch.setattr(submap_window, "MOST_LOOKS", 0)
    fed = in_the_basin(80, 4.0)
    assert max(submap.level for submap in fed.smoother._window._submaps) > 4
    assert sigmas_off(fed) > 0.2
    fed.smoother.settle(79.0)
    assert all(submap.is_settled for submap in fed.smoother._window._whole)
    assert sigmas_off(fed) < 0.1


@pytest.mark.usefixtures("heights_do_not_matter")
def test_a_sighting_that_comes_when_its_keyframe_leaves_for_a_submap_counts():
    """In the very update in which it leaves; nothing is begun anew for it."""
    fed, late = in_the_basin(40, 4.0), []
    in_window = [k for k in range(40) if fed.smoother.in_window([X(k)])]
    handles = [handle for k in in_window for handle in fed.handles_on(X(k), L(5))]
    fed.smoother.exchange(39.0, handles)
    without, _ = fed.smoother.solve_history()
    for k in in_window[1:4]:
        groups = [FactorGroup(fed.groups[handle]) for handle in fed.handles_on(X(k), L(5))]
        was_inside = fed.smoother.in_window([X(k)])
        assert not fed.smoother.exchange(60.0, (), groups).withheld
        late.append(was_inside and not fed.smoother.in_window([X(k)]))
    assert any(late)
    assert not fed.smoother._window.is_by_qr
    batch, _ = fed.smoother.solve_history()
    assert sigmas_off(fed) < 0.1
    assert np.linalg.norm(batch.atPoint3(L(5)) - without.atPoint3(L(5))) > 5e-3


def test_where_cholesky_gives_up_on_a_sighting_from_inside_a_submap_qr_goes_on_with_it(monkeypatch):
    fed, update = in_the_basin(40, 4.0), gtsam.ISAM2.update
    window, handles = fed.smoother._window, fed.handles_on(X(9), L(5))
    groups = [FactorGroup(fed.groups[handle]) for handle in handles]
    fed.smoother.exchange(39.0, handles)

    def giving_up(isam, *arguments):
        if not window.is_by_qr:
            raise RuntimeError("indeterminate")
        return update(isam, *arguments)

    monkeypatch.setattr(gtsam.ISAM2, "update", giving_up)
    assert not fed.smoother.exchange(39.0, (), groups).withheld
    assert window.is_by_qr
    assert sigmas_off(fed) < 0.1


def test_a_submap_that_leaves_a_direction_of_its_keyframes_open_is_refused():
    values = values_of(X1=gtsam.Pose3(), L1=np.ones(3))
    seen = gtsam.RangeFactor3D(X(1), L(1), 1.7, gtsam.noiseModel.Isotropic.Sigma(1, 0.1))
    with pytest.raises(RuntimeError, match="open"):
        Submap([X(1)], {seen: None}, picked(values, [X(1)])).linearise(values)


def test_a_landmark_that_left_submaps_and_came_back_is_where_it_was():
    fed, time_s = in_the_basin(40, 4.0), 39.0
    batch, handles = fed.smoother.solve_history()[0].atPoint3(L(5)), fed.handles_on(L(5))
    handles += [handle for k in range(40) for handle in fed.handles_on(X(k), L(5))]
    groups = [FactorGroup(fed.groups[handle]) for handle in handles]
    assert any(L(5) in submap.summary.keys for submap in fed.smoother._window._whole if submap.parent is not None)
    fed.smoother.exchange(time_s, handles, lost_landmarks=[L(5)])
    assert L(5) not in set(fed.smoother.values.keys())
    fed.smoother.exchange(time_s, (), groups, {L(5): batch + 0.2})
    assert fed.smoother.values.atPoint3(L(5)) == pytest.approx(batch, abs=1e-3)


@pytest.mark.usefixtures("heights_do_not_matter")
def test_an_update_makes_one_submap_or_linearises_few_anew(monkeypatch):
    counts: list[int] = []
    linearise = Submap.linearise

    def counting(submap: Submap, *arguments) -> None:
        counts[-1] += 1
        linearise(submap, *arguments)

    update = submap_window.SubmapWindow.update

    def watched(*arguments, **more) -> gtsam.Values:
        counts.append(0)
        return update(*arguments, **more)

    monkeypatch.setattr(Submap, "linearise", counting)
    monkeypatch.setattr(submap_window.SubmapWindow, "update", watched)
    fed: Fed = in_the_basin(60, 4.0)
    assert len(fed.smoother._window._whole) > 20
    assert max(counts) <= submap_window.MOST_LOOKS
    assert sum(counts) > len(fed.smoother._window._whole)


def test_a_submap_on_which_no_pose_hangs_is_a_prior_of_the_rest():
    """A keyframe with a landmark, and no odometry to others."""
    values = values_of(X1=gtsam.Pose3(), L1=np.ones(3))
    seen = gtsam.RangeFactor3D(X(1), L(1), 1.7, gtsam.noiseModel.Isotropic.Sigma(1, 0.1))
    submap = Submap([X(1)], dict.fromkeys([pose_prior(X(1), gtsam.Pose3(), 0.1), seen]), picked(values, [X(1)]))
    submap.linearise(values)
    together = graph_of([*submap.marginals, point_prior(L(1), np.ones(3), 1.0)])
    exact = graph_of([*submap.factors, point_prior(L(1), np.ones(3), 1.0)])
    found = gtsam.Marginals(together, values_of(L1=np.ones(3))).marginalCovariance(L(1))
    assert found == pytest.approx(gtsam.Marginals(exact, values).marginalCovariance(L(1)), rel=1e-9)
