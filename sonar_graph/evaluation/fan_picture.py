"""A sonar frame as a picture of its fan, with the recognised identities drawn where they were seen.

The counterpart of Fig. 6 of the 2014 paper. Pixels are looked up in the polar image (nearest beam and bin), for
display only: nothing is measured in such a picture.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sonar_graph.measurements import Floats, LandmarkDetections

Picture = NDArray[np.uint8]
PIXELS_HIGH = 420
MARGIN = 6
SURE = 0.9
"""Posterior from which on an identity is drawn as recognised."""
RECOGNISED, DOUBTFUL = (60, 220, 255), (190, 190, 190)
"""Blue, green, red."""
JPEG_QUALITY = 85


@dataclass(frozen=True, eq=False)
class Fan:
    """Where each pixel of a picture lies in a polar image: range up, azimuth positive to the left."""

    beam: NDArray[np.int32]
    """Shape (height, width); -1 outside of the fan."""
    bin: NDArray[np.int32]
    """Shape (height, width)."""
    pixels_per_m: float
    lowest_m: float
    """Distance ahead of the sonar at the lower edge."""
    half_width_m: float

    @classmethod
    def of(cls, ranges_m: Floats, azimuths_rad: Floats) -> Fan:
        """The fan of a sonar's beams and bins."""
        r0, r1 = float(ranges_m.min()), float(ranges_m.max())
        widest = float(np.abs(azimuths_rad).max())
        lowest, half_width = r0 * np.cos(widest), r1 * np.sin(min(widest, np.pi / 2))
        scale = PIXELS_HIGH / (r1 - lowest)
        ahead = lowest + (np.arange(PIXELS_HIGH)[::-1, None] + 0.5) / scale
        across = half_width - (np.arange(int(2 * half_width * scale))[None] + 0.5) / scale
        distance, azimuth = np.hypot(ahead, across), np.arctan2(across, ahead)
        order = np.argsort(azimuths_rad)
        place = np.interp(azimuth, azimuths_rad[order], np.arange(len(order)), -1, -1)
        inside = (place >= 0) & (distance >= r0) & (distance <= r1)
        beam = np.where(inside, order[np.rint(np.maximum(place, 0)).astype(int)], -1)
        at = np.rint(np.interp(distance, np.sort(ranges_m), np.argsort(ranges_m)))
        return cls(beam.astype(np.int32), at.astype(np.int32), scale, float(lowest), float(half_width))

    def pixel(self, range_m: float, azimuth_rad: float) -> tuple[int, int]:
        """Column and row of a point."""
        ahead, across = range_m * np.cos(azimuth_rad), range_m * np.sin(azimuth_rad)
        column = (self.half_width_m - across) * self.pixels_per_m
        return round(column), round(PIXELS_HIGH - (ahead - self.lowest_m) * self.pixels_per_m)


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
    (width, _), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.6, 2)
    left = int(np.clip(place[0] - width // 2, MARGIN, picture.shape[1] - width - MARGIN))
    corner = (left, max(place[1] - radius - MARGIN, 18))
    cv2.putText(picture, text, corner, cv2.FONT_HERSHEY_SIMPLEX, 0.6, (0, 0, 0), 4, cv2.LINE_AA)
    cv2.putText(picture, text, corner, cv2.FONT_HERSHEY_SIMPLEX, 0.6, colour, 2, cv2.LINE_AA)


def as_jpeg(picture: Picture) -> bytes:
    """The picture as the bytes of a JPEG file."""
    _, encoded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return encoded.tobytes()
