"""Roll, pitch and heading at the start of a log, against the start that its calibration gives.

Roll and pitch come with the gyro bias from a rest at the start or, where the vehicle moves there, from its first minute
(docs/theory/alignment.md). A heading comes from a reference alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sonar_graph.calibration import Start
from sonar_graph.errors import AlignmentError
from sonar_graph.evaluation.finding import NO_NEED, Finding, in_degrees, matters, said_once
from sonar_graph.measurements import Dvl, Imu
from sonar_graph.navigation.dvl_against_imu import Estimates3D
from sonar_graph.navigation.initial_tilt import InitialTilt
from sonar_graph.navigation.moving_alignment import LONGEST_S, align_in_motion, until_hole
from sonar_graph.navigation.offset_search import Estimate1D
from sonar_graph.navigation.still_alignment import align_at_rest
from sonar_graph.sequence import NS_PER_S, Sequence
from sonar_graph.states import Trajectory

RESTS_S = (10, 20, 40, 80, 160)
"""A rest at the start is taken as the longest of these that holds; a shorter one tells less than a minute's motion."""
LEAST_TILT_RAD = np.radians(0.25)
LEAST_HEADING_RAD = np.radians(1.0)
"""What is smaller changes nothing that other errors would not hide."""
TURN_OVER_NS = NS_PER_S
LEAST_SPREAD_RAD = np.radians(0.1)


@dataclass(frozen=True)
class StartTilt:
    """An alignment at the start of a log, or why there is none."""

    tilt: InitialTilt | None
    said: str
    """From what it is, such as "from 20 s of rest"; why there is none."""
    is_rest: bool = False

    def angle(self, axis: int) -> Estimate1D:
        """Roll (0) or pitch (1), rad."""
        if self.tilt is None:
            return Estimate1D(np.nan, np.inf, self.said)
        value = (self.tilt.roll_rad, self.tilt.pitch_rad)[axis]
        return Estimate1D(value, float(np.sqrt(self.tilt.covariance[axis, axis])))

    def gyro_bias(self) -> Estimates3D | None:
        """From a rest; in motion the whole drive tells more than its first minute."""
        if self.tilt is None or not self.is_rest:
            return None
        sigmas = np.sqrt(np.diag(self.tilt.covariance)[2:]).tolist()
        x, y, z = map(Estimate1D, self.tilt.gyro_bias.tolist(), sigmas)
        return x, y, z


def find_start_tilt(sequence: Sequence) -> StartTilt:
    """At rest if the vehicle rests at the start, else in motion.

    Parameters
    ----------
    sequence
        With stamps, mountings and scale put right as far as they are known to be wrong.
    """
    found = _at_rest(sequence)
    if found.tilt is not None:
        return found
    imu, dvl = _beginning(sequence, LONGEST_S)
    if imu is None or dvl is None:
        return found
    imu = until_hole(imu)
    try:
        tilt = align_in_motion(imu, dvl, sequence.calibration)
    except AlignmentError as error:
        return StartTilt(None, f"at rest: {found.said}; in motion: {_without_advice(error)}")
    except np.linalg.LinAlgError:
        return StartTilt(None, f"at rest: {found.said}; in motion: the calibration's noise is zero")
    return StartTilt(tilt, f"from {(imu.stamps_ns[-1] - imu.stamps_ns[0]) / NS_PER_S:.0f} s in motion")


def tilt_findings(found: StartTilt, start: Start, yaw_rad: float) -> list[Finding]:
    """Roll and pitch in a row each, and the line for the calibration with this heading; one row if there are none."""
    if found.tilt is None:
        return [Finding("start roll and pitch", found.angle(0), "°", "")]
    given, sigmas = start.rpy_rad, [float(found.angle(axis).sigma) for axis in (0, 1)]
    line = (
        f"`start.rpy_rad = [{found.angle(0).value:.4f}, {found.angle(1).value:.4f}, {yaw_rad:.4f}]`, "
        f"`start.rpy_sigma_rad = [{sigmas[0]:.2g}, {sigmas[1]:.2g}, {start.rpy_sigma_rad[2]:.2g}]` in the calibration"
    )
    rows = []
    for axis, name in enumerate(("roll", "pitch")):
        of_calibration, acts = f"the calibration's {np.degrees(given[axis]):+.2f}°", _contradicts(found, start, axis)
        advice = (
            f"{found.said}, not {of_calibration}: {line}" if acts else f"{found.said}; {of_calibration} fits, {NO_NEED}"
        )
        rows.append(Finding(f"start {name}", in_degrees(found.angle(axis)), "°", advice, acts))
    return said_once(rows)


