"""Labels of landmarks that a person gave to places in frames: their file, and the calibration by them.

A file of labels is JSON, or CSV with the columns stamp_ns, range_m, azimuth_rad and id::

    {"log": "dive.mcap", "labels": [{"stamp_ns": 1700000000000000000, "range_m": 1.93, "azimuth_rad": 0.05, "id": 2}]}

with the middle of what is seen, azimuths positive to the left, and null (CSV: empty) for what is no landmark. Each
label names the track of the recogniser that it meets, in all frames of it: landmarks are at rest, so that the motion of
the sonar carries the place of a label into these frames (the mean place of several). So a few labels give hundreds of
labelled sightings, as a log with known truth does (`sonar_graph.recognition.confusion_fit`).

A click errs by a centimetre, more than the recogniser does. With the distance d of the labels' mean place from the
median one of the track's sightings, and V the variance of such means by the scatter of the labels of a track (that of
`CLICK_SIGMA_M` where no track has two), the true place is taken as the sightings' plus
``max(0, 1 - mean V / mean d^2) d`` (James and Stein 1961): labels tell an error that all tracks share only as far as it
exceeds their own.
"""

import csv
import json
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import gtsam
import numpy as np
from pydantic import Field

from sonar_graph.calibration import Section
from sonar_graph.devices import DEFAULT_DESIGNS, LandmarkDesign
from sonar_graph.errors import CalibrationError
from sonar_graph.files import replacing, spelt, text_of
from sonar_graph.images import SonarFrames
from sonar_graph.logs import ImagesAlone, read_sonar_frames
from sonar_graph.logs.adapters import LogConfig
from sonar_graph.measurements import Floats
from sonar_graph.recognition.confusion_fit import LabelledSightings, estimate_confusion
from sonar_graph.recognition.image_motion import MotionFrom
from sonar_graph.recognition.session import RecognitionSession
from sonar_graph.sequence import Sequence as Run
from sonar_graph.settings import parse
from sonar_graph.sonar import SLANT_PLANE, Confusion, ObjectSighting, Recogniser, RecogniserParams

COLUMNS = ("stamp_ns", "range_m", "azimuth_rad", "id")
NEAR_M = 0.2
"""Distance of a candidate up to which a label is of it."""
CLICK_SIGMA_M = 0.01
"""Standard deviation of a label along each axis, where labels do not tell it."""
NOWHERE = np.array([-1]), np.array([1e9]), np.array([0.0])
"""True landmarks around what is none: one that is far away."""


class Label(Section):
    """Place in a frame, and what is there."""

    stamp_ns: int
    """Of the frame."""
    range_m: float = Field(gt=0, allow_inf_nan=False)
    azimuth_rad: float = Field(ge=-np.pi, le=np.pi, allow_inf_nan=False)
    id: int | None = Field(ge=0)
    """Identity of the landmark; None: it is no landmark."""


class Labels(Section):
    """Labels of one log."""

    log: str
    """Name of its file."""
    labels: tuple[Label, ...] = ()

    def write(self, path: Path) -> None:
        """Write the file, whole or not at all."""
        with replacing(path) as partial:
            rows = ",\n".join(f"    {label.model_dump_json()}" for label in self.labels)
            text = f'{{\n  "log": {json.dumps(self.log)},\n  "labels": [\n{rows}\n  ]\n}}\n'
            partial.write_text(text, encoding="utf-8")


def read_labels(path: Path, log: Path) -> Labels:
    """Read labels of a log from a JSON or CSV file.

    Raises
    ------
    CalibrationError
        When the file cannot be read, is neither, has a field that does not fit, or is of another log.
    """
    try:
        text = text_of(path)
        content = _from_csv(text, log) if path.suffix.lower() == ".csv" else json.loads(text)
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise CalibrationError(
            f"{path}: {error}; expected JSON as `sonar-graph label` writes it, or CSV with {', '.join(COLUMNS)}"
        ) from error
    labels = parse(Labels, content, str(path))
    if labels.log != spelt(log.name):
        raise CalibrationError(f"{path}: its labels are of {labels.log}, not of {log.name}; name the log they are of")
    return labels


def _from_csv(text: str, log: Path) -> dict[str, object]:
    rows = csv.DictReader(text.splitlines())
    if missing := set(COLUMNS) - set(rows.fieldnames or ()):
        raise ValueError(f"no column {', '.join(sorted(missing))}")
    labels = [
        {name: (row[name] or "").strip() for name in COLUMNS[:3]} | {"id": (row["id"] or "").strip() or None}
        for row in rows
    ]
    return {"log": spelt(log.name), "labels": labels}


@dataclass
class LabelledTrack:
    """Sightings of a track with the sonar's pose at each, and the labels that it met, all in one frame at rest."""

    sightings: list[tuple[gtsam.Pose3, ObjectSighting, float]] = field(default_factory=list)
    """With the independent share of the frame."""
    seen: list[Floats] = field(default_factory=list)
    """Places of the sightings."""
    ids: set[int | None] = field(default_factory=set)
    labelled: list[Floats] = field(default_factory=list)
    """Places of the labels."""

    def off(self) -> Floats:
        """Mean place of the labels from `middle`, shape (3,)."""
        return np.asarray(np.mean(self.labelled, axis=0) - self.middle())

    def middle(self) -> Floats:
        """Median place of the sightings, shape (3,)."""
        return np.asarray(np.median(self.seen, axis=0))


