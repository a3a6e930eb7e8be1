"""Findings of the sensor check: an estimate, how certain it is, and the line of the calibration to change.

Here: lever arm from IMU to DVL, gyro bias, and roll, pitch and heading at the start of a log. Roll and pitch come from
a rest at the start or, if the vehicle moves there, from its first minute (docs/theory/alignment.md); the heading needs
a reference. Derivation: docs/theory/sensor_check.md.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import Calibration, DvlCalibration, ImuCalibration, Start
from sonar_graph.errors import AlignmentError
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

INTERVAL_SIGMAS = 1.96
"""Half width of printed intervals, 95 %."""
ACTING_SIGMAS = 4.5
"""A log has some twenty numbers: of faultless logs fewer than one in a thousand asks for an action by chance."""
NO_NEED = "no need to act"
ALSO = "put right by the line above"
IN_CALIBRATION = "in the calibration (--calibration FILE)"
IN_LOG_CONFIG = "in the log configuration (--log-config FILE)"


@dataclass(frozen=True)
class Finding:
    """One quantity with its uncertainty, and the advice that follows.

    Examples
    --------
    Velocities that were logged in mm/s:

    >>> from dataclasses import replace
    >>> from sonar_graph.diagnosis import check_sensors
    >>> from sonar_graph.testing import small_world
    >>> world = small_world()
    >>> wrong = replace(world, dvl=replace(world.dvl, velocity=1000 * world.dvl.velocity))
    >>> finding = check_sensors(wrong)[0]
    >>> finding.quantity, finding.acts
    ('DVL: unit', True)
    """

    quantity: str
    estimate: Estimate1D
    unit: str
    advice: str
    """A sentence, also where nothing need be done."""
    acts: bool = False
    """True where something should be done."""
    grave: bool = False
    """True where a sensor contradicts another beyond doubt, so that results are doubtful."""

    def text(self) -> str:
        """Value with its 95 % interval and the advice; or the reason why it is not known."""
        if not self.estimate.is_known:
            return (
                self.advice if self.acts else f"cannot be told: {self.estimate.reason}"
            )
        return f"{with_interval(self.estimate, self.unit)}: {self.advice}"

    def plain(self) -> dict[str, Any]:
        """Content for JSON."""
        known, e = self.estimate.is_known, self.estimate
        numbers = {
            "value": e.value if known else None,
            "sigma": e.sigma if known else None,
            "unit": self.unit,
        }
        return {
            "quantity": self.quantity,
            **numbers,
            "reason": e.reason,
            "act": bool(self.acts),
            "grave": bool(self.grave),
            "advice": self.advice,
        }


def with_interval(estimate: Estimate1D, unit: str) -> str:
    """Value and 95 % interval, with the digits that the interval supports."""
    half = INTERVAL_SIGMAS * estimate.sigma
    digits = int(np.clip(1 - np.floor(np.log10(half)), 0, 8)) if half > 0 else 3
    if unit.startswith(("rad/s", "m/s")):
        return f"{estimate.value:.2g} ± {half:.1g} {unit}"
    sign = "" if unit == "" else "+"
    return f"{estimate.value:{sign}.{digits}f} ± {half:.{digits}f} {unit}".rstrip()


def in_degrees(angle: Estimate1D) -> Estimate1D:
    """An angle converted from radians."""
    return replace(
        angle,
        value=float(np.degrees(angle.value)),
        sigma=float(np.degrees(angle.sigma)),
    )


def matters(estimate: Estimate1D, least: float) -> bool:
    """True for an estimate above a threshold and beyond `ACTING_SIGMAS` of zero."""
    return bool(
        estimate.is_known
        and abs(estimate.value) > max(least, ACTING_SIGMAS * estimate.sigma)
    )


def worst_first(findings: Iterable[Finding]) -> list[Finding]:
    """Grave findings, then those to act on, then the others; each in the order in which to act."""
    return sorted(findings, key=lambda finding: (not finding.grave, not finding.acts))


def notes_of(findings: Iterable[Finding]) -> dict[str, str]:
    """Notes for a sequence, the findings to act on, worst first: grave ones under ``log.doubtful``."""
    texts: dict[str, list[str]] = {"log.doubtful": [], "log.sensors": []}
    for finding in worst_first(findings):
        if finding.acts:
            subject = "log.doubtful" if finding.grave else "log.sensors"
            texts[subject].append(f"{finding.quantity}: {finding.text()}")
    return {subject: "; ".join(said) for subject, said in texts.items() if said}


def said_once(findings: Iterable[Finding]) -> list[Finding]:
    """Findings that share one line of advice: it stands in the first that acts, the others refer to it."""
    acting = [number for number, finding in enumerate(findings) if finding.acts]
    return [
        replace(f, advice=ALSO) if number in acting[1:] else f
        for number, f in enumerate(findings)
    ]


LEAST_LEVER_M = 0.05
"""A turn of 0.2 rad/s makes 0.01 m/s of it, the noise of a good Doppler log."""
LEAST_BIAS_RAD_S = 1e-4
"""The Earth's rotation, 7.3e-5 rad/s, may be in the bias."""
AXES = "xyz"
ARM, BIAS = "lever arm from IMU to DVL", "gyro bias"


