"""Output of an estimator: poses, landmarks, the outcome of each detection, and refused rows."""

from __future__ import annotations

import math
import reprlib
from array import array
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
from html import escape
from typing import NamedTuple

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sonar_graph.errors import MeasurementError
from sonar_graph.measurements import Columns, Floats, Ints

FIRST_ANONYMOUS_ID = 3_000_000_000
"""First identity given to landmarks that the recogniser has not named; identities of designs end at 2^31 - 1."""


def landmark_name(identity: int) -> str:
    """Short name of a landmark: its identity, or ``u`` and a number where the recogniser has not named it.

    Examples
    --------
    >>> from sonar_graph.states import FIRST_ANONYMOUS_ID, landmark_name
    >>> landmark_name(4), landmark_name(FIRST_ANONYMOUS_ID + 3)
    ('4', 'u3')
    """
    # identities of designs are below
    number = identity - FIRST_ANONYMOUS_ID
    return str(identity) if number < 0 else f"u{number}"


MOST_ROWS = 30
"""Most landmarks that a notebook shows."""
ABSENT = "\N{EN DASH}"
"""Stands in tables where there is no number."""


def counted(number: int, noun: str) -> str:
    """A number with its noun, such as ``1 landmark`` and ``4 landmarks``."""
    return f"{number} {noun}{'s' * (number != 1)}"


def html_table(caption: str, headings: list[str], rows: list[list[str]]) -> str:
    """Plain table of texts for a notebook, all of them escaped."""
    head = " ".join(f"<th>{escape(heading)}</th>" for heading in headings)
    lines = [
        "<table>",
        f"<caption>{escape(caption)}</caption>",
        f"<thead><tr>{head}</tr></thead>",
        "<tbody>",
    ]
    for row in rows:
        cells = " ".join(f"<td>{escape(text)}</td>" for text in row)
        lines.append(f"<tr>{cells}</tr>")
    lines += ["</tbody>", "</table>"]
    return "\n".join(lines)


@dataclass(frozen=True, eq=False)
class Estimate:
    """Causal estimate of the pose at ``stamp_ns``, from what was measured until then.

    Examples
    --------
    >>> import gtsam, numpy as np
    >>> estimate = Estimate(stamp_ns=0, world_T_body=gtsam.Pose3(), covariance=1e-6 * np.eye(6))
    >>> estimate.world_T_body.translation()
    array([0., 0., 0.])
    """

    stamp_ns: int
    world_T_body: gtsam.Pose3
    covariance: Floats
    """Covariance of the body-frame perturbation [rotation, translation], shape (6, 6), rad and m."""


