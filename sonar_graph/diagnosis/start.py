"""Findings about what holds for a whole log: lever arm from IMU to Doppler log, gyro bias, and the start.

Roll and pitch at the start come from a rest or, if the vehicle moves there, from its first minute
(docs/theory/alignment.md); the heading needs a reference. Derivation: docs/theory/sensor_check.md.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import Calibration, ImuCalibration, Mounting
from sonar_graph.diagnosis.findings import (
    IN_CALIBRATION,
    INTERVAL_SIGMAS,
    NO_NEED,
    Finding,
    Findings,
    gravity_of,
    in_degrees,
    judged,
    known_values,
    matters,
    numbers,
    said_once,
    unknown,
)
from sonar_graph.errors import AlignmentError
from sonar_graph.logs import is_without_gravity
from sonar_graph.measurements import NS_PER_S, Dvl, Floats, Heading, Imu
from sonar_graph.models import wrap_angle
from sonar_graph.navigation.alignment import (
    LONGEST_S,
    DvlMatch,
    Estimate1D,
    Estimates3D,
    InitialTilt,
    align_at_rest,
    align_in_motion,
    until_hole,
)
from sonar_graph.sequence import Sequence
from sonar_graph.states import Trajectory

LEAST_LEVER_M = 0.05
"""A turn of 0.2 rad/s makes 0.01 m/s of it, the noise of a good Doppler log."""
LEAST_BIAS_RAD_S = 1e-4
"""The Earth's rotation, 7.3e-5 rad/s, may be in the bias."""
LARGE_TURN_RAD = np.radians(10.0)
"""Of a heading, of a mounting, of the start: beyond, results are doubtful."""
AXES = "xyz"
ARM = "lever arm from IMU to DVL"
BIAS = "gyro bias"
ACCEL_BIAS = "accelerometer bias"
LEAST_ACCEL_BIAS_M_S2 = 0.05
LARGE_ACCEL_BIAS_M_S2 = 0.15
"""Beyond it gravity is tilted by a degree."""
NO_GRAVITY = "no gravity in the specific forces"


def lever_findings(found: DvlMatch, calibration: Calibration) -> Findings:
    """One row for each axis; a single row where no axis is known.

    The arm is a difference of two places, and nothing shows which of them is wrong.
    """
    if not any(estimate.is_known for estimate in found.lever):
        return [Finding(ARM, found.lever[0], "m")]
    # the line has all three axes; those that fit stay as they are
    wrong = arm_error(found, calibration)
    imu = np.subtract(calibration.imu.mounting.translation_m, wrong)
    dvl = np.add(calibration.dvl.mounting.translation_m, wrong)
    line = (
        f"`imu.mounting.translation_m = {numbers(imu, 3)}` {IN_CALIBRATION} or, if that place is sure, "
        f"`dvl.mounting.translation_m = {numbers(dvl, 3)}`"
    )
    rows = Findings()
    given = given_arm(calibration)
    for axis, estimate, place in zip(AXES, found.lever, given, strict=True):
        of_calibration = f"the calibration's {place:+.2f} m"
        name = f"{ARM}, {axis}"
        row = Finding(name, estimate, "m", f"not {of_calibration}", line=line)
        fits = f"{of_calibration} fits, {NO_NEED}"
        rows.append(judged(row, estimate.minus(place), LEAST_LEVER_M, fits=fits))
    return said_once(rows)


def given_arm(calibration: Calibration) -> Floats:
    """The calibration's arm from IMU to Doppler log, shape (3,), m."""
    place = calibration.dvl.mounting.translation_m
    return np.subtract(place, calibration.imu.mounting.translation_m)


def arm_error(found: DvlMatch, calibration: Calibration) -> Floats:
    """Error of the calibration's arm, shape (3,), m; 0 along an axis on which nothing need be done."""
    # an axis on which nothing is known keeps the calibration's number
    errors = map(Estimate1D.minus, found.lever, given_arm(calibration))
    return np.array([e.value if matters(e, LEAST_LEVER_M) else 0.0 for e in errors])


