"""Start of a log whose owner does not state it: measured where sensors can, else by convention.

Height comes from the first depths, roll and pitch from the first seconds of accelerometers and Doppler log, yaw from
the first headings, x and y from the first fixes. With C the turn by the gyros since the start, F = int C f dt, v the
velocity in the body and p = int C v dt, which also leads back from the first headings and fixes to the start::

    C v - F = v_0 - g t u            the slope of this line is the world's up u, in the body's axes at the start
    fix(t) = p_0 + exp(i yaw) p(t)   complex numbers, level: yaw where there are fixes and no headings

What no sensor measures defines the world: x, y and yaw are zero at the vehicle (`Start.source`).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import UNKNOWN_HEIGHT, Calibration, Start
from sonar_graph.logs.adapters import plain_lines
from sonar_graph.measurements import Depth, Dvl, Floats, Imu, Ints
from sonar_graph.numerics import columns_at, running_integral, running_rotations

NEAREST_ROWS = 5
"""Rows about the start whose median counts, so that one wrong row does not."""
WIDER = 3.0
"""Factor from a row's sigma to the start's: the rows are measurements too, and so count twice by a ninth only."""
LEVEL_S = 20.0
LONGEST_S = 600.0
"""Longest time from which yaw is taken by fixes; roll and pitch are taken from the first `LEVEL_S`."""
LONGEST_HOLE_S = 1.0
FEWEST_VELOCITIES = 10
FEWEST_FIXES = 6
LARGEST_GRAVITY_ERROR = 0.2
"""Relative; beyond it the accelerometers have another unit, or gravity was taken out."""
LEAST_TILT_SIGMA_RAD = 0.01
"""The axes of a sensor are seldom known better in the vehicle."""
LEVEL_SIGMA_RAD = 0.1
"""Of roll and pitch taken as zero."""
LEAST_HEIGHT_SIGMA_M = 0.05
"""Waves and resolution."""
CLIMB_SHARE = 0.1
UNKNOWN_YAW_SIGMA_RAD = 1.0
SOURCES = {
    "stated": "as stated",
    "fixes": "heading and position by the first headings and fixes",
    "heading": "heading by the first headings, position by convention (x = y = 0)",
    "vehicle": "heading and position by convention: the world begins at the vehicle with x forward",
    "map": "heading and position in the known map, from the landmarks that are seen",
}


@dataclass(frozen=True, eq=False)
class FirstPath:
    """Velocity and specific force of the body from the start on, in the body's axes at the start."""

    seconds: Floats
    """Since the start, of each velocity, shape (n,)."""
    velocity: Floats
    """C v, shape (n, 3), m/s."""
    impulse: Floats
    """F, shape (n, 3), m/s; NaN without accelerometers."""

    @classmethod
    def of(
        cls, imu: Imu, dvl: Dvl, calibration: Calibration, start_ns: int
    ) -> "FirstPath":
        """Integrate with the trapezoid rule, up to the first hole of the IMU."""
        t = (imu.stamps_ns - start_ns) * 1e-9
        # a hole of the IMU ends what can be integrated
        t_hole = np.append(t[:-1][np.diff(t) > LONGEST_HOLE_S], LONGEST_S)
        rows = (t >= -1.0) & (t <= t_hole[t_hole > 0][0])
        t = t[rows]
        body_R_imu = calibration.imu.mounting.rotation_matrix()
        rate = (
            imu.angular_velocity[rows] - calibration.imu.gyro_bias_rad_s
        ) @ body_R_imu.T
        dt = np.diff(t)[:, None]
        C = running_rotations((rate[1:] + rate[:-1]) / 2 * dt)
        # turns are counted from the start on
        C = C[np.searchsorted(t, 0.0, side="right") - 1].T @ C
        unbiased = imu.specific_force[rows] - calibration.imu.accel_bias_m_s2
        force = np.einsum("nij,nj->ni", C, unbiased @ body_R_imu.T)
        seconds = (dvl.stamps_ns - start_ns) * 1e-9
        is_inside = (seconds >= 0) & (seconds <= t[-1])
        seconds = seconds[is_inside]
        at = C[np.searchsorted(t, seconds, side="right") - 1]
        body_R_dvl = calibration.dvl.mounting.rotation_matrix()
        velocity = np.einsum("nij,nj->ni", at, dvl.velocity[is_inside] @ body_R_dvl.T)
        impulse = columns_at(seconds, t, running_integral(t, force))
        return cls(seconds, velocity, impulse)

    def moved(self, seconds: Floats) -> Floats:
        """C v integrated from the start to some instants, shape (n, 3), m."""
        if len(self.seconds) < 2:
            return np.zeros((len(seconds), 3))
        path = running_integral(self.seconds, self.velocity)
        return columns_at(seconds, self.seconds, path)

    def up(self, calibration: Calibration) -> tuple[Floats, float] | None:
        """The world's up at the start, shape (3,), and its sigma in rad; None without gravity in the accelerometers."""
        first = self.seconds <= LEVEL_S
        t = self.seconds[first]
        line = (self.velocity - self.impulse)[first]
        if len(t) < FEWEST_VELOCITIES or not np.isfinite(line).all():
            return None
        # a constant force in the world is a straight line in time
        slope, level = np.polyfit(t, line, 1)
        size = float(np.linalg.norm(slope))
        g = calibration.gravity_m_s2
        if abs(size - g) > LARGEST_GRAVITY_ERROR * g:
            return None
        scatter = float(np.std(line - slope * t[:, None] - level))
        # as if all scatter were one slow wave
        of_line = scatter * np.sqrt(12.0) / (g * float(np.ptp(t)))
        # a bias of the accelerometers tilts gravity by its share of g
        of_force = calibration.imu.accel_bias_sigma / g
        of_turn = calibration.imu.gyro_bias_sigma * float(np.ptp(t))
        sigma = WIDER * float(np.sqrt(of_line**2 + of_force**2 + of_turn**2))
        return -slope / size, max(sigma, LEAST_TILT_SIGMA_RAD)


