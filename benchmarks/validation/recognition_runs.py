"""One simulated basin, recognised by one or more rules: what every detection said, and what truly lay there."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sonar_graph.measurements import LandmarkDetections
from sonar_graph.recognition.session import RecognitionSession, one_by_one
from sonar_graph.simulation import BasinOptions, simulate_basin, simulate_basin_frames
from sonar_graph.simulation.sonar_image.frames import FrameTruth
from sonar_graph.sonar import Recogniser, RecogniserParams
from sonar_graph.sonar.bayes import IdentityParams

WHOLE = 0.9
"""Share of an object that must be in view for it to be in view."""
GAP_S = 15.0
"""An object that is out of view for less is still being passed: a vehicle that hovers sways."""
MARGIN_S = 1.0
"""Before and after it is wholly in view, detections count too."""
LEAST_FRAMES = 5
"""In view, for a pass to count: one second."""
SAME_M, APART_M = 0.15, 0.40
NONE, UNJUDGED = 0, -(10**6)
"""Labels of what is nothing, and of what lies between one thing and another; landmarks > 0, other objects < 0."""


@dataclass(frozen=True, eq=False)
class Detections:
    """Detections of one rule with the truth about them; n of them."""

    stamp_s: np.ndarray
    track: np.ndarray
    """Track of each; negative: none."""
    named: np.ndarray
    """Most probable landmark."""
    probability: np.ndarray
    """Of that landmark."""
    confidence: np.ndarray
    """Of the most probable class, none of them included."""
    is_named: np.ndarray
    """Whether that class is a landmark."""
    label: np.ndarray
    """What truly lies there."""
    error: np.ndarray
    """Measured minus true range and azimuth of that, shape (n, 2); NaN where there is nothing."""
    covariance: np.ndarray
    """As reported, shape (n, 2, 2)."""


@dataclass(frozen=True, eq=False)
class Passes:
    """Stretches in which an object is in view; m of them."""

    object_id: np.ndarray
    kind: np.ndarray
    """What the object is: a landmark's design, or the name of another thing."""
    begin_s: np.ndarray
    end_s: np.ndarray
    frames: np.ndarray

    def during(self, row: int, stamp_s: np.ndarray) -> np.ndarray:
        """Mask of the instants of a pass."""
        return (stamp_s >= self.begin_s[row] - MARGIN_S) & (
            stamp_s <= self.end_s[row] + MARGIN_S
        )


@dataclass(frozen=True, eq=False)
class Run:
    """All that came of one basin."""

    passes: Passes
    detections: dict[str, Detections]
    """By rule."""


def run_basin(options: BasinOptions, rules: Sequence[str]) -> Run:
    """Simulate, and recognise the same frames by every rule."""
    sequence = simulate_basin(options)
    sessions = {
        rule: RecognitionSession(
            sequence,
            Recogniser(
                sequence.calibration,
                params=RecogniserParams(
                    identity=IdentityParams.model_validate({"rule": rule}),
                    independent=False,
                ),
            ),
        )
        for rule in rules
    }
    seconds, in_view, found = [], [], {rule: [] for rule in rules}
    ids, kinds = np.empty(0, dtype=np.int64), ()
    for block in simulate_basin_frames(options):
        ids, kinds = block.truth.ids, block.truth.kinds
        block_s = (block.frames.stamps_ns - sequence.start_ns) * 1e-9
        seconds.append(block_s)
        in_view.append(block.truth.share_in_view >= WHOLE)
        for row, frame in enumerate(one_by_one(block.frames)):
            for rule, session in sessions.items():
                if (reported := session.take(frame).detections) is not None:
                    found[rule].append(
                        _judged(reported, float(block_s[row]), block.truth, row)
                    )
    passes = passes_of(np.concatenate(seconds), np.concatenate(in_view), ids, kinds)
    return Run(passes, {rule: _stacked(parts) for rule, parts in found.items()})


def passes_of(
    seconds: np.ndarray, in_view: np.ndarray, ids: np.ndarray, kinds: Sequence[str]
) -> Passes:
    """From which objects, m of them, are in view in which frames, shape (n, m)."""
    rows = []
    for column, object_id in enumerate(ids.tolist()):
        seen_s = seconds[in_view[:, column]]
        stretches = np.split(seen_s, np.flatnonzero(np.diff(seen_s) > GAP_S) + 1)
        rows += [
            (object_id, column, s[0], s[-1], len(s))
            for s in stretches
            if len(s) >= LEAST_FRAMES
        ]
    columns = np.array(rows, dtype=float).reshape(-1, 5).T
    kind = np.array(kinds)[columns[1].astype(int)]
    return Passes(
        columns[0].astype(int), kind, columns[2], columns[3], columns[4].astype(int)
    )


def _judged(
    found: LandmarkDetections, stamp_s: float, truth: FrameTruth, row: int
) -> Detections:
    """The detections of one frame beside what truly lies there."""
    range_m, azimuth_rad = truth.range_m()[row], truth.azimuth_rad()[row]
    error_r = found.range_m[:, None] - range_m
    error_a = (found.azimuth_rad[:, None] - azimuth_rad + np.pi) % (2 * np.pi) - np.pi
    off_m = np.hypot(error_r, 2 * range_m * np.sin(error_a / 2))
    nearest = off_m.argmin(axis=1)
    each = np.arange(len(found))
    least = off_m[each, nearest]
    label = np.where(
        least <= SAME_M, truth.ids[nearest], np.where(least > APART_M, NONE, UNJUDGED)
    )
    error = np.column_stack([error_r[each, nearest], error_a[each, nearest]])
    named, probability = found.most_probable()
    none = 1.0 - found.id_probability.sum(axis=1)
    confidence = np.maximum(probability, none)
    is_named = probability >= none
    return Detections(
        np.full(len(found), stamp_s),
        found.track,
        named,
        probability,
        confidence,
        is_named,
        label,
        np.where(least[:, None] <= SAME_M, error, np.nan),
        found.range_azimuth_cov,
    )


def _stacked(parts: list[Detections]) -> Detections:
    names = Detections.__dataclass_fields__
    shapes = {"error": (0, 2), "covariance": (0, 2, 2)}
    return Detections(
        **{
            n: np.concatenate([getattr(p, n) for p in parts])
            if parts
            else np.empty(shapes.get(n, 0))
            for n in names
        }
    )


def kept_run(path: Path | None, options: BasinOptions, rules: Sequence[str]) -> Run:
    """`run_basin`, or what it left in a file earlier; without a path nothing is kept."""
    if path is None:
        return run_basin(options, rules)
    if not path.is_file():
        _write(run_basin(options, rules), path)
    return _read(path, rules)


def _write(run: Run, path: Path) -> None:
    columns = {
        f"passes.{n}": getattr(run.passes, n) for n in Passes.__dataclass_fields__
    }
    for rule, found in run.detections.items():
        columns |= {
            f"{rule}.{n}": getattr(found, n) for n in Detections.__dataclass_fields__
        }
    partial = path.with_suffix(".part.npz")
    np.savez_compressed(partial, **columns)
    partial.rename(path)


def _read(path: Path, rules: Sequence[str]) -> Run:
    with np.load(path) as file:
        passes = Passes(**{n: file[f"passes.{n}"] for n in Passes.__dataclass_fields__})
        found = {
            r: Detections(
                **{n: file[f"{r}.{n}"] for n in Detections.__dataclass_fields__}
            )
            for r in rules
        }
    return Run(passes, found)
