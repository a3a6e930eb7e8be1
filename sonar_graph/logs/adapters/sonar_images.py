"""Imaging sonar: messages as frames of intensities over beams and range bins."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from sonar_graph.logs.adapters.adapter import Adapter
from sonar_graph.logs.cdr import Messages
from sonar_graph.logs.container import Topic
from sonar_graph.logs.table import Table
from sonar_graph.measurements import Floats, SonarFrames

SAMPLE_TYPES = ("u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f4", "f8")
"""numpy's type for each number in marine_acoustic_msgs/SonarImageData."""
_GAIN_BYTES = 4


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

    def read(self, topic: Topic) -> Iterator[SonarFrames]:
        """Blocks of frames that share beams, bins and kind of sample, in no particular order of time.

        Raises
        ------
        LogError
            When an image is not as long as beams and bins say.
        """
        if not topic.messages():
            return  # nothing sound in this piece of the log
        table = self.table(topic)
        for group in table.groups:
            yield from self._blocks(table, group)

    def _blocks(self, table: Table, group: Messages) -> Iterator[SonarFrames]:
        """Splits messages of one layout where beams, bins or samples change."""
        beams, bins = self._azimuths(group), self._bins(group)
        kind = np.column_stack([self._flag(group, path) for path in self._kinds()])
        _, first, block = np.unique(
            np.column_stack([kind, bins, beams]), axis=0, return_index=True, return_inverse=True
        )
        for number, at in enumerate(first.tolist()):
            rows = np.flatnonzero(block.reshape(-1) == number)
            samples = self._samples(table, group, rows, beams.shape[1], kind[at])
            count = samples.shape[2]
            ranges_m = bins[at] if self.ranges is not None else (np.arange(count) + 0.5) * bins[at, 0]
            if len(ranges_m) != count:
                table.refuse(self.data, f"has {count} bins a beam; {self.ranges} has {len(ranges_m)}")
            stamps_ns = table.stamps_ns[group.rows[rows]]
            order = np.argsort(stamps_ns, kind="stable")
            yield SonarFrames(stamps_ns[order], samples[order], ranges_m, beams[at])

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
        self, table: Table, group: Messages, rows: NDArray[np.int64], beams: int, kind: NDArray[np.int64]
    ) -> NDArray[np.generic]:
        """Intensities, shape (n, beams, bins)."""
        dtype = self._dtype(table, kind)
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
            table.refuse(self.data, f"has {size} bytes; that is no image of {beams} beams of {dtype} samples")
        image = data.reshape(len(rows), row_count, row_bytes)
        values = np.ascontiguousarray(image[:, :, head:used]).view(dtype)
        if has_gains:
            gains = np.ascontiguousarray(image[:, :, :_GAIN_BYTES]).view("<u4").astype(np.float32)
            values = (values / np.sqrt(np.maximum(gains, 1))).astype(np.float32)
        return values.transpose(0, 2, 1) if self.image_order == "range-major" else values

    def _dtype(self, table: Table, kind: NDArray[np.int64]) -> np.dtype[np.generic]:
        order = ">" if kind[2] > 0 else "<"
        if self.sample_type is not None:
            if not 0 <= kind[0] < len(SAMPLE_TYPES):
                table.refuse(self.sample_type, f"is {kind[0]}; kinds of samples are 0 to {len(SAMPLE_TYPES) - 1}")
            return np.dtype(order + SAMPLE_TYPES[kind[0]])
        size = int(kind[1]) if self.sample_bytes is not None else 1
        if size not in (1, 2, 4):
            table.refuse(str(self.sample_bytes), f"is {size}; samples have 1, 2 or 4 bytes")
        return np.dtype(f"{order}u{size}")