def with_fitted(found: DvlMatch, calibration: Calibration) -> Calibration:
    """Calibration with the place of the IMU that the findings advise."""
    imu = calibration.imu
    place = np.subtract(imu.mounting.translation_m, arm_error(found, calibration))
    moved = imu.mounting.model_copy(update={"translation_m": tuple(place.tolist())})
    changed = imu.model_copy(update={"mounting": moved})
    return calibration.model_copy(update={"imu": changed})


def without_bias(imu: Imu, calibration: Calibration) -> Imu:
    """Rows whose rates are less the bias that the calibration states."""
    unbiased = imu.angular_velocity - calibration.imu.gyro_bias_rad_s
    return replace(imu, angular_velocity=unbiased)


def accel_bias_findings(
    found: DvlMatch, calibration: Calibration
) -> tuple[Findings, Calibration]:
    """A row for each axis on which the accelerometers' bias is beyond its sigma, and the calibration with it.

    A large one along the vertical would change the size of gravity, which `force_scale` compares: it is none, and shows
    that the turns are wrong.
    """
    *_, upward = found.accel_bias
    if matters(upward, LARGE_ACCEL_BIAS_M_S2):
        return [], calibration
    imu = calibration.imu
    allowed = imu.accel_bias_sigma
    # the calibration states biases in the axes of the sensor
    body_R_imu = imu.mounting.rotation_matrix()
    in_imu = body_R_imu.T @ known_values(found.accel_bias)
    whole = np.add(imu.accel_bias_m_s2, in_imu)
    line = f"`imu.accel_bias_m_s2 = {numbers(whole, 3)}` {IN_CALIBRATION}"
    rows = [
        Finding(
            f"{ACCEL_BIAS}, {axis}",
            one,
            "m/s²",
            f"from the turns of the drive, beyond the calibration's sigma of {allowed:.2g}: it tilts gravity by "
            f"{np.degrees(abs(one.value) / calibration.gravity_m_s2):.2g}°",
            line=line,
            gravity=gravity_of(abs(one.value) > LARGE_ACCEL_BIAS_M_S2),
        )
        for axis, one in zip(AXES, found.accel_bias, strict=True)
        if matters(one, LEAST_ACCEL_BIAS_M_S2, allowed)
    ]
    if not rows:
        return [], calibration
    known = imu.model_copy(update={"accel_bias_m_s2": tuple(whole.tolist())})
    return said_once(rows), calibration.model_copy(update={"imu": known})


def acting_bias(bias: Estimates3D, imu: ImuCalibration) -> list[Estimate1D]:
    """Biases along the axes of the body that the calibration does not allow; zero, and sure, along the other axes."""
    none = Estimate1D(0.0, 0.0)
    sigma = imu.gyro_bias_sigma
    return [one if matters(one, LEAST_BIAS_RAD_S, sigma) else none for one in bias]


def with_bias(bias: Estimates3D, imu: ImuCalibration) -> ImuCalibration:
    """Calibration with the bias and its sigma that the findings advise."""
    acting = acting_bias(bias, imu)
    body_R_imu = imu.mounting.rotation_matrix()
    whole = np.add(imu.gyro_bias_rad_s, body_R_imu.T @ known_values(acting))
    sigma = max(imu.gyro_bias_sigma, *(one.sigma for one in acting))
    update = {"gyro_bias_rad_s": tuple(whole.tolist()), "gyro_bias_sigma": sigma}
    return imu.model_copy(update=update)


