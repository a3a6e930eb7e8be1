"""Measurements as columnar blocks of n >= 1 rows, one class for each kind of sensor.

A live caller passes blocks of one row, a replay passes all rows between two instants: the same code, without a
Python call for every IMU sample. `Measurements` bundles what arrived since the last call, for an estimator to process.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields
from functools import cache
from itertools import pairwise
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from sonar_graph.errors import MeasurementError

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
NS_PER_S = 1_000_000_000
PAUSE_NS = 86_400 * NS_PER_S
"""A day. No log pauses so long: between rows farther apart a clock was set, and the part with more rows counts."""
FASTEST_NS = 1e4
"""Shortest mean time between rows of any sensor: 100,000 a second."""
STAMP_ADVICE = (
    "stamps are nanoseconds; of seconds: np.round(seconds * 1e9).astype(np.int64)"
)
NO_TRACK = -1
"""Track number of a detection that belongs to no track."""
ROUNDING = 1e-6
"""Tolerance of a sum of posteriors above 1, and of a covariance: single precision."""
FIRST_TOO_LARGE_ID = 2**56
"""An identity is part of a variable's key in a graph, which has 56 bits for it."""
ID_ADVICE = "number the landmarks from 0 on, such as 1, 2, 3, where identities are made (a hash has no place)"
FARTHEST_M = 100_000.0
"""Largest range accepted; no sonar sees farther."""
UNMEASURED_M2 = 1e8
"""Variance of a coordinate that a position fix does not measure, such as a height: 10 km squared."""
FARTHEST_FIX_M = 1e7
"""Largest coordinate of a position fix, and sigma of one: a quarter of the Earth's circumference."""
MOST_YAW_RAD = 1e9
"""Largest yaw of a compass that counts on over turns: a double has steps of 1e-7 rad there, finer than any compass."""

FULL_TURN_RAD = 2.0 * np.pi
"""No azimuth lies beyond: half a turn to either side, or a turn where it is counted from 0 on. A sigma of yaw beyond it
constrains nothing (a direction anywhere on the circle has 1.8 rad)."""


def no_posterior(probability: Floats) -> NDArray[np.bool_]:
    """Mask, shape (n,), of rows of ``probability``, shape (n, k), that are below 0, NaN, or above 1 in sum."""
    with np.errstate(invalid="ignore", over="ignore"):
        # NaN compares false, and so is no posterior
        is_one = (probability >= 0).all(axis=1) & (
            probability.sum(axis=1) <= 1.0 + ROUNDING
        )
    return np.asarray(~is_one)


def possible_ranges(range_m: Floats) -> NDArray[np.bool_]:
    """Mask of ranges above 0 and at most `FARTHEST_M`, shape (n,)."""
    return np.asarray((range_m > 0) & (range_m <= FARTHEST_M))


def _is_sound(a: float, b: float, c: float, d: float) -> bool:
    """True for a covariance [[a, b], [c, d]] that is positive definite, or not known (NaN)."""
    # determinant and symmetry relative to the diagonal: metres and radians differ
    variances = a * d
    if a > 0 and d > 0 and variances - b * c > ROUNDING * variances:
        return abs(b - c) <= ROUNDING * math.sqrt(variances)
    # NaN compares false
    return any(math.isnan(number) for number in (a, b, c, d))


@dataclass(frozen=True, eq=False, repr=False)
class Columns:
    """Base class of tables whose fields are columns: arrays whose first axis runs over the rows."""

    def rows(self, selection: slice | NDArray[np.bool_] | Ints) -> Self:
        """The table with only the selected rows."""
        return type(self)(
            *(getattr(self, column.name)[selection] for column in fields(self))
        )

    @classmethod
    def concatenate(cls, tables: Sequence[Self]) -> Self:
        """One table from several, in the order given."""
        return cls(
            *(
                np.concatenate([getattr(table, column.name) for table in tables])
                for column in fields(cls)
            )
        )