@dataclass(frozen=True, eq=False, repr=False)
class Trajectory(Columns):
    """Poses of the body in the world over time, with their covariances where known.

    Examples
    --------
    Two seconds of straight motion, and the pose in the middle:

    >>> import numpy as np
    >>> positions, quaternions_xyzw = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]), np.array([[0.0, 0.0, 0.0, 1.0]] * 2)
    >>> path = Trajectory.without_covariances(np.array([0, 2_000_000_000]), positions, quaternions_xyzw)
    >>> path.at(np.array([1_000_000_000])).positions
    array([[0.5, 0. , 0. ]])
    """

    stamps_ns: Ints
    """Shape (n,), strictly increasing."""
    positions: Floats
    """Origin of the body in the world, shape (n, 3), metres."""
    quaternions_xyzw: Floats
    """world_R_body, shape (n, 4), unit length, scalar last; NaN where only positions are known."""
    covariances: Floats
    """Covariances of the body-frame perturbation [rotation, translation], shape (n, 6, 6); NaN where unknown."""

    def __post_init__(self) -> None:
        if np.any(np.diff(self.stamps_ns) <= 0):
            raise MeasurementError("Trajectory: stamps must increase strictly")

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def __repr__(self) -> str:
        span = f", {self.stamps_ns[0]} to {self.stamps_ns[-1]} ns" if len(self) else ""
        return f"Trajectory({counted(len(self), 'pose')}{span})"

    def _repr_html_(self) -> str:
        """Times, length and extent, for a notebook."""
        rows = [["poses", str(len(self))]]
        if len(self):
            # along the poses: noise makes it too long
            length_m = np.linalg.norm(np.diff(self.positions, axis=0), axis=1).sum()
            rows.append(
                [
                    "duration",
                    f"{(int(self.stamps_ns[-1]) - int(self.stamps_ns[0])) * 1e-9:.2f} s",
                ]
            )
            rows.append(["length of the path", f"{length_m:.2f} m"])
            for axis, low, high in zip(
                "xyz",
                self.positions.min(axis=0),
                self.positions.max(axis=0),
                strict=True,
            ):
                rows.append([axis, f"{low:.3f} to {high:.3f} m"])
            rows.append(
                ["orientations", "known" if self.has_orientation else "unknown"]
            )
            rows.append(
                [
                    "covariances",
                    "unknown" if np.isnan(self.covariances).all() else "known",
                ]
            )
        return html_table("Trajectory", ["Quantity", "Value"], rows)

    @classmethod
    def from_poses(
        cls,
        stamps_ns: Ints | Iterable[int],
        poses: Iterable[gtsam.Pose3 | Floats],
        covariances: Floats | None = None,
    ) -> Trajectory:
        """Trajectory through poses in time order.

        Parameters
        ----------
        stamps_ns
            Shape (n,), strictly increasing.
        poses
            world_T_body of each stamp: a ``gtsam.Pose3``, or a matrix of shape (4, 4).
        covariances
            Of the body-frame perturbation [rotation, translation], shape (n, 6, 6); None: unknown.

        Raises
        ------
        MeasurementError
            When the numbers of stamps, poses and covariances differ.

        Examples
        --------
        >>> import gtsam
        >>> path = Trajectory.from_poses([0, 1_000_000_000], [gtsam.Pose3(), gtsam.Pose3()])
        >>> len(path), path.has_orientation
        (2, True)
        """
        stamps = np.asarray(list(stamps_ns), dtype=np.int64)
        n = len(stamps)
        matrices = np.array(
            [one.matrix() if isinstance(one, gtsam.Pose3) else one for one in poses],
            dtype=np.float64,
        )  # (n, 4, 4)
        # an empty list has no shape of its own
        matrices = matrices if len(matrices) else np.empty((0, 4, 4))
        if matrices.shape != (n, 4, 4):
            raise MeasurementError(
                f"Trajectory.from_poses: expected {n} poses, one a stamp, as gtsam.Pose3 or of shape (4, 4); "
                f"as matrices they have shape {matrices.shape}"
            )
        # NaN stands for unknown in all columns
        covs = np.full((n, 6, 6), np.nan) if covariances is None else covariances
        if np.shape(covs) != (n, 6, 6):
            raise MeasurementError(
                f"Trajectory.from_poses: expected covariances of shape {(n, 6, 6)}, not {np.shape(covs)}"
            )
        R = matrices[:, :3, :3]
        return cls(
            stamps_ns=stamps,
            positions=matrices[:, :3, 3],
            quaternions_xyzw=Rotation.from_matrix(R).as_quat()
            if n
            else np.empty((0, 4)),
            covariances=np.asarray(covs, dtype=np.float64),
        )

    @classmethod
    def from_estimates(cls, estimates: list[Estimate]) -> Trajectory:
        """Trajectory through a list of estimates in time order."""
        n = len(estimates)
        return cls.from_poses(
            [estimate.stamp_ns for estimate in estimates],
            [estimate.world_T_body for estimate in estimates],
            np.array([estimate.covariance for estimate in estimates]).reshape(n, 6, 6),
        )

    @classmethod
    def without_covariances(
        cls, stamps_ns: Ints, positions: Floats, quaternions_xyzw: Floats
    ) -> Trajectory:
        """Trajectory of unknown uncertainty, such as a reference."""
        return cls(
            stamps_ns,
            positions,
            quaternions_xyzw,
            np.full((len(stamps_ns), 6, 6), np.nan),
        )

    @classmethod
    def of_positions(cls, stamps_ns: Ints, positions: Floats) -> Trajectory:
        """Reference of positions only, such as from satellites: orientations are not known (NaN)."""
        return cls.without_covariances(
            stamps_ns, positions, np.full((len(stamps_ns), 4), np.nan)
        )

    @property
    def has_orientation(self) -> bool:
        """True where orientations are known, not only positions."""
        return not np.isnan(self.quaternions_xyzw).any()

    def rotations(self) -> Rotation:
        """world_R_body of every row; a `MeasurementError` where only positions are known."""
        if not self.has_orientation:
            raise MeasurementError(
                "Trajectory: only its positions are known; see has_orientation"
            )
        return Rotation.from_quat(self.quaternions_xyzw)

    @cached_property
    def matrices(self) -> Floats:
        """world_R_body of every row, shape (n, 3, 3), computed once; NaN where only positions are known."""
        return (
            np.asarray(self.rotations().as_matrix())
            if self.has_orientation
            else np.full((len(self), 3, 3), np.nan)
        )

    def at(self, stamps_ns: Ints) -> Trajectory:
        """Poses at other instants: position linear, rotation along the shortest arc; without covariances.

        Raises `MeasurementError` when an instant lies outside the trajectory.
        """
        if len(stamps_ns) and (
            stamps_ns[0] < self.stamps_ns[0] or stamps_ns[-1] > self.stamps_ns[-1]
        ):
            raise MeasurementError(
                "Trajectory.at: an instant lies outside it; select the common time span first"
            )
        # the last instant belongs to the last interval
        after = np.clip(
            np.searchsorted(self.stamps_ns, stamps_ns, side="right"), 1, len(self) - 1
        )
        before = after - 1
        # of a single pose there is no interval
        interval_ns = np.maximum(self.stamps_ns[after] - self.stamps_ns[before], 1)
        share = ((stamps_ns - self.stamps_ns[before]) / interval_ns)[:, None]
        positions = self.positions[before] + share * (
            self.positions[after] - self.positions[before]
        )
        if not self.has_orientation:
            return Trajectory.of_positions(stamps_ns, positions)
        # slerp
        start = Rotation.from_quat(self.quaternions_xyzw[before])
        end = Rotation.from_quat(self.quaternions_xyzw[after])
        quaternions = (
            # a share of the rotation vector: constant rate along the shortest arc
            start * Rotation.from_rotvec(share * (start.inv() * end).as_rotvec())
        ).as_quat()
        return Trajectory.without_covariances(stamps_ns, positions, quaternions)


