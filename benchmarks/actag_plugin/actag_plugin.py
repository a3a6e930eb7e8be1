"""AcTag fiducials in sonar images, decoded by AcTag's own detector, as a recogniser by plug-in; and designs to simulate.

    pip install benchmarks/actag_plugin
    sonar-graph recognise dive.mcap -o tags.mcap --recogniser actag --set family=AcTag24h10 --set tag_size_m=0.13

AcTag wants rows and columns equally spaced in range and azimuth, the farthest range and the leftmost azimuth first, and
its filters have a size in pixels. Frames are therefore resampled by the log's table of beams, with
`AcTagSettings.pixels_per_bit` pixels for a bit. AcTag decodes clutter now and then; a tag is reported from the second
frame on that has it in the same place.

Source: K. Norman, D. Butterfield, J. Mangelson, "AcTag: Opti-Acoustic Fiducial Markers for Underwater Localization and
Mapping", IROS 2023; PyPI ``actag`` (BSD-2-Clause).
"""

from importlib import import_module
from typing import Any, NamedTuple

import cv2
import gtsam
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from sonar_graph.calibration import Calibration, Section
from sonar_graph.devices import LandmarkDesign
from sonar_graph.errors import CalibrationError
from sonar_graph.images import SonarFrames, decibels
from sonar_graph.measurements import Floats, LandmarkDetections
from sonar_graph.settings import parse
from sonar_graph.sonar import (
    REPORTED,
    Fate,
    FloorView,
    FrameCheck,
    RecognisedFrame,
    SonarStep,
    check_block,
)

INSTALL = "pip install benchmarks/actag_plugin"
BITS_OF_INNER_SQUARE = 3
"""Of a tag with 24 bits, which is 7 bits wide."""
COUNTS_A_DECIBEL = 255 / 80
"""AcTag's threshold has an offset of one count; so fine is a DIDSON's or ARIS' scale."""
SEED = 1
"""AcTag fits quadrilaterals to random points; the same frame gives the same tags."""


class AcTagSettings(Section):
    """Family of tags, and settings of AcTag."""

    family: str = "AcTag24h10"
    """AcTag24h4, 24h6, 24h8 or 24h10: number of bits, and least number in which two tags differ."""
    tag_size_m: float = Field(0.1306, gt=0)
    """Side of the inner square; the whole tag is 7/3 of it."""
    bit_corrections: int = Field(3, ge=0)
    """Wrong bits that are corrected: fewer than half of those in which two tags differ."""
    pixels_per_bit: float = Field(8.0, ge=4)
    """Size of a bit in the image that AcTag gets."""
    least_frames: int = Field(2, ge=1)
    """Frames in which a tag must have been decoded in one place before it is reported."""
    same_place_m: float = Field(0.5, gt=0)
    """Largest distance of one place between frames; the elevation of a tag is not known."""
    probability: float = Field(0.99, gt=0, lt=1)
    """Posterior of a decoded identity."""
    range_sigma_m: float = Field(0.003, gt=0)
    """Of a tag's centre."""
    azimuth_sigma_rad: float = Field(0.001, gt=0)
    """The same in azimuth."""


class Tag(NamedTuple):
    """A decoded tag and the place of its centre."""

    id: int
    range_m: float
    azimuth_rad: float


