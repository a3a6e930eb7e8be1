"""How a velocity is had between two Doppler samples: our two rules, and those of others.

=============== ====================================== ================================ ==============================
rule            velocity between samples a and b       rotation that turns it           whose
=============== ====================================== ================================ ==============================
inertial        through both samples, in between the   at every IMU sample              ours, with an accelerometer
                shape that the accelerometer felt
linear          linear from a to b, in the body        at every IMU sample              ours, gyro and Doppler alone
hold-previous   that of a                              at every IMU sample              AQUA-SLAM
zoh-previous    that of a                              in the middle of the interval    coug_fgo, tight integrator
zoh-current     that of b                              at the end of the interval       TURTLMap
trapezoid       mean of a and b                        in the middle of the interval    sonar-SLAM's dead reckoning
=============== ====================================== ================================ ==============================

The last four are here to be compared with. A hold is late or early by half an interval, which costs half of it times
the change of velocity over the motion.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Literal, NamedTuple

DopplerRule = Literal["inertial", "linear", "hold-previous", "zoh-previous", "zoh-current", "trapezoid"]


class Turning(IntEnum):
    """Which rotation turns a velocity into frame i."""

    EVERY_SAMPLE = 0
    MIDDLE = 1
    END = 2


class Rule(NamedTuple):
    """A row of the table, for compiled code."""

    inertial: bool
    """Whether the accelerometer shapes the velocity between samples."""
    interpolated: bool
    """Whether the later sample's share grows from 0 to 1 over the interval."""
    share: float
    """The later sample's share where it is constant."""
    turning: int


RULES: dict[DopplerRule, Rule] = {
    "inertial": Rule(True, False, 0.5, Turning.EVERY_SAMPLE.value),
    "linear": Rule(False, True, 0.5, Turning.EVERY_SAMPLE.value),
    "hold-previous": Rule(False, False, 0.0, Turning.EVERY_SAMPLE.value),
    "zoh-previous": Rule(False, False, 0.0, Turning.MIDDLE.value),
    "zoh-current": Rule(False, False, 1.0, Turning.END.value),
    "trapezoid": Rule(False, False, 0.5, Turning.MIDDLE.value),
}
