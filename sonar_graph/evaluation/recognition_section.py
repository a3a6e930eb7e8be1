"""What the report says about how detections came from sonar images."""

from __future__ import annotations

import base64
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from sonar_graph.evaluation.figure_style import INK, TRUTH, blank_panels, name_axes
from sonar_graph.evaluation.recognition import DrawnFrame
from sonar_graph.evaluation.reliability import Reliability, reliability_of
from sonar_graph.evaluation.results import Comparison
from sonar_graph.evaluation.svg import inline_svg


def recognition_content(comparison: Comparison) -> dict[str, Any] | None:
    """Pictures, outcomes, warnings and the reliability of posteriors; None where nothing was recognised here."""
    found = comparison.recognition
    if found is None:
        return None
    start_ns = comparison.sequence.start_ns
    judged = reliability_of(comparison.sequence)
    return {
        "frames": found.frames,
        "pictures": [_picture(picture, start_ns) for picture in found.shown()],
        "outcomes": dict(found.outcomes.most_common()),
        "warnings": [(f"{(stamp_ns - start_ns) * 1e-9:.2f}", reason) for stamp_ns, reason in found.warnings],
        "expected_error": None if judged is None else f"{judged.expected_error:.3f}",
        "reliability": "" if judged is None else _drawn(judged),
    }


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
    """Share of right identities over confidence, with the number of detections in each bin below."""
    figure, axes = blank_panels(2, 1, (5.2, 4.6), sharex=True, height_ratios=[3, 1])
    shares, counts = axes[:, 0]
    shares.plot([0, 1], [0, 1], color=TRUTH, linewidth=1)
    shares.plot(judged.confidence, judged.right, "o-", color=INK, linewidth=1.2, markersize=5)
    shares.set(xlim=(0, 1), ylim=(0, 1.03))
    name_axes(shares, y="share that is right")
    middles = (np.arange(len(judged.count)) + 0.5) / len(judged.count)
    counts.bar(middles, judged.count, width=0.08, color=INK)
    name_axes(counts, "posterior of the most probable class", "detections")
    return figure
