import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, X
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import (
    Calibration,
    DepthCalibration,
    DvlCalibration,
    ImuCalibration,
    Mounting,
    PlanarMotion,
    Start,
)
from sonar_graph.measurements import Depth, Dvl, Imu
from sonar_graph.navigation.earth import earth_rate_in_world
from sonar_graph.slam.keyframes import KeyframePolicy, Keyframes
from sonar_graph.slam.smoother import Smoother

NS = 1_000_000_000
T0_NS = 1_500_000_000 * NS
G = 9.80665
NO_BIAS = ImuCalibration(gyro_bias_sigma=0.0)
POLICY = KeyframePolicy(min_interval_s=0.5, max_interval_s=2.0, bias_interval_s=10.0)


def seconds(keyframes: Keyframes) -> list[float]:
    return [(stamp - T0_NS) / NS for stamp in keyframes.stamps_ns]


def at(*offsets_s: float) -> np.ndarray:
    return T0_NS + np.round(np.array(offsets_s) * NS).astype(np.int64)


def level_imu(until_s: float, rate=(0.0, 0.0, 0.0), hz: float = 20) -> Imu:
    stamps = at(*(np.arange(round(until_s * hz) + 1) / hz))
    return Imu(stamps, np.tile(rate, (len(stamps), 1)), np.tile([0.0, 0.0, G], (len(stamps), 1)))


def steady_dvl(until_s: float, velocity=(0.5, 0.0, 0.0), hz: float = 5) -> Dvl:
    stamps = at(*(np.arange(round(until_s * hz) + 1) / hz))
    return Dvl(stamps, np.tile(velocity, (len(stamps), 1)), np.full((len(stamps), 3, 3), np.nan))


def keyframes_of(calibration: Calibration, policy: KeyframePolicy = POLICY) -> Keyframes:
    return Keyframes(calibration, policy, Smoother(1e9, 0.01, 1e9))


def driven(calibration: Calibration, until_s: float, depth: Depth | None = None, **motion) -> Keyframes:
    keyframes = keyframes_of(calibration)
    keyframes.add(
        level_imu(until_s, motion.get("rate", (0, 0, 0))),
        steady_dvl(until_s, motion.get("velocity", (0.5, 0, 0))),
        depth,
    )
    keyframes.advance(int(at(until_s)[0]))
    return keyframes


def factors_on(keyframes: Keyframes, kind: type, key: int) -> list[gtsam.NonlinearFactor]:
    graph = keyframes.smoother.graph
    every = [graph.at(k) for k in range(graph.size())]
    return [f for f in every if isinstance(f, kind) and list(f.keys()) == [key]]


def test_one_is_set_at_the_first_node_after_the_longest_interval():
    keyframes = driven(Calibration(imu=NO_BIAS), 5.0)
    assert seconds(keyframes) == [0.0, 2.0, 4.0]
    assert keyframes.newest_key == X(2)
    assert keyframes.newest_s == pytest.approx(T0_NS * 1e-9 + 4.0)


def test_nodes_off_the_interval_are_waited_for():
    keyframes = keyframes_of(Calibration(imu=NO_BIAS), KeyframePolicy(0.5, 1.9, 10.0))
    keyframes.add(level_imu(4.5), steady_dvl(4.5, hz=3), None)
    keyframes.advance(int(at(4.5)[0]))
    assert seconds(keyframes) == pytest.approx([0.0, 2.0, 4.0], abs=1e-8)


def test_there_is_none_before_imu_covers_a_doppler_stamp():
    keyframes = keyframes_of(Calibration())
    keyframes.add(level_imu(1.0), None, None)
    keyframes.advance(int(at(1.0)[0]))
    assert keyframes.newest_ns is None
    keyframes.add(None, Dvl(at(1.02), np.zeros((1, 3)), np.full((1, 3, 3), np.nan)), None)
    keyframes.advance(int(at(1.04)[0]))
    assert keyframes.newest_ns is None
    assert keyframes.smoother.graph.size() == 0
    keyframes.add(Imu(at(1.05), np.zeros((1, 3)), np.full((1, 3), np.nan)), None, None)
    keyframes.advance(int(at(1.03)[0]))
    assert seconds(keyframes) == pytest.approx([1.02])


def test_frames_bring_one_at_the_newest_reached_node_when_the_last_is_old_enough():
    keyframes = driven(Calibration(imu=NO_BIAS), 1.0)
    keyframes.set_for_frame(int(at(0.45)[0]))
    assert seconds(keyframes) == [0.0]
    keyframes.set_for_frame(int(at(0.79)[0]))
    assert seconds(keyframes) == [0.0, 0.6]
    keyframes.set_for_frame(int(at(1.0)[0]))
    assert seconds(keyframes) == [0.0, 0.6]