def bias_findings(
    bias: Estimates3D,
    sources: tuple[str, ...],
    imu: ImuCalibration,
    D_heading: Floats,
) -> Findings:
    """One row for each body axis with its source, such as "from 12 s of rest"; a single row where no axis is known.

    ``D_heading``: derivative of the heading at the end by the bias, shape (3,), s. Gravity holds roll and pitch.
    """
    if not any(estimate.is_known for estimate in bias):
        return [Finding(BIAS, bias[0], "rad/s")]
    allowed = imu.gyro_bias_sigma
    right = with_bias(bias, imu)
    line = (
        f"`imu.gyro_bias_rad_s = {numbers(right.gyro_bias_rad_s, 5)}` and "
        f"`imu.gyro_bias_sigma = {right.gyro_bias_sigma:.2g}` {IN_CALIBRATION}"
    )
    turned_rad = D_heading @ known_values(acting_bias(bias, imu))
    # all axes together turn the vehicle
    large = 0.0 if abs(turned_rad) > LARGE_TURN_RAD else np.inf
    rows = Findings()
    for axis, estimate, source in zip(AXES, bias, sources, strict=True):
        cause = f"{source}, beyond the calibration's sigma of {allowed:.2g}"
        row = Finding(f"{BIAS}, {axis}", estimate, "rad/s", cause, line=line)
        sigma = np.hypot(allowed, estimate.sigma)
        is_doubted = abs(estimate.value) > 2.0 * sigma
        judgement = "is not surely exceeded" if is_doubted else "allows it"
        fits = (
            f"{source}; the calibration's sigma of {allowed:.2g} {judgement}, {NO_NEED}"
        )
        least = LEAST_BIAS_RAD_S
        rows.append(
            judged(row, estimate, least, allowed=allowed, large=large, fits=fits)
        )
    return said_once(rows)


def turned_mounting(
    mounting: Mounting, turn_rad: Floats | tuple[float, float, float]
) -> tuple[float, float, float]:
    """Roll, pitch and yaw of a mounting after a turn, a rotation vector along the body's axes, shape (3,)."""
    # the turn is along the body's axes, so that it goes in front
    before = Rotation.from_euler("ZYX", mounting.rpy_rad[::-1])
    after = Rotation.from_rotvec(turn_rad) * before
    yaw, pitch, roll = after.as_euler("ZYX").tolist()
    return roll, pitch, yaw


FEWEST_HEADINGS = 5
RESTS_S = (10, 20, 40, 80, 160)
"""Tried lengths of a rest at the start; the longest that holds counts."""
LEAST_TILT_RAD = np.radians(0.25)
LEAST_HEADING_RAD = np.radians(1.0)
"""Smaller errors are hidden by others."""
TURN_OVER_NS = NS_PER_S
LEAST_SPREAD_RAD = np.radians(0.1)


@dataclass(frozen=True)
class StartTilt:
    """Alignment at the start of a log, or the reason why it is missing."""

    tilt: InitialTilt | None
    said: str
    """Source, such as "from 20 s of rest", or the reason why it is missing."""
    is_rest: bool = False

    def angle(self, axis: int) -> Estimate1D:
        """Roll (0) or pitch (1), rad."""
        if self.tilt is None:
            return unknown(self.said)
        value = (self.tilt.roll_rad, self.tilt.pitch_rad)[axis]
        return Estimate1D(value, np.sqrt(self.tilt.covariance[axis, axis]))

    def gyro_bias(self) -> Estimates3D | None:
        """Bias from a rest; None in motion, where the whole drive shows more than its first minute."""
        if self.tilt is None or not self.is_rest:
            return None
        sigmas = np.sqrt(np.diag(self.tilt.covariance)[2:]).tolist()
        return tuple(map(Estimate1D, self.tilt.gyro_bias.tolist(), sigmas))


def find_start_tilt(sequence: Sequence) -> StartTilt:
    """Alignment at rest if the vehicle rests at the start, else in motion, of a log with the other faults corrected."""
    # without forces, or without gravity in them, nothing shows which way is up
    if np.isnan(sequence.imu.specific_force).all():
        return StartTilt(None, "no accelerometers")
    if lacks_gravity(sequence):
        return StartTilt(None, NO_GRAVITY)
    found = rest_tilt(sequence)
    imu, dvl = beginning(sequence, LONGEST_S)
    if found.tilt is not None or imu is None or dvl is None:
        return found
    # attitude cannot be carried over a hole
    imu = until_hole(imu)
    try:
        tilt = align_in_motion(imu, dvl, sequence.calibration)
        return StartTilt(tilt, f"from {span_s(imu):.0f} s in motion")
    except AlignmentError as error:
        reason = without_advice(error)
    except np.linalg.LinAlgError:
        reason = "the calibration's noise is zero"
    return StartTilt(None, f"at rest: {found.said}; in motion: {reason}")