class AcTagRecogniser:
    """Recogniser of AcTags (`sonar_graph.recognition.LandmarkRecogniser`).

    Parameters
    ----------
    calibration
        Scale of the samples of the sonar.
    settings
        Values of `AcTagSettings` by name; None: the defaults.

    Raises
    ------
    CalibrationError
        When AcTag is not installed, or refuses the settings.
    """

    def __init__(
        self, calibration: Calibration, settings: dict[str, Any] | None = None
    ) -> None:
        self.settings = parse(
            AcTagSettings, settings or {}, "settings of actag", CalibrationError
        )
        self._image = calibration.sonar.image
        self._check = FrameCheck(calibration.sonar.image)
        self._make = _import_actag("actag", "recognising").AcTag
        try:
            self._detector(np.array([1.0, 2.0]), np.array([-0.25, 0.25]))
        except (ValueError, FileNotFoundError) as error:
            raise CalibrationError(
                f"AcTag: family {self.settings.family}: {error}"
            ) from error
        self._start_T_sonar = gtsam.Pose3()
        self._seen: dict[int, tuple[Floats, int]] = {}

    def process(
        self,
        frame: SonarFrames,
        motion: SonarStep | None = None,
        view: FloorView | None = None,
    ) -> RecognisedFrame:
        """Decode the tags in a block of one frame; motion as for `Recogniser`, the floor is not used.

        Raises
        ------
        MeasurementError
            When the block is not one frame.
        """
        del view
        check_block(frame)
        stamp_ns = int(frame.stamps_ns[0])
        settings = self.settings
        if motion is not None:
            self._start_T_sonar = self._start_T_sonar.compose(motion.previous_T_sonar)
        verdict = self._check.judge(frame)
        if verdict.fault is not None:
            return RecognisedFrame.not_used(
                stamp_ns, f"frame not used: {verdict.fault}"
            )
        bit_m = settings.tag_size_m / BITS_OF_INNER_SQUARE
        image_db = decibels(frame.intensity[0], self._image)
        picture_db, rows_m, columns_rad = evenly_sampled(
            image_db,
            frame.ranges_m,
            frame.azimuths_rad,
            bit_m / settings.pixels_per_bit,
        )
        counts = np.clip(np.rint(picture_db * COUNTS_A_DECIBEL), 0, 255).astype(
            np.int64
        )
        decoded = self._detector(rows_m, columns_rad).run_detection(counts)
        tags = [
            Tag(int(id_), *np.mean(range_azimuth, axis=0).tolist())
            for id_, _, range_azimuth in decoded
        ]
        fates = []
        reported = []
        decoded_ids: set[int] = set()
        for tag in tags:
            outcome = REPORTED
            if tag.id in decoded_ids:
                outcome = "not reported: decoded already in this frame"
            elif self._frames_in_place(tag) < settings.least_frames:
                outcome = f"not reported: decoded in fewer than {settings.least_frames} frames in one place"
            else:
                reported.append(tag)
            decoded_ids.add(tag.id)
            fates.append(Fate(stamp_ns, -1, tag.range_m, tag.azimuth_rad, outcome))
        if verdict.change is not None:
            fates.append(Fate.of_frame(stamp_ns, verdict.change))
        if not reported:
            return RecognisedFrame(stamp_ns, None, fates)
        covariance = np.diag([settings.range_sigma_m**2, settings.azimuth_sigma_rad**2])
        detections = LandmarkDetections(
            stamps_ns=np.full(len(reported), stamp_ns),
            range_m=np.array([tag.range_m for tag in reported]),
            azimuth_rad=np.array([tag.azimuth_rad for tag in reported]),
            range_azimuth_cov=np.tile(covariance, (len(reported), 1, 1)),
            candidate_ids=np.array([[tag.id] for tag in reported]),
            id_probability=np.full((len(reported), 1), settings.probability),
        )
        return RecognisedFrame(stamp_ns, detections, fates)

    def _frames_in_place(self, tag: Tag) -> int:
        """Frames in a row that have a tag in one place; remembers the place."""
        direction = np.array([np.cos(tag.azimuth_rad), np.sin(tag.azimuth_rad), 0.0])
        place = np.asarray(self._start_T_sonar.transformFrom(tag.range_m * direction))
        before, frames = self._seen.get(tag.id, (place, 0))
        frames = (
            frames + 1
            if np.linalg.norm(place - before) <= self.settings.same_place_m
            else 1
        )
        self._seen[tag.id] = place, frames
        return frames

    def notes(self) -> dict[str, str]:
        """Rule and designs, for the notes of a log."""
        return {
            "detections.rule": f"AcTag, decoded in {self.settings.least_frames} frames in one place",
            "detections.designs": f"{self.settings.family}, inner square {self.settings.tag_size_m:g} m",
        }

    def _detector(self, rows_m: Floats, columns_rad: Floats) -> Any:
        return self._make(
            min_range=float(rows_m.min()),
            max_range=float(rows_m.max()),
            horizontal_aperture=float(np.ptp(columns_rad)),
            tag_family=self.settings.family,
            tag_size=self.settings.tag_size_m,
            decoding_num_bit_corrections=self.settings.bit_corrections,
            quads_random_seed=SEED,
        )