class CausalEstimates:
    """Causal estimates of a filter in order of time, one an instant: its `trajectory`.

    Examples
    --------
    >>> import gtsam, numpy as np
    >>> estimates = CausalEstimates()
    >>> estimates.keep(Estimate(stamp_ns=0, world_T_body=gtsam.Pose3(), covariance=1e-6 * np.eye(6)))
    >>> len(estimates.trajectory())
    1
    """

    def __init__(self) -> None:
        self._estimates: list[Estimate] = []

    def keep(self, estimate: Estimate) -> None:
        """Append an estimate; one for the same instant replaces the last, an earlier one is ignored."""
        if not self._estimates or estimate.stamp_ns > self._estimates[-1].stamp_ns:
            self._estimates.append(estimate)
        # rows that came late changed the estimate of the same instant
        elif estimate.stamp_ns == self._estimates[-1].stamp_ns:
            self._estimates[-1] = estimate

    def trajectory(self) -> Trajectory:
        """Trajectory through all estimates."""
        return Trajectory.from_estimates(self._estimates)


@dataclass(frozen=True, eq=False, repr=False)
class LandmarkMap:
    """Positions of landmarks, with their covariances, by identity.

    Examples
    --------
    >>> import numpy as np
    >>> landmarks = LandmarkMap(np.array([1, 2]), np.array([[5.0, 0.0, -1.0], [7.0, -5.0, -1.0]]), np.zeros((2, 3, 3)))
    >>> len(landmarks)
    2
    """

    ids: Ints
    """Shape (m,), each once, ascending."""
    positions: Floats
    """In the world, shape (m, 3), metres."""
    covariances: Floats
    """Shape (m, 3, 3), m²; NaN where unknown."""

    @classmethod
    def empty(cls) -> LandmarkMap:
        """Map of no landmarks."""
        return cls(np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 3, 3)))

    def __len__(self) -> int:
        return len(self.ids)

    def __repr__(self) -> str:
        return f"LandmarkMap({counted(len(self), 'landmark')}, ids {reprlib.repr(self.ids.tolist())})"

    def _repr_html_(self) -> str:
        """Positions with their standard deviations, for a notebook: of the first `MOST_ROWS` landmarks."""
        # NaN where a covariance is unknown, shown as a dash
        sigmas = np.sqrt(np.diagonal(self.covariances, axis1=1, axis2=2))
        rows = [
            [
                str(id_),
                *(f"{at:.3f}" for at in position),
                *(ABSENT if np.isnan(one) else f"{one:.3f}" for one in sigma),
            ]
            for id_, position, sigma in zip(
                self.ids[:MOST_ROWS].tolist(), self.positions, sigmas, strict=False
            )
        ]
        left_out = (
            f"; {len(self) - MOST_ROWS} more are not shown"
            if len(self) > MOST_ROWS
            else ""
        )
        heads = [
            "ID",
            "x (m)",
            "y (m)",
            "z (m)",
            "sigma x (m)",
            "sigma y (m)",
            "sigma z (m)",
        ]
        return html_table(
            f"Map of {counted(len(self), 'landmark')}{left_out}", heads, rows
        )


