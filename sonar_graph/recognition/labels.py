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
``max(0, 1 - mean V / mean d^2) d`` (James and Stein 1961): labels correct an error that all tracks share only as far as
it exceeds their own. Errors of the motion that carries a place add to the model's sigmas, which so are rather too large.
"""

import csv
import json
from collections import Counter, defaultdict
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
from sonar_graph.recognition.confusion_fit import (
    LabelledSightings,
    TrueObjects,
    estimate_confusion,
)
from sonar_graph.recognition.image_motion import MotionFrom
from sonar_graph.recognition.session import RecognitionSession
from sonar_graph.sequence import Sequence as Run
from sonar_graph.settings import parse
from sonar_graph.sonar import (
    SLANT_PLANE,
    Confusion,
    ObjectSighting,
    Recogniser,
    RecogniserParams,
    TrackInFrame,
    with_lens,
)

COLUMNS = ("stamp_ns", "range_m", "azimuth_rad", "id")
NEAR_M = 0.2
"""Distance of a candidate up to which a label is of it."""
CLICK_SIGMA_M = 0.01
"""Standard deviation of a label along each axis, where labels do not determine it."""
MOST_ROWS = 8
"""Rows of labels that a message lists."""
OUTSIDE = "outside of the image"
NO_FRAME = "no such frame"
UNUSED = "of a frame that was not used"
IN_DEGREES = (
    "outside of the image, but not if the azimuth is in degrees; expected radians"
)
NO_TRACK = "no track there"
CONTRADICTED = "contradicts other labels of its track, so left out"
"""Reasons why labels are not used."""
NOWHERE = TrueObjects(np.array([-1]), np.array([1e9]), np.array([0.0]))
"""True landmarks around other things: one that is far away."""


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
    r"""Read labels of a log from a JSON or CSV file.

    Raises
    ------
    CalibrationError
        When the file cannot be read, is neither, has a field that does not fit, or is of another log.

    Examples
    --------
    A landmark, and something else:

    >>> from pathlib import Path
    >>> from sonar_graph.recognition import read_labels
    >>> text = "stamp_ns,range_m,azimuth_rad,id\n1000000000,1.62,0.05,1\n2000000000,1.70,-0.10,\n"
    >>> written = Path("labels.csv").write_text(text)
    >>> [label.id for label in read_labels(Path("labels.csv"), Path("dive.mcap")).labels]
    [1, None]
    """
    try:
        # spreadsheets begin their CSV with a byte-order mark
        text = text_of(path, "utf-8-sig")
        content = (
            _from_csv(text, log) if path.suffix.lower() == ".csv" else json.loads(text)
        )
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise CalibrationError(
            f"{path}: {error}; expected JSON as `sonar-graph label` writes it, or CSV with {', '.join(COLUMNS)}"
        ) from error
    try:
        labels = parse(Labels, content, str(path))
    except CalibrationError as error:
        hint = (
            "; angles are in rad, and these seem to be in degrees"
            if "azimuth_rad: expected" in str(error)
            else ""
        )
        raise CalibrationError(f"{error}{hint}") from error
    if labels.log != spelt(log.name):
        raise CalibrationError(
            f"{path}: its labels are of {labels.log}, not of {log.name}; name the log they are of, or, if it is the "
            f"same one under another name, write that as `log` in {path.name}"
        )
    return labels


def _from_csv(text: str, log: Path) -> dict[str, object]:
    rows = csv.DictReader(text.splitlines())
    if missing := set(COLUMNS) - set(rows.fieldnames or ()):
        raise ValueError(f"no column {', '.join(sorted(missing))}")
    labels = [
        {name: (row[name] or "").strip() for name in COLUMNS[:3]}
        | {"id": (row["id"] or "").strip() or None}
        for row in rows
    ]
    return {"log": spelt(log.name), "labels": labels}


@dataclass
class LabelledTrack:
    """Sightings of a track with the sonar's pose at each, and the labels that it met, all in one frame at rest."""

    frames: list[tuple[int, gtsam.Pose3, TrackInFrame]] = field(default_factory=list)
    """Frames with a sighting: stamp, pose of the sonar, the track in it."""
    seen: list[Floats] = field(default_factory=list)
    """Places of the sightings."""
    labels: list[tuple[int, Label, Floats]] = field(default_factory=list)
    """Each after its row (from 1), and its place."""

    @property
    def ids(self) -> set[int | None]:
        """Identities of the labels."""
        return {label.id for _, label, _ in self.labels}

    @property
    def labelled(self) -> list[Floats]:
        """Places of the labels."""
        return [place for _, _, place in self.labels]

    def drop_contradictions(self) -> list[int]:
        """Leave out several identities in one frame, and those of fewer than half of the rest; their rows."""
        said_at: dict[int, set[int | None]] = defaultdict(set)
        for _, label, _ in self.labels:
            said_at[label.stamp_ns].add(label.id)
        # two identities of one object in one frame: neither counts
        sound = [one for one in self.labels if len(said_at[one[1].stamp_ns]) == 1]
        counts = Counter(label.id for _, label, _ in sound)
        # the identity of more than half of the labels, if there is one
        rows = {row for row, _, _ in self.labels}
        self.labels = [one for one in sound if 2 * counts[one[1].id] > len(sound)]
        return sorted(rows.difference(row for row, _, _ in self.labels))

    def off(self) -> Floats:
        """Mean place of the labels from `middle`, shape (3,)."""
        return np.mean(self.labelled, axis=0) - self.middle()

    def middle(self) -> Floats:
        """Median place of the sightings, shape (3,)."""
        return np.median(self.seen, axis=0)