def lever_findings(found: DvlMatch, calibration: Calibration) -> list[Finding]:
    """One row for each axis; a single row where no axis is known.

    The arm is a difference of two places, and nothing tells which of them is wrong.
    """
    if not any(estimate.is_known for estimate in found.lever):
        return [Finding(ARM, found.lever[0], "m", "")]
    given, wrong = _arm_and_error(found, calibration)
    imu, dvl = (
        calibration.imu.mounting.translation_m,
        calibration.dvl.mounting.translation_m,
    )
    line = (
        f"`imu.mounting.translation_m = {numbers(np.subtract(imu, wrong), 3)}` {IN_CALIBRATION} or, if that place "
        f"is sure, `dvl.mounting.translation_m = {numbers(np.add(dvl, wrong), 3)}`"
    )
    rows = []
    for axis, estimate, of_calibration, error in zip(
        AXES, found.lever, given, wrong, strict=True
    ):
        advice = f"the calibration's {of_calibration:+.2f} m fits, {NO_NEED}"
        if error:
            advice = f"not the calibration's {of_calibration:+.2f} m: {line}"
        rows.append(Finding(f"{ARM}, {axis}", estimate, "m", advice, bool(error)))
    return said_once(rows)


def with_fitted(found: DvlMatch, calibration: Calibration) -> Calibration:
    """Calibration with the changes that the findings advise: place of the IMU, sigma of the gyro bias."""
    imu = calibration.imu
    place = np.subtract(
        imu.mounting.translation_m, _arm_and_error(found, calibration)[1]
    )
    moved = imu.mounting.model_copy(update={"translation_m": tuple(place.tolist())})
    sigma = (
        _largest(found.gyro_bias)
        if any(_is_beyond(e, imu) for e in found.gyro_bias)
        else imu.gyro_bias_sigma
    )
    changed = imu.model_copy(update={"mounting": moved, "gyro_bias_sigma": sigma})
    return calibration.model_copy(update={"imu": changed})


def bias_findings(
    bias: Estimates3D, sources: tuple[str, str, str], imu: ImuCalibration
) -> list[Finding]:
    """One row for each body axis with its source, such as "from 12 s of rest"; a single row where no axis is known."""
    if not any(estimate.is_known for estimate in bias):
        return [Finding(BIAS, bias[0], "rad/s", "")]
    rows, allowed = [], imu.gyro_bias_sigma
    for axis, estimate, source in zip(AXES, bias, sources, strict=True):
        acts = _is_beyond(estimate, imu)
        advice = (
            f"{source}; the calibration's sigma of {allowed:.2g} allows it, {NO_NEED}"
        )
        if acts:
            advice = (
                f"{source}, beyond the calibration's sigma of {allowed:.2g}: "
                f"`imu.gyro_bias_sigma = {_largest(bias):.2g}` {IN_CALIBRATION}, for estimators that find the bias"
            )
        rows.append(Finding(f"{BIAS}, {axis}", estimate, "rad/s", advice, acts))
    return said_once(rows)


def _is_beyond(bias: Estimate1D, imu: ImuCalibration) -> bool:
    return matters(
        replace(bias, sigma=float(np.hypot(bias.sigma, imu.gyro_bias_sigma))),
        LEAST_BIAS_RAD_S,
    )


def _largest(bias: Estimates3D) -> float:
    return max(
        (abs(estimate.value) for estimate in bias if estimate.is_known), default=0.0
    )


def _arm_and_error(found: DvlMatch, calibration: Calibration) -> tuple[Floats, Floats]:
    """The calibration's arm and its error, shapes (3,), m; error 0 along an axis on which nothing need be done."""
    given = np.subtract(
        calibration.dvl.mounting.translation_m, calibration.imu.mounting.translation_m
    )
    errors = [
        replace(e, value=e.value - g)
        for e, g in zip(found.lever, given.tolist(), strict=True)
    ]
    return given, np.array(
        [error.value if matters(error, LEAST_LEVER_M) else 0.0 for error in errors]
    )


def turned_mounting(dvl: DvlCalibration, yaw_rad: float) -> tuple[float, float, float]:
    """Roll, pitch and yaw of the mounting after a turn about the body's z axis."""
    before = Rotation.from_euler("ZYX", dvl.mounting.rpy_rad[::-1])
    yaw, pitch, roll = (
        (Rotation.from_euler("z", yaw_rad) * before).as_euler("ZYX").tolist()
    )
    return roll, pitch, yaw


