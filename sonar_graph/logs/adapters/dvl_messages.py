"""Adapters for Doppler velocity logs, and for other messages whose velocity stands for one.

A beam that leaves the instrument at a tilt t from its vertical and an azimuth a (from x towards y) has the direction::

    d = [sin t cos a, sin t sin a, cos t]    with z along the instrument's vertical, down

and measures the velocity d . v. Three beams or more give v by least squares, fewer the part of it that they measured
(`sonar_graph.devices.dvl_beams`, docs/theory/beams.md).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from sonar_graph.devices import velocity_of_beams
from sonar_graph.logs.adapters.adapter import (
    Adapter,
    CovarianceFields,
    PathSection,
    SpeedScale,
    turn,
    turn_covariances,
)
from sonar_graph.logs.adapters.message_table import (
    NOT_FINITE,
    Dropped,
    FieldTable,
    fit_block,
    not_finite,
    share,
)
from sonar_graph.measurements import Dvl, Floats, Ints

FEWEST_BEAMS = 3
"""Beams needed for a velocity."""


class BeamGeometry(PathSection):
    """Directions of the beams, and their fields where the velocity is to be computed from them."""

    PATHS = ("velocity", "valid")

    tilt_deg: float = Field(gt=0, lt=90)
    """Angle between beams and the instrument's vertical: 30 (RDI), 25 (Nortek), 22.5 (Water Linked)."""
    azimuth_deg: tuple[float, ...] = Field(min_length=3)
    """Of each beam, from x towards y of the driver's axes (z down): [45, -45, -135, 135] for a Janus turned by 45."""
    velocity: str | None = None
    """Array field with one velocity a beam, positive along the beam; none: the driver's own velocity is used."""
    valid: str | None = None
    """Array field that is 0 where a beam is not to be used."""
    sigma_m_s: float | None = Field(None, gt=0)
    """White noise of the velocity along one beam. With it one or two valid beams are used
    too, and every covariance follows from the beams; none: three beams are needed, and the adapter's `covariance` or
    the calibration says how good they are."""

    def directions(self) -> Floats:
        """Unit vectors, shape (beams, 3), z down."""
        tilt = np.radians(self.tilt_deg)
        azimuth = np.radians(self.azimuth_deg)
        across = np.sin(tilt)
        down = np.full(azimuth.shape, np.cos(tilt))
        return np.column_stack(
            [across * np.cos(azimuth), across * np.sin(azimuth), down]
        )

    def velocities(
        self, table: FieldTable, scale: float
    ) -> tuple[Floats, Floats, NDArray[np.int64]]:
        """Velocities from the valid beams of each row, along the driver's axes; ``scale`` turns the field into m/s.

        Shape (n, 3), NaN with too few beams; their covariances, shape (n, 3, 3), NaN without `sigma_m_s`; and the
        numbers of valid beams, shape (n,).
        """
        along = table.column(str(self.velocity)).astype(float)
        if along.shape[1:] != (len(self.azimuth_deg),):
            table.refuse(
                str(self.velocity),
                f"has {along.shape[1:]} beams; azimuth_deg has {len(self.azimuth_deg)}",
            )
        valid = np.isfinite(along)
        if self.valid is not None:
            said = table.column(self.valid)
            if said.shape != along.shape:
                table.refuse(
                    self.valid,
                    f"has {said.shape[1:]} elements; there are {along.shape[1]} beams",
                )
            valid &= said.astype(bool)
        velocity, covariance = velocity_of_beams(
            self.directions(), along * scale, valid, self.sigma_m_s or 1.0
        )
        count = valid.sum(axis=1)
        # fewer beams leave a direction unmeasured, and its variance is unknown
        velocity[count < self.fewest] = np.nan
        return (
            velocity,
            covariance if self.sigma_m_s else np.full_like(covariance, np.nan),
            count,
        )

    @property
    def fewest(self) -> int:
        """Number of beams that a row needs."""
        return 1 if self.sigma_m_s else FEWEST_BEAMS


