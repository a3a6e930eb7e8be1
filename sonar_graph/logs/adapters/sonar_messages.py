"""Imaging sonar: messages as frames of intensities over beams and range bins."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from sonar_graph.logs.adapters.adapter import Adapter
from sonar_graph.logs.cdr import Messages
from sonar_graph.logs.mcap import Topic
from sonar_graph.logs.message_table import MessageTable
from sonar_graph.measurements import Floats, Ints, SonarFrames

SAMPLE_TYPES = ("u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f4", "f8")
"""numpy's type for each number in marine_acoustic_msgs/SonarImageData."""
_GAIN_BYTES = 4
Refused = Callable[[int, str], None]
"""Called with a message's stamp and why it is no image."""


class _NoImageError(Exception):
    """A message is no image: the field, and what is wrong with it."""


class _Images(NamedTuple):
    """Images of one size and kind, in no particular order."""

    rows: Ints
    """Which messages of the topic."""
    samples: NDArray[np.generic]
    """Shape (n, beams, bins)."""
    ranges_m: Floats
    azimuths_rad: Floats


class SonarAdapter(Adapter):
    """Beams, range bins and the image of every ping."""

    data: str
    """Field with the image's bytes."""
    image_order: Literal["range-major", "beam-major"] = "range-major"
    """range-major: all beams of the first range, then of the next, which is what drivers do (also where the message's
    comment says otherwise); beam-major: all ranges of the first beam first."""
    ranges: str | None = None
    """Array field with the middle of each range bin, metres."""
    range_resolution: str | None = None
    """Field with the size of a range bin, instead: bins then begin at the sonar."""
    bearings: str | None = None
    """Array field with an angle a beam."""
    bearing_unit_deg: float = Field(180 / np.pi, gt=0)
    """What one unit of a bearing is, in degrees; 0.01 where they are given in hundredths."""
    bearing_positive: Literal["left", "right"] = "right"
    """Which side of the sonar positive bearings are on."""
    directions: tuple[str, str, str] | None = None
    """Array fields with x, y, z of each beam's direction, instead: z forward, x up, y to the right."""
    sample_type: str | None = None
    """Field with the kind of a sample as marine_acoustic_msgs counts them (0: u8, 1: i8, 2: u16, ... 9: f64)."""
    sample_bytes: str | None = None
    """Field with the number of bytes of an unsigned sample, instead; without either they are bytes."""
    big_endian: str | None = None
    """Field that says whether samples are big-endian."""
    row_gains: str | None = None
    """Field that says whether each row begins with its gain, a uint32; samples are divided by its square root."""
    row_bytes: str | None = None
    """Field with the number of bytes of a row, gain and padding included."""

    @model_validator(mode="after")
    def _has_one_of_each(self) -> SonarAdapter:
        if (self.ranges is None) == (self.range_resolution is None):
            raise ValueError("give either ranges or range_resolution")
        if (self.bearings is None) == (self.directions is None):
            raise ValueError("give either bearings or directions")
        return self

    def fields(self) -> Iterator[str]:
        """Paths that a message must have."""
        single = (self.data, self.ranges, self.range_resolution, self.bearings, self.sample_type, self.sample_bytes)
        yield from filter(None, (*single, self.big_endian, self.row_gains, self.row_bytes))
        yield from self.directions or ()

    def read(self, topic: Topic, refused: Refused | None = None) -> Iterator[SonarFrames]:
        """Blocks of frames that share beams, bins and kind of sample, in the order of the log.

        A block ends where the next frame differs in these, or has an earlier stamp.

        Parameters
        ----------
        topic
            With its payloads.
        refused
            Called with stamp and reason of each message that is no image; None: the first is an error.

        Raises
        ------
        LogError
            When an image is not as long as beams and bins say, without ``refused``.
        """
        recorded_ns = topic.log_times_ns
        is_any_sound = bool(topic.messages())
        if refused is not None:
            for stamp_ns in _missing(recorded_ns, topic.log_times_ns):
                refused(stamp_ns, f"message {' or '.join(topic.unsound)}")
        if not is_any_sound:
            return
        table = self.table(topic)
        blocks = [block for group in table.groups for block in self._blocks(table, group, refused)]
        yield from _in_order(blocks, table.stamps_ns)

    def _blocks(self, table: MessageTable, group: Messages, refused: Refused | None) -> Iterator[_Images]:
        """Splits messages of one layout where beams, bins or samples change."""
        beams, bins = self._azimuths(group), self._bins(group)
        kind = np.column_stack([self._flag(group, path) for path in self._kinds()])
        _, first, block = np.unique(
            np.column_stack([kind, bins, beams]), axis=0, return_index=True, return_inverse=True
        )
        for number, at in enumerate(first.tolist()):
            rows = np.flatnonzero(block.reshape(-1) == number)
            try:
                samples = self._samples(group, rows, beams.shape[1], kind[at])
                ranges_m = self._ranges(bins[at], samples.shape[2])
            except _NoImageError as fault:
                if refused is None:
                    table.refuse(*fault.args)
                for stamp_ns in table.stamps_ns[group.rows[rows]].tolist():
                    refused(stamp_ns, " ".join(fault.args))
                continue
            yield _Images(group.rows[rows], samples, ranges_m, beams[at])

    def _ranges(self, bins_m: Floats, count: int) -> Floats:
        """Middles of bins of an image that has so many."""
        if self.ranges is None:
            return (np.arange(count) + 0.5) * bins_m[0]
        if len(bins_m) != count:
            raise _NoImageError(self.data, f"has {count} bins a beam; {self.ranges} has {len(bins_m)}")
        return bins_m

    def _kinds(self) -> tuple[str | None, ...]:
        return self.sample_type, self.sample_bytes, self.big_endian, self.row_gains, self.row_bytes

    def _flag(self, group: Messages, path: str | None) -> NDArray[np.int64]:
        return np.full(len(group), -1) if path is None else group[path].astype(np.int64)

    def _bins(self, group: Messages) -> Floats:
        """Middles of bins, shape (n, bins), or one size, shape (n, 1)."""
        return np.asarray(group[str(self.ranges or self.range_resolution)], float).reshape(len(group), -1)

    def _azimuths(self, group: Messages) -> Floats:
        """Positive to the left, shape (n, beams)."""
        if self.directions is not None:
            _, y, z = (group[path].astype(float) for path in self.directions)
            return np.arctan2(-y, z)
        sign = 1 if self.bearing_positive == "left" else -1
        return sign * np.radians(group[str(self.bearings)].astype(float) * self.bearing_unit_deg)

    def _samples(
        self, group: Messages, rows: NDArray[np.int64], beams: int, kind: NDArray[np.int64]
    ) -> NDArray[np.generic]:
        """Intensities, shape (n, beams, bins)."""
        dtype = self._dtype(kind)
        has_gains, row_bytes = kind[3] > 0, int(kind[4])
        data = np.ascontiguousarray(group[self.data][rows]).view(np.uint8)
        head = _GAIN_BYTES if has_gains else 0
        size = data.shape[1]
        if self.image_order == "range-major":
            row_bytes = row_bytes if row_bytes > 0 else head + beams * dtype.itemsize
            row_count, used = size // max(row_bytes, 1), head + beams * dtype.itemsize
        else:
            row_count, row_bytes = beams, row_bytes if row_bytes > 0 else size // max(beams, 1)
            used = row_bytes
        if beams == 0 or row_count == 0 or row_count * row_bytes != size or used > row_bytes:
            raise _NoImageError(self.data, f"has {size} bytes; that is no image of {beams} beams of {dtype} samples")
        image = data.reshape(len(rows), row_count, row_bytes)
        values = np.ascontiguousarray(image[:, :, head:used]).view(dtype)
        if has_gains:
            gains = np.ascontiguousarray(image[:, :, :_GAIN_BYTES]).view("<u4").astype(np.float32)
            values = (values / np.sqrt(np.maximum(gains, 1))).astype(np.float32)
        return values.transpose(0, 2, 1) if self.image_order == "range-major" else values

    def _dtype(self, kind: NDArray[np.int64]) -> np.dtype[np.generic]:
        order = ">" if kind[2] > 0 else "<"
        if self.sample_type is not None:
            if not 0 <= kind[0] < len(SAMPLE_TYPES):
                last = len(SAMPLE_TYPES) - 1
                raise _NoImageError(self.sample_type, f"is {kind[0]}; kinds of samples are 0 to {last}")
            return np.dtype(order + SAMPLE_TYPES[kind[0]])
        size = int(kind[1]) if self.sample_bytes is not None else 1
        if size not in (1, 2, 4):
            raise _NoImageError(str(self.sample_bytes), f"is {size}; samples have 1, 2 or 4 bytes")
        return np.dtype(f"{order}u{size}")