def is_whole(start: Start) -> bool:
    """True for a start whose owner states both position and orientation."""
    return start.model_fields_set >= {"position_m", "rpy_rad"}


def with_measured_start(
    calibration: Calibration, blocks: Mapping[str, Any]
) -> tuple[Calibration, str]:
    """Calibration with the start by the first rows, by role, and a note about what it was taken from."""
    start_ns = int(max(blocks["imu"].stamps_ns[0], blocks["dvl"].stamps_ns[0]))
    start, missing = measured_start(calibration, start_ns, blocks)
    stated = calibration.start.model_dump(exclude_unset=True)
    if "position_m" in stated or ("rpy_rad" in stated and start.source == "vehicle"):
        start = start.model_copy(
            update={"source": "stated" if "position_m" in stated else "heading"}
        )
    start = start.model_copy(update=stated)
    height = UNKNOWN_HEIGHT
    if "position_m" in stated:
        height = "height as stated"
    elif blocks.get("depth") is not None:
        height = "height by the first depths"
    elif blocks.get("positions") is not None:
        height = "height by the first fixes"
    elif calibration.planar is not None:
        height = "height of the plane"
    if calibration.map is not None:
        start = start.in_map(has_height=height != UNKNOWN_HEIGHT)
    what = (
        f"of the start only {' and '.join(stated)} stated"
        if stated
        else "start pose not stated"
    )
    said = "; ".join([f"{what}: {height}", *missing, SOURCES[start.source]])
    values = ", ".join(plain_lines(start.model_dump(exclude={"source"})))
    advice = "; state it as [start] position_m and rpy_rad in a file for --calibration where it matters"
    return calibration.model_copy(update={"start": start}), f"{said}: {values}{advice}"


def measured_start(
    calibration: Calibration, start_ns: int, blocks: Mapping[str, Any]
) -> tuple[Start, list[str]]:
    """Start by the first rows, and what was not measured as it should be."""
    start = calibration.start
    notes = list[str]()
    path = FirstPath.of(blocks["imu"], blocks["dvl"], calibration, start_ns)
    roll, pitch, yaw = start.rpy_rad
    sigmas = np.array(start.rpy_sigma_rad)
    if calibration.planar is None:
        up = path.up(calibration) if calibration.use_gravity else None
        if up is None:
            sigmas[:2] = LEVEL_SIGMA_RAD
            notes.append("roll and pitch unknown, taken as 0")
        else:
            (x, y, z), sigmas[:2] = up
            # the world's up in the body fixes roll and pitch
            roll = float(np.arctan2(y, z))
            pitch = float(np.arctan2(-x, np.hypot(y, z)))
            notes.append("level by gravity")
    world_R_level = Rotation.from_euler("ZYX", [0.0, pitch, roll])
    source = "vehicle"
    fixes = blocks.get("positions")
    if (heading := blocks.get("heading")) is not None:
        source = "heading"
        near = _nearest(heading.stamps_ns, start_ns)
        turned = _turned(
            blocks["imu"], calibration, (roll, pitch), heading.stamps_ns[near], start_ns
        )
        # angles near the cut at 180 degrees have no median of their own
        at_start = np.unwrap(heading.yaw_rad[near]) - turned
        yaw = float(np.angle(np.exp(1j * np.median(at_start))))
        sigmas[2] = WIDER * np.hypot(
            calibration.heading.bias_sigma_rad, calibration.heading.sigma_rad
        )
    elif fixes is not None:
        yaw, sigmas[2] = yaw_by_fixes(
            (fixes.stamps_ns - start_ns) * 1e-9, fixes.position_m, path, world_R_level
        )
        notes.append("heading by the path of the fixes")
    R = gtsam.Rot3.RzRyRx(roll, pitch, yaw).matrix()
    position = np.array(start.position_m)
    position_sigma = np.array(start.position_sigma_m)
    if fixes is not None:
        source = "fixes"
        near = _nearest(fixes.stamps_ns, start_ns)
        variances = np.median(np.einsum("nii->ni", fixes.covariance_m2[near]), axis=0)
        variances = np.where(
            np.isnan(variances), np.square(calibration.positions.sigma_m), variances
        )
        # fixes near the start were not taken at it
        way = path.moved((fixes.stamps_ns[near] - start_ns) * 1e-9) @ R.T  # (k, 3)
        # fixes are of the antenna
        antenna = R @ np.array(calibration.positions.antenna_m)
        position = np.median(fixes.position_m[near] - way, axis=0) - antenna
        # an error of the heading turns the way to the fixes
        turned_m = sigmas[2] * float(np.median(np.linalg.norm(way, axis=1)))
        position_sigma = np.sqrt(WIDER**2 * variances + turned_m**2)
    if blocks.get("depth") is not None:
        position[2], position_sigma[2] = height_by_depth(
            calibration, start_ns, blocks["depth"], path, R[2]
        )
    elif fixes is None and calibration.planar is None:
        notes.append("no depth")
    changes: dict[str, Any] = {
        "rpy_rad": (roll, pitch, yaw),
        "rpy_sigma_rad": sigmas,
        "position_m": position,
        "position_sigma_m": position_sigma,
    }
    rounded = {
        name: tuple(round(float(value), 4) for value in values)
        for name, values in changes.items()
    }
    return start.model_copy(update={**rounded, "source": source}), notes