def lacks_gravity(sequence: Sequence) -> bool:
    """True where gravity was taken out of the specific forces."""
    forces = sequence.imu.specific_force
    return is_without_gravity(forces, sequence.calibration.gravity_m_s2)


def rest_tilt(sequence: Sequence) -> StartTilt:
    """Alignment at the longest rest at the start, or why it is missing."""
    found = StartTilt(None, "no rows")
    for rest_s in RESTS_S:
        imu, dvl = beginning(sequence, rest_s)
        if imu is None:
            break
        try:
            tilt = align_at_rest(imu, sequence.calibration, dvl)
        except AlignmentError as error:
            # a longer rest that fails leaves the shorter one that held
            if found.tilt is None:
                return StartTilt(None, without_advice(error))
            break
        source = f"from {span_s(imu):.0f} s of rest"
        turned = turn_by_heading(sequence.heading, imu, tilt)
        if turned is not None:
            source += ", less the turn of the heading"
        found = StartTilt(turned or tilt, source, is_rest=True)
    return found


def span_s(imu: Imu) -> float:
    """Time from the first to the last row."""
    return float(imu.stamps_ns[-1] - imu.stamps_ns[0]) / NS_PER_S


def turn_by_heading(
    heading: Heading | None, imu: Imu, tilt: InitialTilt
) -> InitialTilt | None:
    """Alignment at rest whose gyro bias is without a turn that the heading confirms; None where it confirms none.

    A vehicle that turns slowly and steadily looks like one at rest whose gyros have a bias. The heading's rate, by
    least squares over the rest, counts where it is most of that of the gyros about the vertical, and four of its sigmas
    (as if all of its scatter were one slow wave).
    """
    if heading is None:
        return None
    rows = heading.between(int(imu.stamps_ns[0]) - 1, int(imu.stamps_ns[-1]))
    if rows is None or len(rows) < FEWEST_HEADINGS:
        return None
    t = (rows.stamps_ns - rows.stamps_ns.mean()) / NS_PER_S
    yaw_rad = np.unwrap(rows.yaw_rad)
    yaw_rad = yaw_rad - yaw_rad.mean()
    rate = float(t @ yaw_rad / (t @ t))
    sigma = 2.0 * float(np.std(yaw_rad - rate * t)) / float(np.ptp(t))
    # only the part about the vertical can be a turn that a heading shows
    body_R_level = Rotation.from_euler("YX", [tilt.pitch_rad, tilt.roll_rad]).inv()
    up = body_R_level.apply([0.0, 0.0, 1.0])
    by_gyros = float(up @ tilt.gyro_bias)
    rate = np.copysign(rate, by_gyros)  # also of a compass that runs mirrored
    if abs(rate) < 4.0 * sigma or abs(rate - by_gyros) > 0.5 * abs(by_gyros):
        return None
    covariance = tilt.covariance.copy()
    # the bias is now as unsure about the vertical as the heading's rate
    covariance[2:, 2:] += sigma**2 * np.outer(up, up)
    return replace(tilt, gyro_bias=tilt.gyro_bias - rate * up, covariance=covariance)


