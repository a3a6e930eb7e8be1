"""Laws of every way to a motion: over steps, over gaps, and by each rule of joint preintegration.

A vehicle that rolls, pitches and turns, written down by hand; derivatives by differences.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest

from sonar_graph.calibration import Calibration, DvlCalibration, ImuCalibration, Mounting
from sonar_graph.measurements import Dvl, Imu
from sonar_graph.navigation.preintegration.joint_preintegration import JointPreintegrator
from sonar_graph.navigation.preintegration.joint_recursion import RULES
from sonar_graph.navigation.preintegration.motion import PreintegratedMotion

from .rows import NS, T0_NS, at, dvl, stamps
from .vehicle import acceleration_at, attitude, motion, rate_at, velocity_at

IMU_HZ, DVL_HZ = 10.0, 2.0
LOST_S, FOUND_S, OPEN_S, WAITS_S = 6.0, 11.0, 10.8, 1e-3
BODY_P_IMU, BODY_P_DVL = np.array([0.2, -0.1, 0.1]), np.array([-0.5, 0.3, -0.2])
SIGMA_M_S = (0.01, 0.02, 0.005)
NO_NOISE = {"gyro_noise_density": 0.0, "accel_noise_density": 0.0, "accel_bias_sigma": 0.0}


class Way(NamedTuple):
    """From a node to a node, or to an instant in a gap; by the odometry, or by a rule of joint preintegration."""

    start_s: float
    until_s: float
    rule: str | None = None
    is_blind: bool = False
    interpolation: str = "linear"


WAYS = {
    "linear": Way(2.0, 5.5),
    "held": Way(2.0, 5.5, interpolation="hold-past"),
    "closed gap": Way(LOST_S, FOUND_S),
    "open gap": Way(LOST_S, OPEN_S),
    "two gaps": Way(5.0, 16.0),
    "closed walk": Way(LOST_S, FOUND_S, is_blind=True),
    "open walk": Way(LOST_S, OPEN_S, is_blind=True),
    "two walks": Way(5.0, 16.0, is_blind=True),
    "inertial over gaps": Way(5.0, 16.0, "inertial"),
    **{f"rule {rule}": Way(2.0, 5.5, rule) for rule in RULES},
}
every_way = pytest.mark.parametrize("way", WAYS.values(), ids=WAYS)


def rows(lever=BODY_P_DVL - BODY_P_IMU, dvl_hz=DVL_HZ, pings_s=None):
    """With velocities at these instants; or without them in two gaps, which end when a row confirms one before it."""
    imu_ns = stamps(IMU_HZ, 16.5)
    dvl_ns = np.union1d(stamps(dvl_hz, 16.0), [at(FOUND_S - WAITS_S), at(15.0 - WAITS_S)])
    t, s = ((ns - T0_NS) * 1e-9 for ns in (imu_ns, dvl_ns))
    force = attitude(t).inv().apply(acceleration_at(t) + np.array([0.0, 0.0, 9.8]))
    velocity = attitude(s).inv().apply(velocity_at(s)) + np.cross(rate_at(s), lever)
    kept = ((s <= LOST_S) | (s > FOUND_S - 2 * WAITS_S)) & ((s <= 12.0) | (s > 15.0 - 2 * WAITS_S))
    kept = kept if pings_s is None else np.isin(dvl_ns, [at(second) for second in pings_s])
    return Imu(imu_ns, rate_at(t), force), dvl(dvl_ns[kept], velocity[kept])


def calibration(imu=None, body_p_imu=BODY_P_IMU, interpolation="linear", **dvl):
    sensors = ImuCalibration(**{**NO_NOISE, **(imu or {})}, mounting=Mounting(translation_m=tuple(body_p_imu)))
    doppler = {"velocity_sigma_m_s": (0.0,) * 3, "velocity_walk_density": 1e-9, **dvl}
    return Calibration(
        imu=sensors,
        dvl=DvlCalibration(**doppler, mounting=Mounting(translation_m=tuple(BODY_P_DVL))),
        odometry_interpolation=interpolation,
    )


def moved_by(way: Way, imu: Imu, dvl: Dvl, bias=(0.0, 0.0, 0.0), earth=None, known=None) -> PreintegratedMotion:
    known = calibration(interpolation=way.interpolation, **(known or {}))
    if way.rule is None:
        return motion(blinded(imu) if way.is_blind else imu, dvl, known, way.start_s, way.until_s, bias, earth)
    joint = replace(JointPreintegrator.from_calibration(known, way.rule), longest_s=2.0)
    removed = np.r_[bias, np.zeros(3)]
    return joint.integrate(imu, dvl, at(way.start_s), at(way.until_s), removed, earth).relative_pose()


def blinded(imu):
    return Imu(imu.stamps_ns, imu.angular_velocity, np.full((len(imu), 3), np.nan))


def change_of(before, after):
    step = before.i_T_j.between(after.i_T_j)
    return np.r_[step.rotation().rpy(), step.translation()]


def spoilt(imu, dvl, column, delta):
    """Rows with one column changed."""
    if column == "velocity":
        return imu, Dvl(dvl.stamps_ns, dvl.velocity + delta, dvl.velocity_cov)
    rate, force = imu.angular_velocity, imu.specific_force
    return Imu(imu.stamps_ns, *((rate + delta, force) if column == "rate" else (rate, force + delta))), dvl


@every_way
def test_the_bias_derivative_is_that_of_integrating_again(way):
    imu, dvl = rows()
    base, step = moved_by(way, imu, dvl), 1e-6
    J = [change_of(base, moved_by(way, *spoilt(imu, dvl, "rate", -step * axis))) / step for axis in np.eye(3)]
    assert base.D_bias == pytest.approx(np.transpose(J), rel=1e-3, abs=0.02)


@every_way
def test_a_bias_that_is_removed_is_as_if_it_had_not_been(way):
    imu, dvl = rows()
    bias, noise = np.array([0.03, -0.02, 0.04]), {"velocity_sigma_m_s": SIGMA_M_S, "imu": {"gyro_noise_density": 1e-3}}
    clean = moved_by(way, imu, dvl, known=noise)
    biased = moved_by(way, *spoilt(imu, dvl, "rate", bias), bias, known=noise)
    assert biased.i_T_j.equals(clean.i_T_j, 1e-9)
    assert biased.covariance == pytest.approx(clean.covariance, abs=1e-12)
    assert np.array_equal(biased.bias, bias)


@every_way
def test_earths_rotation_is_removed_as_if_it_stood_still(way):
    """Exaggerated twentyfold, and known in the frame of the first node."""
    imu, dvl = rows()
    world_earth = np.array([0.0, 1e-3, 8e-4])
    turning, at_dvl = (attitude((ns - T0_NS) * 1e-9).inv().apply(world_earth) for ns in (imu.stamps_ns, dvl.stamps_ns))
    felt = spoilt(*spoilt(imu, dvl, "rate", turning), "velocity", -np.cross(at_dvl, BODY_P_IMU - BODY_P_DVL))
    earth = attitude(np.array([way.start_s])).inv().apply(world_earth)[0]
    still, found, left_in = moved_by(way, imu, dvl), moved_by(way, *felt, earth=earth), moved_by(way, *felt)
    assert found.i_T_j.equals(still.i_T_j, 4e-3)
    assert found.i_T_j.rotation().equals(still.i_T_j.rotation(), 4e-4)
    assert not left_in.i_T_j.rotation().equals(still.i_T_j.rotation(), 1e-3)


@every_way
def test_rows_stamped_later_than_the_covering_one_change_nothing(way):
    imu, dvl = rows()
    is_open = way.until_s == OPEN_S
    way = way._replace(until_s=way.until_s + 0.03 * is_open)
    noise = {"velocity_sigma_m_s": SIGMA_M_S, "imu": {"gyro_noise_density": 1e-3, "accel_noise_density": 1e-2}}
    begin_ns = 0 if way.rule is None else at(way.start_s) - NS // 10
    part = imu.between(begin_ns - 1, at(way.until_s) + (0 if is_open else NS // 10))
    whole, cut = moved_by(way, imu, dvl, known=noise), moved_by(way, part, dvl.between(0, at(way.until_s)), known=noise)
    assert np.array_equal(whole.i_T_j.matrix(), cut.i_T_j.matrix())
    assert np.array_equal(whole.covariance, cut.covariance)


@pytest.mark.parametrize("name", ["two gaps", "inertial over gaps", "rule inertial", "linear"])
def test_the_motion_is_that_of_the_vehicle(name):
    way = WAYS[name]
    seconds = np.linspace(way.start_s, way.until_s, 20001)
    track = np.trapezoid(velocity_at(seconds), seconds, axis=0)
    start, end = attitude(np.array([way.start_s, way.until_s]))
    truth = start.inv().apply(track - (end.apply(BODY_P_IMU) - start.apply(BODY_P_IMU)))
    found = moved_by(way, *rows())
    assert found.i_T_j.translation() == pytest.approx(truth, abs=0.03)
    assert found.i_T_j.rotation().matrix() == pytest.approx((start.inv() * end).as_matrix(), abs=2e-3)
