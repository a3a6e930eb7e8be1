"""Keyframes and the factors that they get from odometry, depth and gravity, on drives made by hand."""

from dataclasses import replace
from itertools import pairwise

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, X
from hypothesis import given
from hypothesis import strategies as st

from sonar_graph.calibration import (
    Calibration,
    DepthCalibration,
    DvlCalibration,
    ImuCalibration,
    PlanarMotion,
    Start,
)
from sonar_graph.measurements import Depth, Dvl, Heading, Imu
from sonar_graph.navigation import Odometry
from sonar_graph.slam import KeyframeParams
from sonar_graph.slam.keyframes import Keyframes, average_at_end
from tests.navigation.rows import NS, T0_NS, dvl, imu, stamps

from .graphs import factors_of
from .made import smoother_with

G = 9.80665
NO_BIAS = ImuCalibration(gyro_bias_sigma=0.0, accel_bias_sigma=0.0)
EXACT_DVL = DvlCalibration(velocity_sigma_m_s=(1e-7, 1e-7, 1e-7))
POLICY = KeyframeParams(
    max_interval_s=2.0, motion_noise_share=1e9, bias_interval_s=10.0
)


def seconds(keyframes: Keyframes) -> list[float]:
    return [(stamp - T0_NS) / NS for stamp in keyframes.stamps_ns]


def at(*offsets_s: float) -> np.ndarray:
    return T0_NS + np.round(np.array(offsets_s) * NS).astype(np.int64)


def level_imu(until_s: float, rate=(0.0, 0.0, 0.0)) -> Imu:
    return imu(stamps(20, until_s), rate)


def steady_dvl(until_s: float, velocity=(0.5, 0.0, 0.0)) -> Dvl:
    return dvl(stamps(5, until_s), velocity)


def keyframes_of(
    calibration: Calibration, policy: KeyframeParams = POLICY
) -> Keyframes:
    return Keyframes(
        calibration, Odometry(calibration), policy, smoother_with(1e9, 0.01, 1e9)
    )


def driven(
    calibration: Calibration,
    until_s: float,
    depth: Depth | None = None,
    *,
    rate=(0.0, 0.0, 0.0),
    velocity=(0.5, 0.0, 0.0),
    felt: Imu | None = None,
) -> Keyframes:
    keyframes = keyframes_of(calibration)
    keyframes.add(
        felt or level_imu(until_s, rate), steady_dvl(until_s, velocity), depth
    )
    keyframes.advance(int(at(until_s)[0]))
    return keyframes


def factors_on(
    keyframes: Keyframes, kind: type, key: int
) -> list[gtsam.NonlinearFactor]:
    return [
        f
        for f in factors_of(keyframes.smoother.graph)
        if isinstance(f, kind) and list(f.keys()) == [key]
    ]


def factor_of(keyframes: Keyframes, kind: type) -> gtsam.NonlinearFactor:
    """The only factor of a kind on the second keyframe."""
    (factor,) = factors_on(keyframes, kind, X(1))
    return factor


def test_every_keyframe_has_its_odometry_gravity_and_plane():
    keyframes = driven(Calibration(imu=NO_BIAS), 6.0)
    graph = keyframes.smoother.graph
    assert graph.size() == 2 + 3 * 2
    assert [
        len(factors_on(keyframes, gtsam.MagPoseFactorPose3, X(k))) for k in range(4)
    ] == [0, 1, 1, 1]
    assert [list(graph.at(k).keys()) for k in (2, 4, 6)] == [
        [X(0), X(1)],
        [X(1), X(2)],
        [X(2), X(3)],
    ]
    without = Calibration(imu=NO_BIAS, use_gravity=False)
    assert driven(without, 6.0).smoother.graph.size() == 2 + 3
    keyframes = driven(without.model_copy(update={"planar": PlanarMotion()}), 6.0)
    for kind in (gtsam.MagPoseFactorPose3, gtsam.GPSFactorArm):
        assert [len(factors_on(keyframes, kind, X(k))) for k in range(4)] == [
            1,
            1,
            1,
            1,
        ]