def tilt_findings(
    found: StartTilt, calibration: Calibration, yaw_rad: float
) -> Findings:
    """One row each for roll and pitch, and a line for the calibration with this heading; a single row without them.

    Where a start is stated, gravity differs from it by a wrong start or by a wrong mounting of the IMU.
    """
    start = calibration.start
    roll = found.angle(0)
    pitch = found.angle(1)
    if found.tilt is None:
        return [Finding("start roll and pitch", roll, "°")]
    line = (
        f"`start.rpy_rad = {numbers((roll.value, pitch.value, yaw_rad), 4)}`, `start.rpy_sigma_rad = "
        f"[{roll.sigma:.2g}, {pitch.sigma:.2g}, {start.rpy_sigma_rad[2]:.2g}]` {IN_CALIBRATION}"
    )
    if start.states("rpy_rad"):
        turned = calibration.imu.mounting
        for about, angle, stated_rad in zip(
            np.eye(3), (roll, pitch), start.rpy_rad, strict=False
        ):
            rpy_rad = turned_mounting(turned, (angle.value - stated_rad) * about)
            turned = turned.model_copy(update={"rpy_rad": rpy_rad})
        of_imu = f"`imu.mounting.rpy_rad = {numbers(turned.rpy_rad, 4)}`"
        line += f" or, if that start is sure, {of_imu}"
    rows = Findings()
    for axis, name in enumerate(("roll", "pitch")):
        angle = found.angle(axis)
        given = start.rpy_rad[axis]
        off_rad = wrap_angle(angle.value - given)
        allowed_rad = start.rpy_sigma_rad[axis]
        stated = f"the calibration's {np.degrees(given):+.2f}°"
        is_near = abs(off_rad) <= INTERVAL_SIGMAS * np.hypot(angle.sigma, allowed_rad)
        fits = "fits" if is_near else "differs by less than four of its sigmas"
        cause = f"{found.said}, not {stated}"
        quantity = f"start {name}: value"
        row = Finding(quantity, in_degrees(angle), "°", cause, line=line)
        of_row = judged(
            row,
            replace(angle, value=off_rad),
            LEAST_TILT_RAD,
            allowed=allowed_rad,
            large=LARGE_TURN_RAD,
            fits=f"{found.said}; {stated} {fits}, {NO_NEED}",
        )
        rows.append(of_row)
    return said_once(rows)


def start_heading_finding(
    sequence: Sequence, reference: Trajectory, offset: Estimate1D, tilt: StartTilt
) -> tuple[Finding, float]:
    """The stated heading against the reference at that instant, its stamps corrected by an offset in s; the right one, rad.

    The line has roll and pitch of the alignment if known, so that rows agree; else those of the reference.
    """
    first_ns, last_ns = reference.stamps_ns[[0, -1]].tolist()
    corrected_ns = sequence.start_ns - round(offset.value * NS_PER_S)
    at_ns = int(np.clip(corrected_ns, first_ns, last_ns))
    pose = reference.at(np.array([at_ns]))
    yaw, pitch, roll = pose.rotations().as_euler("ZYX")[0].tolist()
    of_tilt = ""
    if tilt.tilt is not None:
        roll = tilt.tilt.roll_rad
        pitch = tilt.tilt.pitch_rad
        of_tilt = f", with roll and pitch {tilt.said}"
    # an error of the stamps turns the heading by as much as the vehicle turns meanwhile
    near_ns = at_ns + np.array([-1, 1]) * (TURN_OVER_NS // 2)
    near_ns = np.clip(near_ns, first_ns, last_ns)
    begin, end = reference.at(near_ns).rotations()
    turned_rad = float((begin.inv() * end).magnitude())
    turn_rate = turned_rad * NS_PER_S / max(int(np.ptp(near_ns)), 1)
    spread = np.hypot(LEAST_SPREAD_RAD, turn_rate * offset.sigma)
    start = sequence.calibration.start
    error = Estimate1D(wrap_angle(start.rpy_rad[2] - yaw), spread)
    row = Finding(
        "start heading: error",
        in_degrees(error),
        "°",
        f"the calibration's start heading is wrong; by the reference, its stamps put right{of_tilt}",
        line=f"`start.rpy_rad = {numbers((roll, pitch, yaw), 4)}`, `start.position_m = {numbers(pose.positions[0], 2)}` "
        f"{IN_CALIBRATION}; the position too is the reference's, so that both are of one pose",
    )
    allowed_rad = start.rpy_sigma_rad[2]
    return judged(row, error, LEAST_HEADING_RAD, allowed=allowed_rad), yaw


def beginning(sequence: Sequence, seconds: float) -> tuple[Imu | None, Dvl | None]:
    """Rows of so long from the start on."""
    before_ns = sequence.start_ns - 1
    until_ns = sequence.start_ns + round(seconds * NS_PER_S)
    imu = without_bias(sequence.imu, sequence.calibration)
    return imu.between(before_ns, until_ns), sequence.dvl.between(before_ns, until_ns)


def without_advice(error: AlignmentError) -> str:
    """The finding of an error; other rows have the advice."""
    return str(error).partition(";")[0]
