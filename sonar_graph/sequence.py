"""A recorded or simulated run: produced by logs and simulator, consumed by estimators."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from numbers import Real
from typing import Any

import numpy as np

from sonar_graph.calibration import Calibration, require_calibration
from sonar_graph.errors import ArgumentError, MeasurementError
from sonar_graph.measurements import (
    BLOCKS,
    NS_PER_S,
    Block,
    Depth,
    Dvl,
    Heading,
    Imu,
    Ints,
    LandmarkDetections,
    Measurements,
    PositionFixes,
    require_blocks,
)
from sonar_graph.measurements import PAUSE_NS as PAUSE_NS
from sonar_graph.states import (
    ABSENT,
    LandmarkMap,
    Refusal,
    RefusedRow,
    Trajectory,
    html_table,
)

MOST_INSTANTS = 10_000_000
"""Two months at 2 Hz; a clock that was set meanwhile could take all memory."""


@dataclass(frozen=True, eq=False, repr=False)
class Sequence:
    """Calibration, measurements in order of time, and truth where it is known.

    Examples
    --------
    >>> import numpy as np
    >>> from sonar_graph import Calibration, Dvl, Imu
    >>> stamps_ns = np.arange(0, 2_000_000_001, 100_000_000)
    >>> n = len(stamps_ns)
    >>> imu = Imu(stamps_ns, np.zeros((n, 3)), np.tile([0.0, 0.0, 9.81], (n, 1)))
    >>> dvl = Dvl(stamps_ns, np.tile([0.15, 0.0, 0.0], (n, 1)), np.full((n, 3, 3), np.nan))
    >>> straight = Sequence("straight", Calibration(), imu, dvl)
    >>> straight
    Sequence('straight': 2.0 s, 21 imu, 21 dvl)
    >>> [step.end_ns for step in straight.replay(straight.instants(rate_hz=1.0))]
    [1000000000, 2000000000]
    """

    name: str
    """Short, for tables and file names."""
    calibration: Calibration
    imu: Imu
    dvl: Dvl
    depth: Depth | None = None
    detections: LandmarkDetections | None = None
    truth: Trajectory | None = None
    """Reference poses of the body, or its positions only; `notes` names their origin."""
    true_landmarks: LandmarkMap | None = None
    heading: Heading | None = None
    positions: PositionFixes | None = None
    notes: dict[str, str] = field(default_factory=dict)
    """Provenance by subject: data set, licence, options of a simulation, seed."""

    def __post_init__(self) -> None:
        require_calibration(self.calibration, "Sequence.calibration")
        require_blocks(self)
        for name in ("imu", "dvl"):
            if getattr(self, name) is None:
                raise MeasurementError(
                    f"Sequence.{name}: expected {BLOCKS[name].__name__}, not None; every estimator needs an IMU and a "
                    "Doppler log"
                )

    def __repr__(self) -> str:
        known = self.blocks() | {
            "truth": self.truth,
            "true_landmarks": self.true_landmarks,
        }
        rows = (
            f"{len(block)} {name}" for name, block in known.items() if block is not None
        )
        return f"Sequence({self.name!r}: {self.duration_s:.1f} s, {', '.join(rows)})"

    def _repr_html_(self) -> str:
        """The blocks with their rows, times and rates, for a notebook."""
        # truth has stamps, and so a rate
        known = self.blocks() | {"truth": self.truth}
        rows = []
        for name, block in known.items():
            if block is None or not len(block):
                continue
            first, last = (
                (int(stamp_ns) - self.start_ns) * 1e-9
                for stamp_ns in block.stamps_ns[[0, -1]]
            )
            rate = (
                f"{(len(block) - 1) / (last - first):.4g}" if last > first else ABSENT
            )
            rows.append([name, str(len(block)), f"{first:.2f}", f"{last:.2f}", rate])
        if self.true_landmarks is not None:
            rows.append(
                ["true landmarks", str(len(self.true_landmarks)), *[ABSENT] * 3]
            )
        heads = ["Block", "Rows", "First (s)", "Last (s)", "Rate (Hz)"]
        caption = f"Sequence {self.name}, {self.duration_s:.1f} s"
        return html_table(caption, heads, rows)

    def blocks(self) -> dict[str, Block]:
        """Measurements that there are, by their names in `Measurements`."""
        return {
            name: block for name in BLOCKS if (block := getattr(self, name)) is not None
        }

    @property
    def true_poses(self) -> Trajectory | None:
        """The truth, where it has orientations and not only positions."""
        return (
            self.truth
            if self.truth is not None and self.truth.has_orientation
            else None
        )

    @cached_property
    def start_ns(self) -> int:
        """First instant with IMU and DVL: the start pose of the calibration holds here."""
        return max(longest_part(rows.stamps_ns)[0] for rows in (self.imu, self.dvl))

    @cached_property
    def end_ns(self) -> int:
        """Last instant with IMU and DVL."""
        return min(longest_part(rows.stamps_ns)[1] for rows in (self.imu, self.dvl))

    def off_the_clock(self) -> list[RefusedRow]:
        """Rows more than a day before the start or after the end, which `replay` leaves out, or that are too fast."""
        # no log pauses for a day: a clock was set there
        first_ns = self.start_ns - PAUSE_NS
        last_ns = self.end_ns + PAUSE_NS
        too_fast = [
            RefusedRow(sensor, stamp_ns, Refusal.RATE, math.nan)
            for sensor, block in self.blocks().items()
            if block.is_too_fast() and first_ns < block.stamps_ns[0]
            for stamp_ns in block.stamps_ns.tolist()
        ]
        return too_fast + [
            RefusedRow(sensor, stamp_ns, Refusal.CLOCK, math.nan)
            for sensor, block in self.blocks().items()
            if block.stamps_ns[0] <= first_ns or block.stamps_ns[-1] > last_ns
            for stamp_ns in block.stamps_ns[
                (block.stamps_ns <= first_ns) | (block.stamps_ns > last_ns)
            ].tolist()
        ]

    @property
    def duration_s(self) -> float:
        """Seconds between `start_ns` and `end_ns`."""
        return (self.end_ns - self.start_ns) * 1e-9

    def instants(self, rate_hz: float) -> Ints:
        """Equally spaced instants from one step after the start until the end, shape (n,), nanoseconds.

        Raises
        ------
        MeasurementError
            When the rate is no positive number, the sequence is shorter than one step, or the instants are too many.
        """
        given: object = rate_hz
        if not isinstance(given, Real) or not 0 < rate_hz <= NS_PER_S:
            raise MeasurementError(
                f"{rate_hz!r} Hz is no rate; expected a number of more than 0, and at most one instant a nanosecond"
            )
        # whole nanoseconds, so that instants do not drift by rounding
        step_ns = round(NS_PER_S / rate_hz)
        count = (self.end_ns - self.start_ns) // step_ns
        if count > MOST_INSTANTS:
            raise MeasurementError(
                f"{self.name}: {self.duration_s:.0f} s at {rate_hz:g} Hz are {count} instants, and at most "
                f"{MOST_INSTANTS} are asked for: read a part with --start and --end, or lower --rate-hz"
            )
        instants = np.arange(
            self.start_ns + step_ns, self.end_ns + 1, step_ns, dtype=np.int64
        )
        # one of the clocks was set, or the parts of a log are of two days
        if self.end_ns < self.start_ns:
            raise MeasurementError(
                f"{self.name}: the rows of IMU and DVL have no time in common: of two clocks, or of one that was set?"
            )
        if not len(instants):
            raise MeasurementError(
                f"{self.name}: {self.duration_s:.3f} s with IMU and DVL are too short for {rate_hz} Hz"
            )
        return instants

    def replay(self, instants_ns: Ints) -> Iterator[Measurements]:
        """Measurements between successive instants; the first item holds all from a day before the start on."""
        # sensors that began earlier belong to the first call
        after_ns = self.start_ns - PAUSE_NS
        for end_ns in instants_ns.tolist():
            rows: dict[str, Any] = {
                name: block.between(after_ns, end_ns)
                for name, block in self.blocks().items()
            }
            yield Measurements(end_ns, **rows)
            after_ns = end_ns


def longest_part(stamps_ns: Ints) -> tuple[int, int]:
    """First and last stamp of the part with the most rows between pauses."""
    # in float: differences of stamps of 1970 and 2200 do not fit into 64 bits
    pauses = np.flatnonzero(np.diff(stamps_ns.astype(np.float64)) > PAUSE_NS) + 1
    # of a log in two parts the larger one counts
    first, end = max(
        pairwise([0, *pauses.tolist(), len(stamps_ns)]),
        key=lambda part: part[1] - part[0],
    )
    return int(stamps_ns[first]), int(stamps_ns[end - 1])


def require_sequence(value: object, call: str) -> None:
    """Raise an `ArgumentError` that names the expected ``call`` where an argument is no `Sequence`."""
    if not isinstance(value, Sequence):
        raise ArgumentError(
            f"{call}: expected a Sequence, not {type(value).__name__}; read_log gives one"
        )