def _turned(
    imu: Imu,
    calibration: Calibration,
    tilt_rad: tuple[float, float],
    at_ns: Ints,
    start_ns: int,
) -> Floats:
    """Turn by the gyros about the vertical at the start until some instants, shape (n,), rad."""
    level_R_body = Rotation.from_euler("ZYX", [0.0, tilt_rad[1], tilt_rad[0]])
    body_R_imu = calibration.imu.mounting.rotation_matrix()
    rate = (imu.angular_velocity - calibration.imu.gyro_bias_rad_s) @ body_R_imu.T
    about_up = np.asarray(rate @ level_R_body.as_matrix()[2], np.float64)
    seconds = np.asarray((imu.stamps_ns - start_ns) * 1e-9, np.float64)
    turn = running_integral(seconds, about_up)
    at = np.interp(at_ns, imu.stamps_ns, turn)
    return at - np.interp(start_ns, imu.stamps_ns, turn)


def height_by_depth(
    calibration: Calibration,
    start_ns: int,
    depth: Depth,
    path: FirstPath,
    up: Floats,
) -> tuple[float, float]:
    """Height of the body at the start and its sigma, m: the first depths, less what the vehicle climbed meanwhile.

    ``up`` is the world's up in the body, shape (3,).
    """
    near = _nearest(depth.stamps_ns, start_ns)
    # the first depths may come after the start
    late_s = np.asarray((depth.stamps_ns[near] - start_ns) * 1e-9, np.float64)
    climb_m = path.moved(late_s) @ up
    port_m = float(up @ calibration.depth.port_m)
    z_m = float(np.median(depth.z_m[near] - climb_m)) - port_m
    variance = float(np.median(depth.variance_m2[near]))
    sigma_m = (
        calibration.depth.sigma_m if np.isnan(variance) else float(np.sqrt(variance))
    )
    # a tenth of the climb for the error of the velocities and of up
    of_climb = CLIMB_SHARE * float(np.median(np.abs(climb_m)))
    return z_m, float(
        np.sqrt((WIDER * sigma_m) ** 2 + LEAST_HEIGHT_SIGMA_M**2 + of_climb**2)
    )


def yaw_by_fixes(
    t: Floats, places: Floats, path: FirstPath, level_R_body: Rotation
) -> tuple[float, float]:
    """Yaw at the start and its sigma, rad, that turns the path by gyros and Doppler log into that of the fixes."""
    level = level_R_body.apply(path.velocity) @ [1.0, 1j, 0.0]
    p = running_integral(path.seconds, level)
    is_inside = (t >= 0) & (t <= path.seconds.max(initial=0.0))
    if np.count_nonzero(is_inside) < FEWEST_FIXES:
        return 0.0, UNKNOWN_YAW_SIGMA_RAD
    reckoned = np.interp(t[is_inside], path.seconds, p)
    seen = places[is_inside] @ [1.0, 1j, 0.0]
    # turn about the centre: the place of the start is another unknown
    reckoned = reckoned - reckoned.mean()
    seen = seen - seen.mean()
    c = np.vdot(reckoned, seen)
    left = seen - reckoned * c / max(abs(c), 1e-12)
    moved_m = float(np.sqrt(np.vdot(reckoned, reckoned).real))
    # errors of fixes are alike for a while: a quarter of them counts
    sigma = (
        2.0
        * WIDER
        * float(np.sqrt(np.mean(np.abs(left) ** 2) / 2))
        / max(moved_m, 1e-9)
    )
    # the path is too short for a direction
    if sigma > UNKNOWN_YAW_SIGMA_RAD / 2:
        return 0.0, UNKNOWN_YAW_SIGMA_RAD
    return float(np.angle(c)), max(sigma, LEAST_TILT_SIGMA_RAD)


def _nearest(stamps_ns: Ints, at_ns: int) -> Ints:
    """Rows nearest to an instant, at most `NEAREST_ROWS`, in their order."""
    return np.sort(np.argsort(np.abs(stamps_ns - at_ns), kind="stable")[:NEAREST_ROWS])