def trusted_share(tracks: Sequence[LabelledTrack]) -> float:
    """Share of the distance of labels from sightings that is not the labels' own error, pooled over tracks."""
    several = [track for track in tracks if len(track.labelled) > 1]
    spread2 = 2 * CLICK_SIGMA_M**2
    if several:
        squares = sum(float(np.sum(np.var(track.labelled, axis=0))) * len(track.labelled) for track in several)
        spread2 = squares / sum(len(track.labelled) - 1 for track in several)
    of_means = float(np.mean([spread2 / len(track.labelled) for track in tracks]))
    measured = float(np.mean([np.sum(track.off() ** 2) for track in tracks]))
    return max(0.0, 1.0 - of_means / max(measured, 1e-12))


def calibrate_by_labels(
    logs: Sequence[tuple[Path, Run | ImagesAlone, Labels, MotionFrom]],
    *,
    topic: str | None = None,
    config: LogConfig | None = None,
    designs: Sequence[LandmarkDesign] | None = None,
    params: RecogniserParams | None = None,
    salvage: bool = False,
) -> Confusion:
    """Measure the model of recognition on logs with labels, each with where its motion is from.

    The other parameters are those of `calibrate`.

    Raises
    ------
    CalibrationError
        When the labels are of other frames or designs, or of too few tracks.
    LogError
        When a log has no images, or they cannot be read.
    """
    designs = tuple(designs or DEFAULT_DESIGNS)
    gathered = LabelledSightings(tuple(design.id for design in designs))
    given = met = 0
    for log, (path, run, labels, motion) in enumerate(logs):
        if unknown := {label.id for label in labels.labels} - {None, *gathered.ids}:
            raise CalibrationError(
                f"{path}: its labels name landmark {', '.join(map(str, sorted(map(int, filter(None, unknown)))))}, the "
                f"designs are {', '.join(map(str, gathered.ids))}; give the designs of the labels with --designs"
            )
        recogniser = Recogniser(run.calibration, designs, params)
        session = RecognitionSession(run, recogniser=recogniser, pictures=False, motion=motion)
        tracks, frames = _labelled_tracks(
            session, recogniser, labels, read_sonar_frames(path, topic, config, salvage=salvage)
        )
        given, met = given + len(labels.labels), met + sum(len(track.labelled) for track in tracks.values())
        if labels.labels and not frames:
            raise CalibrationError(f"{path}: no frame has the stamp of any label; are these labels of another log?")
        # those that nobody labelled, and those of two landmarks, tell nothing
        sure = {number: track for number, track in tracks.items() if len(track.ids) == 1}
        known = [track for track in sure.values() if track.ids != {None}]
        share = trusted_share(known) if known else 0.0
        for number, track in sure.items():
            (landmark,) = track.ids
            place = track.middle() + share * track.off()
            for world_T_sonar, sighting, news in track.sightings:
                truth = NOWHERE if landmark is None else _seen_from(world_T_sonar, place, landmark)
                gathered.add(sighting, (log, number), news, *truth)
    names = spelt(", ".join(path.name for path, *_ in logs))
    provenance = {"logs": names, "what they are": f"labels: {given}, of which {met} met a track"}
    try:
        return estimate_confusion(gathered.fits(), gathered.ids, provenance, designs)
    except CalibrationError as error:
        raise CalibrationError(
            f"{met} of {given} labels met a track of the recogniser; {error}, or label more with `sonar-graph label`"
        ) from error


def _labelled_tracks(
    session: RecognitionSession, recogniser: Recogniser, labels: Labels, blocks: Iterable[SonarFrames]
) -> tuple[dict[int, LabelledTrack], int]:
    """Tracks by number, with the labels that they met, and the number of frames that have a label."""
    tracks: dict[int, LabelledTrack] = defaultdict(LabelledTrack)
    by_stamp: dict[int, list[Label]] = defaultdict(list)
    for label in labels.labels:
        by_stamp[label.stamp_ns].append(label)
    frames = 0
    for stamp_ns in session.run(blocks):
        frames += stamp_ns in by_stamp
        if recogniser.stamp_ns != stamp_ns:
            continue
        seen: dict[int, ObjectSighting] = {}
        rows = zip(recogniser.track_ids.tolist(), recogniser.sightings, recogniser.news.tolist(), strict=True)
        for number, sighting, news in rows:
            if sighting is None:
                continue
            seen[number] = sighting
            tracks[number].sightings.append((session.start_T_sonar, sighting, news))
            tracks[number].seen.append(place_of(sighting.range_m, sighting.azimuth_rad, session))
        for label in by_stamp.pop(stamp_ns, []):
            away = {number: _distance(sighting, label) for number, sighting in seen.items()}
            nearest = min(away, key=lambda number: away[number], default=None)
            if nearest is not None and away[nearest] <= NEAR_M:
                tracks[nearest].ids.add(label.id)
                tracks[nearest].labelled.append(place_of(label.range_m, label.azimuth_rad, session))
    return tracks, frames


def _distance(sighting: ObjectSighting, label: Label) -> float:
    across = label.range_m * (sighting.azimuth_rad - label.azimuth_rad)
    return float(np.hypot(sighting.range_m - label.range_m, across))


def place_of(range_m: float, azimuth_rad: float, session: RecognitionSession) -> Floats:
    """Place in the sonar's axes at the first frame, shape (3,): on the floor, or in the image's plane."""
    q = np.full(3, np.nan)
    for floor in (session.view, SLANT_PLANE):
        if floor is not None and np.isnan(q).any():
            q = floor.floor_points(np.array([range_m]), np.array([azimuth_rad]))[0]
    return np.asarray(session.start_T_sonar.transformFrom(q))


def _seen_from(world_T_sonar: gtsam.Pose3, place: Floats, landmark: int) -> tuple[Floats, Floats, Floats]:
    """Identity, range and azimuth of a place, each of shape (1,)."""
    q = world_T_sonar.transformTo(place)
    return np.array([landmark]), np.array([np.linalg.norm(q)]), np.array([np.arctan2(q[1], q[0])])
