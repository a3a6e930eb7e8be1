"""Small polar images of designs on a flat floor, of exponential speckle without memory, and candidates made by hand."""

from functools import cache

import numpy as np
from scipy.spatial.transform import Rotation

from sonar_graph.devices import DEFAULT_DESIGNS, LandmarkDesign
from sonar_graph.images import SonarFrames
from sonar_graph.measurements import Floats
from sonar_graph.sonar import FloorView, confusion_for
from sonar_graph.sonar.appearance import DesignFit
from sonar_graph.sonar.regions import Candidates, CandidateVerdict

RANGES_M = 1.26 + 1.25 / 512 * (np.arange(512) + 0.5)
AZIMUTHS_RAD = np.radians(np.linspace(-14.25, 14.25, 96))
WINDOW = np.array([[1.26, 2.51], [-0.25, 0.25]])
HEIGHT_M = 0.95
FLOOR_DB = 35.0


def level_R_sonar(pitch_rad: float = np.radians(30), roll_rad: float = 0.0) -> Floats:
    """Down by the pitch, then rolled."""
    return Rotation.from_euler("YX", [pitch_rad, roll_rad]).as_matrix()


ROTATION = level_R_sonar()
VIEW = FloorView(ROTATION, HEIGHT_M)


def frame(image: Floats, stamp_ns: int = 1) -> SonarFrames:
    """A block of one frame."""
    return SonarFrames(np.array([stamp_ns]), image[None], RANGES_M, AZIMUTHS_RAD)


def odds(fit: DesignFit) -> Floats:
    """Of each design against none of them, by one look and the weights that ship."""
    return confusion_for(DEFAULT_DESIGNS).log_odds(fit.evidence)


def design_of(
    *boxes_m: tuple[float, float, float, float],
    size_m: float = 0.5,
    middle_m: tuple[float, float] = (0.0, 0.0),
) -> LandmarkDesign:
    """Bright boxes (x, y, half width, half height), moved so far from the middle of their square."""
    places_m = np.arange(-size_m / 2 + 0.001, size_m / 2, 0.002)
    y, x = np.meshgrid(-places_m, places_m, indexing="ij")
    mask = np.full(x.shape, np.nan)
    for x0, y0, half_x, half_y in boxes_m:
        off_x = np.abs(x - x0 - middle_m[0])
        off_y = np.abs(y - y0 - middle_m[1])
        mask[(off_x <= half_x) & (off_y <= half_y)] = 12.0
    return LandmarkDesign(7, "own", size_m, mask)


def polar(xy_m: tuple[float, float]) -> tuple[float, float]:
    """Range and azimuth of a point of the floor."""
    (r,), (a,) = VIEW.range_azimuth(np.array([xy_m]))
    return float(r), float(a)


def candidates_at(
    range_m: list[float], azimuth_rad: list[float], rejected: tuple[int, ...] = ()
) -> Candidates:
    """Candidates with these positions and an elevation known to 0.07 rad."""
    zero = np.zeros(len(range_m))
    verdicts = np.zeros(len(range_m), dtype=np.int64)
    verdicts[list(rejected)] = CandidateVerdict.TOO_SMALL
    positions = (
        np.zeros((len(zero), 3)),
        np.array(range_m, dtype=float),
        np.array(azimuth_rad, dtype=float),
    )
    boxes = np.zeros((len(zero), 4), dtype=np.int64)
    labels = np.zeros((2, 2), dtype=np.int32)
    return Candidates(
        *positions, *[zero] * 4, verdicts, zero + 0.07, boxes, WINDOW, labels
    )


@cache
def floor_of(numbers: tuple[float, ...]) -> Floats:
    """Level floor point (beams, bins, 2) of every pixel; NaN where the sonar's 18 degrees show none."""
    view = FloorView(np.reshape(numbers, (3, 3)), HEIGHT_M)
    pixels = np.tile(RANGES_M, 96), np.repeat(AZIMUTHS_RAD, 512)
    points_m = view.floor_points(*pixels)
    is_lit = np.abs(points_m[:, 2]) < pixels[0] * np.sin(np.radians(9))
    level_m = np.where(is_lit[:, None], points_m @ view.level_R_sonar.T, np.nan)
    return level_m[:, :2].reshape(96, 512, 2)


def image_db(
    design: LandmarkDesign | None,
    xy_m: tuple[float, float],
    heading_rad: float,
    rotation: Floats = ROTATION,
    rng: np.random.Generator | None = None,
) -> Floats:
    """Decibels, shape (96, 512); without a generator the mean level itself."""
    x, y = np.moveaxis(floor_of(tuple(rotation.ravel().tolist())), 2, 0)
    level = np.where(np.isnan(x), 0.0, FLOOR_DB)
    if design is not None:
        turned = np.exp(-1j * heading_rad) * (x - xy_m[0] + 1j * (y - xy_m[1]))
        on_it = np.nan_to_num(turned, nan=9.0)
        level += np.nan_to_num(design.level_db(on_it.real, on_it.imag))
    if rng is not None:
        level += 10 * np.log10(rng.exponential(size=level.shape))
    return level.astype(np.float32)