LARGEST_SPEED_M_S = 30.0
"""Speed beyond which equal components are a sentinel: PD0 has -32.768 m/s for "not measured"."""
STEP_RATIO = 5.0
"""Factor of a step to zero over the usual steps of the velocity, from which zeros are no measurement."""
LEAST_STEP_M_S = 0.05
"""Steps below this are no sign: at such speeds a row of zeros does little harm."""
FEWEST_STEPS = 10
"""Fewest steps from which usual ones are known."""
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


class DvlAdapter(Adapter):
    """Velocity over the bottom in the instrument's frame."""

    PATHS = (
        "velocity",
        "covariance",
        "valid_where",
        "good_beams",
        "altitude",
        "beams",
    )

    velocity: tuple[str, str, str] | None = None
    """Fields of the velocity along x, y, z; not used where `beams` have a velocity."""
    scale: SpeedScale = 1.0
    """Turns it into m/s; 0.001 or "mm/s" from mm/s, -1 where the driver gives the bottom's velocity."""
    covariance: CovarianceFields | None = None
    """Of the velocity, before `scale`; without it the calibration's noise holds."""
    valid_where: Mapping[str, Number] = {}
    """Fields, each with its value in messages to be used: {velocity_mode = 1}."""
    may_be_unfilled: tuple[str, ...] = ()
    """Fields of `valid_where` that some drivers never fill: where one is 0 in every message, it does not count."""
    good_beams: str | None = None
    """Field that counts good beams; messages with none are left out, where the driver counts at all."""
    altitude: str | None = None
    """Field that is negative without bottom lock. It counts where `valid_where` is the same in all messages."""
    are_zeros_measured: bool = False
    """true: a velocity of exactly 0 is measured also where it comes in one step, as without bottom lock."""
    lock: Literal["found", "marked", "signs"] = "found"
    """Who decides on bottom lock: "marked": `valid_where` alone; "signs": also beams, `altitude` and sentinels of each
    message; "found": `valid_where` where it differs between messages, else the signs, zeros and repeats."""
    are_beams_counted: bool = False
    """true: the driver counts, so that messages with none are left out even where no message has any."""
    beams: BeamGeometry | None = None
    """Directions of the beams."""

    @model_validator(mode="after")
    def _has_a_velocity(self) -> DvlAdapter:
        if self.velocity is None and (
            self.beams is None or self.beams.velocity is None
        ):
            raise ValueError(
                "give velocity = [x, y, z] fields, or beams with a velocity field"
            )
        return self

    def read(self, table: FieldTable) -> tuple[Dvl | None, Dropped]:
        """The rows with a valid velocity, or with part of one from beams; a covariance that is not known is NaN."""
        faults: dict[str, NDArray[np.bool_]] = {}
        if self.beams is not None and self.beams.velocity is not None:
            velocity, covariance, count = self.beams.velocities(table, self.scale)
            fewest = self.beams.fewest
            faults[
                "without a valid beam"
                if fewest == 1
                else f"with fewer than {fewest} valid beams"
            ] = count < fewest
        else:
            assert self.velocity is not None  # by the validator
            velocity = table.beside(self.velocity) * self.scale
            covariance = np.full((len(table), 3, 3), np.nan)
        if self.covariance is not None and not self._is_noise_of_beams:
            covariance, faults[SAID_INVALID] = self.covariance.read(table)
            covariance = covariance * self.scale**2
        faults |= self._marked_invalid(table)
        faults[NOT_FINITE] = not_finite(velocity)
        faults |= self._signs_of_no_lock(table, velocity)
        velocity = turn(self.rotation, velocity)
        covariance = turn_covariances(self.rotation, covariance)
        return fit_block(Dvl, table.stamps_ns, faults, velocity, covariance)

    def _filled(self, table: FieldTable) -> dict[str, NDArray[np.bool_]]:
        """Masks of valid messages by the fields of `valid_where` that the driver fills."""
        columns = {path: table.column(path) for path in self.valid_where}
        # a field that is 0 in every message carries no mark
        is_unfilled = {
            path: path in self.may_be_unfilled and not column.any()
            for path, column in columns.items()
        }
        return {
            path: column == self.valid_where[path]
            for path, column in columns.items()
            if not is_unfilled[path]
        }

    def _is_marked(self, table: FieldTable) -> bool:
        """Tell whether the driver marks some messages as valid and others as invalid."""
        return self.lock == "marked" or any(
            valid.any() and not valid.all() for valid in self._filled(table).values()
        )

    def _marked_invalid(self, table: FieldTable) -> dict[str, NDArray[np.bool_]]:
        """Masks of messages that their driver marks as invalid, by the reason."""
        faults = {
            f"with {path} not {str(self.valid_where[path]).lower()}": ~valid
            for path, valid in self._filled(table).items()
        }
        if self.good_beams is not None:
            # 0 beams in all messages: the driver does not count
            beams = table.column(self.good_beams)
            faults[NO_BEAM] = (beams == 0) & (self.are_beams_counted or beams.any())
        return faults

    def _signs_of_no_lock(
        self, table: FieldTable, velocity: Floats
    ) -> dict[str, NDArray[np.bool_]]:
        """Masks of messages that look sent without bottom lock, by the reason, where no field marks them."""
        faults: dict[str, NDArray[np.bool_]] = {}
        if not self._is_marked(table):
            if self.good_beams is not None:
                beams = table.column(self.good_beams)
                faults[FEW_BEAMS] = (
                    (beams > 0)
                    & (beams < FEWEST_BEAMS)
                    & self._may_count(beams >= FEWEST_BEAMS)
                )
            if self.altitude is not None:
                altitude_m = table.column(self.altitude)
                faults[f"with {self.altitude} below 0"] = (
                    altitude_m < 0
                ) & self._may_count(altitude_m > 0)
            # sentinels fill all axes alike
            is_same = (velocity == velocity[:, :1]).all(axis=1)
            faults[SENTINEL] = is_same & (np.abs(velocity[:, 0]) > LARGEST_SPEED_M_S)
            if self.lock == "found" and not self.are_zeros_measured:
                faults[ZEROS] = zeros_in_one_step(velocity, table.stamps_ns)
        if self.lock == "found":
            faults[REPEATED] = repeats(velocity, table.stamps_ns)
        return faults

    def _may_count(self, is_good: NDArray[np.bool_]) -> bool:
        """Tell whether a sign counts: the driver fills its field, since some message is good by it."""
        return self.lock == "signs" or bool(is_good.any())

    def with_marks_alone(self) -> DvlAdapter:
        """Adapter for velocities that were chosen before, as those in a log of `write_log`."""
        return (
            self.model_copy(update={"lock": "marked"}) if self.lock == "found" else self
        )

    def accepts(self, fault: str) -> str | None:
        """Setting with which messages that are left out for a fault are used; None: there is none."""
        if fault.endswith("below 0"):
            return "altitude = false"
        if fault.startswith("with ") and " not " in fault and fault != NOT_FINITE:
            return "valid_where = {}"
        return ACCEPTING.get(fault) or super().accepts(fault)

    def at_first(self) -> DvlAdapter:
        """Adapter for the first messages of a live run, where a mode that is 0 in all of them may still come."""
        flags = tuple(
            path for path in self.may_be_unfilled if self.valid_where.get(path) is True
        )
        return self.model_copy(update={"may_be_unfilled": flags})

    def pinned(self, table: FieldTable) -> dict[str, Any]:
        """Settings by which single messages are read as all messages of a table are together."""
        filled = self._filled(table)
        settings: dict[str, Any] = {
            "valid_where": {
                path: value
                for path, value in self.valid_where.items()
                if path in filled
            },
            "may_be_unfilled": [],
        }
        can_count = True
        if self.good_beams is not None:
            beams = table.column(self.good_beams)
            settings |= (
                {"are_beams_counted": True} if beams.any() else {"good_beams": False}
            )
            can_count = not beams.any() or bool((beams >= FEWEST_BEAMS).any())
        if self.altitude is not None and not (table.column(self.altitude) > 0).any():
            settings["altitude"] = False
        if self.covariance is not None and not self._is_noise_of_beams:
            settings["covariance"] = self.covariance.pinned(table).model_dump()
        settings["lock"] = (
            "signs" if can_count and not self._is_marked(table) else "marked"
        )
        return settings

    @property
    def _is_noise_of_beams(self) -> bool:
        """Tell whether the covariance follows from the beams, not from a field of the message."""
        return (
            self.beams is not None
            and self.beams.velocity is not None
            and self.beams.sigma_m_s is not None
        )

    def warnings(self, table: FieldTable) -> Iterator[str]:
        """Warnings about validity and covariances."""
        yield from self._validity_warnings(table)
        if self.covariance is not None and not self._is_noise_of_beams:
            yield from self.covariance.warnings(table)

    def _validity_warnings(self, table: FieldTable) -> Iterator[str]:
        """Warnings about fields that mark no message, and about messages left out by other signs."""
        filled = self._filled(table)
        unfilled = [path for path in self.valid_where if path not in filled]
        if unfilled and not filled:
            yield f"{' and '.join(unfilled)} are 0 in every message: taken as not filled, all messages as bottom track"
        if self.velocity is None:
            return
        velocity = table.beside(self.velocity) * self.scale
        for reason, has_it in self._signs_of_no_lock(table, velocity).items():
            if has_it.any():
                yield (
                    f"{share(has_it)} messages {reason}: left out; "
                    f"`{self.accepts(reason)}` under [dvl] in a log configuration uses them"
                )