def evenly_sampled(
    image_db: NDArray[np.float32],
    ranges_m: Floats,
    azimuths_rad: Floats,
    pixel_m: float,
) -> tuple[NDArray[np.float32], Floats, Floats]:
    """Resample a polar image on equally spaced ranges and azimuths, with square pixels in the middle of the window.

    Levels are averaged over the bins of a pixel, and interpolated between beams. Returned are the picture, shape (rows,
    columns), the range of each row, farthest first, and the azimuth of each column, leftmost first and 0 in the middle.
    """
    first_m = float(ranges_m[0])
    last_m = float(ranges_m[-1])
    widest_rad = float(np.abs(azimuths_rad).max())
    rows_m = np.linspace(last_m, first_m, max(2, round((last_m - first_m) / pixel_m)))
    columns = max(2, round(2 * widest_rad * 0.5 * (first_m + last_m) / pixel_m))
    columns_rad = np.linspace(widest_rad, -widest_rad, columns)
    order = np.argsort(azimuths_rad)
    bin_m = (last_m - first_m) / (len(ranges_m) - 1)
    smooth_db = cv2.blur(image_db, (max(1, round(pixel_m / bin_m)), 1))
    bins = np.repeat(((rows_m - first_m) / bin_m)[:, None], columns, axis=1).astype(
        np.float32
    )
    beams = np.repeat(
        np.interp(columns_rad, azimuths_rad[order], order)[None], len(rows_m), axis=0
    ).astype(np.float32)
    picture = cv2.remap(smooth_db, bins, beams, cv2.INTER_LINEAR)
    return np.asarray(picture, np.float32), rows_m, columns_rad


def _import_actag(module: str, activity: str) -> Any:
    """A module of AcTag, needed for an activity."""
    try:
        return import_module(module)
    except ImportError as error:
        raise CalibrationError(
            f"{activity} AcTags needs the package actag: {INSTALL} ({error})"
        ) from error


BITS_ACROSS = 7
PIXELS_A_BIT = 20
FOAM_DB = 12.0
PLATE_DB = -8.0
"""Over the floor: as of the landmarks that ship."""
RING = (
    *((0, column) for column in range(7)),
    *((row, 6) for row in range(1, 7)),
    *((6, column) for column in range(5, -1, -1)),
    *((row, 0) for row in range(5, 0, -1)),
)
"""Row and column of each of 24 bits, clockwise from the upper left corner of the tag's picture."""


def tag_design(family: str, tag: int, tag_size_m: float) -> LandmarkDesign:
    """Design of a tag of foam and metal: 24 bits about a dark ring about a square of foam of this size.

    Raises `CalibrationError` when AcTag is not installed.
    """
    parameters = _import_actag("actag.tag_parameters", "drawing")
    levels = np.full((BITS_ACROSS, BITS_ACROSS), PLATE_DB)
    for bit, place in zip(
        parameters.AcTagParams(family, tag_size_m).tags_in_family[tag],
        RING,
        strict=True,
    ):
        levels[place] = FOAM_DB if bit else PLATE_DB
    levels[2:5, 2:5] = FOAM_DB
    mask = np.kron(levels, np.ones((PIXELS_A_BIT, PIXELS_A_BIT)))
    return LandmarkDesign(
        tag, f"{family} {tag}", tag_size_m * BITS_ACROSS / BITS_OF_INNER_SQUARE, mask
    )
