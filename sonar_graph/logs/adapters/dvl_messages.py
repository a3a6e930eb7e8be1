"""Adapters for Doppler velocity logs, and for other messages whose velocity stands for one.

A beam that leaves the instrument at a tilt t from its vertical and an azimuth a (from x towards y) has the direction::

    d = [sin t cos a, sin t sin a, cos t]    with z along the instrument's vertical, down

and measures the velocity d . v. Three beams or more give v by least squares (`sonar_graph.devices.dvl_beams`,
docs/theory/beams.md).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any, Literal

import numpy as np
from pydantic import Field, model_validator

from sonar_graph.devices import velocity_of_beams
from sonar_graph.logs.adapters.adapter import (
    Adapter,
    CovarianceFields,
    FieldPath,
    FieldPaths,
    PathSection,
    Setup,
    SpeedScale,
    turn,
    turn_covariances,
)
from sonar_graph.logs.adapters.message_table import (
    NOT_FINITE,
    FieldTable,
    Fit,
    Mask,
    fit_block,
    not_finite,
    share,
)
from sonar_graph.measurements import Dvl, Floats

FEWEST_BEAMS = 3
"""Beams needed for a velocity."""


class BeamGeometry(PathSection):
    """Velocities along the beams, from which that of the vehicle is computed."""

    velocity: FieldPath
    """Array field with one velocity a beam, positive along the beam."""
    valid: FieldPath | None = None
    """Array field that is 0 where a beam is not to be used."""
    tilt_deg: float = Field(gt=0, lt=90)
    """Angle between beams and the instrument's vertical: 30 (RDI), 25 (Nortek), 22.5 (Water Linked)."""
    azimuth_deg: tuple[float, ...] = Field(min_length=FEWEST_BEAMS)
    """Of each beam, from x towards y of the driver's axes (z down): [45, -45, -135, 135] for a Janus turned by 45."""

    def directions(self) -> Floats:
        """Unit vectors, shape (beams, 3), z down."""
        tilt = np.radians(self.tilt_deg)
        azimuth = np.radians(self.azimuth_deg)
        across = np.sin(tilt) * np.column_stack([np.cos(azimuth), np.sin(azimuth)])
        return np.column_stack([across, np.full(len(azimuth), np.cos(tilt))])

    def velocities(self, table: FieldTable) -> tuple[Floats, Mask]:
        """Velocities along the driver's axes, shape (n, 3), and rows with too few beams, shape (n,)."""
        along = table.column(self.velocity).astype(float)  # (n, beams)
        count = len(self.azimuth_deg)
        if along.shape[1:] != (count,):
            fault = f"has {along.shape[1:]} beams; azimuth_deg has {count}"
            table.refuse(self.velocity, fault)
        is_valid = np.isfinite(along)
        if self.valid is not None:
            marks = table.column(self.valid)
            if marks.shape != along.shape:
                fault = f"has {marks.shape[1:]} elements; there are {count} beams"
                table.refuse(self.valid, fault)
            is_valid &= marks.astype(bool)
        # with one noise for all beams its size does not matter
        velocity, _ = velocity_of_beams(self.directions(), along, is_valid, 1.0)
        return velocity, is_valid.sum(axis=1) < FEWEST_BEAMS


