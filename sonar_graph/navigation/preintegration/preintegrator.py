"""Relative motion between two instants from gyro and Doppler steps, with one joint covariance.

Over the steps k with duration dt, measured rate w and DVL velocity v (body axes)::

    phi_k  = (w_k - b - E_k) dt                    b gyro bias, E Earth rate in the body
    u_k    = v_k - (w_k - b - E_k) x l             velocity of the body's origin; l lever arm of the DVL
    dp    += dR J_l(phi_k) u_k dt                  displacement in the first body frame
    dR    <- dR Exp(phi_k)

The perturbation ``dR Exp(theta)``, ``dp + eps`` obeys, to first order in the gyro error ``d`` (rate) and the velocity
error ``n``::

    theta <- Exp(-phi)  theta + J_r(phi) dt d
    eps   <- eps - dR [J_l u dt]x theta + dR (D dt + J_l [l]x) dt d + dR J_l dt n,     D = d(J_l u) / d phi

White noise gives the covariance, a constant ``d = -db`` the bias Jacobian. After Forster et al., TRO 2017, section VI,
with the DVL in place of the accelerometer; compare Thoms et al., IEEE JOE 2023. docs/theory/preintegration.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from sonar_graph.calibration import Calibration
from sonar_graph.errors import CalibrationError
from sonar_graph.measurements import Floats
from sonar_graph.motion import PreintegratedMotion
from sonar_graph.navigation.preintegration.dvl_gaps import GapValues, bridge, gap_values
from sonar_graph.navigation.preintegration.recursion import Columns, Steps, in_last_frame, integrate_steps, trace_point
from sonar_graph.navigation.samples import finite_vector, require_noise


@dataclass(frozen=True, eq=False)
class Preintegrator:
    """Preintegration of gyro and Doppler steps, for one set of sensors.

    Raises
    ------
    CalibrationError
        When the density is negative, or a number is not finite.

    Examples
    --------
    >>> import numpy as np
    >>> from sonar_graph.navigation import Preintegrator
    >>> from sonar_graph.navigation.preintegration import Steps
    >>> zeros, ahead = np.zeros((10, 3)), np.tile([0.5, 0.0, 0.0], (10, 1))
    >>> steps = Steps(np.full(10, 0.1), zeros, ahead, np.zeros((10, 3, 3)), zeros, zeros)
    >>> motion = Preintegrator(1e-4, np.zeros(3)).integrate(steps, np.zeros(3))
    >>> motion.i_T_j.translation().round(6).tolist()
    [0.5, 0.0, 0.0]
    """

    gyro_noise_density: float
    """rad/s/√Hz."""
    body_p_dvl: Floats
    """Lever arm of the DVL, shape (3,), m."""
    gap: GapValues | None = None
    """Model of DVL gaps; None: the velocity is linear or held however long a gap lasts."""

    def __post_init__(self) -> None:
        require_noise("gyro_noise_density", self.gyro_noise_density, 1)
        finite_vector("body_p_dvl", self.body_p_dvl, 3, CalibrationError)

    @classmethod
    def from_calibration(cls, calibration: Calibration) -> Preintegrator:
        """Pick the numbers from a calibration."""
        body_p_dvl = np.array(calibration.dvl.mounting.translation_m)
        return cls(calibration.imu.gyro_noise_density, body_p_dvl, gap_values(calibration))

    def integrate(self, steps: Steps, bias: Floats, earth_rate: Floats | None = None) -> PreintegratedMotion:
        """Integrate steps.

        Parameters
        ----------
        steps
            Steps of `sonar_graph.navigation.odometry.Odometry`.
        bias
            Gyro bias in the body frame to remove, shape (3,), rad/s.
        earth_rate
            Earth's rotation in body frame i, shape (3,), rad/s; None: not removed.

        Raises
        ------
        MeasurementError
            When bias or Earth rate are not three finite numbers.
        """
        bias = finite_vector("bias", bias, 3)
        rotation, displacement, cov, D, impulse = integrate_steps(
            steps.duration_s,
            steps.rate,
            steps.velocity,
            steps.velocity_psd,
            steps.specific_force,
            steps.turn_psd,
            bias,
            np.zeros(3) if earth_rate is None else finite_vector("earth_rate", earth_rate, 3),
            self.body_p_dvl,
            self.gyro_noise_density,
        )
        i_T_j = gtsam.Pose3(gtsam.Rot3(rotation), displacement)
        duration_s = float(steps.duration_s.sum())
        mean_force = impulse / duration_s if duration_s > 0 else np.full(3, np.nan)
        return PreintegratedMotion(i_T_j, cov, D, bias, duration_s, mean_force)

    def bridge(
        self,
        columns: Columns,
        start_ns: int,
        end_ns: int,
        is_closed: bool,
        bias: Floats,
        earth_rate: Floats | None = None,
    ) -> PreintegratedMotion:
        """Motion over a gap of the Doppler log (`sonar_graph.navigation.preintegration.dvl_gaps`).

        Parameters
        ----------
        columns
            Rows of `sonar_graph.navigation.odometry.Odometry`.
        start_ns, end_ns
            An epoch and the next one, or (not closed) an epoch and an instant before the next.
        bias, earth_rate
            See `integrate`.
        """
        if self.gap is None:
            raise CalibrationError("gap: a Preintegrator without it bridges no gaps; make it with from_calibration")
        earth = (0.0, 0.0, 0.0) if earth_rate is None else float_triple(earth_rate)
        motion = bridge(columns, self.gap, start_ns, end_ns, is_closed, float_triple(bias), earth)
        rotation, displacement, cov, D, impulse = in_last_frame(*motion)
        duration_s = (end_ns - start_ns) * 1e-9
        pose = gtsam.Pose3(gtsam.Rot3(rotation), displacement)
        return PreintegratedMotion(pose, cov, D, bias, duration_s, impulse / duration_s)

    def path_of(self, point: Floats, steps: Steps, bias: Floats, offsets_s: Floats) -> Floats:
        """Positions of a point of the body at times after the first instant, in the first body frame.

        Parameters
        ----------
        point
            Position in the body frame, shape (3,), m.
        offsets_s
            Times after the start of the steps, not decreasing, shape (n,).

        Returns
        -------
        Floats
            Shape (n, 3), m; linear within a step.
        """
        return trace_point(steps.duration_s, steps.rate, steps.velocity, bias, self.body_p_dvl, point, offsets_s)


def float_triple(a: Floats) -> tuple[float, float, float]:
    """Three numbers of an array as a tuple, for compiled code."""
    return float(a[0]), float(a[1]), float(a[2])
