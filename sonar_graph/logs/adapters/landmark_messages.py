"""Adapters for landmark detections and maps: messages of this package, ``vision_msgs/Detection3DArray``, and tables.

A position p in the sonar's frame with the covariance C becomes range and azimuth with the covariance ``J C J^T``::

    r = |p|,   a = atan2(p_y, p_x),   J = [p / r; (-p_y, p_x, 0) / (p_x^2 + p_y^2)]

Impossible identities are refused, impossible rows are left out, and unlikely ones are named in `detection_warnings`
(docs/design/0004-logs.md).
"""

from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Literal, NamedTuple, Self

import numpy as np
from pydantic import model_validator

from sonar_graph.logs.adapters.adapter import (
    Adapter,
    AngleScale,
    FieldPath,
    FieldPaths,
    LengthScale,
    Setup,
    turn,
    turn_covariances,
)
from sonar_graph.logs.adapters.aiding_messages import ENU_R, World
from sonar_graph.logs.adapters.geodesy import turned
from sonar_graph.logs.adapters.message_table import (
    NOT_FINITE,
    FieldTable,
    Fit,
    MessageTable,
    fit_block,
    not_finite,
    share,
)
from sonar_graph.logs.cdr import Messages
from sonar_graph.measurements import (
    FIRST_TOO_LARGE_ID,
    FULL_TURN_RAD,
    ID_ADVICE,
    NO_TRACK,
    ROUNDING,
    Floats,
    Ints,
    LandmarkDetections,
    no_posterior,
    possible_ranges,
)
from sonar_graph.states import LandmarkMap

NO_POSTERIOR = "with probabilities that are not between 0 and 1 or more than 1 in sum (97 % is 0.97)"


class _Rows(NamedTuple):
    """Detections, one row each."""

    message: Ints
    """Number of the message in its topic."""
    ids: Ints
    """Shape (n, k)."""
    probabilities: Floats
    """Shape (n, k)."""
    values: tuple[Any, ...]
    """Columns that do not depend on the candidates."""


def _joined(table: MessageTable, parts: list[_Rows]) -> _Rows:
    """Rows of all layouts in the order of messages, padded to the most candidates with -1 and probability 0."""
    most = max(1, *(part.ids.shape[1] for part in parts))

    def stacked(columns: Iterable[np.ndarray], filling: int) -> np.ndarray:
        widths = ((0, 0), (0, most))
        padded = (np.pad(c, widths, constant_values=filling)[:, :most] for c in columns)
        return np.concatenate(list(padded))

    ids = stacked((part.ids for part in parts), -1)
    message = np.concatenate([part.message for part in parts])
    is_large = (ids >= FIRST_TOO_LARGE_ID).any(axis=1)
    if is_large.any():
        first = message[np.argmax(is_large)]
        raise table.topic.error(
            f"message {first} has an identity of 2^56 or more; {ID_ADVICE}, or do not use them: [detections] use = false"
        )
    # rows of one stamp keep the order in which they were sent
    order = np.argsort(message, kind="stable")
    probabilities = stacked((part.probabilities for part in parts), 0)
    columns = zip(*(part.values for part in parts), strict=True)
    values = tuple(np.concatenate(column)[order] for column in columns)
    return _Rows(message[order], ids[order], probabilities[order], values)


_LISTS = ("range_m", "azimuth_rad", "covariance", "candidate_ids", "id_probability")


