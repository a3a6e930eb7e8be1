"""Adapter for imaging sonars: messages as frames of intensities over beams and range bins."""

from collections import Counter
from collections.abc import Callable, Iterator
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from sonar_graph.images import SonarFrames
from sonar_graph.logs.adapters.adapter import Adapter, FieldPath, FieldPaths
from sonar_graph.logs.adapters.message_table import MessageTable
from sonar_graph.logs.cdr import Messages
from sonar_graph.logs.mcap import Topic
from sonar_graph.measurements import Floats, Ints

SAMPLE_TYPES = ("u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f4", "f8")
"""Type of a sample, as numpy names it, for each number in marine_acoustic_msgs/SonarImageData."""
GAIN_BYTES = 4
KINDS = ("sample_type", "sample_bytes", "big_endian", "row_gains", "row_bytes")
"""Attributes with the fields that state what samples are, and how they lie."""
Refused = Callable[[int, str], None]
"""Called with the stamp of a message and the reason why it is no image."""


class _NoImageError(Exception):
    """Field and fault of a message that is no image."""


class _Images(NamedTuple):
    """Images of one size and kind."""

    rows: Ints
    """Numbers of the messages in the topic, ascending."""
    samples: NDArray[np.generic]
    """Shape (n, beams, bins)."""
    ranges_m: Floats
    azimuths_rad: Floats


def samples_of_rows(
    rows: NDArray[np.uint8], dtype: np.dtype[np.generic], *, has_gains: bool
) -> NDArray[np.generic]:
    """Samples in rows of bytes, shape (..., bytes), where each row may begin with its gain, a uint32."""
    head = GAIN_BYTES if has_gains else 0
    values: NDArray[np.generic] = np.ascontiguousarray(rows[..., head:]).view(dtype)
    if not has_gains:
        return values
    gains = np.ascontiguousarray(rows[..., :head]).view("<u4").astype(np.float32)
    # the gain of a row is of power, and samples are amplitudes; a gain of 0 would be none at all
    return np.asarray(values / np.sqrt(np.maximum(gains, 1)), np.float32)