def test_first_estimates_follow_the_odometry():
    """A turn of 0.1 rad/s at 0.5 m/s: an arc of 5 m radius from the start pose."""
    start = Start(position_m=(1.0, 2.0, -0.5), rpy_rad=(0.0, 0.0, 0.7))
    keyframes = driven(Calibration(imu=NO_BIAS, start=start), 4.0, rate=(0, 0, 0.1))
    arc = np.array([5 * np.sin(0.4), 5 * (1 - np.cos(0.4)), 0.0])
    pose = keyframes.smoother.values.atPose3(X(2))
    assert pose.translation() == pytest.approx(np.add([1, 2, -0.5], Rotation.from_euler("z", 0.7).apply(arc)), abs=1e-9)
    assert pose.rotation().yaw() == pytest.approx(1.1)


def test_every_keyframe_has_its_odometry_and_gravity():
    calibration = Calibration(imu=NO_BIAS)
    keyframes = driven(calibration, 6.0)
    graph = keyframes.smoother.graph
    assert graph.size() == 1 + 3 * 2
    for k in range(1, 4):
        assert len(factors_on(keyframes, gtsam.AttitudeFactorPose3, X(k))) == 1
    assert [list(graph.at(k).keys()) for k in (1, 3, 5)] == [[X(0), X(1)], [X(1), X(2)], [X(2), X(3)]]
    without = driven(calibration.model_copy(update={"use_gravity": False}), 6.0)
    assert without.smoother.graph.size() == 1 + 3


def test_unmeasured_forces_bring_no_gravity():
    keyframes, imu = keyframes_of(Calibration(imu=NO_BIAS)), level_imu(4.0)
    keyframes.add(Imu(imu.stamps_ns, imu.angular_velocity, imu.specific_force * np.nan), steady_dvl(4.0), None)
    keyframes.advance(int(at(4.0)[0]))
    assert keyframes.smoother.graph.size() == 1 + 2


def test_gravity_tells_the_tilt_of_a_tilted_vehicle():
    tilt = Rotation.from_euler("xyz", [0.1, -0.2, 0.5])
    start = Start(rpy_rad=(0.1, -0.2, 0.5))
    keyframes, imu = keyframes_of(Calibration(imu=NO_BIAS, start=start)), level_imu(2.0)
    force = np.tile(tilt.inv().apply([0, 0, G]), (len(imu), 1))
    keyframes.add(Imu(imu.stamps_ns, imu.angular_velocity, force), steady_dvl(2.0), None)
    keyframes.advance(int(at(2.0)[0]))
    (factor,) = factors_on(keyframes, gtsam.AttitudeFactorPose3, X(1))
    assert np.abs(factor.unwhitenedError(keyframes.smoother.values)).max() < 1e-9


def test_velocity_is_taken_to_the_imu_before_gravity_is():
    """A vehicle that begins to turn accelerates an IMU off its centre: without the lever arm up would seem to lean."""
    arm, alpha, T = 2.0, 0.05, 2.0
    calibration = Calibration(imu=NO_BIAS.model_copy(update={"mounting": Mounting(translation_m=(arm, 0, 0))}))
    stamps = at(*(np.arange(41) / 20))
    t = (stamps - T0_NS) / NS
    rate = np.outer(alpha * t, [0, 0, 1.0])
    force = np.column_stack([-((alpha * t) ** 2) * arm, np.full(41, alpha * arm), np.full(41, G)])
    keyframes = keyframes_of(calibration)
    keyframes.add(Imu(stamps, rate, force), steady_dvl(T, (0, 0, 0)), None)
    keyframes.advance(int(at(T)[0]))
    (factor,) = factors_on(keyframes, gtsam.AttitudeFactorPose3, X(1))
    assert np.abs(factor.unwhitenedError(keyframes.smoother.values)).max() < 2e-5
    assert alpha * arm / G > 1e-2


def test_depths_since_the_last_keyframe_become_one_factor_at_their_weighted_mean():
    """The vehicle sinks at 0.1 m/s; samples on the way are carried to the keyframe by its own motion."""
    port, variance = (0.3, 0.0, 0.2), np.array([1e-4, 4e-4, np.nan])
    calibration = Calibration(imu=NO_BIAS, depth=DepthCalibration(sigma_m=0.03, port_m=port))
    when = np.array([0.5, 1.1, 1.9])
    depth = Depth(at(*when), -0.1 * when + port[2] + 0.01, variance)
    keyframes = driven(calibration, 2.0, depth, velocity=(0.0, 0.0, -0.1))
    (factor,) = factors_on(keyframes, gtsam.GPSFactorArm, X(1))
    sigma = (1 / 1e-4 + 1 / 4e-4 + 1 / 9e-4) ** -0.5
    assert keyframes.smoother.values.atPose3(X(1)).translation()[2] == pytest.approx(-0.2)
    assert factor.unwhitenedError(keyframes.smoother.values)[2] == pytest.approx(-0.01, abs=1e-9)
    assert factor.noiseModel().sigmas()[2] == pytest.approx(sigma)


def test_depths_are_weighed_by_their_variances():
    depth = Depth(at(0.5, 1.5), np.array([1.0, 2.0]), np.array([1.0, 3.0]))
    keyframes = driven(Calibration(imu=NO_BIAS), 2.0, depth)
    (factor,) = factors_on(keyframes, gtsam.GPSFactorArm, X(1))
    assert factor.unwhitenedError(keyframes.smoother.values)[2] == pytest.approx(-1.25)


