"""Landmark SLAM for underwater vehicles.

Vocabulary
----------
Every docstring in this package uses these words, frames and units without repeating them.

Frames (REP-103)
    ``world``  local, z up, x and y horizontal. Where the data set or the start pose puts its origin.
    ``body``   fixed to the vehicle: x forward, y left, z up.
    ``imu``, ``dvl``  the sensors' own axes, x forward, y left, z up unless their mounting says otherwise.
    ``sonar``  x along the centre beam; azimuth positive to the left, elevation positive up.

Names
    ``world_T_body``   the pose of the body in the world: ``p_world = world_T_body @ p_body``; frames cancel by eye.
    ``world_R_body``   its rotation.
    ``*_m``, ``*_rad``, ``*_ns``  units, wherever they could be mistaken.
    ``*_sigma``        a standard deviation; ``*_cov`` a covariance; never one in the name of the other.
    ``*_density``      the root spectral density of white noise: sigma of its integral over T is ``density * sqrt(T)``.

Units
    Metres, radians, seconds, m/s, rad/s, m/s². Time stamps are integer nanoseconds of the sensor's own clock;
    floating-point seconds are used for differences only.

Tangent space
    Poses are perturbed on the right, in the body frame, rotation before translation (GTSAM's order):
    ``world_T_body = mean @ Exp([theta, rho])``, ``theta`` in radians, ``rho`` in metres.
    A pose covariance is the 6 × 6 covariance of ``[theta, rho]``.

Azimuth and range
    For a point ``q`` in the sonar frame: ``range = |q|`` and ``azimuth = atan2(q_y, q_x)``.
    Elevation is not measured; it is known only to lie within the sonar's aperture.
"""

__version__ = "0.1.0"