@dataclass(frozen=True, eq=False, repr=False)
class Block(Columns):
    """Base class of the measurements: columns, arrays whose first axis runs over the rows, with a stamp each.

    The constructor converts types where needed (without a copy where not). A column has in its metadata the ``shape``
    of one row, where that is fixed, and whether it must be ``finite``; elsewhere NaN means "not measured".

    Raises `MeasurementError` when there is no row, a column has another shape or type than stated, a number that must
    be finite is not, or stamps are no integers or run backwards.
    """

    stamps_ns: Ints
    """Time of validity, shape (n,), integer nanoseconds, not decreasing."""

    def __post_init__(self) -> None:
        name = type(self).__name__
        stamps = np.asarray(self.stamps_ns)
        # a block of no rows would have no first stamp, which everything that takes blocks needs
        if stamps.size == 0:
            raise MeasurementError(
                f"{name}: a block needs at least one row; leave the block out instead"
            )
        if stamps.ndim != 1:
            raise MeasurementError(
                f"{name}.stamps_ns: expected shape (n,), not {stamps.shape}"
            )
        n = len(stamps)
        for column, place, is_whole, shape, is_finite in _columns(type(self)):  # type: ignore[arg-type]  # hash of a row
            values = _numbers(
                place, np.asarray(getattr(self, column)), is_whole=is_whole
            )
            row_shape = values.shape[1:] if shape is None else shape
            if values.shape[:1] != (n,):
                # the usual mistake: columns in place of rows
                advice = "; transpose it" * (values.shape[1:] == (n,))
                raise MeasurementError(
                    f"{place}: shape {values.shape} has not one row for each of {n} stamps{advice}"
                )
            if values.shape[1:] != row_shape:
                raise MeasurementError(
                    f"{place}: expected shape {(n, *row_shape)}, not {values.shape}"
                )
            if is_finite and not np.isfinite(values).all():
                row = np.argwhere(~np.isfinite(values))[0, 0]
                raise MeasurementError(
                    f"{place}: row {row} is not finite; leave such rows out of the block"
                )
            # the class is frozen for its users, not for its own constructor
            object.__setattr__(self, column, values)
        if (
            n > 1
            and (
                backwards := np.flatnonzero(self.stamps_ns[1:] < self.stamps_ns[:-1])
            ).size
        ):
            raise MeasurementError(
                f"{name}: stamps run backwards after row {backwards[0]}; sort the rows by stamp"
            )

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({len(self)} rows, {self.stamps_ns[0]} to {self.stamps_ns[-1]} ns)"

    def is_too_fast(self) -> bool:
        """True where stamps, at least ten, follow each other faster than any sensor measures."""
        stamps_ns = np.unique(self.stamps_ns)
        # a few close rows may be a burst of a driver; many are stamps in another unit
        return len(stamps_ns) >= 10 and bool(
            stamps_ns[-1] - stamps_ns[0] < FASTEST_NS * (len(stamps_ns) - 1)
        )

    def rows(self, selection: slice | NDArray[np.bool_] | Ints) -> Self:
        """The block with only the selected rows."""
        if (
            isinstance(selection, slice)
            and (selection.step or 1) > 0
            and len(self.stamps_ns[selection])
        ):
            # as the whole is
            block = object.__new__(type(self))
            vars(block).update(
                {name: column[selection] for name, column in vars(self).items()}
            )
            return block
        return super().rows(selection)

    def between(self, after_ns: int, until_ns: int) -> Self | None:
        """The rows with ``after_ns < stamp <= until_ns``, or None without any."""
        first, last = np.searchsorted(
            self.stamps_ns, [after_ns, until_ns], side="right"
        )
        return self.rows(slice(first, last)) if last > first else None


