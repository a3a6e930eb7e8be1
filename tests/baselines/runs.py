"""Runs of the filters on rows made by hand, and the states that they must have."""

import math
from dataclasses import replace

import numpy as np
import pytest

from baselines.dead_reckoning import DeadReckoning
from baselines.ekf_slam import EkfSlam
from baselines.invariant_ekf import InvariantEkf
from sonar_graph.calibration import (
    Calibration,
    DepthCalibration,
    DvlCalibration,
    ImuCalibration,
    Mounting,
    SonarCalibration,
    Start,
)
from sonar_graph.measurements import (
    NS_PER_S,
    Depth,
    Heading,
    LandmarkDetections,
    Measurements,
    PositionFixes,
)
from sonar_graph.navigation import Odometry
from sonar_graph.sequence import Sequence
from sonar_graph.slam import Isam2
from tests.navigation import rows
from tests.navigation.rows import T0_NS

STANDARD_FORCE = np.array([0.0, 0.0, 9.80665])


NO_FORCE = (math.nan,) * 3


NAMES = {
    DeadReckoning: "dead-reckoning",
    EkfSlam: "ekf-slam",
    InvariantEkf: "invariant-ekf",
    Isam2: "isam2",
}


def for_estimators(*kinds):
    return pytest.mark.parametrize("kind", kinds, ids=[NAMES[kind] for kind in kinds])


every_filter = for_estimators(EkfSlam, InvariantEkf, DeadReckoning)


every_estimator = for_estimators(*NAMES)


slam_filters = for_estimators(EkfSlam, InvariantEkf)


filters_with_bias = for_estimators(InvariantEkf, DeadReckoning)


def later(*seconds):
    """Stamps so many seconds after the beginning; one stamp for one number."""
    stamps_ns = T0_NS + np.round(np.array(seconds) * NS_PER_S).astype(np.int64)
    return stamps_ns if len(seconds) > 1 else int(stamps_ns[0])


def imu(seconds, rate=(0.0, 0.0, 0.0), force=STANDARD_FORCE, rate_hz=50):
    return rows.imu(rows.stamps(rate_hz, seconds), rate, force)


def dvl(seconds, velocity=(0.0, 0.0, 0.0), rate_hz=5):
    return rows.dvl(rows.stamps(rate_hz, seconds), velocity)


def depths(stamps_ns, z_m, variance_m2=math.nan):
    return Depth(
        stamps_ns, np.full(len(stamps_ns), z_m), np.full(len(stamps_ns), variance_m2)
    )


def seen(stamps_ns, range_m=2.0, azimuth_rad=0.1, landmark=3, probability=1.0):
    n = len(stamps_ns)
    return LandmarkDetections(
        np.asarray(stamps_ns),
        np.full(n, range_m, float),
        np.full(n, azimuth_rad, float),
        np.full((n, 2, 2), np.nan),
        np.full((n, 1), landmark),
        np.full((n, 1), probability),
    )


def begun(kind, calibration, **params):
    return kind(calibration, Odometry(calibration), kind.Params(**params))


def run(kind, sequence, rate_hz=1.0, **params):
    estimator = begun(kind, sequence.calibration, **params)
    for window in sequence.replay(sequence.instants(rate_hz)):
        estimator.process(window)
    return estimator


def estimate_after(kind, calibration, seconds, *rows):
    return begun(kind, calibration).process(Measurements(later(seconds), *rows))


def state_of(slam):
    """Arrays of the state at the newest node."""
    return slam.state()[1:] if isinstance(slam, EkfSlam) else tuple(slam.state()[1])


def height_and_tilt(slam):
    """Mean height of the body at the node, its variance, and the variances of roll and pitch (level only)."""
    if isinstance(slam, EkfSlam):
        _, x, P = slam.state()
        return x[2], P[2, 2], np.diag(P)[3:5]
    _, state = slam.state()
    return state.points[0, 2], state.P[16, 16], np.diag(state.P)[:2]


YAW_RATE = 0.1
SPEED = 0.3
LEVER = np.array([0.2, 0.1, -0.3])


CIRCLE_S = 20
CIRCLE_START = Start(position_m=(1.0, 2.0, -3.0), rpy_rad=(0.0, 0.0, 0.5))


def circle_calibration(**imu_noise):
    return Calibration(
        imu=ImuCalibration(gyro_noise_density=1e-3, **imu_noise),
        dvl=DvlCalibration(
            velocity_sigma_m_s=(0.02, 0.02, 0.02),
            mounting=Mounting(translation_m=tuple(LEVER)),
        ),
        start=CIRCLE_START,
    )


def circle(seconds=CIRCLE_S):
    """A level circle; the DVL off the centre of the body, the accelerometer silent."""
    velocity = np.array([SPEED, 0.0, 0.0]) + np.cross([0.0, 0.0, YAW_RATE], LEVER)
    return imu(seconds, (0.0, 0.0, YAW_RATE), NO_FORCE), dvl(seconds, velocity)


def in_a_gap(depth=None, detections=None):
    """At rest, without accelerometer; the Doppler log is silent from 2 s to 12 s and from 14 s to 24 s."""
    doppler = dvl(25)
    seconds = (doppler.stamps_ns - T0_NS) * 1e-9
    calibration = Calibration(
        use_gravity=False,
        depth=DepthCalibration(sigma_m=0.001),
        start=Start(position_sigma_m=(1.0, 1.0, 1.0)),
        sonar=SonarCalibration(range_sigma_m=0.001, azimuth_sigma_rad=0.001),
    )
    log = doppler.rows(
        (seconds <= 2.0) | ((seconds >= 12.0) & (seconds <= 14.0)) | (seconds >= 24.0)
    )
    return Sequence("gap", calibration, imu(25, force=NO_FORCE), log, depth, detections)


def aided(mission):
    """The mission with headings and fixes at stamps of depths and a little later; some rows are unsound."""
    depth_ns = mission.depth.stamps_ns[1:-1]
    heading_ns, fixes_ns = (
        np.sort(np.append(depth_ns[::n], depth_ns[::n] + 1_000_000)) for n in (3, 7)
    )
    yaw_rad = mission.truth.at(heading_ns).rotations().as_euler("ZYX")[:, 0]
    sigma_rad = np.full(len(yaw_rad), math.nan)
    covs = np.full((len(fixes_ns), 3, 3), math.nan)
    sigma_rad[5::10], covs[3::10] = -1.0, -np.eye(3)
    fixes = PositionFixes(fixes_ns, mission.truth.at(fixes_ns).positions + 1.0, covs)
    return replace(
        mission, heading=Heading(heading_ns, yaw_rad + 0.03, sigma_rad), positions=fixes
    )