class Outcome(StrEnum):
    """Outcome of a detection in an estimator.

    Examples
    --------
    >>> Outcome.GATED.value
    'refused: innovation outside the gate'
    """

    USED = "used"
    NEW = "new landmark"
    USED_LATER = "used later, when its identity was known"
    PLACED_LATER = (
        "used later, when its landmark, of unknown identity, had been seen often enough"
    )
    MOVED = "used: taken back from one landmark and given to another"
    GATED = "refused: innovation outside the gate"
    REASSIGNED = "used: its place says that it is another landmark"
    UNFIT = "refused: its place fits no landmark that it may be"
    NO_IDENTITY = "refused: no identity probable enough"
    WAITING = "waiting: its identity is not known yet"
    FORGOTTEN = "refused: its identity did not become known in time"
    TAKEN_BACK = "taken back: its track is of no known landmark"
    REPEATED = "refused: the frame shows this landmark elsewhere, more probably"
    TRACK_REPEATED = (
        "refused: the frame has another row of its track, of which one object is seen"
    )
    UNSOUND = "refused: its range is not above 0 and at most 100 km, or its covariance not positive definite"
    WITHHELD = "withheld: with it the estimate could not be determined"
    LATE = "refused: older than what was already processed"
    UNLOCATED = "refused: no odometry covers its stamp"
    IGNORED = "ignored: this estimator uses no landmarks"


@dataclass(frozen=True, eq=False, repr=False)
class DetectionLog:
    """Outcome of every detection, one row each, in the order processed.

    Examples
    --------
    Number of detections used by an estimator that has run:

    >>> def used(log: DetectionLog) -> int:
    ...     return sum(outcome is Outcome.USED for outcome in log.outcomes)
    """

    stamps_ns: Ints
    """Shape (n,)."""
    landmark_ids: Ints
    """Most probable identity, shape (n,)."""
    innovations: Floats
    """Measured minus predicted (range m, azimuth rad), shape (n, 2); NaN where there was no prediction."""
    innovation_covs: Floats
    """Shape (n, 2, 2); NaN where there was no prediction."""
    outcomes: list[Outcome]
    """Length n."""

    @classmethod
    def empty(cls) -> DetectionLog:
        """Log of an estimator that was given no detections."""
        return DetectionJournal().log()

    def __len__(self) -> int:
        return len(self.outcomes)

    def __repr__(self) -> str:
        counts = Counter(outcome.name for outcome in self.outcomes)
        return f"DetectionLog({', '.join(f'{count} {name}' for name, count in counts.items())})"