def numbers(values: Iterable[float], digits: int) -> str:
    """A list of numbers as TOML has it."""
    return f"[{', '.join(f'{value:.{digits}f}' for value in values)}]"


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
    """Alignment at the start of a log, or the reason why there is none."""

    tilt: InitialTilt | None
    said: str
    """Source, such as "from 20 s of rest", or the reason why there is none."""
    is_rest: bool = False

    def angle(self, axis: int) -> Estimate1D:
        """Roll (0) or pitch (1), rad."""
        if self.tilt is None:
            return Estimate1D(np.nan, np.inf, self.said)
        value = (self.tilt.roll_rad, self.tilt.pitch_rad)[axis]
        return Estimate1D(value, float(np.sqrt(self.tilt.covariance[axis, axis])))

    def gyro_bias(self) -> Estimates3D | None:
        """Bias from a rest; None in motion, where the whole drive tells more than its first minute."""
        if self.tilt is None or not self.is_rest:
            return None
        sigmas = np.sqrt(np.diag(self.tilt.covariance)[2:]).tolist()
        x, y, z = map(Estimate1D, self.tilt.gyro_bias.tolist(), sigmas)
        return x, y, z


def find_start_tilt(sequence: Sequence) -> StartTilt:
    """Alignment at rest if the vehicle rests at the start, else in motion, of a log with the other faults corrected."""
    if np.isnan(sequence.imu.specific_force).all():
        return StartTilt(None, "no accelerometers")
    found = StartTilt(None, "no rows")
    for rest_s in RESTS_S:
        imu, dvl = _beginning(sequence, rest_s)
        if imu is None:
            break
        try:
            tilt = align_at_rest(imu, sequence.calibration, dvl)
        except AlignmentError as error:
            found = (
                found
                if found.tilt is not None
                else StartTilt(None, _without_advice(error))
            )
            break
        lasted_s = (imu.stamps_ns[-1] - imu.stamps_ns[0]) / NS_PER_S
        found = StartTilt(tilt, f"from {lasted_s:.0f} s of rest", is_rest=True)
        if (turned := turn_by_heading(sequence.heading, imu, tilt)) is not None:
            found = StartTilt(
                turned, f"{found.said}, less the turn of the heading", is_rest=True
            )
    if found.tilt is not None:
        return found
    imu, dvl = _beginning(sequence, LONGEST_S)
    if imu is None or dvl is None:
        return found
    imu = until_hole(imu)
    try:
        tilt = align_in_motion(imu, dvl, sequence.calibration)
    except AlignmentError as error:
        return StartTilt(
            None, f"at rest: {found.said}; in motion: {_without_advice(error)}"
        )
    except np.linalg.LinAlgError:
        return StartTilt(
            None, f"at rest: {found.said}; in motion: the calibration's noise is zero"
        )
    return StartTilt(
        tilt,
        f"from {(imu.stamps_ns[-1] - imu.stamps_ns[0]) / NS_PER_S:.0f} s in motion",
    )


def turn_by_heading(
    heading: Heading | None, imu: Imu, tilt: InitialTilt
) -> InitialTilt | None:
    """Alignment at rest whose gyro bias is without a turn that the heading confirms; None where it confirms none.

    A vehicle that turns slowly and steadily looks like one at rest whose gyros have a bias. The heading's rate, by
    least squares over the rest, counts where it is most of that of the gyros about the vertical, and four of its sigmas
    (as if all of its scatter were one slow wave).
    """
    rows = (
        None
        if heading is None
        else heading.between(int(imu.stamps_ns[0]) - 1, int(imu.stamps_ns[-1]))
    )
    if rows is None or len(rows) < FEWEST_HEADINGS:
        return None
    t = (rows.stamps_ns - rows.stamps_ns.mean()) * 1e-9
    yaw_rad = np.unwrap(rows.yaw_rad) - np.unwrap(rows.yaw_rad).mean()
    rate = float(t @ yaw_rad / (t @ t))
    sigma = 2.0 * float(np.std(yaw_rad - rate * t)) / float(np.ptp(t))
    roll, pitch = tilt.roll_rad, tilt.pitch_rad
    up = np.array(
        [-np.sin(pitch), np.sin(roll) * np.cos(pitch), np.cos(roll) * np.cos(pitch)]
    )
    by_gyros = float(up @ tilt.gyro_bias)
    rate = float(np.copysign(rate, by_gyros))  # also of a compass that runs mirrored
    if abs(rate) < 4.0 * sigma or abs(rate - by_gyros) > 0.5 * abs(by_gyros):
        return None
    covariance = tilt.covariance.copy()
    covariance[2:, 2:] += sigma**2 * np.outer(up, up)
    return replace(tilt, gyro_bias=tilt.gyro_bias - rate * up, covariance=covariance)