def zeros_in_one_step(velocity: Floats, stamps_ns: Ints) -> NDArray[np.bool_]:
    """Rows of zeros, shape (n,), that the velocity reaches or leaves by a step which no vehicle makes.

    A vehicle slows down over several rows. A driver without bottom lock sends zeros from one row to the next, and the
    step is `STEP_RATIO` times the 99 % quantile of the steps between rows with a velocity.
    """
    # messages may be recorded out of order
    order = np.argsort(stamps_ns, kind="stable")
    v = velocity[order]
    is_zero: NDArray[np.bool_] = np.asarray(~v.any(axis=1))
    step_m_s = np.linalg.norm(np.diff(v, axis=0), axis=1)
    # steps to and from zeros would raise the limit that is to find them
    is_usual = ~is_zero[1:] & ~is_zero[:-1] & np.isfinite(step_m_s)
    found = np.zeros(len(v), bool)
    if not is_zero.any() or np.count_nonzero(is_usual) < FEWEST_STEPS:
        return found
    limit_m_s = max(
        STEP_RATIO * float(np.quantile(step_m_s[is_usual], 0.99)), LEAST_STEP_M_S
    )
    is_jump = (is_zero[1:] != is_zero[:-1]) & (step_m_s > limit_m_s)
    first = np.flatnonzero(is_zero & ~np.concatenate([[False], is_zero[:-1]]))
    last = np.flatnonzero(is_zero & ~np.concatenate([is_zero[1:], [False]]))
    for begin, end in zip(first, last, strict=True):
        found[begin : end + 1] = (
            is_jump[max(begin - 1, 0) : begin].any() or is_jump[end : end + 1].any()
        )
    in_file = np.empty(len(v), bool)
    in_file[order] = found
    return in_file


def repeats(velocity: Floats, stamps_ns: Ints) -> NDArray[np.bool_]:
    """Rows, shape (n,), that repeat the velocity of the row before, where the driver does so all the time.

    Such a driver publishes at its own rate, or once for each of two reports of the instrument, and holds the velocity
    between. A sensor that got stuck once repeats one value, which is not the driver's habit.
    """
    order = np.argsort(stamps_ns, kind="stable")
    v = velocity[order]
    is_same = np.concatenate(
        [[False], (v[1:] == v[:-1]).all(axis=1) & v[1:].any(axis=1)]
    )
    in_file = np.zeros(len(v), bool)
    # runs of equal rows, which a habit makes often and a fault once
    lengths = np.diff([*np.flatnonzero(~is_same), len(v)])
    if (
        np.mean(is_same) < LEAST_REPEATED
        or np.mean(lengths > 1) < LEAST_REPEATED
        or len(lengths) < FEWEST_STEPS
    ):
        return in_file
    in_file[order] = is_same
    return in_file
