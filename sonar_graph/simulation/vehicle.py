"""True motion of the vehicle: one quintic spline through pose samples, and the route that an operator intends.

All readings follow from derivatives of (x, y, z, roll, pitch, yaw) in closed form, so that noise-free measurements are
exact, not integrated. With ``world_R_body = Rz(yaw) Ry(pitch) Rx(roll)`` the body's angular velocity is ::

    omega = ( roll' - yaw' sin(pitch),
              pitch' cos(roll) + yaw' sin(roll) cos(pitch),
             -pitch' sin(roll) + yaw' cos(roll) cos(pitch) )

and its angular acceleration the time derivative of that (Diebel, "Representing Attitude", 2006, section 5.6).

A route is a list of straight drives, turns on the spot and hovers, each from rest to rest. Speed rises over ``ramp_s``
by a cubic smoothstep, stays, and falls again. With ``A(t)`` the distance since a start at unit final speed, progress
along a leg of duration T is ``(A(t) - A(t - (T - ramp))) / (T - ramp)``. docs/theory/simulation.md
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline
from scipy.spatial.transform import Rotation

from sonar_graph.measurements import Floats

DEGREE = 5


@dataclass(frozen=True, eq=False)
class Kinematics:
    """The body's motion at n instants."""

    position: Floats
    """Origin of the body in the world, shape (n, 3), m."""
    velocity: Floats
    """Of that origin, in the world, shape (n, 3), m/s."""
    acceleration: Floats
    """Of that origin, in the world, shape (n, 3), m/s²."""
    world_R_body: Rotation
    """n rotations."""
    angular_velocity: Floats
    """Of the body against the world, in the body frame, shape (n, 3), rad/s."""
    angular_acceleration: Floats
    """Time derivative of `angular_velocity`, shape (n, 3), rad/s²."""


@dataclass(frozen=True, eq=False)
class VehiclePath:
    """True pose over time."""

    spline: BSpline
    """(x, y, z, roll, pitch, yaw) over seconds since the start; metres and radians, yaw unwrapped."""
    duration_s: float

    @classmethod
    def through(cls, seconds: Floats, poses: Floats) -> VehiclePath:
        """The quintic spline through poses (x, y, z, roll, pitch, yaw), shape (n, 6), at increasing times."""
        return cls(make_interp_spline(seconds, poses, k=DEGREE), float(seconds[-1]))

    def at(self, seconds: Floats) -> Kinematics:
        """Motion at any instants from 0 to ``duration_s``, shape (n,), seconds since the start."""
        # derivatives of the spline are exact
        pose, rate, change = (self.spline(seconds, nu=order) for order in range(3))
        angular_velocity, angular_acceleration = angular_motion(
            pose[:, 3:], rate[:, 3:], change[:, 3:]
        )
        return Kinematics(
            position=pose[:, :3],
            velocity=rate[:, :3],
            acceleration=change[:, :3],
            world_R_body=rotation_from_rpy(pose[:, 3:]),
            angular_velocity=angular_velocity,
            angular_acceleration=angular_acceleration,
        )


def rotation_from_rpy(rpy_rad: Floats) -> Rotation:
    """Rz(yaw) Ry(pitch) Rx(roll) of angles (roll, pitch, yaw) in the last axis."""
    return Rotation.from_euler("ZYX", np.asarray(rpy_rad)[..., ::-1])


def rpy_from_rotation(rotation: Rotation) -> Floats:
    """The angles (roll, pitch, yaw) of `rotation_from_rpy`, in the last axis."""
    return rotation.as_euler("ZYX")[..., ::-1]


def smooth_noise(
    seconds: Floats,
    sigma: float | Floats,
    interval_s: float,
    columns: int,
    rng: np.random.Generator,
) -> Floats:
    """Random smooth wandering, shape (n, columns): quintic B-splines with independent normal coefficients.

    The shorter the interval between coefficients, the livelier. ``sigma`` is their standard deviation, for all columns
    or each; the curve's own is about 0.66 of it.
    """
    # a spline of this degree needs as many knots beyond each end
    spans = int(np.ceil(seconds[-1] / interval_s)) + 1
    knots = interval_s * np.arange(-DEGREE, spans + DEGREE + 1)
    coefficients = sigma * rng.standard_normal((spans + DEGREE, columns))
    return BSpline(knots, coefficients, DEGREE)(seconds)


