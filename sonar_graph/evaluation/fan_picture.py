"""A sonar frame as a picture of its fan, with the recognised identities drawn where they were seen.

The counterpart of Fig. 6 of the 2014 paper. Pixels are looked up in the polar image (nearest beam and bin), for
display only: nothing is measured in such a picture.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from sonar_graph.measurements import LandmarkDetections
from sonar_graph.sonar.geometry import Fan

Picture = NDArray[np.uint8]
MARGIN = 6
SURE = 0.9
"""Posterior from which on an identity is drawn as recognised."""
RECOGNISED, DOUBTFUL = (60, 220, 255), (190, 190, 190)
"""Blue, green, red."""
JPEG_QUALITY = 85
TEXT_SIZE = 0.85
"""Of letters that can still be read where a page shows four pictures in a row."""


def draw_fan(image_db: NDArray[np.floating], fan: Fan, detections: LandmarkDetections | None) -> Picture:
    """The frame in grey, the detections as rings with identity and posterior; shape (height, width, 3)."""
    low, high = np.percentile(image_db, [5, 99.7])
    grey = np.clip((image_db - low) / max(high - low, 1e-6) * 255, 0, 255).astype(np.uint8)
    shown = np.where(fan.beam >= 0, grey[np.maximum(fan.beam, 0), fan.bin], 0).astype(np.uint8)
    picture = np.asarray(cv2.cvtColor(cv2.medianBlur(shown, 3), cv2.COLOR_GRAY2BGR), np.uint8)
    if detections is not None:
        ids, probabilities = detections.most_probable()
        for i, (landmark, probability) in enumerate(zip(ids.tolist(), probabilities.tolist(), strict=True)):
            place = fan.pixel(float(detections.range_m[i]), float(detections.azimuth_rad[i]))
            _draw_detection(picture, place, landmark, probability, round(0.23 * fan.pixels_per_m))
    return picture


def _draw_detection(picture: Picture, place: tuple[int, int], landmark: int, probability: float, radius: int) -> None:
    is_sure = probability >= SURE
    colour = RECOGNISED if is_sure else DOUBTFUL
    text = f"ID {landmark}" if is_sure else f"ID {landmark}?  {probability:.2f}"
    cv2.circle(picture, place, radius, colour, 2 if is_sure else 1, cv2.LINE_AA)
    cv2.drawMarker(picture, place, colour, cv2.MARKER_CROSS, 9, 1)
    (width, height), descent = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, TEXT_SIZE, 2)
    left = int(np.clip(place[0] - width // 2, MARGIN, picture.shape[1] - width - MARGIN))
    foot = max(place[1] - radius - 2 * MARGIN, height + MARGIN)
    cv2.rectangle(
        picture, (left - MARGIN, foot - height - MARGIN), (left + width + MARGIN, foot + descent), (0, 0, 0), -1
    )
    cv2.putText(picture, text, (left, foot), cv2.FONT_HERSHEY_SIMPLEX, TEXT_SIZE, colour, 2, cv2.LINE_AA)


def as_jpeg(picture: Picture) -> bytes:
    """The picture as the bytes of a JPEG file."""
    _, encoded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return encoded.tobytes()