@cache
def _columns(
    kind: type[Block],
) -> list[tuple[str, str, bool, tuple[int, ...] | None, bool]]:
    """Name, place in errors, and rules of each column: is it whole, the shape of a row, must it be finite."""
    return [
        (
            column.name,
            f"{kind.__name__}.{column.name}",
            column.type == "Ints",
            column.metadata.get("shape"),
            bool(column.metadata.get("finite")),
        )
        for column in fields(kind)
    ]


def _numbers(place: str, values: NDArray[Any], *, is_whole: bool) -> NDArray[Any]:
    """Column as int64 or float64; refuses floats where integers are expected, instead of truncating them."""
    # a stamp in float seconds would be truncated without a word
    kinds, expected = ("iu", "integers") if is_whole else ("iufb", "numbers")
    if values.dtype.kind not in kinds and values.size:
        advice = (
            "; of seconds: np.round(seconds * 1e9).astype(np.int64)"
            * place.endswith(".stamps_ns")
        )
        raise MeasurementError(
            f"{place}: expected {expected}, not {values.dtype}{advice}"
        )
    if (
        values.dtype.kind == "u"
        and is_whole
        and values.size
        and int(values.max()) > np.iinfo(np.int64).max
    ):
        raise MeasurementError(
            f"{place}: expected integers below 2^63, not {values.max()}"
        )
    return values.astype(np.int64 if is_whole else np.float64, copy=False)


@dataclass(frozen=True, eq=False, repr=False)
class Imu(Block):
    """Inertial measurements in the IMU's frame.

    Examples
    --------
    Two samples of a vehicle at rest, 10 ms apart:

    >>> import numpy as np
    >>> force = np.array([[0.0, 0.0, 9.81], [0.0, 0.0, 9.81]])
    >>> imu = Imu(stamps_ns=np.array([0, 10_000_000]), angular_velocity=np.zeros((2, 3)), specific_force=force)
    >>> len(imu)
    2
    """

    angular_velocity: Floats = field(metadata={"shape": (3,), "finite": True})
    """Shape (n, 3), rad/s."""
    specific_force: Floats = field(metadata={"shape": (3,)})
    """Acceleration minus gravity, shape (n, 3), m/s²: +9.81 on z at rest; NaN: not measured."""


@dataclass(frozen=True, eq=False, repr=False)
class Dvl(Block):
    """Velocity over the bottom by the Doppler log, in the DVL's frame; rows without bottom lock are left out.

    Examples
    --------
    >>> import numpy as np
    >>> velocity, unknown = np.array([[0.15, 0.0, 0.0], [0.16, 0.0, 0.0]]), np.full((2, 3, 3), np.nan)
    >>> dvl = Dvl(stamps_ns=np.array([0, 200_000_000]), velocity=velocity, velocity_cov=unknown)
    >>> dvl.between(0, 200_000_000).velocity
    array([[0.16, 0.  , 0.  ]])
    """

    velocity: Floats = field(metadata={"shape": (3,), "finite": True})
    """Shape (n, 3), m/s."""
    velocity_cov: Floats = field(metadata={"shape": (3, 3)})
    """Shape (n, 3, 3), m²/s²; NaN where unknown: the calibration's value then holds."""


@dataclass(frozen=True, eq=False, repr=False)
class Depth(Block):
    """Height of the pressure sensor's port in the world, from pressure.

    Examples
    --------
    >>> import numpy as np
    >>> depth = Depth(stamps_ns=np.array([0]), z_m=np.array([-0.5]), variance_m2=np.array([1e-4]))
    >>> depth.z_m
    array([-0.5])
    """

    z_m: Floats = field(metadata={"shape": (), "finite": True})
    """World z of the port (negative below the surface of a world with its origin there), shape (n,)."""
    variance_m2: Floats = field(metadata={"shape": ()})
    """Shape (n,); NaN where unknown: the calibration's value then holds."""