LARGEST_SPEED_M_S = 30.0
"""Speed beyond which equal components are a sentinel: PD0 has -32.768 m/s for "not measured"."""
STEP_RATIO = 5.0
"""Factor of a step to zero over the usual steps of the velocity, from which zeros are no measurement."""
LEAST_STEP_M_S = 0.05
"""Steps below this are no sign: at such speeds a row of zeros does little harm."""
FEWEST_STEPS = 10
"""Fewest steps from which usual ones are known."""
LEAST_CHANGING = 0.9
"""Share of the axes that change where a velocity is not repeated."""
LEAST_REPEATED = 0.2
"""Share of rows, and of values, that a driver repeats which holds velocities between measurements."""
SAID_INVALID = "with a covariance that says invalid"
ZEROS = "with a velocity of 0 in one step"
SENTINEL = "with one value beyond 30 m/s in all components"
REPEATED = "that repeat the velocity before"
FEW_BEAMS = f"with fewer than {FEWEST_BEAMS} good beams"
NO_BEAM = "without a good beam"
ACCEPTING = {
    ZEROS: "are_zeros_measured = true",
    SENTINEL: 'lock = "marked"',
    REPEATED: 'lock = "signs"',
    FEW_BEAMS: "good_beams = false",
    NO_BEAM: "good_beams = false",
    SAID_INVALID: 'covariance = {negative = "unknown", zero = "unknown"}',
}
"""Settings that use messages which were left out, by the reason."""
Number = bool | int | float
Masks = dict[str, Mask]