class DetectionListsAdapter(Adapter):
    """``sonar_graph_msgs/LandmarkDetections``: range, azimuth, covariance and posterior, in flat lists."""

    range_scale: LengthScale = 1.0
    """Turns ranges into metres; 0.001 or "mm" from millimetres, a ratio of sound speeds where that is wrong."""
    azimuth_scale: AngleScale = 1.0
    """Turns azimuths into rad, positive to the left; -1 where they are positive to the right."""

    def read(
        self,
        table: MessageTable,
        setup: Setup,  # noqa: ARG002  # of all adapters
    ) -> Fit[LandmarkDetections]:
        """One row a detection; where messages differ in the number of candidates, -1 with probability 0 fills."""
        groups = [group for group in table.groups if group["range_m"].shape[1]]
        if not groups:
            return None, {}
        rows = _joined(table, [self._rows(table, group) for group in groups])
        ranges, azimuths, covariances, tracks = rows.values
        scales = np.array([self.range_scale, self.azimuth_scale])
        ranges = ranges * self.range_scale
        azimuths = azimuths * self.azimuth_scale
        faults = {
            NOT_FINITE: not_finite(ranges, azimuths, rows.probabilities),
            NO_POSTERIOR: no_posterior(rows.probabilities),
        }
        measured = (ranges, azimuths, covariances * np.outer(scales, scales))
        return _fit(table, rows, faults, measured, tracks)

    def _rows(self, table: MessageTable, group: Messages) -> _Rows:
        columns = [group[name] for name in _LISTS]
        count, azimuths, elements, ids, probabilities = (c.shape[1] for c in columns)
        where = f"message {group.rows[0]} has {count} ranges"
        if (azimuths, elements, ids % count) != (count, 4 * count, 0) or (
            ids != probabilities
        ):
            raise table.topic.error(
                f"{where}, {azimuths} azimuths, {elements} covariance elements, {ids} identities, {probabilities} "
                "probabilities; expected n, n, 4n, kn and kn"
            )
        message = np.repeat(group.rows, count)
        tracks = np.full(len(message), NO_TRACK, np.int64)
        # not in old logs
        if "track" in group.layout.columns and group["track"].size:
            if group["track"].shape[1] != count:
                raise table.topic.error(
                    f"{where} and {group['track'].shape[1]} tracks; expected as many, or none"
                )
            tracks = group["track"].astype(np.int64).reshape(-1)
        range_m, azimuth_rad, pairs, identities, posterior = (
            column.reshape(len(message), -1) for column in columns
        )
        covariances = pairs.reshape(-1, 2, 2)
        values = (range_m[:, 0], azimuth_rad[:, 0], covariances, tracks)
        return _Rows(message, identities, posterior, values)


def _fit(
    table: MessageTable,
    rows: _Rows,
    faults: Mapping[str, np.ndarray],
    measured: tuple[Floats, Floats, Floats],
    tracks: Floats | Ints,
) -> Fit[LandmarkDetections]:
    """Rows fit for use, from ranges, azimuths and covariances."""
    stamps_ns = table.stamps_ns[rows.message]
    columns = (*measured, rows.ids, rows.probabilities, tracks)
    return fit_block(LandmarkDetections, stamps_ns, faults, *columns, unique=False)


_SCORE = "detections.results.hypothesis.score"
_CLASS = "detections.results.hypothesis.class_id"
_CENTRE = "detections.bbox.center.position"
_RESULT = "detections.results.pose"