def test_gravity_has_the_velocity_noise_of_both_ends():
    """Beside what the IMU adds: the change of a velocity with these sigmas at its ends, over 2 s and g."""
    ends = np.array([(0.1, 0.1), (0.2, 0.2), (0.1, 0.2), (0.2, 0.1)])
    variances = []
    for first, others in ends:
        keyframes = keyframes_of(Calibration(imu=NO_BIAS))
        rows = steady_dvl(2.0)
        sigmas = np.where(np.arange(len(rows)) == 0, first, others)
        rows = replace(rows, velocity_cov=sigmas[:, None, None] ** 2 * np.eye(3))
        keyframes.add(level_imu(2.0), rows, None)
        keyframes.advance(int(at(2.0)[0]))
        variances.append(
            factor_of(keyframes, gtsam.MagPoseFactorPose3).noiseModel().sigma() ** 2
        )
    assert np.diff(variances) == pytest.approx(
        np.diff((ends**2).sum(axis=1)) / (2.0 * G) ** 2, rel=1e-3, abs=1e-9
    )


def test_depths_of_a_turning_vehicle_are_carried_by_its_motion():
    """Mean port and sigma as from the exact path of a constant twist; the log's axes differ in noise."""
    rate = np.array([0.3, 0.1, -0.2])
    velocity = np.array([0.5, 0.2, -0.1])
    port = np.array([0.4, -0.3, 0.2])
    sigmas = np.array([0.002, 0.06, 0.004])
    calibration = Calibration(
        imu=ImuCalibration(gyro_noise_density=1e-9, gyro_bias_sigma=1e-9),
        dvl=DvlCalibration(velocity_sigma_m_s=tuple(sigmas)),
        depth=DepthCalibration(sigma_m=0.05, port_m=tuple(port)),
        start=Start(rpy_rad=(0.3, -0.2, 0.5)),
        use_gravity=False,
    )
    when = np.arange(0.15, 2.0, 0.25)
    depth = Depth(at(*when), when, np.full(len(when), np.nan))
    keyframes = driven(calibration, 2.0, depth, rate=rate, velocity=velocity)
    factor = factor_of(keyframes, gtsam.GPSFactorArm)

    def pose_at(t: float) -> gtsam.Pose3:
        twist = np.r_[rate, velocity]
        return calibration.start.pose().compose(gtsam.Pose3.Expmap(twist * t))

    q = []  # variance of the way from each sample to the next, along the vertical
    for begin, end in pairwise([*when, 2.0]):
        ups = [pose_at(t).rotation().matrix()[2] for t in np.linspace(begin, end, 9)]
        q.append(np.mean(np.square(ups) @ sigmas**2) * 0.2 * (end - begin))
    weights, variance = average_at_end(np.full(len(when), 0.05**2), np.array(q))
    end = pose_at(2.0)
    ports = [end.transformTo(pose_at(t).transformFrom(port)) for t in when]
    values = gtsam.Values()
    for pose in (gtsam.Pose3(), gtsam.Pose3(gtsam.Rot3.Roll(1.2), np.zeros(3))):
        values.insert_or_assign(X(1), pose)
        expected = pose.transformFrom(weights @ ports)[2] - weights @ when
        assert factor.unwhitenedError(values)[2] == pytest.approx(expected, abs=2e-4)
    assert factor.noiseModel().sigmas()[2] == pytest.approx(variance**0.5, rel=0.03)


