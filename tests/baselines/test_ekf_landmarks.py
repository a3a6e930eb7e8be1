import math

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from baselines.ekf_equations import location, moment_after, motion_covariance, observation, observe_rows
from baselines.sonar_update import GATED, NEW, NO_SLOT, PASSED_OVER, USED, Frame, SonarModel, no_outcomes
from sonar_graph.numerics.mat3 import matrix, vector
from sonar_graph.slam.landmarks.association import gate_threshold
from sonar_graph.slam.models.sonar_model import FLOOR_GATE, elevation_on_floor, locate, range_azimuth

from .motions import motion_of

STEP = 1e-6
MOUNTING = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.1, 0.5, -0.2), np.array([0.4, 0.1, -0.2]))
NOISE = np.diag([0.02**2, 0.01**2])
MOTION_SIGMA = 1e-3
attitudes = st.builds(
    lambda *angles: np.array(angles), st.floats(-3.1, 3.1), st.floats(-1.3, 1.3), st.floats(-3.1, 3.1)
)
views = st.tuples(st.floats(1.0, 10.0), st.floats(-math.pi, math.pi), st.floats(-0.8, 0.8))


def sonar(**changes):
    model = SonarModel(
        body_R_sonar=matrix(MOUNTING.rotation().matrix()),
        body_p_sonar=vector(MOUNTING.translation()),
        gate=gate_threshold(0.999, 2),
        aperture_rad=0.244,
        range_variance_m2=NOISE[0, 0],
        azimuth_variance=NOISE[1, 1],
        has_floor=False,
        floor_z_m=0.0,
        floor_variance_m2=1e-4,
    )
    return model._replace(**changes)


TWIST = np.array([0.02, -0.01, 0.05, 0.1, 0.02, -0.01])


def motion():
    return motion_of(TWIST, MOTION_SIGMA**2 * np.eye(6))


def body(x, xi=None):
    """The body at the instant of the frame, by gtsam; the motion perturbed on the left of its rotation, in place."""
    dR, dp, xi = gtsam.Rot3.Expmap(TWIST[:3]), TWIST[3:], np.zeros(6) if xi is None else xi
    motion = gtsam.Pose3(gtsam.Rot3.Expmap(xi[:3]).compose(dR), dp + xi[3:])
    return gtsam.Pose3(gtsam.Rot3.RzRyRx(x[3:6]), x[:3]).compose(motion)


def numbers(rows):
    """Derivatives by the pose state (m, 6) and by the motion (m, 6)."""
    return (
        np.array([row.by_X + row.by_angles for row in rows]),
        np.array([row.by_theta + row.by_eps for row in rows]),
    )


def state(angles, *landmarks, room=3):
    n = 6 + 3 * len(landmarks)
    x, P = np.zeros(n + 3 * room), np.zeros((n + 3 * room, n + 3 * room))
    x[:3], x[3:6] = (1.0, -2.0, 3.0), angles
    if landmarks:
        x[6:n] = np.concatenate(landmarks)
    A = 0.02 * np.random.default_rng(3).normal(size=(n, n))
    P[:n, :n] = A @ A.T
    return x, P, n


def frame(x, P, n, slots, z, model=None, R=NOISE):
    m, (range_m, azimuth) = len(slots), np.array(z).T.copy()
    columns = np.array(slots), range_m, azimuth, np.array([R] * m)
    told = no_outcomes(m)
    n = observe_rows(x, P, n, motion(), model or sonar(), Frame(columns, 0, m, told, False))
    return n, *told


def difference(ahead, behind):
    change = (ahead - behind) / (2 * STEP)
    if len(change) == 2:
        change[1] = math.remainder(ahead[1] - behind[1], 2 * math.pi) / (2 * STEP)
    return change