def _in_order(blocks: Sequence[_Images], stamps_ns: Ints) -> Iterator[SonarFrames]:
    """Runs of frames that follow each other in the log, share a block, and whose stamps do not run backwards."""
    rows = np.concatenate([images.rows for images in blocks] or [np.empty(0, np.int64)])
    block = np.repeat(np.arange(len(blocks)), [len(images.rows) for images in blocks])
    within = np.concatenate([np.arange(len(images.rows)) for images in blocks] or [np.empty(0, np.int64)])
    order = np.argsort(rows)
    rows, block, within = rows[order], block[order], within[order]
    begins = np.flatnonzero((np.diff(block) != 0) | (np.diff(stamps_ns[rows]) < 0)) + 1
    for run in np.split(np.arange(len(rows)), begins):
        if len(run):
            images = blocks[block[run[0]]]
            is_whole = len(run) == len(images.rows)
            samples = images.samples if is_whole else images.samples[within[run]]
            yield SonarFrames(stamps_ns[rows[run]], samples, images.ranges_m, images.azimuths_rad)


def _missing(before_ns: Ints, after_ns: Ints) -> list[int]:
    """Log times of messages that are no longer there, those at one instant taken together."""
    instants, counts = np.unique(before_ns, return_counts=True)
    there = np.searchsorted(np.sort(after_ns), instants, "right") - np.searchsorted(np.sort(after_ns), instants)
    return np.repeat(instants, counts - there).tolist()
