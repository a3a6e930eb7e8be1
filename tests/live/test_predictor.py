"""Predictions between estimates are dead reckoning, and their messages contain the same numbers."""

import gtsam
import mcap_ros2._dynamic as ros2
import numpy as np
import pytest

from sonar_graph import Odometry, load_estimator
from sonar_graph.live import Predictor
from sonar_graph.live.outlets import ODOMETRY, TF, PoseForms
from sonar_graph.logs.adapters import body_to_ros
from sonar_graph.logs.cdr import definition
from sonar_graph.states import Estimate
from sonar_graph.testing import small_world

EARTH_RAD = 7.3e-5
"""Turn of the Earth in the second between two estimates, which the estimator removes and a prediction does not."""


def predicted():
    """Estimates of dead reckoning at epochs, where they are final, and predictions from the estimates before."""
    world = small_world()
    estimator = load_estimator("dead-reckoning")(
        world.calibration, Odometry(world.calibration)
    )
    predictor = Predictor(world.calibration)
    pairs = []
    for step in world.replay(world.instants(1.0)):
        predictor.add(step.imu, step.dvl)
        estimate = estimator.process(step)
        if estimate is not None:
            pairs.append((estimate, predictor.predict()))
            predictor.correct(estimate)
    return pairs[1:]


def test_a_prediction_is_the_next_estimate_of_dead_reckoning():
    pairs = predicted()
    assert len(pairs) > 15
    for estimate, prediction in pairs:
        assert prediction.stamp_ns == estimate.stamp_ns
        expected = estimate.world_T_body.matrix()
        found = prediction.world_T_body
        np.testing.assert_allclose(found, expected, atol=1.1 * EARTH_RAD)


def test_a_vehicle_that_is_lost_has_no_pose_until_the_next_estimate():
    world = small_world()
    predictor = Predictor(world.calibration)
    first, second, third, *_ = world.replay(world.instants(10.0))
    for step in (first, second, third):
        predictor.add(step.imu, step.dvl)
    for step in (first, second):
        predictor.correct(Estimate(step.end_ns, gtsam.Pose3(), np.eye(6)))
        assert predictor.predict().stamp_ns == third.end_ns
        predictor.lose()
        assert predictor.predict() is None


def test_frames_differ_by_the_newest_correction():
    """``world_T_body = map_T_odom odom_T_body``, also after an estimate that jumps; odom moves on smoothly."""
    world = small_world()
    predictor = Predictor(world.calibration)
    jump = gtsam.Pose3(gtsam.Rot3.Yaw(0.3), np.array([5.0, 0.0, 0.0]))
    poses = {20: gtsam.Pose3(), 60: jump}
    places = []
    for k, step in enumerate(world.replay(world.instants(10.0))):
        predictor.add(step.imu, step.dvl)
        if k in poses:
            predictor.correct(Estimate(step.end_ns, poses[k], np.eye(6)))
            now = predictor.predict().world_T_body
            np.testing.assert_allclose(now, poses[k].matrix(), atol=1e-12)
        if (now := predictor.predict()) is not None:
            world_T_body = predictor.map_T_odom @ now.odom_T_body
            np.testing.assert_allclose(now.world_T_body, world_T_body, atol=1e-12)
            places.append(now.odom_T_body[:3, 3])
    assert len(places) > 100
    assert np.linalg.norm(np.diff(places, axis=0), axis=1).max() < 0.5


@pytest.mark.parametrize(
    "turn", [(0.1, -0.2, 0.3), (3.1, 0.0, 0.0), (0.0, 3.1, 0.1), (0.2, 0.0, -3.1)]
)
def test_messages_say_the_numbers_of_a_prediction(turn):
    factor = np.random.default_rng(0).normal(size=(6, 6))
    pose = gtsam.Pose3(gtsam.Rot3.Rodrigues(*turn), np.array([1.0, -2.0, 3.0]))
    _, at = predicted()[5]
    matrix = np.ascontiguousarray(pose.matrix())
    changes = {"world_T_body": matrix, "odom_T_body": matrix}
    at = at._replace(covariance=factor @ factor.T, **changes)
    forms = PoseForms()
    message = read(ODOMETRY, forms.odometry(at))
    stamp = message.header.stamp
    assert stamp.sec * 10**9 + stamp.nanosec == at.stamp_ns
    assert (message.header.frame_id, message.child_frame_id) == ("map", "base_link")
    found = message.pose.pose
    assert same_pose(found.position, found.orientation, pose)
    (world_axes,) = body_to_ros(at.covariance[None], matrix[None, :3, :3])
    covariance = np.reshape(message.pose.covariance, (6, 6))
    np.testing.assert_allclose(covariance, world_axes, atol=1e-12)
    velocity = message.twist.twist.linear
    assert np.array_equal([velocity.x, velocity.y, velocity.z], at.velocity_m_s)
    (frame,) = read(TF, forms.body(at)).transforms
    assert same_pose(frame.transform.translation, frame.transform.rotation, pose)


def read(kind, payload):
    short = kind.replace("/msg/", "/")
    return ros2.generate_dynamic(kind, definition(kind))[short](payload)


def same_pose(p, q, pose):
    turn = gtsam.Rot3.Quaternion(q.w, q.x, q.y, q.z)
    found = gtsam.Pose3(turn, np.array([p.x, p.y, p.z]))
    size = np.linalg.norm([q.w, q.x, q.y, q.z])
    return found.equals(pose, 1e-12) and abs(size - 1.0) < 1e-12
