"""Findings of the sensor check: what is wrong, by how much, what it does to results, and the line that mends it.

One type serves all checks, so that commands print, sort and store them alike. docs/theory/sensor_check.md.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any

import numpy as np

from sonar_graph.logs.adapters import LogConfig
from sonar_graph.measurements import Floats
from sonar_graph.navigation.alignment import Estimate1D

INTERVAL_SIGMAS = 1.96
"""Half width of printed intervals, 95 %."""
ACTING_SIGMAS = 4.5
"""A log has some twenty numbers: of faultless logs fewer than one in a thousand needs an action by chance."""
NO_NEED = "no need to act"
ALSO = "put right by the line above"
IN_CALIBRATION = "in the calibration (--calibration FILE)"
IN_LOG_CONFIG = "in the log configuration (--log-config FILE)"


class Gravity(IntEnum):
    """What a finding calls for, the worst last."""

    FINE = 0
    """Nothing need be done, or the quantity is unknown."""
    ACT = 1
    """A line should be written."""
    GRAVE = 2
    """A sensor contradicts another beyond doubt, so that results are doubtful."""


@dataclass(frozen=True)
class Finding:
    """One quantity with its uncertainty, and what follows.

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
    """Size of the quantity, or the reason why it is unknown."""
    unit: str = ""
    cause: str = ""
    """What is wrong; where nothing is, what the value was compared with."""
    consequence: str = ""
    """Size of the error that it makes."""
    line: str = ""
    """Line to write, and the file that it belongs to."""
    gravity: Gravity = Gravity.FINE

    @property
    def acts(self) -> bool:
        """True where something should be done."""
        return self.gravity > Gravity.FINE

    @property
    def grave(self) -> bool:
        """True where results are doubtful."""
        return self.gravity is Gravity.GRAVE

    @property
    def advice(self) -> str:
        """Cause, consequence and line as a sentence."""
        reason = ", ".join(filter(None, (self.cause, self.consequence)))
        if not (reason and self.line):
            return reason or self.line
        return f"{reason}{'' if reason.endswith('?') else ':'} {self.line}"

    def text(self) -> str:
        """Value with its 95 % interval and the advice; or the reason why it is not known."""
        if self.estimate.is_known:
            return f"{with_interval(self.estimate, self.unit)}: {self.advice}"
        return self.advice if self.acts else f"cannot be told: {self.estimate.reason}"

    def plain(self) -> dict[str, Any]:
        """Content for JSON."""
        known = self.estimate.is_known
        return {
            "quantity": self.quantity,
            "value": self.estimate.value if known else None,
            "sigma": self.estimate.sigma if known else None,
            "unit": self.unit,
            "reason": self.estimate.reason,
            "act": self.acts,
            "grave": self.grave,
            "cause": self.cause,
            "consequence": self.consequence,
            "line": self.line,
            "advice": self.advice,
        }


Findings = list[Finding]


def gravity_of(is_grave: bool) -> Gravity:
    """Of a finding to act on."""
    return Gravity.GRAVE if is_grave else Gravity.ACT


def contradiction(
    quantity: str,
    cause: str,
    line: str,
    estimate: Estimate1D | str,
    unit: str = "",
    consequence: str = "",
) -> Finding:
    """A grave finding; without a number a word instead of the estimate."""
    if isinstance(estimate, str):
        estimate = unknown(estimate)
    return Finding(quantity, estimate, unit, cause, consequence, line, Gravity.GRAVE)


def judged(
    row: Finding,
    error: Estimate1D,
    least: float,
    *,
    allowed: float = 0.0,
    large: float = np.inf,
    fits: str = NO_NEED,
) -> Finding:
    """The row itself where an error matters, grave where it is large; else only what fits.

    ``error``: of the value that the calibration or the log has; ``least``: error from which on results change;
    ``allowed``: sigma by which the calibration allows it.
    """
    # a row that needs no action keeps its number, so that a user sees what was compared
    if not matters(error, least, allowed):
        return replace(row, cause=fits, consequence="", line="")
    return replace(row, gravity=gravity_of(abs(error.value) > large))


unknown = Estimate1D.unknown
"""A number that is not known, for a reason."""


def known_values(estimates: Iterable[Estimate1D]) -> Floats:
    """The numbers, with 0 for those that are not known."""
    return np.array([one.value if one.is_known else 0.0 for one in estimates])