@dataclass(frozen=True, eq=False, repr=False)
class Heading(Block):
    """Yaw of the body in the world, by a compass, an attitude reference or a gyrocompass.

    A sigma of NaN is unknown noise: the row is used, with ``heading.sigma_rad`` of the calibration. The error that all
    rows share is ``heading.bias_sigma_rad`` in either case. A row that was not measured is left out of the block.

    Examples
    --------
    >>> import numpy as np
    >>> heading = Heading(stamps_ns=np.array([0]), yaw_rad=np.array([1.57]), sigma_rad=np.array([np.nan]))
    >>> heading.yaw_rad
    array([1.57])
    """

    yaw_rad: Floats = field(metadata={"shape": (), "finite": True})
    """Yaw of world_T_body = Rz(yaw) Ry(pitch) Rx(roll), positive to the left, whole turns do not matter, shape (n,)."""
    sigma_rad: Floats = field(metadata={"shape": ()})
    """Standard deviation of white noise, shape (n,); NaN where unknown: the calibration's value then holds."""

    def are_sound(self) -> NDArray[np.bool_]:
        """Mask, shape (n,), of rows whose yaw is at most `MOST_YAW_RAD`, and sigma above 0 up to a turn, or unknown."""
        is_sigma = np.isnan(self.sigma_rad) | (
            (self.sigma_rad > 0) & (self.sigma_rad <= FULL_TURN_RAD)
        )
        return np.asarray(is_sigma & (np.abs(self.yaw_rad) <= MOST_YAW_RAD))


@dataclass(frozen=True, eq=False, repr=False)
class PositionFixes(Block):
    """Positions of an antenna or acoustic transponder in the world, from satellites or an acoustic array (USBL).

    A covariance with any NaN is unknown as a whole: the row is used, with ``positions.sigma_m`` of the calibration on
    every axis. A coordinate that was not measured is no NaN, but has a variance of `UNMEASURED_M2`; a row without
    any is left out of the block.

    Examples
    --------
    >>> import numpy as np
    >>> fixes = PositionFixes(np.array([0]), np.array([[12.0, -3.0, 0.0]]), np.diag([4.0, 4.0, 25.0])[None])
    >>> fixes.are_sound()
    array([ True])
    """

    position_m: Floats = field(metadata={"shape": (3,), "finite": True})
    """Shape (n, 3); a coordinate that is not measured has a variance of `UNMEASURED_M2`."""
    covariance_m2: Floats = field(metadata={"shape": (3, 3)})
    """Along the world's axes, shape (n, 3, 3); NaN where unknown: the calibration's value then holds."""

    def are_sound(self) -> NDArray[np.bool_]:
        """Mask, shape (n,), of rows with a positive definite covariance (Sylvester's criterion) or none (NaN).

        No coordinate and no sigma is beyond `FARTHEST_FIX_M`.
        """
        with np.errstate(all="ignore"):
            sigmas = np.sqrt(np.einsum("nii->ni", self.covariance_m2))
            # without units, so that one tolerance holds for metres and millimetres
            correlations = self.covariance_m2 / (
                sigmas[:, :, None] * sigmas[:, None, :]
            )
            is_symmetric = (
                np.abs(correlations - np.swapaxes(correlations, 1, 2)).max(axis=(1, 2))
                <= ROUNDING
            )
            # leading minors: the first is 1
            is_definite = (correlations[:, 0, 1] ** 2 < 1 - ROUNDING) & (
                np.linalg.det(correlations) > ROUNDING
            )
            is_covariance = (
                is_symmetric & is_definite & (sigmas <= FARTHEST_FIX_M).all(axis=1)
            )
        is_near = (np.abs(self.position_m) <= FARTHEST_FIX_M).all(axis=1)
        return np.asarray(
            is_near & (is_covariance | np.isnan(self.covariance_m2).any(axis=(1, 2)))
        )