class DvlAdapter(Adapter):
    """Velocity over the bottom in the instrument's frame."""

    velocity: FieldPaths | None = None
    """Fields of the velocity along x, y, z; not used with `beams`."""
    scale: SpeedScale = 1.0
    """Turns it into m/s; 0.001 or "mm/s" from mm/s, -1 where the driver gives the bottom's velocity."""
    covariance: CovarianceFields | None = None
    """Of the velocity, before `scale`; without it the calibration's noise holds."""
    valid_where: Mapping[FieldPath | str, Number] = {}
    """Fields, each with its value in messages to be used: {velocity_mode = 1}."""
    may_be_unfilled: tuple[str, ...] = ()
    """Fields that some drivers never fill: where one is 0 in every message, it does not count."""
    good_beams: FieldPath | None = None
    """Field that counts good beams; messages with none are left out."""
    altitude: FieldPath | None = None
    """Field that is negative without bottom lock. It counts where `valid_where` is the same in all messages."""
    are_zeros_measured: bool = False
    """true: a velocity of exactly 0 is measured also where it comes in one step, as without bottom lock."""
    lock: Literal["found", "marked", "signs"] = "found"
    """Who decides on bottom lock: "marked": `valid_where` alone; "signs": also beams, `altitude` and sentinels of each
    message; "found": `valid_where` where it differs between messages, else the signs, zeros and repeats."""
    beams: BeamGeometry | None = None
    """Velocities along the beams, for a driver that gives no other."""

    @model_validator(mode="after")
    def _has_a_velocity(self) -> DvlAdapter:
        if self.velocity is None and self.beams is None:
            raise ValueError(
                "give velocity = [x, y, z] fields, or beams with a velocity field"
            )
        return self

    def read(self, table: FieldTable, setup: Setup) -> Fit[Dvl]:  # noqa: ARG002  # of all adapters
        """The rows with a valid velocity; a covariance that is not known is NaN."""
        velocity, faults = self._velocity(table)
        covariance = np.full((len(table), 3, 3), np.nan)
        if self.covariance is not None:
            covariance, faults[SAID_INVALID] = self.covariance.read(table)
            covariance = covariance * self.scale**2
        faults |= self._marked_invalid(table)
        faults[NOT_FINITE] = not_finite(velocity)
        faults |= self._signs_of_no_lock(table, velocity)
        velocity = turn(self.rotation, velocity)
        covariance = turn_covariances(self.rotation, covariance)
        return fit_block(Dvl, table.stamps_ns, faults, velocity, covariance)

    def _velocity(self, table: FieldTable) -> tuple[Floats, Masks]:
        """Velocity in m/s along the driver's axes, shape (n, 3), and masks of rows without one, by the reason."""
        if self.beams is None:
            return table.beside(self.velocity or ()) * self.scale, {}
        velocity, is_few = self.beams.velocities(table)
        fault = f"with fewer than {FEWEST_BEAMS} valid beams"
        return velocity * self.scale, {fault: is_few}

    def _is_filled(self, table: FieldTable, path: str) -> bool:
        """True where the driver fills a field, as far as it may be unfilled."""
        return path not in self.may_be_unfilled or bool(table.column(path).any())

    def _filled(self, table: FieldTable) -> Masks:
        """Masks of valid messages by the fields of `valid_where` that the driver fills."""
        return {
            path: table.column(path) == value
            for path, value in self.valid_where.items()
            if self._is_filled(table, path)
        }

    def _is_marked(self, table: FieldTable) -> bool:
        """True where the driver marks some messages as valid and others as invalid."""
        return self.lock == "marked" or any(
            valid.any() and not valid.all() for valid in self._filled(table).values()
        )

    def _marked_invalid(self, table: FieldTable) -> Masks:
        """Masks of messages that their driver marks as invalid, by the reason."""
        faults = {
            f"with {path} not {str(self.valid_where[path]).lower()}": ~is_valid
            for path, is_valid in self._filled(table).items()
        }
        # a mark and a count do not exclude each other
        if self.good_beams is not None and self._is_filled(table, self.good_beams):
            faults[NO_BEAM] = table.column(self.good_beams) == 0
        return faults

    def _signs_of_no_lock(self, table: FieldTable, velocity: Floats) -> Masks:
        """Masks of messages that look sent without bottom lock, by the reason, where no field marks them."""
        faults: Masks = {}
        if not self._is_marked(table):
            if self.good_beams is not None:
                beams = table.column(self.good_beams)
                is_good = beams >= FEWEST_BEAMS
                is_few = (beams > 0) & ~is_good
                faults[FEW_BEAMS] = is_few & self._may_count(is_good)
            if self.altitude is not None:
                altitude_m = table.column(self.altitude)
                is_below = (altitude_m < 0) & self._may_count(altitude_m > 0)
                faults[f"with {self.altitude} below 0"] = is_below
            # sentinels fill all axes alike
            is_same = (velocity == velocity[:, :1]).all(axis=1)
            faults[SENTINEL] = is_same & (np.abs(velocity[:, 0]) > LARGEST_SPEED_M_S)
            if self.lock == "found" and not self.are_zeros_measured:
                faults[ZEROS] = _in_time(zeros_in_one_step, table, velocity)
        # a habit shows in many messages, not in a single one
        if self.lock == "found":
            faults[REPEATED] = _in_time(repeats, table, velocity)
        return faults

    def _may_count(self, is_good: Mask) -> bool:
        """True where a sign counts: the driver fills its field, since some message is good by it."""
        return self.lock == "signs" or bool(is_good.any())

    def with_marks_alone(self) -> DvlAdapter:
        """Adapter for velocities that were chosen before, as those in a log of `write_log`."""
        lock = "marked" if self.lock == "found" else self.lock
        return self.model_copy(update={"lock": lock})

    def accepts(self, fault: str) -> str | None:
        """Setting with which messages that are left out for a fault are used; None without one."""
        if fault.endswith("below 0"):
            return "altitude = false"
        if fault.startswith("with ") and " not " in fault and fault != NOT_FINITE:
            return "valid_where = {}"
        return ACCEPTING.get(fault) or super().accepts(fault)

    def at_first(self) -> DvlAdapter:
        """Adapter for the first messages of a live run, where a mode that is 0 in all of them may still come."""
        flags = tuple(
            path
            for path in self.may_be_unfilled
            if self.valid_where.get(path, True) is True
        )
        return self.model_copy(update={"may_be_unfilled": flags})

    def pinned(self, table: FieldTable) -> dict[str, Any]:
        """Settings by which single messages are read as all messages of a table are together."""
        settings: dict[str, Any] = {
            "valid_where": {
                path: self.valid_where[path] for path in self._filled(table)
            },
            "may_be_unfilled": [],
        }
        can_count = True
        if self.good_beams is not None:
            beams = table.column(self.good_beams)
            if not beams.any():
                settings["good_beams"] = False
            can_count = not beams.any() or bool((beams >= FEWEST_BEAMS).any())
        if self.altitude is not None and not (table.column(self.altitude) > 0).any():
            settings["altitude"] = False
        if self.covariance is not None:
            settings["covariance"] = self.covariance.pinned(table).model_dump()
        # a count that never reached three beams would leave out everything
        is_by_signs = can_count and not self._is_marked(table)
        return settings | {"lock": "signs" if is_by_signs else "marked"}

    def warnings(self, table: FieldTable) -> Iterator[str]:
        """Warnings about fields that mark no message, messages left out by other signs, and covariances."""
        filled = self._filled(table)
        unfilled = [path for path in self.valid_where if path not in filled]
        if unfilled and not filled:
            yield f"{' and '.join(unfilled)} are 0 in every message: taken as not filled, all messages as bottom track"
        velocity, _ = self._velocity(table)
        for reason, has_it in self._signs_of_no_lock(table, velocity).items():
            if has_it.any():
                yield (
                    f"{share(has_it)} messages {reason}: left out; "
                    f"`{self.accepts(reason)}` under [dvl] in a log configuration uses them"
                )
        if self.covariance is not None:
            yield from self.covariance.warnings(table)