def test_each_depth_is_used_once_at_the_next_keyframe():
    when = np.arange(1, 60) / 10
    keyframes = driven(Calibration(imu=NO_BIAS), 6.0, Depth(at(*when), np.zeros(59), np.full(59, 1e-4)))
    sigmas = [factors_on(keyframes, gtsam.GPSFactorArm, X(k))[0].noiseModel().sigmas()[2] for k in (1, 2, 3)]
    assert [1e-4 / sigma**2 for sigma in sigmas] == pytest.approx([20, 20, 19])


def test_the_plane_holds_every_keyframe_from_the_first():
    keyframes = driven(Calibration(imu=NO_BIAS, planar=PlanarMotion(), use_gravity=False), 4.0)
    for k in range(3):
        assert len(factors_on(keyframes, gtsam.GPSFactorArm, X(k))) == 1
        assert len(factors_on(keyframes, gtsam.AttitudeFactorPose3, X(k))) == 1


def test_the_bias_walks_between_stretches():
    """A new one after ten seconds, tied to the old by the walk in between; odometry uses that of its start."""
    imu = ImuCalibration(gyro_bias_sigma=1e-3, gyro_bias_walk_density=1e-4)
    keyframes = driven(Calibration(imu=imu, use_gravity=False), 24.0)
    graph = keyframes.smoother.graph
    every = [graph.at(k) for k in range(graph.size())]
    walks = [f for f in every if isinstance(f, gtsam.BetweenFactorPoint3)]
    assert [list(f.keys()) for f in walks] == [[B(0), B(1)], [B(1), B(2)]]
    assert walks[0].noiseModel().sigmas() == pytest.approx([1e-4 * np.sqrt(10)] * 3)
    odometry = [list(f.keys()) for f in every if f.size() == 3]
    assert odometry == [[X(k), X(k + 1), B(k // 5)] for k in range(12)]
    assert [keyframes.bias_key(k) for k in (0, 4, 5, 12)] == [B(0), B(0), B(1), B(2)]
    assert len(factors_on(keyframes, gtsam.PriorFactorPoint3, B(0))) == 1


@pytest.mark.parametrize("imu", [NO_BIAS, ImuCalibration(gyro_bias_walk_density=0.0)], ids=["none", "constant"])
def test_a_bias_that_does_not_walk_stays_one(imu):
    keyframes = driven(Calibration(imu=imu, use_gravity=False), 24.0)
    keys = {keyframes.bias_key(k) for k in range(13)}
    assert keys == ({None} if imu.gyro_bias_sigma == 0 else {B(0)})
    assert keyframes.smoother.graph.size() == 1 + 12 + (imu.gyro_bias_sigma > 0)


def test_the_known_bias_is_taken_out_of_the_motion():
    keyframes = driven(Calibration(), 2.0, rate=(0, 0, 0.02))
    still = gtsam.Values()
    still.insert(B(0), np.array([0.0, 0.0, 0.02]))
    keyframes.smoother.values.update(still)
    motion = keyframes.motion_since_newest(int(at(2.0)[0]) + NS)
    assert motion.i_T_j.rotation().yaw() == pytest.approx(0.0, abs=1e-12)
    assert motion.bias == pytest.approx([0, 0, 0.02])


def test_a_vehicle_that_turns_with_the_earth_stays_where_it_heads():
    """Its gyros feel 15 degrees an hour about the Earth's axis, in a body that heads south and leans."""
    start = Start(rpy_rad=(0.2, -0.1, -1.6))
    calibration = Calibration(imu=NO_BIAS, start=start, earth_rate_latitude_rad=0.63, use_gravity=False)
    felt = start.pose().rotation().matrix().T @ earth_rate_in_world(calibration)
    kept = driven(calibration, 60.0, rate=felt, velocity=(0, 0, 0)).smoother.values.atPose3(X(30))
    assert start.pose().between(kept).equals(gtsam.Pose3(), 1e-7)
    unaware = calibration.model_copy(update={"earth_rate_latitude_rad": None})
    drifted = driven(unaware, 60.0, rate=felt, velocity=(0, 0, 0)).smoother.values.atPose3(X(30))
    assert np.linalg.norm(gtsam.Rot3.Logmap(start.pose().rotation().between(drifted.rotation()))) == pytest.approx(
        60 * 7.292115e-5, rel=1e-3
    )


def test_a_lever_arm_is_known_to_the_keyframes():
    """Turning about the Doppler log 1 m ahead: the body goes round it, on the spot the log reads nothing."""
    dvl = DvlCalibration(mounting=Mounting(translation_m=(1.0, 0.0, 0.0)))
    keyframes = driven(Calibration(imu=NO_BIAS, dvl=dvl), 4.0, rate=(0, 0, 0.3), velocity=(0, 0, 0))
    expected = [1 - np.cos(1.2), -np.sin(1.2), 0.0]
    assert keyframes.smoother.values.atPose3(X(2)).translation() == pytest.approx(expected, abs=1e-9)