@given(attitudes, views)
def test_jacobians_of_the_observation_are_the_numerical_ones(angles, view):
    x, _, _ = state(angles)
    p = locate(body(x).compose(MOUNTING), *view)
    z, *rows = observation(moment_after(x, motion()), vector(p), sonar())
    H_v, H_m = numbers(rows)

    def seen(pose_state, point, xi=None):
        return range_azimuth(body(pose_state, xi).compose(MOUNTING), point)

    assert_allclose(difference(z, seen(x, p)), 0.0, atol=1e-3)  # over 2e-6: 1e-9
    by_pose = [difference(seen(x[:6] + STEP * u, p), seen(x[:6] - STEP * u, p)) for u in np.eye(6)]
    by_motion = [difference(seen(x, p, STEP * u), seen(x, p, -STEP * u)) for u in np.eye(6)]
    by_point = [difference(seen(x, p + STEP * u), seen(x, p - STEP * u)) for u in np.eye(3)]
    assert_allclose(H_v, np.array(by_pose).T, atol=1e-5, rtol=1e-5)
    assert_allclose(H_m, np.array(by_motion).T, atol=1e-5, rtol=1e-5)
    assert_allclose(-H_v[:, :3], np.array(by_point).T, atol=1e-5, rtol=1e-5)


@given(attitudes, views)
def test_jacobians_of_the_augmentation_are_the_numerical_ones(angles, view):
    x, _, _ = state(angles)
    point, rows, G_z = location(moment_after(x, motion()), sonar(), view[:2], view[2])
    G_v, G_m = numbers(rows)

    def located(pose_state, values, xi=None):
        return locate(body(pose_state, xi).compose(MOUNTING), *values)

    values = np.array(view)
    assert_allclose(point, located(x, values), atol=1e-12)
    by_pose = [difference(located(x[:6] + STEP * u, values), located(x[:6] - STEP * u, values)) for u in np.eye(6)]
    by_motion = [difference(located(x, values, STEP * u), located(x, values, -STEP * u)) for u in np.eye(6)]
    by_view = [difference(located(x, values + STEP * u), located(x, values - STEP * u)) for u in np.eye(3)]
    assert_allclose(G_v, np.array(by_pose).T, atol=1e-5, rtol=1e-5)
    assert_allclose(G_m, np.array(by_motion).T, atol=1e-5, rtol=1e-5)
    assert_allclose(G_z, np.array(by_view).T, atol=1e-5, rtol=1e-5)


def test_the_covariance_of_a_motion_is_that_of_its_six_numbers():
    A = 0.01 * np.random.default_rng(7).normal(size=(6, 6))
    cov, turn = A @ A.T, np.kron(np.eye(2), gtsam.Rot3.Expmap(TWIST[:3]).matrix())
    moved = motion_of(TWIST, cov)
    _, *rows = observation(moment_after(state(np.array([0.1, 0.2, 0.3]))[0], moved), (2.0, 1.0, 0.5), sonar())
    _, H_m = numbers(rows)
    actual = [[motion_covariance(moved, one, other) for other in rows] for one in rows]
    assert_allclose(actual, H_m @ turn @ cov @ turn.T @ H_m.T, rtol=1e-12)


@pytest.mark.slow
def test_a_new_landmark_has_the_covariance_of_many_draws():
    rng = np.random.default_rng(5)
    x, P, n = state(np.array([0.1, 0.2, 0.3]))
    P *= 0.01
    before, root = x[:6].copy(), np.linalg.cholesky(P[:6, :6])
    aperture = 0.05
    n_after, outcomes, _, _ = frame(x, P, n, [0], [[2.0, 0.3]], sonar(aperture_rad=aperture))
    assert (n_after, outcomes.tolist()) == (9, [NEW])
    draws = np.empty((20_000, 9))
    for row in draws:
        row[:6] = before + root @ rng.normal(size=6)
        theta, rho = MOTION_SIGMA * rng.normal(size=(2, 3))
        pose = body(row[:6]).compose(gtsam.Pose3(gtsam.Rot3.Expmap(theta), rho)).compose(MOUNTING)
        z = rng.multivariate_normal([2.0, 0.3], NOISE)
        row[6:] = locate(pose, *z, rng.uniform(-0.5, 0.5) * aperture)
    spread, sigma = np.cov(draws.T), np.std(draws, axis=0)
    assert_allclose(x[6:9], draws[:, 6:].mean(axis=0), atol=2e-3)
    assert_allclose(P[:9, :9] / np.outer(sigma, sigma), spread / np.outer(sigma, sigma), atol=0.05)