def _contradicts(found: StartTilt, start: Start, axis: int) -> bool:
    told = found.angle(axis)
    sigma = float(np.hypot(told.sigma, start.rpy_sigma_rad[axis]))
    return matters(replace(told, value=_wrapped(told.value - start.rpy_rad[axis]), sigma=sigma), LEAST_TILT_RAD)


@dataclass(frozen=True, eq=False)
class StartHeading:
    """The reference's pose at the start, and by how much the calibration's heading is off."""

    rpy_rad: tuple[float, float, float]
    position_m: tuple[float, float, float]
    error: Estimate1D
    """Rad."""

    @property
    def acts(self) -> bool:
        """Whether the calibration's heading should be changed."""
        return matters(self.error, LEAST_HEADING_RAD)

    def finding(self, tilt: StartTilt) -> Finding:
        """A row, with roll and pitch of the alignment, so that no row contradicts another; else the reference's."""
        advice = NO_NEED
        if self.acts:
            rpy = (tilt.angle(0).value, tilt.angle(1).value, self.rpy_rad[2]) if tilt.tilt else self.rpy_rad
            of_tilt = f", with roll and pitch {tilt.said}" if tilt.tilt else ""
            turns = ", ".join(f"{angle:.4f}" for angle in rpy)
            place = ", ".join(f"{metres:.2f}" for metres in self.position_m)
            advice = (
                f"the start heading is wrong; by the reference, its stamps put right{of_tilt}: "
                f"`start.rpy_rad = [{turns}]`, `start.position_m = [{place}]` in the calibration"
            )
        return Finding("start heading of the calibration", in_degrees(self.error), "°", advice, self.acts)


def find_start_heading(sequence: Sequence, reference: Trajectory, offset: Estimate1D) -> StartHeading:
    """The calibration's start against the reference at that instant.

    Parameters
    ----------
    sequence
        As for `find_start_tilt`.
    offset
        To be added to the reference's stamps, s.
    """
    first_ns, last_ns = reference.stamps_ns[[0, -1]].tolist()
    at_ns = min(max(sequence.start_ns - round(offset.value * NS_PER_S), first_ns), last_ns)
    pose = reference.at(np.array([at_ns]))
    yaw, pitch, roll = pose.rotations().as_euler("ZYX")[0].tolist()
    x, y, z = pose.positions[0].tolist()
    error = _wrapped(sequence.calibration.start.rpy_rad[2] - yaw)
    spread = float(np.hypot(LEAST_SPREAD_RAD, _turn_rate(reference, at_ns) * offset.sigma))
    return StartHeading((roll, pitch, yaw), (x, y, z), Estimate1D(error, spread))


def _turn_rate(reference: Trajectory, at_ns: int) -> float:
    """About an instant, or as near to it as the reference lasts, rad/s."""
    first_ns, last_ns = reference.stamps_ns[[0, -1]].tolist()
    begin_ns, end_ns = max(at_ns - TURN_OVER_NS // 2, first_ns), min(at_ns + TURN_OVER_NS // 2, last_ns)
    if end_ns <= begin_ns:
        return 0.0
    begin, end = reference.at(np.array([begin_ns, end_ns])).rotations()
    return float((begin.inv() * end).magnitude()) * NS_PER_S / (end_ns - begin_ns)


def _wrapped(angle_rad: float) -> float:
    return float(np.angle(np.exp(1j * angle_rad)))


def _beginning(sequence: Sequence, seconds: float) -> tuple[Imu | None, Dvl | None]:
    before_ns = sequence.start_ns - 1
    until_ns = sequence.start_ns + round(seconds * NS_PER_S)
    return sequence.imu.between(before_ns, until_ns), sequence.dvl.between(before_ns, until_ns)


def _at_rest(sequence: Sequence) -> StartTilt:
    """The longest rest, or what speaks against the shortest."""
    found = StartTilt(None, "no rows")
    for rest_s in RESTS_S:
        imu, dvl = _beginning(sequence, rest_s)
        if imu is None:
            break
        try:
            tilt = align_at_rest(imu, sequence.calibration, dvl)
        except AlignmentError as error:
            return found if found.tilt is not None else StartTilt(None, _without_advice(error))
        lasted_s = (imu.stamps_ns[-1] - imu.stamps_ns[0]) / NS_PER_S
        found = StartTilt(tilt, f"from {lasted_s:.0f} s of rest", is_rest=True)
    return found


def _without_advice(error: AlignmentError) -> str:
    """What was found; what to do about it is said in other rows."""
    return str(error).partition(";")[0]
