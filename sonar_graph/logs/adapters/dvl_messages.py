"""Adapters for Doppler velocity logs, and for other messages whose velocity stands for one.

A beam that leaves the instrument at a tilt t from its vertical and an azimuth a (from x towards y) has the direction::

    d = [sin t cos a, sin t sin a, cos t]    with z along the instrument's vertical, down

and measures the velocity d . v. Three beams or more give v by least squares, fewer the part of it that they measured
(`sonar_graph.devices.dvl_beams`, docs/theory/beams.md).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from sonar_graph.calibration import Section
from sonar_graph.devices import velocity_of_beams
from sonar_graph.logs.adapters.adapter import (
    Adapter,
    CovarianceFields,
    SpeedScale,
    field_paths,
    turn,
    turn_covariances,
)
from sonar_graph.logs.adapters.message_table import (
    NOT_FINITE,
    Dropped,
    FieldTable,
    fit_rows,
    not_finite,
)
from sonar_graph.measurements import Dvl, Floats

LARGEST_TILT_DEG = 45.0
"""Largest tilt of beams in use; 20 to 30 degrees are usual."""
TOLERANCE_DEG = 3.0
"""Difference allowed between published and configured directions."""
FEWEST_BEAMS = 3
"""Beams needed for a velocity."""


class BeamGeometry(Section):
    """Directions of the beams, and their fields where the velocity is to be computed from them."""

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
        tilt, azimuth = np.radians(self.tilt_deg), np.radians(self.azimuth_deg)
        across, down = np.sin(tilt), np.full(azimuth.shape, np.cos(tilt))
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


def beam_direction_fault(vectors: Floats, geometry: BeamGeometry | None) -> str | None:
    """Fault of published beam directions, shape (beams, 3); None: there is none, or nothing was published.

    One driver, and one that copies it, publish z = sin(22.5°) where a beam tilted by 22.5° has cos(22.5°). Published
    directions are never used; where velocities come from beams, the configured directions are.
    """
    if not np.isfinite(vectors).all() or not vectors.any():
        return None
    across, down = np.hypot(vectors[:, 0], vectors[:, 1]), np.abs(vectors[:, 2])
    if (
        np.allclose(across, down, atol=1e-3)
        and across.max() < np.sin(np.radians(LARGEST_TILT_DEG)) - 1e-2
    ):
        tilt_deg = float(np.degrees(np.arcsin(down)).mean())
        return (
            f"have z = {down.mean():.3f}, the sine of the tilt of {tilt_deg:.1f}°, where its cosine "
            f"{np.cos(np.radians(tilt_deg)):.3f} should be"
        )
    lengths = np.linalg.norm(vectors, axis=1)
    if np.any(np.abs(lengths - 1) > 1e-2):
        return (
            f"are no unit vectors (length {lengths.min():.3f} to {lengths.max():.3f})"
        )
    tilt_deg = float(np.degrees(np.arccos(np.clip(down, 0, 1))).max())
    if tilt_deg > LARGEST_TILT_DEG:
        return (
            f"are tilted by {tilt_deg:.1f}°, which no Doppler log is: the driver seems to publish the sine of "
            f"{90 - tilt_deg:.1f}° as z, where its cosine should be"
        )
    if geometry is None:
        return None
    if abs(tilt_deg - geometry.tilt_deg) > TOLERANCE_DEG:
        return f"are tilted by {tilt_deg:.1f}°, the configured beams by {geometry.tilt_deg:g}°"
    if geometry.velocity is None:
        return None
    if len(vectors) != len(geometry.azimuth_deg):
        return f"are {len(vectors)}, the configured beams {len(geometry.azimuth_deg)}"
    # z may point up or down
    configured = geometry.directions() * np.sign(vectors[:, 2:]) ** np.array([0, 0, 1])
    off_deg = np.degrees(np.arccos(np.clip((configured * vectors).sum(axis=1), -1, 1)))
    beam = int(off_deg.argmax())
    if off_deg[beam] <= TOLERANCE_DEG:
        return None
    return f"and the configured ones differ by up to {off_deg[beam]:.0f}° (beam {beam}); check azimuth_deg"


Number = bool | int | float
SAID_INVALID = "with a covariance that says invalid"


class DvlAdapter(Adapter):
    """Velocity over the bottom in the instrument's frame."""

    velocity: tuple[str, str, str] | None = None
    """Fields of the velocity along x, y, z; not used where `beams` have a velocity."""
    scale: SpeedScale = 1.0
    """Turns it into m/s; 0.001 or "mm/s" from mm/s, -1 where the driver gives the bottom's velocity."""
    covariance: CovarianceFields | None = None
    """Of the velocity, before `scale`; without it the calibration's noise holds."""
    valid_where: Mapping[str, Number] = {}
    """Fields, each with its value in messages to be used: {velocity_mode = 1}."""
    good_beams: str | None = None
    """Field that counts good beams; messages with none are left out, where the driver counts at all."""
    are_beams_counted: bool = False
    """true: the driver counts, so that messages with none are left out even where no message has any."""
    beams: BeamGeometry | None = None
    """Directions of the beams."""
    beam_unit_vectors: tuple[str, str, str] | None = None
    """Array fields with x, y, z of each beam's direction: only checked, because drivers get them wrong. Velocities come
    from the directions of `beams`."""
    beam_ranges: str | None = None
    """Array field with a range for each beam: only checked."""
    beam_ranges_valid: str | None = None
    """Field that says whether ranges are valid: only checked, because drivers leave it true."""
    sound_speed: str | None = None
    """Field with the speed of sound, m/s: only checked, because drivers leave it 0."""

    @model_validator(mode="after")
    def _has_a_velocity(self) -> DvlAdapter:
        if self.velocity is None and (
            self.beams is None or self.beams.velocity is None
        ):
            raise ValueError(
                "give velocity = [x, y, z] fields, or beams with a velocity field"
            )
        return self

    def fields(self) -> Iterator[str]:
        """Paths that a message must have."""
        checked = (
            self.beam_ranges,
            self.beam_ranges_valid,
            self.sound_speed,
            self.beam_unit_vectors,
        )
        beams = (self.beams.velocity, self.beams.valid) if self.beams else ()
        covariance = self.covariance.fields if self.covariance else None
        return field_paths(
            self.velocity,
            covariance,
            self.valid_where,
            self.good_beams,
            *checked,
            *beams,
        )

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
            velocity = table.beside(self.velocity)
            velocity = velocity if self.scale == 1 else velocity * self.scale
            covariance = np.full((len(table), 3, 3), np.nan)
        if self.covariance is not None and not self._is_noise_of_beams:
            covariance, faults[SAID_INVALID] = self.covariance.read(table)
            covariance = covariance if self.scale == 1 else covariance * self.scale**2
        for path, value in self.valid_where.items():
            faults[f"with {path} not {str(value).lower()}"] = (
                table.column(path) != value
            )
        if self.good_beams is not None:
            beams = table.column(self.good_beams)
            faults["without a good beam"] = (beams == 0) & (
                self.are_beams_counted or beams.any()
            )
        faults[NOT_FINITE] = not_finite(velocity)
        rows, dropped = fit_rows(table.stamps_ns, faults, unique=True)
        velocity, covariance = (
            turn(self.rotation, velocity[rows]),
            turn_covariances(self.rotation, covariance[rows]),
        )
        return (
            Dvl(table.stamps_ns[rows], velocity, covariance) if rows.size else None
        ), dropped

    @property
    def _is_noise_of_beams(self) -> bool:
        """Tell whether the covariance follows from the beams, not from a field of the message."""
        return (
            self.beams is not None
            and self.beams.velocity is not None
            and self.beams.sigma_m_s is not None
        )

    def warnings(self, table: FieldTable) -> Iterator[str]:
        """Warnings about covariances, beam directions, ranges and the speed of sound that a driver gets wrong."""
        if self.covariance is not None and not self._is_noise_of_beams:
            yield from self.covariance.warnings(table)
        if self.beam_unit_vectors is not None:
            vectors = np.stack(
                [table.column(path)[0] for path in self.beam_unit_vectors], axis=-1
            )
            if fault := beam_direction_fault(vectors, self.beams):
                field = self.beam_unit_vectors[0].rpartition(".")[0]
                yield f"{table.source}: {field}: beam directions {fault}; they are not used"
        if self.sound_speed is not None and not table.column(self.sound_speed).any():
            yield f"{self.sound_speed} is 0 in every message: the driver does not fill it"
        if self.beam_ranges is not None and self.beam_ranges_valid is not None:
            ranges, said = (
                table.column(self.beam_ranges),
                table.column(self.beam_ranges_valid).astype(bool),
            )
            wrong = said & ~(np.isfinite(ranges) & (ranges > 0)).all(axis=1)
            if wrong.any():
                yield f"{self.beam_ranges_valid} is true in {wrong.sum()} messages that have a range of 0 or less"