def tilt_findings(found: StartTilt, start: Start, yaw_rad: float) -> list[Finding]:
    """One row each for roll and pitch, and a line for the calibration with this heading; a single row without them."""
    if found.tilt is None:
        return [Finding("start roll and pitch", found.angle(0), "°", "")]
    given, sigmas = start.rpy_rad, [float(found.angle(axis).sigma) for axis in (0, 1)]
    line = (
        f"`start.rpy_rad = {numbers((found.angle(0).value, found.angle(1).value, yaw_rad), 4)}`, "
        f"`start.rpy_sigma_rad = [{sigmas[0]:.2g}, {sigmas[1]:.2g}, {start.rpy_sigma_rad[2]:.2g}]` {IN_CALIBRATION}"
    )
    rows = []
    for axis, name in enumerate(("roll", "pitch")):
        told, of_calibration = (
            found.angle(axis),
            f"the calibration's {np.degrees(given[axis]):+.2f}°",
        )
        sigma = float(np.hypot(told.sigma, start.rpy_sigma_rad[axis]))
        acts = matters(
            replace(told, value=wrap_angle(told.value - given[axis]), sigma=sigma),
            LEAST_TILT_RAD,
        )
        advice = (
            f"{found.said}, not {of_calibration}: {line}"
            if acts
            else f"{found.said}; {of_calibration} fits, {NO_NEED}"
        )
        rows.append(
            Finding(f"start {name}: value", in_degrees(told), "°", advice, acts)
        )
    return said_once(rows)


@dataclass(frozen=True, eq=False)
class StartHeading:
    """Pose of the reference at the start, and error of the calibration's heading."""

    rpy_rad: tuple[float, float, float]
    position_m: tuple[float, float, float]
    error: Estimate1D
    """Rad."""

    @property
    def acts(self) -> bool:
        """True where the calibration's heading should be changed."""
        return matters(self.error, LEAST_HEADING_RAD)

    def finding(self, tilt: StartTilt) -> Finding:
        """The row, with roll and pitch of the alignment if known, so that rows agree; else those of the reference."""
        advice = NO_NEED
        if self.acts:
            rpy = (
                (tilt.angle(0).value, tilt.angle(1).value, self.rpy_rad[2])
                if tilt.tilt
                else self.rpy_rad
            )
            of_tilt = f", with roll and pitch {tilt.said}" if tilt.tilt else ""
            advice = (
                f"the calibration's start heading is wrong; by the reference, its stamps put right{of_tilt}: "
                f"`start.rpy_rad = {numbers(rpy, 4)}`, `start.position_m = {numbers(self.position_m, 2)}` "
                f"{IN_CALIBRATION}; the position too is the reference's, so that both are of one pose"
            )
        return Finding(
            "start heading: error", in_degrees(self.error), "°", advice, self.acts
        )


def find_start_heading(
    sequence: Sequence, reference: Trajectory, offset: Estimate1D
) -> StartHeading:
    """Compare the calibration's start with the reference at that instant, its stamps corrected by an offset in s."""
    first_ns, last_ns = reference.stamps_ns[[0, -1]].tolist()
    at_ns = min(
        max(sequence.start_ns - round(offset.value * NS_PER_S), first_ns), last_ns
    )
    pose = reference.at(np.array([at_ns]))
    yaw, pitch, roll = pose.rotations().as_euler("ZYX")[0].tolist()
    x, y, z = pose.positions[0].tolist()
    error = wrap_angle(sequence.calibration.start.rpy_rad[2] - yaw)
    begin_ns, end_ns = (
        max(at_ns - TURN_OVER_NS // 2, first_ns),
        min(at_ns + TURN_OVER_NS // 2, last_ns),
    )
    turn_rate = 0.0
    if end_ns > begin_ns:
        begin, end = reference.at(np.array([begin_ns, end_ns])).rotations()
        turn_rate = (
            float((begin.inv() * end).magnitude()) * NS_PER_S / (end_ns - begin_ns)
        )
    spread = float(np.hypot(LEAST_SPREAD_RAD, turn_rate * offset.sigma))
    return StartHeading((roll, pitch, yaw), (x, y, z), Estimate1D(error, spread))


def _beginning(sequence: Sequence, seconds: float) -> tuple[Imu | None, Dvl | None]:
    before_ns = sequence.start_ns - 1
    until_ns = sequence.start_ns + round(seconds * NS_PER_S)
    return sequence.imu.between(before_ns, until_ns), sequence.dvl.between(
        before_ns, until_ns
    )


def _without_advice(error: AlignmentError) -> str:
    """The finding of an error; other rows have the advice."""
    return str(error).partition(";")[0]