def test_a_known_floor_fixes_the_height_of_a_new_landmark():
    angles = np.zeros(3)
    x, P, n = state(angles)
    true = locate(body(x).compose(MOUNTING), 2.0, 0.3, 0.05)
    frame(x, P, n, [0], [[2.0, 0.3]], sonar(has_floor=True, floor_z_m=true[2], floor_variance_m2=1e-6))
    assert_allclose(x[6:9], true, atol=1e-3)
    assert P[8, 8] == pytest.approx(1e-6, rel=0.01)


def seen_above_a_floor(height_m, range_m=3.0):
    """First sight of a landmark by a body that is sure of all but its height, sigma 0.2 m; x, P, and x before."""
    x, P, n = state(np.zeros(3))
    P[:] = 0.0
    P[:6, :6] = np.diag([1e-3, 1e-3, 0.2, 1e-3, 1e-3, 1e-3]) ** 2
    before = x.copy()
    model = sonar(has_floor=True, floor_z_m=x[2] - height_m)
    n, outcomes, _, _ = frame(x, P, n, [0], [[range_m, 0.3]], model)
    assert (n, outcomes.tolist()) == (9, [NEW])
    return x, P, before


def test_a_false_detection_far_above_the_floor_does_not_move_the_vehicle():
    x, P, before = seen_above_a_floor(5.0)
    middle = locate(body(before).compose(MOUNTING), 3.0, 0.3, 0.0)
    assert_array_equal(x[:6], before[:6])
    assert P[2, 2] == pytest.approx(0.04)
    assert_allclose(x[6:9], middle, atol=1e-12)


def test_a_detection_on_the_floor_tells_the_vehicle_its_height():
    x, P, _ = seen_above_a_floor(1.6)
    assert x[8] == pytest.approx(3.0 - 1.6, abs=0.01)
    assert P[2, 2] < 0.9 * 0.04


FLOOR_SIGMA_M = 0.01


def on_floor_beside_the_aperture(variances):
    """First sight with the floor this many (signed root) variances off the aperture's centre: x, P, height there, S."""
    bare, bare_P, n = state(np.array([0.1, 0.2, 0.3]))
    frame(bare, bare_P, n, [0], [[2.0, 0.3]])
    S = bare_P[8, 8] + FLOOR_SIGMA_M**2
    floor_z_m = bare[8] + math.copysign(math.sqrt(abs(variances) * S), variances)
    x, P, n = state(np.array([0.1, 0.2, 0.3]))
    world_T_sonar = body(x).compose(MOUNTING)
    model = sonar(has_floor=True, floor_z_m=floor_z_m, floor_variance_m2=FLOOR_SIGMA_M**2)
    assert elevation_on_floor(world_T_sonar, 2.0, 0.3, floor_z_m, model.aperture_rad) is None
    frame(x, P, n, [0], [[2.0, 0.3]], model)
    return x, P, bare, bare_P, floor_z_m


@pytest.mark.parametrize("side", [-1, 1])
def test_a_floor_just_outside_the_aperture_still_fixes_the_height(side):
    """Up to the gate; the innovation's variance has the aperture's share, the pose's and the floor's."""
    for variances in (0.5 * FLOOR_GATE, 0.999 * FLOOR_GATE):
        x, P, bare, bare_P, floor_z_m = on_floor_beside_the_aperture(side * variances)
        share = bare_P[:9, 8] / (bare_P[8, 8] + FLOOR_SIGMA_M**2)
        assert_allclose(x[:9], bare[:9] + share * (floor_z_m - bare[8]), atol=1e-12)
        assert P[8, 8] == pytest.approx(share[8] * FLOOR_SIGMA_M**2)


@pytest.mark.parametrize("side", [-1, 1])
def test_a_floor_beyond_its_gate_changes_nothing(side):
    x, P, bare, bare_P, _ = on_floor_beside_the_aperture(side * 1.001 * FLOOR_GATE)
    assert_array_equal(x, bare)
    assert_array_equal(P, bare_P)


