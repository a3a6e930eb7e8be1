"""What the report says about how detections came from sonar images."""

from __future__ import annotations

import base64
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from sonar_graph.evaluation.fan_picture import SURE
from sonar_graph.evaluation.figure_style import INK, MUTED, TRUTH, blank_panels, name_axes
from sonar_graph.evaluation.recognition import DrawnFrame
from sonar_graph.evaluation.reliability import (
    NONE,
    UNJUDGED,
    Reliability,
    confidences,
    reliability_of,
    true_identities,
)
from sonar_graph.evaluation.results import Comparison
from sonar_graph.evaluation.svg import inline_svg
from sonar_graph.evaluation.wording import ABSENT
from sonar_graph.logs.pictures import PICTURES
from sonar_graph.measurements import Ints
from sonar_graph.sequence import Sequence

LARGEST_DOT, SMALLEST_DOT = 90.0, 9.0
"""Areas in points²."""
SMALL = 7.5


def recognition_content(comparison: Comparison) -> dict[str, Any] | None:
    """Pictures, outcomes, warnings and the reliability of posteriors; None where nothing was recognised here."""
    found = comparison.recognition
    if found is None:
        return None
    start_ns = comparison.sequence.start_ns
    judged = reliability_of(comparison.sequence)
    return {
        "frames": found.frames,
        "detections": 0 if comparison.sequence.detections is None else len(comparison.sequence.detections),
        "named": _named(comparison.sequence),
        "sure": SURE,
        "topic": PICTURES,
        "pictures": [_picture(picture, start_ns) for picture in found.shown()],
        "outcomes": dict(found.outcomes.most_common()),
        "warnings": [(f"{(stamp_ns - start_ns) * 1e-9:.2f}", reason) for stamp_ns, reason in found.warnings],
        "expected_error": None if judged is None else f"{judged.expected_error:.3f}",
        "reliability": "" if judged is None else _drawn(judged),
    }


def _named(sequence: Sequence) -> dict[str, list[str]]:
    """By what a detection truly is: how many were named rightly, named wrongly, and taken for no landmark."""
    if sequence.detections is None or sequence.truth is None or sequence.true_landmarks is None:
        return {}
    labels = true_identities(sequence, sequence.detections)
    _, named = confidences(sequence.detections)
    rows = {}
    for identity in sequence.true_landmarks.ids.tolist():
        seen = labels == identity
        right = int((seen & (named == identity)).sum())
        rows[f"landmark {identity}"] = [str(right), *_others(seen & (named != identity), named)]
    rows["no landmark"] = [ABSENT, *_others(labels == NONE, named)]
    if np.any(labels == UNJUDGED):
        rows["cannot be told"] = [ABSENT, *_others(labels == UNJUDGED, named)]
    return rows


def _others(chosen: NDArray[np.bool_], named: Ints) -> list[str]:
    """Of chosen detections how many are named at all, and how many are not."""
    return [str(int((chosen & (named != NONE)).sum())), str(int((chosen & (named == NONE)).sum()))]


def _picture(picture: DrawnFrame, start_ns: int) -> dict[str, str]:
    """A picture as the page shows it: within the page itself."""
    named = ", ".join(
        f"ID {landmark} ({probability:.2f})"
        for landmark, probability in zip(picture.landmark_ids, picture.probabilities, strict=True)
    )
    return {
        "address": "data:image/jpeg;base64," + base64.b64encode(picture.jpeg).decode("ascii"),
        "caption": f"T = {(picture.stamp_ns - start_ns) * 1e-9:.1f} s: {named}",
    }


def _drawn(judged: Reliability) -> str:
    description = (
        f"Reliability of identity posteriors: expected calibration error {judged.expected_error:.3f} over "
        f"{judged.count.sum()} detections."
    )
    return inline_svg(reliability_figure(judged), "reliability", description)


def reliability_figure(judged: Reliability) -> Figure:
    """Share of right identities over confidence, and below the number of detections in each bin.

    A dot's area is in proportion to the detections behind it, down to a least size.
    """
    figure, axes = blank_panels(2, 1, (5.2, 4.6), sharex=True, height_ratios=[3, 1])
    shares, counts = axes[:, 0]
    shares.plot([0, 1], [0, 1], color=TRUTH, linewidth=1, zorder=1)
    areas = np.maximum(LARGEST_DOT * judged.count / max(int(judged.count.max()), 1), SMALLEST_DOT)
    shares.scatter(judged.confidence, judged.right, s=areas, color=INK, zorder=2, clip_on=False)
    shares.set(xlim=(0, 1), ylim=(0, 1.03))
    name_axes(shares, y="share that is right")
    width = 1 / len(judged.count)
    middles = (np.arange(len(judged.count)) + 0.5) * width
    bars = counts.bar(middles, judged.count, width=0.8 * width, color=INK)
    counts.bar_label(bars, [str(n) if n else "" for n in judged.count], color=MUTED, fontsize=SMALL, padding=1.5)
    counts.set_ylim(0, 1.25 * max(int(judged.count.max()), 1))
    name_axes(counts, "posterior of the most probable class", "detections")
    return figure