class Refusal(StrEnum):
    """Reason for which a row of a sensor is not used."""

    OUTLIER = "refused: no vehicle reaches this velocity from the last"
    LATE = "refused: the motion that it belongs to was already used"
    UNCONFIRMED = (
        "refused: no other velocity confirms it, and none before it is near enough"
    )
    WAITED = "left out: after a gap a velocity waits until a later one agrees, and the later one ends the gap; nothing to do"
    UNSOUND = "refused: its covariance is not positive definite, or no sensor gives its value or its noise"
    INCOMPLETE = "refused: too few beams to measure the whole velocity"
    BEYOND_SENSOR = "refused: no gyro or accelerometer measures this"
    OUT_OF_REACH = "refused: no vehicle reaches this depth from the last, or no other depth confirms it"
    CLOCK = "refused: more than a day from the rows that follow or precede; was the clock set between, or are these not ns?"
    RATE = "not used: stamps follow each other faster than any sensor measures; are they nanoseconds?"


class RefusedRow(NamedTuple):
    """Row of a sensor that is not used, with the reason."""

    sensor: str
    """``imu``, ``dvl``, ``depth``, ``heading`` or ``positions``."""
    stamp_ns: int
    reason: Refusal
    distance: float = math.nan
    """Squared Mahalanobis distance of an outlier, or of a depth out of reach; NaN for other reasons."""


class DetectionJournal:
    """Growing `DetectionLog` of an estimator, as columns of numbers: 73 bytes a row in logs of hours.

    Examples
    --------
    >>> journal = DetectionJournal()
    >>> row = journal.record(0, landmark_id=3, outcome=Outcome.IGNORED)
    >>> journal.log()
    DetectionLog(1 IGNORED)
    """

    def __init__(self) -> None:
        # arrays of the standard library grow without copying every row
        self._stamps_ns = array("q")
        self._ids = array("q")
        self._outcomes = array("b")
        self._innovations = array("d")
        self._innovation_covs = array("d")
        self._forgotten = 0

    def __len__(self) -> int:
        return len(self._outcomes)

    def record(
        self,
        stamp_ns: int,
        landmark_id: int,
        outcome: Outcome,
        innovation: Floats | None = None,
        innovation_cov: Floats | None = None,
    ) -> int:
        """Append a row, and return its number.

        ``innovation``: measured minus predicted (range m, azimuth rad), shape (2,); None without a prediction;
        ``innovation_cov``: shape (2, 2).
        """
        self._stamps_ns.append(stamp_ns)
        self._ids.append(landmark_id)
        self._outcomes.append(OUTCOME_NUMBERS[outcome])
        self._innovations.extend(
            UNKNOWN[:2] if innovation is None else innovation.tolist()
        )
        self._innovation_covs.extend(
            UNKNOWN if innovation_cov is None else innovation_cov.ravel().tolist()
        )
        return self._forgotten + len(self) - 1

    def extend(
        self,
        stamps_ns: Ints,
        ids: Ints,
        outcomes: NDArray[np.int8],
        innovations: Floats,
        covs: Floats,
    ) -> None:
        """Append rows, with outcomes as `OUTCOME_NUMBERS`; NaN without a prediction."""
        self._stamps_ns.frombytes(stamps_ns.tobytes())
        self._ids.frombytes(ids.tobytes())
        self._outcomes.frombytes(outcomes.tobytes())
        self._innovations.frombytes(innovations.tobytes())
        self._innovation_covs.frombytes(covs.tobytes())

    def log(self) -> DetectionLog:
        """Rows that are not forgotten."""
        n = len(self)
        return DetectionLog(
            stamps_ns=np.array(self._stamps_ns, dtype=np.int64),
            landmark_ids=np.array(self._ids, dtype=np.int64),
            innovations=np.array(self._innovations, dtype=np.float64).reshape(n, 2),
            innovation_covs=np.array(self._innovation_covs, dtype=np.float64).reshape(
                n, 2, 2
            ),
            outcomes=[OUTCOMES[number] for number in self._outcomes],
        )


OUTCOMES = list(Outcome)
OUTCOME_NUMBERS = {outcome: number for number, outcome in enumerate(OUTCOMES)}
UNKNOWN = (math.nan,) * 4