def test_the_bias_walks_between_stretches():
    """A new one after ten seconds, tied to the old by the walk in between; odometry uses that of its start."""
    imu = ImuCalibration(gyro_bias_sigma=1e-3, gyro_bias_walk_density=1e-4)
    keyframes = driven(Calibration(imu=imu, use_gravity=False), 24.0)
    every = factors_of(keyframes.smoother.graph)
    walks = [f for f in every if isinstance(f, gtsam.BetweenFactorVector)]
    assert [list(f.keys()) for f in walks] == [[B(0), B(1)], [B(1), B(2)]]
    assert walks[0].noiseModel().sigmas() == pytest.approx(
        [
            *[1e-4 * np.sqrt(10)] * 3,
            *[0.0] * 3,
            *[2e-4 * np.sqrt(10)] * 3,
            1e-3 * 0.05,
            0.0,
        ],
        abs=1e-11,
    )
    odometry = [list(f.keys()) for f in every if f.size() == 3]
    assert odometry == [[X(k), X(k + 1), B(k // 5)] for k in range(12)]
    assert [keyframes.bias_keys[k] for k in (0, 4, 5, 12)] == [B(0), B(0), B(1), B(2)]
    assert len(factors_on(keyframes, gtsam.PriorFactorVector, B(0))) == 1


GAPS_S = ((2.0, 6.0), (7.0, 10.0))


def keyframes_over_gaps(max_interval_s: float = 1e3) -> Keyframes:
    """Straight on at 0.5 m/s for twelve seconds, without bottom lock twice."""
    dvl = DvlCalibration(velocity_sigma_m_s=(0.01, 0.01, 0.01), gap_s=0.3)
    never = KeyframeParams(
        max_interval_s=max_interval_s, motion_noise_share=1e9, bias_interval_s=10.0
    )
    keyframes = keyframes_of(Calibration(imu=NO_BIAS, dvl=dvl), never)
    velocity = steady_dvl(12.0)
    s = (velocity.stamps_ns - T0_NS) / NS
    is_lost = np.any(
        [(s > lost_s) & (s < found_s) for lost_s, found_s in GAPS_S], axis=0
    )
    keyframes.add(level_imu(12.0), velocity.rows(~is_lost), None)
    return keyframes


def shares(keyframes: Keyframes, at_s: list[float]) -> list[float]:
    """The used share of the information of each motion to a frame."""
    found = []
    for stamp_ns in at(*at_s).tolist():
        keyframes.advance(stamp_ns)
        motion = keyframes.motion_since_newest(stamp_ns)
        told = keyframes.set_for_frame(stamp_ns, motion)
        ratio = np.diag(told.covariance) / np.diag(motion.covariance)
        assert ratio == pytest.approx(ratio[0])
        assert told.i_T_j.equals(motion.i_T_j, 0.0)
        found.append(1.0 / ratio[0])
    return found


@pytest.mark.parametrize(
    ("at_s", "told"),
    [
        (
            [1.0, 2.2, 3.0, 4.0, 6.3, 6.7, 8.0, 9.0, 9.5, 11.0],
            [1, 1, 1 / 2, 1 / 6, 1, 1, 1 / 2, 1 / 6, 1 / 12, 1],
        ),
        ([4.0, 6.4], [1 / 2, 1]),
    ],
    ids=["each gap anew", "a gap that has ended before a frame"],
)
def test_frames_between_gaps_tell_all(at_s, told):
    """With bottom lock, or only so long after it that velocity still counts as linear, frames share no such error.

    The end of a gap is a node, even where that is no keyframe.
    """
    keyframes = keyframes_over_gaps()
    assert shares(keyframes, at_s) == pytest.approx(told)
    assert len(keyframes.stamps_ns) == 1


@pytest.mark.parametrize("off", [1.3, 10.0])
def test_an_outlying_heading_has_the_kernel_s_variance(
    off,
):
    """Four that agree and one beside them, with exact gyros: the mean's information is a sum by hand, k = 1.345."""
    exact = NO_BIAS.model_copy(update={"gyro_noise_density": 1e-9})
    keyframes = keyframes_of(Calibration(imu=exact, dvl=EXACT_DVL))
    sigma = 0.02
    yaw_rad = np.array([0.0, 0.0, off * sigma, 0.0, 0.0])
    keyframes.add(
        level_imu(3.0),
        steady_dvl(3.0),
        None,
        Heading(at(0.3, 0.6, 0.9, 1.2, 1.5), yaw_rad, np.full(5, sigma)),
    )
    keyframes.advance(int(at(2.5)[0]))
    (factor,) = [
        f
        for f in factors_of(keyframes.smoother.graph)
        if list(f.keys()) == [X(1), B(0)] and f.dim() == 1
    ]
    doubt = max(1.0, off / 1.345)
    assert factor.noiseModel().noise().covariance().item() == pytest.approx(
        sigma**2 / (4 + 1 / doubt), rel=1e-6
    )


def test_fixes_have_the_covariance_of_the_motion_from_their_keyframe():
    """With bottom lock, then the first and second in a gap: a sum by hand, of the lever arm too."""
    keyframes = keyframes_over_gaps()
    antenna = np.array([0.3, -0.2, 0.5])
    positions = keyframes.calibration.positions.model_copy(
        update={"antenna_m": tuple(antenna)}
    )
    keyframes.calibration = keyframes.calibration.model_copy(
        update={"positions": positions}
    )
    expected = []
    for when, times in ((1.0, 1.0), (3.0, 2.0), (4.0, 6.0)):
        (stamp_ns,) = at(when).tolist()
        keyframes.advance(stamp_ns)
        C = times * keyframes.motion_since_newest(stamp_ns).covariance
        lever = np.hstack((-gtsam.SO3.Hat(antenna), np.eye(3)))
        expected.append(1e-4 * np.eye(3) + lever @ C @ lever.T)
        keyframes.add_fix(stamp_ns, np.zeros(3), 1e-4 * np.eye(3))
        keyframes.update_if_due()
    assert len(keyframes.stamps_ns) == 1
    found = [
        factor.noiseModel().noise().covariance()
        for factor in factors_on(keyframes, gtsam.GPSFactorArm, X(0))
    ]
    assert found == [
        pytest.approx(covariance, rel=1e-6, abs=1e-8) for covariance in expected
    ]
    assert np.abs(expected[0] - 1e-4 * np.eye(3)).max() > 1e-5


@pytest.mark.parametrize("depth_s", [1.5, 5.6, 6.0])
def test_a_depth_in_a_gap_has_the_walk_of_the_velocity(
    depth_s,
):
    """Lost from 2.0 to 6.2 s: variances add up over the walk from the depth to the end, ``q² (u³ / 3 - u⁴ / (4 T))``."""
    keyframes = keyframes_over_gaps(5.0)
    keyframes.add(None, None, Depth(at(depth_s), np.zeros(1), np.full(1, 1e-4)))
    keyframes.advance(int(at(5.9)[0]))
    motion = keyframes.motion_since_newest(int(at(6.2)[0]))
    keyframes.advance(int(at(6.3)[0]))
    assert seconds(keyframes) == [0.0, 6.2]
    (between,) = (
        f
        for f in factors_of(keyframes.smoother.graph)
        if isinstance(f, gtsam.BetweenFactorPose3)
    )
    np.testing.assert_allclose(
        between.noiseModel().covariance(), motion.covariance, rtol=1e-6, atol=1e-15
    )
    (tie,) = factors_on(keyframes, gtsam.GPSFactorArm, X(1))
    T = 4.2
    u = min(6.2 - depth_s, T)
    walked_m2 = 0.1**2 * (u**3 / 3 - u**4 / (4 * T))
    sampled_s = 6.2 - depth_s - u
    doppler_m2 = 0.01**2 * (T * u + 0.2 * sampled_s)
    assert tie.noiseModel().sigmas()[2] ** 2 == pytest.approx(
        1e-4 + walked_m2 + doppler_m2, rel=1e-3
    )


@given(
    st.lists(
        st.tuples(st.floats(1e-9, 1e-2), st.floats(1e-5, 1e-2)), min_size=1, max_size=12
    )
)
def test_weights_are_those_of_least_squares_with_a_shared_random_walk(depths):
    """Two samples share the error of the way that both are carried, that of the later one."""
    wander, variance = np.array(depths).T
    carried = np.cumsum(wander[::-1])[::-1]
    C = np.minimum.outer(carried, carried) + np.diag(variance)
    ones = np.ones(len(variance))
    expected = np.linalg.solve(C, ones) / (ones @ np.linalg.solve(C, ones))
    weights, mean_variance = average_at_end(variance, wander)
    assert weights == pytest.approx(expected, rel=1e-6, abs=1e-9)
    assert mean_variance == pytest.approx(
        1 / (ones @ np.linalg.solve(C, ones)), rel=1e-6
    )