class DetectionArrayAdapter(Adapter):
    """``vision_msgs/Detection3DArray``: Cartesian positions with named hypotheses.

    Identities are integers here: a class that is a number stands for itself, others are given in `ids`.
    """

    LISTS = (
        f"{_CENTRE}.x",
        _SCORE,
        _CLASS,
        f"{_RESULT}.pose.position.x",
        f"{_RESULT}.covariance",
    )
    position: Literal["results", "bbox"] = "results"
    """Source of the position: a detection's first result, with its covariance, or the centre of its box, without."""
    ids: Mapping[str, int] = {}
    """Integer identity of each class that is no number: {"buoy" = 1, "ladder" = 2}."""

    def read(
        self,
        table: MessageTable,
        setup: Setup,  # noqa: ARG002  # of all adapters
    ) -> Fit[LandmarkDetections]:
        """One row a detection that has a result; the scores are the posterior, in the order of the results."""
        groups = [
            group for group in table.groups if group.lengths("detections.results")
        ]
        if not groups:
            return None, {}
        rows = _joined(table, [self._rows(table, group) for group in groups])
        scores = rows.probabilities
        # scores that are no probabilities would be taken for certainty
        worst = float(np.nanmax(scores.sum(axis=1), initial=0.0))
        if worst > 1 + ROUNDING or (scores < 0).any():
            raise table.topic.error(
                f"scores of one detection add up to {worst:g}; the posterior over identities must be between 0 and 1 "
                f"in sum: normalise the scores where the log is made"
            )
        positions, covariances = rows.values
        measured = range_and_azimuth(
            turn(self.rotation, positions), turn_covariances(self.rotation, covariances)
        )
        ranges, azimuths, _ = measured
        # a detection that is nothing in particular has no results
        faults = {
            "without a result": rows.ids[:, 0] < 0,
            NOT_FINITE: not_finite(ranges, azimuths, scores),
            "at the sonar itself": ranges == 0,
        }
        tracks = np.full(len(ranges), NO_TRACK)
        return _fit(table, rows, faults, measured, tracks)

    def _rows(self, table: MessageTable, group: Messages) -> _Rows:
        """Every detection, with the results of each at its own places; NaN: unknown."""
        counts = np.array(group.lengths("detections.results"), np.int64)
        begins = np.cumsum(counts) - counts
        n = len(group)
        m = len(counts)
        k = max(1, int(counts.max()))
        detection = np.repeat(np.arange(m), counts)
        result = np.arange(len(detection)) - np.repeat(begins, counts)
        scores = np.zeros((n, m, k))
        scores[:, detection, result] = group[_SCORE]
        ids = np.full((n, m, k), -1, np.int64)
        names = group.strings(_CLASS)
        ids[:, detection, result] = [
            [self._identity(table, name) for name in message] for message in names
        ]
        positions = np.full((n, m, 3), np.nan)
        covariances = np.full((n, m, 3, 3), np.nan)
        if self.position == "bbox":
            positions[:] = _vectors(group, _CENTRE)
        else:
            some = counts > 0
            first = begins[some]
            positions[:, some] = _vectors(group, f"{_RESULT}.pose.position")[:, first]
            pose = group[f"{_RESULT}.covariance"].reshape(n, -1, 6, 6)[:, first, :3, :3]
            # zeros and a negative variance are unknown
            known = pose.any(axis=(2, 3)) & (pose[..., 0, 0] >= 0)
            covariances[:, some] = np.where(known[..., None, None], pose, np.nan)
        values = (positions.reshape(-1, 3), covariances.reshape(-1, 3, 3))
        message = np.repeat(group.rows, m)
        return _Rows(message, ids.reshape(-1, k), scores.reshape(-1, k), values)

    def _identity(self, table: MessageTable, name: str) -> int:
        try:
            identity = self.ids[name] if name in self.ids else int(name)
            # beyond int64 is refused as too large as well
            return max(-1, min(identity, FIRST_TOO_LARGE_ID))
        except ValueError:
            raise table.topic.error(
                f"class {name!r} is no integer identity; say in a log configuration which it is: [detections] ids = "
                f'{{"{name}" = 1}}, or do not use them: use = false'
            ) from None


def _vectors(group: Messages, path: str) -> Floats:
    """Vectors at a path, shape (messages, places, 3)."""
    return np.stack([group[f"{path}.{axis}"] for axis in "xyz"], axis=-1)


def range_and_azimuth(
    positions: Floats, covariances: Floats
) -> tuple[Floats, Floats, Floats]:
    """Range, azimuth and their covariance, shapes (n,), (n,) and (n, 2, 2), from positions and theirs."""
    x, y, _ = positions.T
    ranges = np.linalg.norm(positions, axis=1)
    across_squared = x**2 + y**2
    jacobians = np.zeros((len(positions), 2, 3))
    with np.errstate(divide="ignore", invalid="ignore"):
        jacobians[:, 0] = positions / ranges[:, None]
        jacobians[:, 1, 0] = -y / across_squared
        jacobians[:, 1, 1] = x / across_squared
        spread = jacobians @ covariances @ jacobians.transpose(0, 2, 1)
    return ranges, np.arctan2(y, x), spread