class SonarAdapter(Adapter):
    """Beams, range bins and the image of every ping."""

    EITHER = (
        ("ranges", "range_resolution", "ranges or range_resolution"),
        ("bearings", "directions", "bearings or directions"),
    )
    data: FieldPath
    """Field with the image's bytes."""
    image_order: Literal["range-major", "beam-major"] = "range-major"
    """range-major: all beams of the first range, then of the next, which is what drivers do (also where the message's
    comment states otherwise); beam-major: all ranges of the first beam first."""
    ranges: FieldPath | None = None
    """Array field with the middle of each range bin, metres."""
    range_resolution: FieldPath | None = None
    """Field with the size of a range bin, instead: bins then begin at the sonar."""
    bearings: FieldPath | None = None
    """Array field with an angle a beam."""
    bearing_unit_deg: float = Field(180 / np.pi, gt=0)
    """Unit of a bearing in degrees; 0.01 where they are given in hundredths."""
    bearing_positive: Literal["left", "right"] = "right"
    """Side of the sonar with positive bearings."""
    directions: FieldPaths | None = None
    """Array fields with x, y, z of each beam's direction, instead: z forward, x up, y to the right."""
    sample_type: FieldPath | None = None
    """Field with the kind of a sample as marine_acoustic_msgs counts them (0: u8, 1: i8, 2: u16, ... 9: f64)."""
    sample_bytes: FieldPath | None = None
    """Field with the number of bytes of an unsigned sample, instead; without either they are bytes."""
    big_endian: FieldPath | None = None
    """Field that states whether samples are big-endian."""
    row_gains: FieldPath | None = None
    """Field that states whether each row begins with its gain, a uint32; samples are divided by its square root."""
    row_bytes: FieldPath | None = None
    """Field with the number of bytes of a row, gain and padding included."""

    def read(
        self, topic: Topic, refused: Refused | None = None
    ) -> Iterator[SonarFrames]:
        """Blocks of frames that share beams, bins and kind of sample, in the order of the log.

        A block ends where the next frame differs in these, or has an earlier stamp. A message that is no image is given
        to ``refused`` with its stamp and the reason, or else is an error.
        """
        recorded_ns = Counter(topic.log_times_ns.tolist())
        # from here on the topic knows its sound messages
        is_any_sound = bool(topic.messages())
        if refused is not None:
            # unsound messages are known by their times alone
            unsound = recorded_ns - Counter(topic.log_times_ns.tolist())
            for stamp_ns in sorted(unsound.elements()):
                refused(stamp_ns, f"message {' or '.join(topic.unsound)}")
        if not is_any_sound:
            return
        table = self.table(topic)
        blocks = [
            block
            for group in table.groups
            for block in self._images(table, group, refused)
        ]
        if not blocks:
            return
        # of each message its number in the topic, its block and its place there
        columns = [
            np.column_stack([b.rows, np.full(len(b.rows), k), np.arange(len(b.rows))])
            for k, b in enumerate(blocks)
        ]
        places = np.concatenate(columns)
        rows, block, within = places[np.argsort(places[:, 0])].T
        is_end = (np.diff(block) != 0) | (np.diff(table.stamps_ns[rows]) < 0)
        ends = np.flatnonzero(is_end) + 1
        for run in np.split(np.arange(len(rows)), ends):
            images = blocks[block[run[0]]]
            is_whole = len(run) == len(images.rows)  # then without a copy
            samples = images.samples if is_whole else images.samples[within[run]]
            stamps_ns = table.stamps_ns[rows[run]]
            yield SonarFrames(stamps_ns, samples, images.ranges_m, images.azimuths_rad)

    def _images(
        self, table: MessageTable, group: Messages, refused: Refused | None
    ) -> Iterator[_Images]:
        """Images of messages of one layout, apart where beams, bins or samples differ."""
        count = len(group)
        paths = [getattr(self, name) for name in KINDS]
        flags = [
            group[path].astype(np.int64) if path else np.full(count, -1)
            for path in paths
        ]
        kinds = np.column_stack(flags)
        bins = group[str(self.ranges or self.range_resolution)]
        bins_m = np.asarray(bins, float).reshape(count, -1)
        if self.directions is not None:
            _, y, z = (group[path].astype(float) for path in self.directions)
            azimuths_rad = np.arctan2(-y, z)
        else:
            sign = 1 if self.bearing_positive == "left" else -1
            bearings = group[str(self.bearings)].astype(float)
            azimuths_rad = sign * np.radians(bearings * self.bearing_unit_deg)
        # a sonar changes range or gain between pings: each setting is a block
        same = np.column_stack([kinds, bins_m, azimuths_rad])
        settings = np.unique(same, axis=0, return_index=True, return_inverse=True)
        _, first, block = settings
        for number, at in enumerate(first.tolist()):
            rows = np.flatnonzero(block.reshape(-1) == number)
            data = group[self.data][rows]
            try:
                samples = self._samples(data, azimuths_rad.shape[1], kinds[at])
                bins_seen = samples.shape[2]
                ranges_m = bins_m[at]
                if self.ranges is None:
                    ranges_m = (np.arange(bins_seen) + 0.5) * ranges_m[0]
                elif len(ranges_m) != bins_seen:
                    fault = f"has {bins_seen} bins a beam; {self.ranges} has {len(ranges_m)}"
                    raise _NoImageError(self.data, fault)
            except _NoImageError as error:
                if refused is None:
                    table.refuse(*error.args)
                for stamp_ns in table.stamps_ns[group.rows[rows]].tolist():
                    refused(stamp_ns, " ".join(error.args))
                continue
            yield _Images(group.rows[rows], samples, ranges_m, azimuths_rad[at])

    def _samples(
        self, data: NDArray[np.generic], beams: int, kind: NDArray[np.int64]
    ) -> NDArray[np.generic]:
        """Intensities, shape (n, beams, bins), from the bytes of n images."""
        sample_type, sample_bytes, big_endian, row_gains, row_bytes = kind.tolist()
        name = f"u{sample_bytes if self.sample_bytes is not None else 1}"
        if self.sample_type is not None:
            if not 0 <= sample_type < len(SAMPLE_TYPES):
                fault = f"is {sample_type}; kinds of samples are 0 to {len(SAMPLE_TYPES) - 1}"
                raise _NoImageError(self.sample_type, fault)
            name = SAMPLE_TYPES[sample_type]
        elif name not in ("u1", "u2", "u4"):
            fault = f"is {sample_bytes}; samples have 1, 2 or 4 bytes"
            raise _NoImageError(str(self.sample_bytes), fault)
        dtype = np.dtype((">" if big_endian > 0 else "<") + name)
        data_bytes: NDArray[np.uint8] = np.ascontiguousarray(data).view(np.uint8)
        size = data_bytes.shape[1]
        is_by_range = self.image_order == "range-major"
        head = GAIN_BYTES if row_gains > 0 else 0
        used = head + beams * dtype.itemsize if is_by_range else size // max(beams, 1)
        if row_bytes <= 0:
            row_bytes = used
        elif not is_by_range:
            used = row_bytes
        # rows may be padded
        row_count = size // max(row_bytes, 1) if is_by_range else beams
        is_whole = row_count * row_bytes == size and used <= row_bytes
        if not (beams and row_count and is_whole):
            fault = f"has {size} bytes; that is no image of {beams} beams of {dtype} samples"
            raise _NoImageError(self.data, fault)
        image = data_bytes.reshape(len(data), row_count, row_bytes)
        values = samples_of_rows(image[:, :, :used], dtype, has_gains=head > 0)
        return values.transpose(0, 2, 1) if is_by_range else values