def test_the_floor_s_gate_is_passed_by_999_of_1000_that_stand_on_it():
    assert pytest.approx(gate_threshold(0.999, 1), abs=5e-3) == FLOOR_GATE


def test_without_a_floor_a_new_landmark_is_in_the_middle_of_the_aperture():
    x, P, n = state(np.zeros(3))
    middle = locate(body(x).compose(MOUNTING), 2.0, 0.3, 0.0)
    frame(x, P, n, [0], [[2.0, 0.3]])
    assert_allclose(x[6:9], middle, atol=1e-12)


def test_a_gated_detection_leaves_the_state_untouched():
    x, P, n = state(np.zeros(3))
    p = locate(body(x).compose(MOUNTING), 2.0, 0.3, 0.05)
    x, P, n = state(np.zeros(3), p)
    before = x.copy(), P.copy()
    n_after, outcomes, innovations, covs = frame(x, P, n, [0], [[3.0, 0.3]])
    assert (n_after, outcomes.tolist()) == (n, [GATED])
    assert innovations[0, 0] == pytest.approx(1.0)
    assert np.linalg.eigvalsh(covs[0]).min() > 0
    assert_array_equal(x, before[0])
    assert_array_equal(P, before[1])


def test_the_innovation_of_azimuth_wraps_around():
    x, P, n = state(np.zeros(3))
    behind = locate(body(x).compose(MOUNTING), 2.0, math.pi - 0.004, 0.0)
    x, P, n = state(np.zeros(3), behind)
    _, outcomes, innovations, _ = frame(x, P, n, [0], [[2.0, -math.pi + 0.004]])
    assert outcomes.tolist() == [USED]
    assert innovations[0, 1] == pytest.approx(0.008)


def test_a_correction_is_the_textbook_s():
    x, P, n = state(np.array([0.1, -0.2, 0.5]))
    p = locate(body(x).compose(MOUNTING), 2.0, 0.3, 0.05)
    x, P, n = state(np.array([0.1, -0.2, 0.5]), p)
    moment = moment_after(x, motion())
    z, *rows = observation(moment, vector(p), sonar())
    H_v, H_m = numbers(rows)
    R = np.array([[4e-4, 1e-4], [1e-4, 1e-4]])
    H = np.hstack([H_v, -H_v[:, :3]])
    S = H @ P[:n, :n] @ H.T + R + MOTION_SIGMA**2 * H_m @ H_m.T
    K = P[:n, :n] @ H.T @ np.linalg.inv(S)
    e = np.array([0.01, -0.005])
    expected = x[:n] + K @ e, (np.eye(n) - K @ H) @ P[:n, :n]
    _, _, innovations, covs = frame(x, P, n, [0], [z + e], R=R)
    assert_allclose(innovations[0], e, atol=1e-12)
    assert_allclose(covs[0], S, rtol=1e-9)
    assert_allclose(x[:n], expected[0], atol=1e-12)
    assert_allclose(P[:n, :n], expected[1], atol=1e-12)


def test_the_rows_of_a_frame_are_taken_in_their_order():
    x, P, n = state(np.zeros(3))
    n, outcomes, _, _ = frame(x, P, n, [0, 0, 1], [[2.0, 0.3], [2.001, 0.301], [2.5, -0.3]])
    assert n == 12
    assert outcomes.tolist() == [NEW, USED, NEW]


@pytest.mark.parametrize("hole", [(0, 0), (1, 1), (0, 1)])
def test_noise_that_the_log_does_not_give_is_the_calibration_s(hole):
    logged = NOISE.copy()
    logged[hole] = math.nan
    given, missing = state(np.zeros(3)), state(np.zeros(3))
    frame(*given, [0], [[2.0, 0.3]])
    frame(*missing, [0], [[2.0, 0.3]], R=logged)
    assert_array_equal(given[1], missing[1])


def test_a_row_without_a_place_is_passed_over():
    x, P, n = state(np.zeros(3))
    n_after, outcomes, innovations, _ = frame(x, P, n, [NO_SLOT, 0], [[2.0, 0.3], [2.0, 0.3]])
    assert n_after == n + 3
    assert outcomes.tolist() == [PASSED_OVER, NEW]
    assert np.isnan(innovations).all()
