"""Measures how often landmarks look like which, on logs whose truth is known: `sonar-graph calibrate`.

Every sighting of a track is labelled by the true landmarks: one that lies within 8 cm of a landmark is of it, one that
has none within 40 cm is of none; what lies between, such as a piece of a landmark, is left out.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sonar_graph.devices import DEFAULT_DESIGNS, LandmarkDesign
from sonar_graph.errors import CalibrationError, LogError
from sonar_graph.logs import read_sonar_frames
from sonar_graph.logs.adapters import LogConfig
from sonar_graph.measurements import Floats, Ints
from sonar_graph.recognition.session import RecognitionSession, no_images
from sonar_graph.sequence import Sequence as Run
from sonar_graph.sonar import Confusion, LabelledFits, ObjectSighting, Recogniser, RecogniserParams, estimate_confusion

SAME_M, APART_M = 0.08, 0.40
NO_LABEL = -2
NONE = -1


@dataclass(eq=False)
class LabelledSightings:
    """Gathers sightings with their true classes."""

    ids: tuple[int, ...]
    """Of the designs, in order."""
    _correlation: list[Floats] = field(default_factory=list)
    _visible: list[float] = field(default_factory=list)
    _label: list[int] = field(default_factory=list)
    _track: list[tuple[int, int]] = field(default_factory=list)
    _error: list[tuple[float, float]] = field(default_factory=list)

    def add(
        self, sighting: ObjectSighting, track: tuple[int, int], ids: Ints, range_m: Floats, azimuth_rad: Floats
    ) -> None:
        """One sighting, the log and the track that it is of, and where every landmark truly is, shapes (m,)."""
        if sighting.fit is None:
            return
        label, at = label_of(sighting, ids, range_m, azimuth_rad)
        if label == NO_LABEL or (label != NONE and label not in self.ids):
            return
        known = label != NONE
        self._track.append(track)
        self._correlation.append(sighting.fit.correlation)
        self._visible.append(sighting.fit.visible)
        self._label.append(self.ids.index(label) if known else len(self.ids))
        missed = (sighting.range_m - range_m[at], sighting.azimuth_rad - azimuth_rad[at])
        fits = known and sighting.is_fitted
        self._error.append(missed if fits else (np.nan, np.nan))

    def fits(self) -> LabelledFits:
        """All of them as columns."""
        return LabelledFits(
            np.array(self._correlation, float).reshape(-1, len(self.ids)),
            np.array(self._visible, float),
            np.array(self._label, np.int64),
            np.unique(np.reshape(self._track, (-1, 2)), axis=0, return_inverse=True)[1].ravel(),
            np.array(self._error, float).reshape(-1, 2),
        )


def label_of(sighting: ObjectSighting, ids: Ints, range_m: Floats, azimuth_rad: Floats) -> tuple[int, int]:
    """Identity of the landmark that was seen, `NONE` or `NO_LABEL`, and its row."""
    off = np.hypot(range_m - sighting.range_m, range_m * np.sin(azimuth_rad - sighting.azimuth_rad))
    off = np.where(np.abs(azimuth_rad - sighting.azimuth_rad) < np.pi / 2, off, np.inf)
    at = int(np.argmin(off))
    if off[at] <= SAME_M:
        return int(ids[at]), at
    return (NONE if off[at] > APART_M else NO_LABEL), at


def true_ranges_azimuths(run: Run, stamp_ns: int) -> tuple[Floats, Floats]:
    """Of every true landmark in the sonar's frame at an instant, shapes (m,)."""
    assert run.truth is not None
    assert run.true_landmarks is not None
    pose = run.truth.at(np.array([stamp_ns]))
    mounting = run.calibration.sonar.mounting.pose()
    world_R_body = pose.matrices[0]
    origin = pose.positions[0] + world_R_body @ mounting.translation()
    q = (run.true_landmarks.positions - origin) @ (world_R_body @ mounting.rotation().matrix())
    return np.linalg.norm(q, axis=1), np.arctan2(q[:, 1], q[:, 0])


def calibrate(
    logs: Sequence[tuple[Path, Run]],
    *,
    topic: str | None = None,
    config: LogConfig | None = None,
    designs: Sequence[LandmarkDesign] | None = None,
    params: RecogniserParams | None = None,
    salvage: bool = False,
) -> Confusion:
    """Measure the model on logs with images, true trajectory and true landmarks.

    Parameters
    ----------
    logs
        Each with the sequence that was read from it.
    topic, config
        As of `read_sonar_frames`.
    designs
        The landmarks; None: those that ship.
    params
        Of the recogniser that will use the model; None: the defaults.
    salvage
        As of `read_log`, and as the sequences were read.

    Raises
    ------
    CalibrationError
        When a log has no truth, has none of the landmarks, or a landmark was seen too rarely.
    LogError
        When a log has no images, or they cannot be read.
    """
    designs = tuple(designs or DEFAULT_DESIGNS)
    gathered = LabelledSightings(tuple(design.id for design in designs))
    for log, (path, run) in enumerate(logs):
        if run.truth is None or run.true_landmarks is None:
            raise CalibrationError(f"{path}: without true trajectory and true landmarks nothing in it can be labelled")
        _require_common(path, run.true_landmarks.ids, gathered.ids)
        recogniser = Recogniser(run.calibration, designs, params)
        session = RecognitionSession(run, recogniser=recogniser, pictures=False)
        for stamp_ns in session.run(read_sonar_frames(path, topic, config, salvage=salvage)):
            if recogniser.stamp_ns == stamp_ns:
                _gather(gathered, log, recogniser, run, stamp_ns)
        if not session.result.frames:
            raise LogError(no_images(path))
    names = ", ".join(path.name for path, _ in logs)
    kinds = "; ".join(dict.fromkeys(run.notes.get("ours", "recorded") for _, run in logs))
    return estimate_confusion(gathered.fits(), gathered.ids, {"logs": names, "what they are": kinds}, designs)


def _require_common(path: Path, in_log: Ints, known: tuple[int, ...]) -> None:
    if not set(known) & set(in_log.tolist()):
        raise CalibrationError(
            f"{path}: its true landmarks are {_listed(in_log.tolist())}, the designs are {_listed(known)}: none can "
            "be measured; give the designs of the log's landmarks with --designs (designs in Python)"
        )


def _listed(ids: Iterable[int]) -> str:
    return ", ".join(map(str, sorted(ids)))


def _gather(gathered: LabelledSightings, log: int, recogniser: Recogniser, run: Run, stamp_ns: int) -> None:
    truth, landmarks = run.truth, run.true_landmarks
    if truth is None or landmarks is None or not truth.stamps_ns[0] <= stamp_ns <= truth.stamps_ns[-1]:
        return
    range_m, azimuth_rad = true_ranges_azimuths(run, stamp_ns)
    for track, sighting in zip(recogniser.track_ids.tolist(), recogniser.sightings, strict=True):
        if sighting is not None:
            gathered.add(sighting, (log, track), landmarks.ids, range_m, azimuth_rad)