@dataclass(frozen=True, eq=False, repr=False)
class LandmarkDetections(Block):
    """Landmarks recognised in sonar frames: one row per detection; rows of one frame share a stamp.

    Examples
    --------
    One detection, 2 m ahead and 10° to the left, probably landmark 3:

    >>> import numpy as np
    >>> detections = LandmarkDetections(
    ...     stamps_ns=np.array([0]), range_m=np.array([2.0]), azimuth_rad=np.array([np.deg2rad(10.0)]),
    ...     range_azimuth_cov=np.diag([0.02**2, 0.009**2])[None],
    ...     candidate_ids=np.array([[3, 4]]), id_probability=np.array([[0.95, 0.04]]),
    ... )
    >>> detections.most_probable()
    (array([3]), array([0.95]))
    """

    range_m: Floats = field(metadata={"shape": (), "finite": True})
    """Slant range, shape (n,)."""
    azimuth_rad: Floats = field(metadata={"shape": (), "finite": True})
    """``atan2(q_y, q_x)`` in the sonar frame, positive to the left, shape (n,)."""
    range_azimuth_cov: Floats = field(metadata={"shape": (2, 2)})
    """Covariance of (range, azimuth), shape (n, 2, 2); NaN where unknown: the calibration's value then holds."""
    candidate_ids: Ints
    """Identities that the recogniser considers, shape (n, k); -1 fills unused places."""
    id_probability: Floats
    """Posterior of each candidate, shape (n, k), in sum at most 1; the rest is "none of the known landmarks"."""
    track: Ints = field(
        default_factory=lambda: np.empty(0, dtype=np.int64), metadata={"shape": ()}
    )
    """Track of each row, shape (n,), whose rows show one object; `NO_TRACK` (-1) or left out: no track.

    Each row has the posterior given all evidence of the track so far, so the last row's is the best."""

    def __post_init__(self) -> None:
        # detections without tracks are the usual case
        if not len(self.track):
            object.__setattr__(
                self, "track", np.full(len(self.stamps_ns), NO_TRACK, dtype=np.int64)
            )
        super().__post_init__()
        for column in ("candidate_ids", "id_probability"):
            shape = getattr(self, column).shape
            if len(shape) != 2 or shape != self.candidate_ids.shape or not shape[1]:
                raise MeasurementError(
                    f"LandmarkDetections.{column}: expected shape (n, k), k >= 1 identities of each row with their"
                    f" probabilities, not {shape}"
                )
        # it would be the key of another variable of the graph
        too_large = (self.candidate_ids >= FIRST_TOO_LARGE_ID).any(axis=1)
        improper = "probabilities that are not between 0 and 1, or more than 1 in sum; 97 % is 0.97"
        for column, has_it, fault in (
            ("candidate_ids", too_large, f"an identity of 2^56 or more; {ID_ADVICE}"),
            ("id_probability", no_posterior(self.id_probability), improper),
        ):
            if has_it.any():
                row = int(has_it.argmax())
                values = getattr(self, column)[row].tolist()
                raise MeasurementError(
                    f"LandmarkDetections.{column}: row {row} ({values}) has {fault}"
                )

    def frames(self) -> Iterator[LandmarkDetections]:
        """Rows of each sonar frame, that is of each stamp."""
        if self.stamps_ns[0] == self.stamps_ns[-1]:  # the usual case live
            yield self
            return
        # rows of a frame share a stamp and follow each other
        edges = [0, *(np.flatnonzero(np.diff(self.stamps_ns)) + 1).tolist(), len(self)]
        for first, last in pairwise(edges):
            yield self.rows(slice(first, last))

    def are_sound(self) -> NDArray[np.bool_]:
        """Mask, shape (n,), of rows with possible range and azimuth, and a positive definite or no covariance (NaN)."""
        covariances = self.range_azimuth_cov.reshape(-1, 4).tolist()
        # a frame has few rows: a loop over numbers is faster than operations on arrays
        is_sound = np.array([_is_sound(*cov) for cov in covariances])
        is_sound &= possible_ranges(self.range_m)
        is_sound &= np.abs(self.azimuth_rad) <= FULL_TURN_RAD
        return is_sound

    def most_probable(self) -> tuple[Ints, Floats]:
        """Identity with the highest posterior, and that posterior, shapes (n,) and (n,)."""
        row = np.arange(len(self))
        best = self.id_probability.argmax(axis=1)
        return self.candidate_ids[row, best], self.id_probability[row, best]


