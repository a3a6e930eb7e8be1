"""What was made of the sonar images of a log: data that recognising fills and that reports and viewers show."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from sonar_graph.evaluation.strict_json import read_json, write_json
from sonar_graph.measurements import LandmarkDetections
from sonar_graph.states import LandmarkMap

RECOGNITION, PICTURES = "recognition.json", "recognised"
MOST_SHOWN = 6
NONE = -1
LEAST_NAMED = 0.5
"""Posterior above which a detection names a landmark."""


@dataclass(frozen=True, eq=False)
class DrawnFrame:
    """A frame with what was recognised drawn into it."""

    stamp_ns: int
    jpeg: bytes
    landmark_ids: tuple[int, ...]
    """Most probable identity of each detection in it."""
    probabilities: tuple[float, ...]
    """Posterior of each of them."""


@dataclass(eq=False)
class Recognition:
    """What was made of the images of a log."""

    frames: int = 0
    detections: LandmarkDetections | None = None
    outcomes: Counter[str] = field(default_factory=Counter)
    """How often each thing became of a candidate, track or frame."""
    warnings: list[tuple[int, str]] = field(default_factory=list)
    """Stamp and reason: frames that were not used, and changes of the sonar's window; the first of each reason, and of
    all others the earliest."""
    pictures: list[DrawnFrame] = field(default_factory=list)
    """Evenly over the run."""
    notes: dict[str, str] = field(default_factory=dict)
    """Which model and settings."""

    def warned(self) -> dict[str, int]:
        """How often frames were warned about, by reason; most frequent first."""
        reasons = {reason for _, reason in self.warnings}
        return {outcome: count for outcome, count in self.outcomes.most_common() if outcome in reasons}

    def naming(self, true_landmarks: LandmarkMap | None = None) -> list[str]:
        """Lines on how often each landmark was the most probable class, and a warning where none ever was.

        Parameters
        ----------
        true_landmarks
            Those that the log says to be there, if it does.
        """
        named: Counter[int] = Counter()
        if self.detections is not None:
            ids, probability = self.detections.most_probable()
            named.update(np.where(probability > LEAST_NAMED, ids, NONE).tolist())
        counts = [f"landmark {i}: {n}" for i, n in sorted(named.items()) if i != NONE]
        lines = [f"Most probable: {', '.join([*counts, f'none of them: {named[NONE]}'])}"] if named else []
        if not counts:
            designs = self.notes.get("detections.designs", "those given")
            lines.append(f"Warning: no landmark was recognised; looked for {designs}; --designs gives others")
        looked_for = set() if self.detections is None else set(np.unique(self.detections.candidate_ids).tolist())
        if true_landmarks is not None and looked_for:
            unknown = sorted(set(true_landmarks.ids.tolist()) - looked_for)
            if unknown:
                listed = ", ".join(map(str, unknown))
                lines.append(f"Warning: the log has landmarks {listed}, of which there is no design; give --designs")
        return lines

    def entry(self) -> dict[str, Any]:
        """All but detections and pictures, as it stands in JSON."""
        outcomes = dict(self.outcomes.most_common())
        return {"frames": self.frames, "outcomes": outcomes, "warnings": self.warnings, "notes": self.notes}

    def shown(self) -> list[DrawnFrame]:
        """The surest picture of each landmark, at most six, in order of identity."""
        surest: dict[int, tuple[float, DrawnFrame]] = {}
        for picture in self.pictures:
            for landmark, probability in zip(picture.landmark_ids, picture.probabilities, strict=True):
                if probability > surest.get(landmark, (0.5, None))[0]:
                    surest[landmark] = probability, picture
        return [picture for _, (_, picture) in sorted(surest.items())][:MOST_SHOWN]


def write_recognition(recognition: Recognition | None, folder: Path) -> None:
    """Write ``recognition.json`` and the pictures that the report shows; remove those of an earlier comparison."""
    (folder / RECOGNITION).unlink(missing_ok=True)
    for old in (folder / PICTURES).glob("*.jpg"):
        old.unlink()
    if recognition is None:
        return
    (folder / PICTURES).mkdir(exist_ok=True)
    shown = recognition.shown()
    for picture in shown:
        (folder / PICTURES / f"{picture.stamp_ns}.jpg").write_bytes(picture.jpeg)
    pictures = [[p.stamp_ns, p.landmark_ids, p.probabilities] for p in shown]
    write_json(folder / RECOGNITION, recognition.entry() | {"pictures": pictures})


def read_recognition(folder: Path) -> Recognition | None:
    """What `write_recognition` left, without detections; None where it left nothing."""
    if not (folder / RECOGNITION).is_file():
        return None
    entry: dict[str, Any] = read_json(folder / RECOGNITION)
    pictures = [
        DrawnFrame(stamp, (folder / PICTURES / f"{stamp}.jpg").read_bytes(), tuple(ids), tuple(probabilities))
        for stamp, ids, probabilities in entry["pictures"]
    ]
    warnings = [(stamp, reason) for stamp, reason in entry["warnings"]]
    return Recognition(entry["frames"], None, Counter(entry["outcomes"]), warnings, pictures, entry["notes"])