@dataclass(frozen=True)
class LabelledLog:
    """A log with labels, and where its motion is from."""

    path: Path
    run: Run | ImagesAlone
    labels: Labels
    file: Path
    """Of the labels, for messages."""
    motion: MotionFrom = "navigation"


def trusted_share(tracks: Sequence[LabelledTrack]) -> float:
    """Share of the distance of labels from sightings that is not the labels' own error, pooled over tracks."""
    several = [track for track in tracks if len(track.labelled) > 1]
    # both axes, where no track has two labels
    spread2 = 2 * CLICK_SIGMA_M**2
    if several:
        squares = sum(
            float(np.sum(np.var(track.labelled, axis=0))) * len(track.labelled)
            for track in several
        )
        spread2 = squares / sum(len(track.labelled) - 1 for track in several)
    # variance of the mean of the labels of a track
    of_means = float(np.mean([spread2 / len(track.labelled) for track in tracks]))
    measured = float(np.mean([np.sum(track.off() ** 2) for track in tracks]))
    return max(0.0, 1.0 - of_means / max(measured, 1e-12))


def calibrate_by_labels(
    logs: Sequence[LabelledLog],
    *,
    topic: str | None = None,
    config: LogConfig | None = None,
    designs: Sequence[LandmarkDesign] | None = None,
    params: RecogniserParams | None = None,
    salvage: bool = False,
) -> Confusion:
    """Measure the model of recognition on logs with labels; its provenance counts the labels of each file that met a track.

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
    provenance = {
        "logs": spelt(", ".join(one.path.name for one in logs)),
        "what they are": "labels",
    }
    for log, one in enumerate(logs, 1):
        if unknown := {
            label.id for label in one.labels.labels if label.id is not None
        } - set(gathered.ids):
            raise CalibrationError(
                f"{one.file}: its labels name landmark {', '.join(map(str, sorted(unknown)))}, the designs are "
                f"{', '.join(map(str, gathered.ids))}; give the designs of the labels with --designs"
            )
        recogniser = Recogniser(one.run.calibration, designs, params)
        tracks, unmet = _labelled_tracks(
            one, recogniser, read_sonar_frames(one.path, topic, config, salvage=salvage)
        )
        given = len(one.labels.labels)
        if given and len(unmet[NO_FRAME]) == given:
            raise CalibrationError(
                f"{one.file}: no frame of {one.path.name} has the stamp of any label; are these labels of another log?"
            )
        provenance[f"labels {log}"] = (
            f"{spelt(one.file.name)}: {what_labels_met(given, unmet)}"
        )
        # a track without a label, or with two identities, has no known class
        sure = {
            number: track for number, track in tracks.items() if len(track.ids) == 1
        }
        known = [track for track in sure.values() if track.ids != {None}]
        # pooled over all tracks: one track has too few labels
        share = trusted_share(known) if known else 0.0
        for track in sure.values():
            (landmark,) = track.ids
            place = track.middle() + share * track.off()
            for stamp_ns, world_T_sonar, in_frame in track.frames:
                truth = NOWHERE
                if landmark is not None:
                    truth = _seen_from(world_T_sonar, place, landmark)
                gathered.add(stamp_ns, log, in_frame, truth)
    try:
        return estimate_confusion(gathered.fits(), gathered.ids, provenance, designs)
    except CalibrationError as error:
        raise CalibrationError(
            f"{'; '.join(provenance[f'labels {log}'] for log in range(1, len(logs) + 1))}; {error}, or label more with "
            "`sonar-graph label`"
        ) from error


def what_labels_met(given: int, unmet: dict[str, list[int]]) -> str:
    """How many of the labels met a track, and the rows (from 1) of those not used, by reason."""
    missed = sum(len(rows) for reason, rows in unmet.items() if reason != CONTRADICTED)
    parts = [f"{given - missed} of {given} labels met a track of the recogniser"]
    for reason, rows in sorted(unmet.items(), key=lambda item: min(item[1], default=0)):
        if rows:
            listed = ", ".join(map(str, sorted(rows)[:MOST_ROWS]))
            more = f" and {len(rows) - MOST_ROWS} more" if len(rows) > MOST_ROWS else ""
            parts.append(f"row{'s' if len(rows) > 1 else ''} {listed}{more}: {reason}")
    return "; ".join(parts)


def _labelled_tracks(
    log: LabelledLog, recogniser: Recogniser, blocks: Iterable[SonarFrames]
) -> tuple[dict[int, LabelledTrack], dict[str, list[int]]]:
    """Tracks by number, with the labels that they met, and the rows (from 1) of labels not used, by reason."""
    session = RecognitionSession(log.run, recogniser, log.motion)
    lens = log.run.calibration.sonar.lens
    tracks: dict[int, LabelledTrack] = defaultdict(LabelledTrack)
    unmet: dict[str, list[int]] = defaultdict(list)
    by_stamp: dict[int, list[tuple[int, Label]]] = defaultdict(list)
    for row, label in enumerate(log.labels.labels, 1):
        by_stamp[label.stamp_ns].append((row, label))
    for frame, result in session.run(blocks):
        stamp_ns = result.stamp_ns
        # its labels cannot meet a track
        if not result.is_used:
            unmet[UNUSED] += [row for row, _ in by_stamp.pop(stamp_ns, [])]
            continue
        seen: dict[int, ObjectSighting] = {}
        for in_frame in result.tracks:
            sighting = in_frame.sighting
            if sighting is None:
                continue
            seen[in_frame.id] = sighting
            track = tracks[in_frame.id]
            track.frames.append((stamp_ns, session.start_T_sonar, in_frame))
            track.seen.append(place_of(sighting.range_m, sighting.azimuth_rad, session))
        for row, label in by_stamp.pop(stamp_ns, []):
            # the nearest sighting in this frame
            away = {
                number: _distance(label, sighting) for number, sighting in seen.items()
            }
            nearest = min(away, key=lambda number: away[number], default=None)
            if nearest is not None and away[nearest] <= NEAR_M:
                place = place_of(label.range_m, label.azimuth_rad, session)
                tracks[nearest].labels.append((row, label, place))
            else:
                # a label outside of the image may be in degrees
                in_radians = label.model_copy(
                    update={"azimuth_rad": np.radians(label.azimuth_rad)}
                )
                places = {NO_TRACK: label, IN_DEGREES: in_radians}
                shown = with_lens(frame, lens)
                fits = [why for why, at in places.items() if _is_within(shown, at)]
                unmet[fits[0] if fits else OUTSIDE].append(row)
    # labels that are left have no frame with their stamp
    unmet[NO_FRAME] = [row for labels in by_stamp.values() for row, _ in labels]
    unmet[CONTRADICTED] = [
        row for track in tracks.values() for row in track.drop_contradictions()
    ]
    return tracks, unmet


def _is_within(frame: SonarFrames, label: Label) -> bool:
    """True for a place in the image, up to half a bin and half a beam beyond the outer middles."""
    axes = (frame.ranges_m, label.range_m), (frame.azimuths_rad, label.azimuth_rad)
    for middles, place in axes:
        half = np.abs(np.diff(middles)).max(initial=0) / 2
        if not middles.min() - half <= place <= middles.max() + half:
            return False
    return True


def is_of_one_object(one: Label, other: Label) -> bool:
    """True for labels of one frame as near to each other as no two objects are."""
    return one.stamp_ns == other.stamp_ns and _distance(one, other) <= NEAR_M / 2


def _distance(label: Label, other: Label | ObjectSighting) -> float:
    across = label.range_m * (label.azimuth_rad - other.azimuth_rad)
    return float(np.hypot(label.range_m - other.range_m, across))


def place_of(range_m: float, azimuth_rad: float, session: RecognitionSession) -> Floats:
    """Place in the sonar's axes at the first frame, shape (3,): on the floor, or in the image's plane."""
    # on the floor, and where the ray misses it in the plane of the image
    q = np.full(3, np.nan)
    for floor in (session.view, SLANT_PLANE):
        if floor is not None and np.isnan(q).any():
            q = floor.floor_points(np.array([range_m]), np.array([azimuth_rad]))[0]
    return session.start_T_sonar.transformFrom(q)


def _seen_from(world_T_sonar: gtsam.Pose3, place: Floats, landmark: int) -> TrueObjects:
    """A landmark at a place."""
    q = world_T_sonar.transformTo(place)
    return TrueObjects(
        np.array([landmark]),
        np.array([np.linalg.norm(q)]),
        np.array([np.arctan2(q[1], q[0])]),
    )
