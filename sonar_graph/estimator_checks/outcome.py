"""What an estimator made of a sequence, and what is demanded of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sonar_graph.calibration import Calibration
from sonar_graph.estimator import Estimator
from sonar_graph.measurements import Floats, Ints
from sonar_graph.sequence import Sequence
from sonar_graph.states import DetectionLog, Estimate, LandmarkMap, Trajectory

MakeEstimator = Callable[[Calibration], Estimator]
ASK_HZ = 1.0
SYMMETRY = 1e-9
"""Largest asymmetry or negative eigenvalue of a covariance, relative to its largest entry."""


class ContractError(AssertionError):
    """An estimator does not keep the contract; the message says how."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """All that an estimator said about one sequence."""

    estimates: list[Estimate]
    trajectory: Trajectory
    landmarks: LandmarkMap
    detections: DetectionLog

    def causal(self, stamps_ns: list[int]) -> Trajectory:
        """The causal estimates at some of the instants."""
        wanted = set(stamps_ns)
        return Trajectory.from_estimates([e for e in self.estimates if e.stamp_ns in wanted])


def run(make: MakeEstimator, sequence: Sequence, instants_ns: Ints | None = None, *, ask_every: int = 0) -> Outcome:
    """Feed a sequence to a fresh estimator, cut at the instants, and ask for everything at the end.

    Parameters
    ----------
    ask_every
        Also ask after so many steps, twice, and again at the end; 0: do not.

    Raises
    ------
    ContractError
        When the answers to one question, asked twice, differ.
    """
    estimator = make(sequence.calibration)
    estimates: list[Estimate] = []
    steps = sequence.replay(sequence.instants(ASK_HZ) if instants_ns is None else instants_ns)
    for number, step in enumerate(steps, start=1):
        estimate = estimator.process(step)
        estimates += [] if estimate is None else [estimate]
        if ask_every and number % ask_every == 0:
            _answer_twice(estimator, estimates)
    return _answer_twice(estimator, estimates) if ask_every else _answer(estimator, estimates)


def _answer(estimator: Estimator, estimates: list[Estimate]) -> Outcome:
    return Outcome(estimates, estimator.trajectory(), estimator.landmarks(), estimator.detections())


def _answer_twice(estimator: Estimator, estimates: list[Estimate]) -> Outcome:
    first, second = _answer(estimator, estimates), _answer(estimator, estimates)
    differing = unlike(first, second)
    require(not differing, f"asked twice, {', '.join(differing)} differ")
    return second


def unlike(one: Outcome, other: Outcome) -> list[str]:
    """What differs, in any bit: causal estimates, trajectory, landmarks, detections."""
    parts: dict[str, tuple[object, object]] = {
        "causal estimates": (Trajectory.from_estimates(one.estimates), Trajectory.from_estimates(other.estimates)),
        "trajectory()": (one.trajectory, other.trajectory),
        "landmarks()": (one.landmarks, other.landmarks),
        "detections()": (one.detections, other.detections),
    }
    return [name for name, (mine, theirs) in parts.items() if not _is_same(mine, theirs)]


def _is_same(mine: object, theirs: object) -> bool:
    """Whether all columns of two tables are equal to the last bit."""
    for name, column in vars(mine).items():
        theirs_too = vars(theirs)[name]
        if isinstance(column, np.ndarray):
            is_same = np.array_equal(column, theirs_too, equal_nan=column.dtype.kind == "f")
        else:
            is_same = column == theirs_too
        if not is_same:
            return False
    return True


def difference(one: Outcome, other: Outcome) -> float:
    """Largest difference of causal estimates at the instants of ``one``, and of landmarks at the end.

    Infinite where an instant or a landmark is missing from ``other``.
    """
    mine, theirs = _at_same_instants(one, other)
    if len(mine) != len(theirs) or not np.array_equal(one.landmarks.ids, other.landmarks.ids):
        return float("inf")
    pairs = (
        (_perturbation(mine, theirs), 0.0),
        (mine.covariances, theirs.covariances),
        (one.landmarks.positions, other.landmarks.positions),
    )
    return max(float(np.max(np.abs(a - b), initial=0.0)) for a, b in pairs)


def deviation(one: Outcome, other: Outcome) -> tuple[float, float]:
    """Largest deviation of causal poses, and of their covariances, relative to the standard deviations of ``one``.

    Infinite where an instant is missing from ``other``.
    """
    mine, theirs = _at_same_instants(one, other)
    if len(mine) != len(theirs):
        return float("inf"), float("inf")
    sigmas = np.sqrt(np.einsum("nii->ni", mine.covariances))
    products = np.einsum("ni,nj->nij", sigmas, sigmas)
    return (
        float(np.max(np.abs(_perturbation(mine, theirs)) / sigmas, initial=0.0)),
        float(np.max(np.abs(mine.covariances - theirs.covariances) / products, initial=0.0)),
    )


def _at_same_instants(one: Outcome, other: Outcome) -> tuple[Trajectory, Trajectory]:
    stamps_ns = [estimate.stamp_ns for estimate in one.estimates]
    return one.causal(stamps_ns), other.causal(stamps_ns)


def _perturbation(mine: Trajectory, theirs: Trajectory) -> Floats:
    """[rotation, translation] from one trajectory to another in the body frame of the first, shape (n, 6)."""
    if not len(mine):
        return np.empty((0, 6))
    into_body = mine.rotations().inv()
    return np.hstack([(into_body * theirs.rotations()).as_rotvec(), into_body.apply(theirs.positions - mine.positions)])


def require(kept: bool, violation: str) -> None:
    """Raise `ContractError` unless ``kept``."""
    if not kept:
        raise ContractError(violation)


def require_covariance(matrix: Floats, size: int, name: str) -> None:
    """Raise unless ``matrix`` is finite, symmetric and positive semi-definite, shape (size, size)."""
    require(matrix.shape == (size, size), f"{name}: shape {matrix.shape}, not {(size, size)}")
    require(bool(np.isfinite(matrix).all()), f"{name} is not finite")
    scale = float(np.abs(matrix).max())
    asymmetry = float(np.abs(matrix - matrix.T).max())
    require(asymmetry <= SYMMETRY * scale, f"{name} is not symmetric: {asymmetry:.1e}")
    least = float(np.linalg.eigvalsh(matrix).min())
    require(least >= -SYMMETRY * scale, f"{name} has a negative eigenvalue: {least:.1e}")