BLOCKS: dict[str, type[Block]] = {
    "imu": Imu, "dvl": Dvl, "depth": Depth, "detections": LandmarkDetections, "heading": Heading,
    "positions": PositionFixes,
}  # fmt: skip
"""Kind of block of each field of `Measurements` and of `sonar_graph.Sequence`."""


def require_blocks(holder: object) -> None:
    """Raise a `MeasurementError` when a field of `BLOCKS` has a value of another type, and is not None."""
    for name, kind in BLOCKS.items():
        block = getattr(holder, name)
        if block is not None and not isinstance(block, kind):
            raise MeasurementError(
                f"{type(holder).__name__}.{name}: expected {kind.__name__} or None, not {type(block).__name__}"
            )


@dataclass(frozen=True)
class Measurements:
    """Input of `Estimator.process`: all that was measured since the previous call, up to and including ``end_ns``.

    Raises
    ------
    MeasurementError
        When ``end_ns`` is no integer, a block is of another kind than its field, or a row is stamped after ``end_ns``
        (rows of IMU and DVL may be) or more than a day before all else.

    Examples
    --------
    >>> import numpy as np
    >>> Measurements(end_ns=10_000_000, depth=Depth(np.array([5_000_000]), np.array([-0.5]), np.array([np.nan]))).imu
    """

    end_ns: int
    """Instant up to which the blocks are complete, and for which an estimate is wanted."""
    imu: Imu | None = None
    dvl: Dvl | None = None
    depth: Depth | None = None
    detections: LandmarkDetections | None = None
    heading: Heading | None = None
    positions: PositionFixes | None = None

    def __post_init__(self) -> None:
        if isinstance(self.end_ns, bool) or not isinstance(
            self.end_ns, (int, np.integer)
        ):
            raise MeasurementError(
                f"Measurements.end_ns: expected an integer, nanoseconds, not {self.end_ns!r}; of seconds:"
                " round(seconds * 1e9)"
            )
        require_blocks(self)
        motion_ns = min(
            [
                self.end_ns,
                *(
                    int(rows.stamps_ns[0])
                    for rows in (self.imu, self.dvl)
                    if rows is not None
                ),
            ]
        )
        for rows in (self.depth, self.detections, self.heading, self.positions):
            if rows is None:
                continue
            if rows.stamps_ns[0] < motion_ns - PAUSE_NS:
                raise MeasurementError(
                    f"Measurements: {type(rows).__name__} has a row at {rows.stamps_ns[0]} ns, more than a day before"
                    f" {motion_ns} ns, where IMU, Doppler log or the call have theirs; {STAMP_ADVICE}"
                )
            if rows.stamps_ns[-1] > self.end_ns:
                raise MeasurementError(
                    f"Measurements: {type(rows).__name__} has a row at {rows.stamps_ns[-1]} ns, after end_ns ="
                    f" {self.end_ns}; hand it in with the call that reaches it"
                )


def require_measurements(value: object, name: str) -> None:
    """Raise a `MeasurementError` where an estimator of this name is given something else to process."""
    if not isinstance(value, Measurements):
        block = next(
            (field for field, kind in BLOCKS.items() if isinstance(value, kind)), "imu"
        )
        raise MeasurementError(
            f"{name}: process(measurements): expected Measurements, not {type(value).__name__}; of blocks:"
            f" Measurements(end_ns, {block}=...)"
        )