def with_interval(estimate: Estimate1D, unit: str) -> str:
    """Value and 95 % interval, with the digits that the interval supports."""
    half = INTERVAL_SIGMAS * estimate.sigma
    if unit.startswith(("rad/s", "m/s")):
        return f"{estimate.value:.2g} ± {half:.1g} {unit}"
    # two digits of the interval: further ones of the value are noise
    digits = int(np.clip(1 - np.floor(np.log10(half)), 0, 8)) if half > 0 else 3
    sign = "+" if unit else ""
    return f"{estimate.value:{sign}.{digits}f} ± {half:.{digits}f} {unit}".rstrip()


def in_degrees(angle: Estimate1D) -> Estimate1D:
    """An angle converted from radians."""
    value_deg = np.degrees(angle.value)
    return replace(angle, value=value_deg, sigma=np.degrees(angle.sigma))


def matters(estimate: Estimate1D, least: float, allowed: float = 0.0) -> bool:
    """True for an estimate above a threshold and beyond `ACTING_SIGMAS`, its own and the ``allowed`` sigma together."""
    sigma = np.hypot(estimate.sigma, allowed)
    return bool(
        estimate.is_known and abs(estimate.value) > max(least, ACTING_SIGMAS * sigma)
    )


def worst_first(findings: Iterable[Finding]) -> Findings:
    """Grave findings, then those to act on, then the others; each in the order in which to act."""
    # a stable sort keeps the order in which to act
    return sorted(findings, key=lambda finding: -finding.gravity)


def notes_of(findings: Iterable[Finding]) -> dict[str, str]:
    """Notes for a sequence, the findings to act on, worst first: grave ones under ``log.doubtful``."""
    texts: dict[str, list[str]] = {"log.doubtful": [], "log.sensors": []}
    for finding in worst_first(findings):
        if finding.acts:
            subject = "log.doubtful" if finding.grave else "log.sensors"
            texts[subject].append(f"{finding.quantity}: {finding.text()}")
    return {subject: "; ".join(lines) for subject, lines in texts.items() if lines}


def said_once(findings: Findings) -> Findings:
    """Findings that share one line: the first that acts has it, the others refer to it."""
    shown = Findings()
    for finding in findings:
        # a line for three axes is one line to write
        is_repeated = finding.acts and any(before.acts for before in shown)
        also = replace(finding, cause=ALSO, consequence="", line="")
        shown.append(also if is_repeated else finding)
    return shown


def numbers(values: Iterable[float], digits: int) -> str:
    """A list of numbers as TOML has it."""
    # + 0.0 takes the sign off a zero
    rounded = (round(float(value), digits) + 0.0 for value in values)
    return f"[{', '.join(f'{value:.{digits}f}' for value in rounded)}]"


def signed_axes(P: np.ndarray) -> list[str]:
    """Rows of a permutation with signs as names, such as ``["x", "-y", "z"]``."""
    largest = np.argmax(np.abs(P), axis=1).tolist()
    return [
        ("-" if row[axis] < 0 else "") + "xyz"[axis]
        for row, axis in zip(P, largest, strict=True)
    ]


@dataclass(frozen=True)
class Advice:
    """What may be wrong, and the line that mends it."""

    cause: str
    line: str


def scale_line(role: str, key: str, config: LogConfig, gain: float) -> str:
    """Line that divides a configured scale by a gain."""
    # the line replaces the configured number, which the rows were read with
    scale = config.number(role, key, 1.0) / gain
    return f"`{key} = {scale:.4g}` under [{role}] {IN_LOG_CONFIG}"


def shift_line(role: str, config: LogConfig, shift_s: float) -> str:
    """Line that adds to a configured offset of stamps."""
    total_s = config.number(role, "stamp_offset_s", 0.0) + shift_s
    return f"`stamp_offset_s = {total_s:.3f}` under [{role}] {IN_LOG_CONFIG}"


def unused(role: str) -> str:
    """Line that leaves a sensor out."""
    return f"`use = false` under [{role}] {IN_LOG_CONFIG}"


def other_world(config: LogConfig, role: str) -> str:
    """The world that is not the configured one, as a setting."""
    is_ned = config.table(role).get("world", "enu") == "ned"
    return f'`world = "{"enu" if is_ned else "ned"}"` under [{role}] {IN_LOG_CONFIG}'
