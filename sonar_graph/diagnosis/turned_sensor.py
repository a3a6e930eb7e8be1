"""Which of IMU and Doppler log is turned: gravity and accelerations fit both alike.

A turn of the Doppler log, and the opposite one of the IMU, differ only in where the vehicle's axes are. About the
vertical, sensors with axes of their own decide: sightings of landmarks, or the course by position fixes from a known
heading at the start. A heading may come from the turned IMU itself: it decides only where it agrees with the Doppler log.
About level axes a stated start decides, from which gravity differs where the IMU is turned.
"""

from dataclasses import dataclass, replace

import numpy as np

from sonar_graph.diagnosis.aiding_check import POSITIONS, RANGE
from sonar_graph.diagnosis.findings import (
    IN_CALIBRATION,
    Finding,
    contradiction,
    numbers,
)
from sonar_graph.diagnosis.motion_signals import BodyMotion
from sonar_graph.diagnosis.signals import CLEARLY_BETTER
from sonar_graph.diagnosis.start import find_start_tilt, turned_mounting
from sonar_graph.measurements import Floats
from sonar_graph.models import wrap_angle
from sonar_graph.navigation.alignment import Estimate1D
from sonar_graph.sequence import Sequence

EITHER = "the Doppler log or the IMU, no other sensor shows which"
NEAR = 1 / 3
"""Share of the turn within which a course counts as right; the other candidate is off by all of it."""


@dataclass(frozen=True, eq=False)
class TurnedPair:
    """IMU and Doppler log that are turned against each other."""

    sequence: Sequence
    turn_rad: Floats
    """Turn of the Doppler log that would make them agree: a rotation vector along the body's axes, shape (3,)."""

    def as_if(self, role: str) -> Sequence:
        """The sequence with the mounting of one of them, ``dvl`` or ``imu``, put right."""
        calibration = self.sequence.calibration
        section = getattr(calibration, role)
        turned = section.mounting.model_copy(update={"rpy_rad": self.rpy_rad(role)})
        section = section.model_copy(update={"mounting": turned})
        right = calibration.model_copy(update={role: section})
        return replace(self.sequence, calibration=right)

    def rpy_rad(self, role: str) -> tuple[float, float, float]:
        """Angles of the mounting of one of them after its turn."""
        before = getattr(self.sequence.calibration, role).mounting
        return turned_mounting(
            before, self.turn_rad if role == "dvl" else -self.turn_rad
        )

    def wrong_one(self) -> str:
        """``dvl`` or ``imu``; empty where nothing else decides."""
        # other sensors show a turn about the vertical, gravity one about a level axis
        if self.turn_rad[:2].any():
            return self.wrong_one_by_start()
        # with the right one turned back, ranges to landmarks fit better
        scatters = dict[str, float]()
        for role in ("dvl", "imu"):
            right = self.as_if(role)
            motion = BodyMotion.of(right)
            if motion is None:
                return ""
            is_sure = role == "imu" or right.calibration.start.states("rpy_rad")
            if is_sure and self.is_near_course(right, motion):
                return role
            ranges = RANGE.compare(right, motion)
            if ranges is not None and ranges.gain.is_known:
                scatters[role] = ranges.scatter
        if len(scatters) < 2:
            return ""
        best, worst = sorted(scatters, key=scatters.__getitem__)
        is_clear = scatters[worst] > CLEARLY_BETTER * scatters[best]
        return best if is_clear else ""

    def wrong_one_by_start(self) -> str:
        """The one whose turn brings gravity to a stated start; empty without one, or where neither clearly does."""
        start = self.sequence.calibration.start
        if not start.states("rpy_rad"):
            return ""
        off_rad = dict[str, float]()
        for role in ("dvl", "imu"):
            found = find_start_tilt(self.as_if(role))
            if found.tilt is None:
                return ""
            roll = wrap_angle(found.tilt.roll_rad - start.rpy_rad[0])
            pitch = found.tilt.pitch_rad - start.rpy_rad[1]
            off_rad[role] = np.hypot(roll, pitch)
        best, worst = sorted(off_rad, key=off_rad.__getitem__)
        # a start that is tilted as much as the pair is turned may have been read off a turned IMU
        is_tilted = np.hypot(*start.rpy_rad[:2]) > 0.5 * np.linalg.norm(self.turn_rad)
        if best == "dvl" and is_tilted:
            return ""
        return best if off_rad[best] < NEAR * off_rad[worst] else ""

    def is_near_course(self, right: Sequence, motion: BodyMotion) -> bool:
        """True where the fixes move from the start as the heading there and the Doppler log have it."""
        start = right.calibration.start
        if right.heading is None and not start.states("rpy_rad"):
            return False
        course = POSITIONS.compare(right, motion)
        if course is None or not course.angle.is_known or course.is_mirrored:
            return False
        sigma = np.hypot(course.angle.sigma, start.rpy_sigma_rad[2])
        off_rad = abs(wrap_angle(course.angle.value - start.rpy_rad[2]))
        return bool(off_rad + 2 * sigma < NEAR * float(np.linalg.norm(self.turn_rad)))

    def finding(self, quantity: str, estimate: Estimate1D, cause: str) -> Finding:
        """A grave finding with the line for the one that is turned, or for either."""
        role = self.wrong_one()
        who = {"dvl": "the Doppler log", "imu": "the IMU"}.get(role, f"{EITHER},")
        lines = {
            name: f"`{name}.mounting.rpy_rad = {numbers(self.rpy_rad(name), 4)}`"
            for name in ("dvl", "imu")
        }
        line = f"{lines[role or 'dvl']} {IN_CALIBRATION}"
        if not role:
            line += f" or, if that mounting is sure, {lines['imu']}"
        return contradiction(
            quantity.replace("DVL", "IMU") if role == "imu" else quantity,
            f"{cause}: {who} is turned on the vehicle, or its driver has other axes",
            line,
            estimate,
            "°" if estimate.is_known else "",
        )

    def corrected(self) -> Sequence:
        """The sequence with the wrong mounting put right; that of the Doppler log where nothing decides."""
        return self.as_if(self.wrong_one() or "dvl")