class LandmarkMapAdapter(Adapter):
    """``sonar_graph_msgs/LandmarkMap``: true positions of landmarks."""

    def read(
        self,
        table: MessageTable,
        setup: Setup,  # noqa: ARG002  # of all adapters
    ) -> Fit[LandmarkMap]:
        """The last map of a topic."""
        # a map is latched: the newest counts
        last = max(table.groups, key=lambda group: int(group.rows[-1]))
        names = ("ids", "position", "covariance")
        ids, position, covariance = (last[name][-1] for name in names)
        count = len(ids)
        different, order = np.unique(ids, return_index=True)
        sizes = (len(different), len(position), len(covariance))
        if sizes != (count, 3 * count, 9 * count):
            raise table.topic.error(
                f"{count} ids ({sizes[0]} different), {sizes[1]} position and {sizes[2]} covariance elements; "
                "expected n different, 3n and 9n"
            )
        positions = position.reshape(-1, 3)[order]
        covariances = covariance.reshape(-1, 3, 3)[order]
        return LandmarkMap(different.astype(np.int64), positions, covariances), {}


def detection_warnings(
    detections: LandmarkDetections, first_ns: int, last_ns: int
) -> Iterator[str]:
    """Rows that estimators do not use: impossible ranges and covariances, repeated tracks, and rows without odometry.

    The odometry lasts from ``first_ns`` to ``last_ns``.
    """
    is_range = possible_ranges(detections.range_m)
    is_azimuth = np.abs(detections.azimuth_rad) <= FULL_TURN_RAD
    faults = {
        "a range that is not above 0 and at most 100 km": ~is_range,
        "a covariance that is not positive definite": is_range
        & is_azimuth
        & ~detections.are_sound(),
        "a stamp before the first odometry": detections.stamps_ns < first_ns,
        "a stamp after the last odometry": detections.stamps_ns > last_ns,
    }
    for fault, has_it in faults.items():
        if has_it.any():
            yield f"{share(has_it)} rows have {fault}: estimators do not use them"
    # some drivers count azimuths from 0 to a full turn
    if not is_azimuth.all():
        yield (
            f"{share(~is_azimuth)} rows have an azimuth beyond a full turn in rad (up to "
            f"{np.abs(detections.azimuth_rad).max():.3g}): not used; degrees? `azimuth_scale = 0.0174533` under "
            "[detections] in the log configuration"
        )
    tracked = detections.track != NO_TRACK
    # one frame sees an object once
    pairs = np.column_stack((detections.stamps_ns[tracked], detections.track[tracked]))
    different, counts = np.unique(pairs, axis=0, return_counts=True)
    if repeated := int((counts - 1).sum()):
        frames = len(np.unique(different[counts > 1, 0]))
        yield (
            f"{repeated} of {len(detections)} rows have the track number of another row of their frame, in {frames}"
            f" frames: a track is of one object, and one row is used; give rows of no track {NO_TRACK}, not 0 or a "
            f"place in a list"
        )


