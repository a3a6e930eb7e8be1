"""A vehicle on splines, and what its sensors measure: truth for preintegration, with no code of the library's.

Euler angles and world velocity are splines of fifth degree through random knots; position, acceleration and angular
rate are their exact integral and derivatives. The IMU and the Doppler log sit off the body's origin.
"""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline
from scipy.spatial.transform import Rotation

GRAVITY = np.array([0.0, 0.0, -9.81])
BODY_P_IMU, BODY_P_DVL = np.array([0.1, 0.05, -0.1]), np.array([-0.2, 0.0, -0.15])
BODY_R_DVL = Rotation.from_euler("xyz", [np.pi, 0.0, np.pi / 4])


@dataclass(frozen=True)
class Vehicle:
    """A motion over time."""

    angles: BSpline
    """Roll, pitch, yaw."""
    velocity: BSpline
    """Of the body's origin in the world."""
    position: BSpline

    def attitude(self, t: np.ndarray) -> Rotation:
        """World from body."""
        return Rotation.from_euler("ZYX", self.angles(t)[..., ::-1])

    def rate(self, t: np.ndarray) -> np.ndarray:
        """Angular rate in body axes, from the rates of the Euler angles."""
        (roll, pitch, _), (d_roll, d_pitch, d_yaw) = (
            self.angles(t).T,
            self.angles(t, 1).T,
        )
        return np.column_stack(
            [
                d_roll - d_yaw * np.sin(pitch),
                d_pitch * np.cos(roll) + d_yaw * np.cos(pitch) * np.sin(roll),
                -d_pitch * np.sin(roll) + d_yaw * np.cos(pitch) * np.cos(roll),
            ]
        )

    def point(self, arm: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Position and velocity of a point of the body in the world."""
        R = self.attitude(t)
        return self.position(t) + R.apply(arm), self.velocity(t) + R.apply(
            np.cross(self.rate(t), arm)
        )

    def specific_force(self, t: np.ndarray) -> np.ndarray:
        """At the IMU, body axes; the angular acceleration by a difference of 0.2 ms."""
        w, h = self.rate(t), 1e-4
        dw = (self.rate(t + h) - self.rate(t - h)) / (2 * h)
        lever = np.cross(dw, BODY_P_IMU) + np.cross(w, np.cross(w, BODY_P_IMU))
        return self.attitude(t).inv().apply(self.velocity(t, 1) - GRAVITY) + lever

    def doppler(self, t: np.ndarray) -> np.ndarray:
        """Velocity in the log's axes."""
        return BODY_R_DVL.inv().apply(
            self.attitude(t).inv().apply(self.point(BODY_P_DVL, t)[1])
        )


def make_vehicle(seed: int, duration_s: float, knot_s: float = 3.0) -> Vehicle:
    """Surge 0.25 to 0.75 m/s and yaw rates to about 0.25 rad/s, new at every knot; gentle roll and pitch."""
    rng = np.random.default_rng(seed)
    knots = np.arange(-6.0, duration_s + 12.0, knot_s)
    n = len(knots)
    yaw = np.cumsum(knot_s * rng.uniform(-0.2, 0.2, n))
    angles = make_interp_spline(
        knots, np.column_stack([*rng.uniform(-0.08, 0.08, (2, n)), yaw]), k=5
    )
    surge = make_interp_spline(
        knots,
        np.column_stack(
            [rng.uniform(0.25, 0.75, n), *rng.uniform(-0.06, 0.06, (2, n))]
        ),
        k=5,
    )
    fine = np.arange(knots[0], knots[-1], 0.05)
    world = Rotation.from_euler("ZYX", angles(fine)[:, ::-1]).apply(surge(fine))
    velocity = make_interp_spline(fine, world, k=5)
    return Vehicle(angles, velocity, velocity.antiderivative())