def angular_motion(rpy: Floats, rate: Floats, change: Floats) -> tuple[Floats, Floats]:
    """Angular velocity and acceleration in the body frame from angles and their two time derivatives."""
    (sin_r, sin_p, _) = np.sin(rpy).T
    (cos_r, cos_p, _) = np.cos(rpy).T
    (roll, pitch, yaw) = rate.T
    (roll2, pitch2, yaw2) = change.T
    velocity = (
        roll - yaw * sin_p,
        pitch * cos_r + yaw * sin_r * cos_p,
        -pitch * sin_r + yaw * cos_r * cos_p,
    )
    acceleration = (
        roll2 - yaw2 * sin_p - yaw * pitch * cos_p,
        pitch2 * cos_r
        - pitch * roll * sin_r
        + yaw2 * sin_r * cos_p
        + yaw * (roll * cos_r * cos_p - pitch * sin_r * sin_p),
        -pitch2 * sin_r
        - pitch * roll * cos_r
        + yaw2 * cos_r * cos_p
        - yaw * (roll * sin_r * cos_p + pitch * cos_r * sin_p),
    )
    return np.column_stack(velocity), np.column_stack(acceleration)


PlanarPose = tuple[float, float, float]


@dataclass(frozen=True)
class RouteLeg:
    """Motion to a goal, from rest to rest."""

    duration_s: float
    ramp_s: float
    """Time to gain full speed, and to lose it; at most half the duration."""
    goal: PlanarPose
    """x, y (m) and unwrapped yaw (rad) at its end."""


def follow(start: PlanarPose, legs: list[RouteLeg], seconds: Floats) -> Floats:
    """The intended x, y (m) and unwrapped yaw (rad) at instants since the start, shape (n, 3).

    ``start`` is the pose before the first leg; after the last leg its goal holds.
    """
    pose = np.tile(np.array(start), (len(seconds), 1))
    begin_s = 0.0
    for (from_, to), leg in zip(
        pairwise([start, *(leg.goal for leg in legs)]), legs, strict=True
    ):
        # a leg moves all later instants: what follows begins at its goal
        first = np.searchsorted(seconds, begin_s)
        elapsed_s = seconds[first:] - begin_s
        full_speed_s = leg.duration_s - leg.ramp_s
        progress = np.ones_like(elapsed_s)
        if full_speed_s > 0:
            # gain speed, and lose it again after the full time
            covered = _distance(elapsed_s, leg.ramp_s) - _distance(
                elapsed_s - full_speed_s, leg.ramp_s
            )
            progress = covered / full_speed_s
        pose[first:] += progress[:, None] * np.subtract(to, from_)
        begin_s += leg.duration_s
    return pose


def drive(
    start: PlanarPose, length_m: float, speed_m_s: float, ramp_s: float
) -> RouteLeg:
    """Leg straight ahead over a length."""
    x, y, yaw = start
    goal = (x + length_m * float(np.cos(yaw)), y + length_m * float(np.sin(yaw)), yaw)
    return RouteLeg(length_m / speed_m_s + ramp_s, ramp_s, goal)


def turn(start: PlanarPose, angle_rad: float, duration_s: float) -> RouteLeg:
    """Turn on the spot, positive to the left."""
    x, y, yaw = start
    return RouteLeg(duration_s, duration_s / 2, (x, y, yaw + angle_rad))


def hover(start: PlanarPose, duration_s: float) -> RouteLeg:
    """Stay at a pose."""
    return RouteLeg(duration_s, duration_s / 2, start)


def _distance(seconds: Floats, ramp_s: float) -> Floats:
    """Distance at unit final speed: the integral of the smoothstep 3u² - 2u³, then of 1."""
    # u^3 - u^4 / 2 is the integral of the smoothstep over u
    u = np.clip(seconds / ramp_s, 0, 1)
    return ramp_s * (u**3 - u**4 / 2) + np.maximum(seconds - ramp_s, 0)