def _in_time(
    rule: Callable[[Floats], Mask], table: FieldTable, velocity: Floats
) -> Mask:
    """Mask by a rule for rows in the order of their stamps, since messages may be recorded out of order."""
    order = np.argsort(table.stamps_ns, kind="stable")
    found = np.empty(len(order), bool)
    found[order] = rule(velocity[order])
    return found


def zeros_in_one_step(velocity: Floats) -> Mask:
    """Rows of zeros, shape (n,), that the velocity reaches or leaves by a step which no vehicle makes.

    A vehicle slows down over several rows. A driver without bottom lock sends zeros from one row to the next, and the
    step is `STEP_RATIO` times the 99 % quantile of the steps between rows with a velocity.
    """
    is_zero = ~np.any(velocity, axis=1)
    step_m_s = np.linalg.norm(np.diff(velocity, axis=0), axis=1)
    # steps to and from zeros would raise the limit that is to find them
    usual_m_s = step_m_s[~is_zero[1:] & ~is_zero[:-1] & np.isfinite(step_m_s)]
    if not is_zero.any() or len(usual_m_s) < FEWEST_STEPS:
        return np.zeros(len(velocity), bool)
    limit_m_s = max(STEP_RATIO * np.quantile(usual_m_s, 0.99), LEAST_STEP_M_S)
    is_change = is_zero[1:] != is_zero[:-1]
    run = np.concatenate([[0], np.cumsum(is_change)])  # of zeros, or of others, (n,)
    jumps = np.flatnonzero(is_change & (step_m_s > limit_m_s))
    return is_zero & np.isin(run, [run[jumps], run[jumps + 1]])


def repeats(velocity: Floats) -> Mask:
    """Rows, shape (n,), that repeat the velocity of the row before, where the driver does so all the time.

    Such a driver publishes at its own rate, or once for each of two reports of the instrument, and holds the velocity
    between. A sensor that got stuck once repeats one value, which is not the driver's habit. A coarse sensor repeats
    rows too, and changes along single axes.
    """
    is_equal = (velocity[1:] == velocity[:-1]).all(axis=1) & velocity[1:].any(axis=1)
    is_same = np.concatenate([[False], is_equal])
    # runs of equal rows, which a habit makes often and a fault once
    lengths = np.diff([*np.flatnonzero(~is_same), len(velocity)])
    shares = (is_same.mean(), (lengths > 1).mean())
    is_habit = min(shares) >= LEAST_REPEATED and len(lengths) >= FEWEST_STEPS
    changes = np.diff(velocity, axis=0)[~is_equal] != 0
    changing_axes = changes[:, changes.any(axis=0)]
    # a velocity that never changes has no such axis, and no mean
    is_habit &= changing_axes.size > 0 and bool(changing_axes.mean() >= LEAST_CHANGING)
    return is_same & is_habit