class DetectionRowsAdapter(Adapter):
    """Range, azimuth and identity of one detection a row; rows of one sonar frame share a stamp."""

    range: FieldPath
    """Field with the slant range."""
    range_scale: LengthScale = 1.0
    """Turns it into metres; 0.001 or "mm" from millimetres."""
    azimuth: FieldPath
    """Field with the azimuth in the sonar's frame, positive to the left; with rotation = "frd" to the right."""
    azimuth_scale: AngleScale = 1.0
    """Turns it into rad; 0.017453292519943295 or "deg" from degrees."""
    ids: tuple[FieldPath, ...] | None
    """Fields with the identities that the recogniser considers: integers; empty, or -1: unknown; false: no field."""
    probabilities: tuple[FieldPath, ...] = ()
    """Fields with the posterior of each identity, at most 1 in sum; without it, or where empty, 1 for the first."""
    range_sigma: FieldPath | None = None
    """Field with the range's standard deviation, before its scale; without it the calibration's noise holds."""
    azimuth_sigma: FieldPath | None = None
    """The same of the azimuth."""
    track: FieldPath | None = None
    """Field with the number of the track; none, or -1: no track."""

    @model_validator(mode="after")
    def _has_pairs(self) -> Self:
        if self.ids is not None and not self.ids:
            raise ValueError("give ids = [...], at least one field, or ids = false")
        if self.probabilities and len(self.probabilities) != len(self.ids or ()):
            raise ValueError(
                f"give as many probabilities as ids: {len(self.ids or ())}, not {len(self.probabilities)}"
            )
        if (self.range_sigma is None) != (self.azimuth_sigma is None):
            raise ValueError("give range_sigma and azimuth_sigma, or neither")
        if self.rotation not in ("flu", "frd"):
            raise ValueError(
                'give rotation = "flu" (azimuth to the left) or "frd" (to the right)'
            )
        return self

    def read(
        self,
        table: FieldTable,
        setup: Setup,  # noqa: ARG002  # of all adapters
    ) -> Fit[LandmarkDetections]:
        """Detections in the order of their stamps."""
        range_m = table.column(self.range) * self.range_scale
        to_the_left = -1.0 if self.rotation == "frd" else 1.0
        azimuth_rad = table.column(self.azimuth) * self.azimuth_scale * to_the_left
        ids = np.full((len(table), 1), -1)
        if self.ids:
            ids = np.column_stack([_whole(table, path) for path in self.ids])
        if (ids >= FIRST_TOO_LARGE_ID).any():
            fault = f"has an identity of 2^56 or more; {ID_ADVICE}"
            table.refuse(", ".join(self.ids or ()), fault)
        # without probabilities the recogniser is sure
        probability = np.eye(1, ids.shape[1]).repeat(len(table), axis=0)
        if self.probabilities:
            given = table.beside(self.probabilities)
            is_given = ~np.isnan(given).all(axis=1)
            probability[is_given] = np.nan_to_num(given[is_given])
        # an unknown landmark takes no share of the posterior
        probability[ids < 0] = 0.0
        covariance = np.full((len(table), 2, 2), np.nan)
        if self.range_sigma is not None and self.azimuth_sigma is not None:
            scales = [self.range_scale, self.azimuth_scale]
            sigmas = table.beside((self.range_sigma, self.azimuth_sigma)) * scales
            known = (sigmas > 0).all(axis=1)
            covariance[known] = (sigmas[known] ** 2)[:, :, None] * np.eye(2)
        track = np.full(len(table), NO_TRACK, np.int64)
        if self.track is not None:
            track = _whole(table, self.track)
        faults = {
            NOT_FINITE: not_finite(range_m, azimuth_rad),
            NO_POSTERIOR: no_posterior(probability),
        }
        columns = (range_m, azimuth_rad, covariance, ids, probability, track)
        return fit_block(
            LandmarkDetections, table.stamps_ns, faults, *columns, unique=False
        )


class LandmarkRowsAdapter(Adapter):
    """Identity and true position of one landmark a row; without stamps."""

    id: FieldPath
    """Field with the identity, an integer."""
    position: FieldPaths
    """Fields of x, y, z in the world."""
    scale: LengthScale = 1.0
    """Turns them into metres; 0.001 or "mm" from millimetres."""
    world: World = "enu"
    """"enu" (any world with z up), or "ned"."""

    def read(
        self,
        table: FieldTable,
        setup: Setup,  # noqa: ARG002  # of all adapters
    ) -> Fit[LandmarkMap]:
        """Map of the rows, whose identities all differ."""
        ids = _whole(table, self.id)
        positions = table.beside(self.position) * self.scale
        fit = np.flatnonzero((ids >= 0) & ~not_finite(positions))
        left_out = len(ids) - len(fit)
        dropped = {"without identity or position": left_out} if left_out else {}
        names, counts = np.unique(ids[fit], return_counts=True)
        if (counts > 1).any():
            twice = names[counts > 1][0]
            table.refuse(
                self.id, f"has {twice} more than once; a landmark has one place"
            )
        if not len(fit):
            return None, dropped
        # maps are compared by identity
        order = fit[np.argsort(ids[fit])]
        in_enu_m = turned(ENU_R[self.world], positions[order])
        unknown = np.full((len(order), 3, 3), np.nan)
        return LandmarkMap(ids[order], in_enu_m, unknown), dropped


def _whole(table: FieldTable, path: str) -> Ints:
    """A column of integers; -1 without one."""
    values = np.nan_to_num(table.column(path), nan=-1.0)
    wrong = values[values != np.floor(values)]
    if len(wrong):
        fault = f"has {wrong[0]:g}, and identities and tracks are integers; {ID_ADVICE}"
        table.refuse(path, fault)
    return values.astype(np.int64)
