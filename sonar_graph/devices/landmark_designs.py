"""Designs of artificial landmarks: flat masks of how strongly they scatter sound.

A design is a square picture with a physical size. Each pixel gives the decibels over the floor around it, or NaN where
the floor shows. Own designs are a TOML file such as ``default_landmarks.toml`` beside this module, with drawn shapes or
with a PNG file for each landmark::

    [[landmark]]
    id = 7
    name = "ring"
    size_m = 0.40                 # side of the square picture
    height_m = 0.013              # height over the floor; optional
    relief_m = 0.012              # height of bright parts over dark ones; optional, default: all of height_m
    picture = "ring.png"          # grey 0 ... 255; beside the TOML file
    black_db = -8.0               # level of 0 ...
    white_db = 12.0               # ... and of 255; transparent pixels are floor

A design is recognised by one connected figure, brighter than the floor, with an area and length that
`sonar_graph.sonar.cfar` accepts (0.008 to 0.2 m² and at most 0.7 m by default). Dark parts may lie apart. A landmark's
place is the middle of the square, wherever in it the figure lies.
Material beyond the square is cut off. The landmarks of the 2014 experiment were never published: these are ours.
"""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError, model_validator

from sonar_graph.calibration import Section
from sonar_graph.errors import CalibrationError
from sonar_graph.files import read_toml
from sonar_graph.measurements import Floats
from sonar_graph.settings import faults_in

PIXEL_M = 0.002
"""Size of the pixels into which drawn shapes are turned."""
LEAST_SIZE_M = 0.02
MOST_SIZE_M = 2.0
MOST_PIXELS = 2000
"""Along the side of a picture."""
MOST_ID = 2**31 - 1
LEAST_BRIGHT_DB = 3.0
"""Least level of the brightest part; below it a design does not stand out of the speckle of the floor."""
CENTRED_M = 0.0075
JOINED_M = 0.05
"""Distance from the middle up to which a figure counts as in it, and gap over which bright parts are one figure."""
OWN_DESIGNS = "landmark designs"
"""Note of a log that names its landmarks, where they are not those that ship."""
_Level = Annotated[float, Field(ge=-100, le=100, allow_inf_nan=False)]
_Length = Annotated[float, Field(allow_inf_nan=False)]


@dataclass(frozen=True, eq=False)
class LandmarkDesign:
    """A landmark: its identity and its mask of scattering levels.

    Examples
    --------
    >>> import numpy as np
    >>> from sonar_graph.devices import LandmarkDesign
    >>> bright = np.full((100, 100), 12.0)
    >>> design = LandmarkDesign(id=7, name="square", size_m=0.2, mask=bright)
    >>> design.size_m / len(design.mask)
    0.002
    """

    id: int
    """Identity, as in maps and detections."""
    name: str
    size_m: float
    """Side of the square that the mask covers."""
    mask: Floats
    """Level over the floor in dB, shape (n, n); NaN: floor. Seen from above with the first row at +y and the first
    column at -x."""
    height_m: float = 0.013
    """Height of its face over the floor."""
    relief_m: float | None = None
    """Height of its bright parts over its dark ones; None: all of its height, for the dark ones are thin."""

    @property
    def standing_m(self) -> float:
        """Height by which its bright parts stand over what is around them, at most its own."""
        return (
            self.height_m
            if self.relief_m is None
            else min(self.relief_m, self.height_m)
        )

    @cached_property
    def figure_m(self) -> tuple[float, float]:
        """Centroid (x, y) of its largest bright part, of equal ones of that nearest to the middle.

        There a candidate has its centre. Parts nearer to each other than `JOINED_M` are one, as `detection.closing_m`
        joins them. (0, 0) where that is nearer to the middle than `CENTRED_M`.
        """
        pixel_m = self.size_m / len(self.mask)
        is_bright = (np.nan_to_num(self.mask) >= LEAST_BRIGHT_DB).astype(np.uint8)
        # as the candidate selection closes gaps of an image
        joined = cv2.morphologyEx(
            is_bright,
            cv2.MORPH_CLOSE,
            np.ones(2 * [round(JOINED_M / pixel_m) // 2 * 2 + 1]),
        )
        _, _, stats, centres = cv2.connectedComponentsWithStats(joined, connectivity=8)
        areas = stats[1:, cv2.CC_STAT_AREA]
        # rows run down, y runs up
        places_m = pixel_m * (centres[1:] - (len(self.mask) - 1) / 2) * [1.0, -1.0]
        away_m = np.hypot(*places_m.T)
        if (
            not len(areas)
            # the largest; of equal ones that nearest to the middle
            or away_m[best := np.lexsort((away_m, -areas))[0]] < CENTRED_M
        ):
            return 0.0, 0.0
        return float(places_m[best, 0]), float(places_m[best, 1])

    def level_db(self, x_m: Floats, y_m: Floats) -> Floats:
        """Level over the floor at points of the design's frame (origin at its centre); NaN outside."""
        pixels = len(self.mask)
        column = np.floor((np.asarray(x_m) / self.size_m + 0.5) * pixels).astype(
            np.int64
        )
        row = np.floor((0.5 - np.asarray(y_m) / self.size_m) * pixels).astype(np.int64)
        inside = (column >= 0) & (column < pixels) & (row >= 0) & (row < pixels)
        last = pixels - 1
        return np.where(
            inside, self.mask[np.clip(row, 0, last), np.clip(column, 0, last)], np.nan
        )

    def digest(self) -> str:
        """16 hexadecimal digits that change with name, size, height, relief or mask (from 0.01 dB on)."""
        # whole counts of 0.01 dB, with a value of its own for the floor: equal on every machine
        counts = np.where(
            np.isnan(self.mask), -(2**31), np.round(100 * np.nan_to_num(self.mask))
        )
        relief = "" if self.relief_m is None else f"{self.relief_m:.6f}\n"
        text = f"{self.name}\n{self.size_m:.6f}\n{self.height_m:.6f}\n{relief}{self.mask.shape}\n"
        return hashlib.sha256(
            text.encode() + counts.astype("<i4").tobytes()
        ).hexdigest()[:16]

    def looks_like(self, other: LandmarkDesign) -> bool:
        """True for a design with the same size and mask, turned by quarters or not."""
        return self.size_m == other.size_m and any(
            np.array_equal(np.rot90(self.mask, quarters), other.mask, equal_nan=True)
            for quarters in range(4)
        )


class _Shape(Section):
    """A filled circle or polygon of one level."""

    level_db: _Level
    circle_m: tuple[_Length, _Length, _Length] | None = None
    polygon_m: list[tuple[_Length, _Length]] | None = Field(None, min_length=3)

    @model_validator(mode="after")
    def _is_one_shape(self) -> _Shape:
        if (self.circle_m is None) == (self.polygon_m is None):
            raise ValueError(
                "give either circle_m = [x, y, radius] or polygon_m = [[x, y], ...]"
            )
        return self

    def covers(self, x_m: Floats, y_m: Floats) -> NDArray[np.bool_]:
        """True for points inside."""
        if self.circle_m is not None:
            centre_x, centre_y, radius = self.circle_m
            return np.asarray(np.hypot(x_m - centre_x, y_m - centre_y) <= radius)
        vertices = np.array(self.polygon_m)
        inside = np.zeros(np.shape(x_m), dtype=bool)
        for (x1, y1), (x2, y2) in zip(
            vertices, np.roll(vertices, -1, axis=0), strict=True
        ):
            if y1 != y2:  # a ray to the right crosses the edges an odd number of times
                crossing = x1 + (y_m - y1) * (x2 - x1) / (y2 - y1)
                inside ^= ((y1 > y_m) != (y2 > y_m)) & (x_m < crossing)
        return inside


class _Entry(Section):
    """A ``[[landmark]]`` of a TOML file."""

    id: int = Field(ge=0, le=MOST_ID)
    name: str = Field(min_length=1)
    size_m: float = Field(ge=LEAST_SIZE_M, le=MOST_SIZE_M, allow_inf_nan=False)
    height_m: float = Field(0.013, ge=0, le=1, allow_inf_nan=False)
    relief_m: float | None = Field(None, ge=0, le=1, allow_inf_nan=False)
    shapes: tuple[_Shape, ...] = ()
    picture: str | None = None
    black_db: _Level = -8.0
    white_db: _Level = 12.0

    @model_validator(mode="after")
    def _has_one_source(self) -> _Entry:
        if (self.picture is None) == (not self.shapes):
            raise ValueError("give either shapes or picture")
        return self

    def design(self, folder: Path) -> LandmarkDesign:
        """The design, drawn or with its picture from the folder.

        Raises `ValueError` when the picture cannot be read, or the landmark looks like the floor.
        """
        if self.picture is not None:
            mask = read_picture(folder / self.picture, self.black_db, self.white_db)
        else:
            # middles of pixels, the first row at +y
            pixels = round(self.size_m / PIXEL_M)
            middles_m = ((np.arange(pixels) + 0.5) / pixels - 0.5) * self.size_m
            x_m, y_m = np.meshgrid(middles_m, -middles_m)
            mask = np.full((pixels, pixels), np.nan)
            for number, shape in enumerate(self.shapes, 1):
                covered = shape.covers(x_m, y_m)
                if not covered.any():
                    half_m = self.size_m / 2
                    raise ValueError(
                        f"shape {number} covers nothing of the square, which reaches from {-half_m:g} to {half_m:g} m "
                        "in x and y; move it, or leave it out"
                    )
                # later shapes lie over earlier ones
                mask[covered] = shape.level_db
        if np.isnan(mask).all():
            raise ValueError(
                "its picture is wholly transparent; give it material, pixels that are opaque"
            )
        brightest_db = float(np.nanmax(mask))
        if brightest_db < LEAST_BRIGHT_DB:
            raise ValueError(
                f"nowhere more than {brightest_db:g} dB over the floor, it would never stand out of it; "
                f"give a part of it at least {LEAST_BRIGHT_DB:g} dB"
            )
        return LandmarkDesign(
            self.id, self.name, self.size_m, mask, self.height_m, self.relief_m
        )


def read_picture(path: Path, black_db: float, white_db: float) -> Floats:
    """Mask from a picture file.

    Raises `ValueError` when the file is not a square picture of 8 or 16 bits.
    """
    try:
        picture = (
            cv2.imread(str(path), cv2.IMREAD_UNCHANGED) if path.is_file() else None
        )
    except cv2.error:
        picture = None
    if picture is None or picture.dtype not in (np.uint8, np.uint16):
        raise ValueError(
            f"{path} is not a picture; give a PNG file of 8 or 16 bits beside the TOML"
        )
    height, width = picture.shape[:2]
    if height != width:
        raise ValueError(f"{path} is {width} x {height}, not square")
    if width > MOST_PIXELS:
        raise ValueError(
            f"{path} is {width} x {height}; make it {MOST_PIXELS} x {MOST_PIXELS} or smaller"
        )
    # levels are linear in the grey
    full = 255.0 if picture.dtype == np.uint8 else 65535.0
    # the alpha channel, where there is one
    transparent = (
        picture[..., 3] < full / 2
        if picture.ndim == 3 and picture.shape[2] == 4
        else False
    )
    grey = (
        picture
        if picture.ndim == 2
        else cv2.cvtColor(picture[..., :3], cv2.COLOR_BGR2GRAY)
    )
    return np.where(transparent, np.nan, black_db + grey / full * (white_db - black_db))


def load_designs(path: Path) -> tuple[LandmarkDesign, ...]:
    """Read the landmarks of a TOML file, or of all TOML files of a folder in the order of their names.

    Parameters
    ----------
    path
        A file with ``[[landmark]]`` tables as in the description of the module, or a folder of such files.

    Raises
    ------
    CalibrationError
        Naming the file and field, when it has no landmark, one is impossible, or two share an identity or look the same.

    Examples
    --------
    >>> from pathlib import Path
    >>> from sonar_graph.devices import load_designs
    >>> text = '''
    ... [[landmark]]
    ... id = 7
    ... name = "disc"
    ... size_m = 0.30
    ... shapes = [{ level_db = 12.0, circle_m = [0.0, 0.0, 0.10] }]
    ... '''
    >>> written = Path("mine.toml").write_text(text)
    >>> [design.name for design in load_designs(Path("mine.toml"))]
    ['disc']
    """
    path = Path(path)
    files = sorted(path.glob("*.toml")) if path.is_dir() else [path]
    designs = [
        _design(file, number, table)
        for file in files
        for number, table in enumerate(_landmark_tables(file), 1)
    ]
    if not designs:
        raise CalibrationError(
            f"{path}: no landmark designs; give a TOML file with [[landmark]] tables"
        )
    # two that look alike would share the posterior of every detection
    for one, other in combinations(designs, 2):
        if one.id == other.id:
            raise CalibrationError(
                f"{path}: {one.name} and {other.name} both have the id {one.id}; change one"
            )
        if one.looks_like(other):
            raise CalibrationError(
                f"{path}: {one.name} (id {one.id}) and {other.name} (id {other.id}) look the same, so that nothing "
                "tells them apart; change or leave out one"
            )
    return tuple(designs)


def _landmark_tables(file: Path) -> list[dict[str, Any]]:
    """The ``[[landmark]]`` tables of a TOML file."""
    values = read_toml(file, CalibrationError)
    # a misspelt table would be an empty file
    if unknown := sorted(values.keys() - {"landmark"}):
        meant = (
            "; did you mean [[landmark]]?"
            if unknown[0].lower().startswith("landmark")
            else ";"
        )
        raise CalibrationError(
            f"{file}: {unknown[0]}: unknown{meant} a designs file has [[landmark]] tables only"
        )
    tables = values.get("landmark", [])
    if not isinstance(tables, list) or not all(
        isinstance(table, dict) for table in tables
    ):
        raise CalibrationError(
            f"{file}: landmark: write [[landmark]] with two brackets above each landmark"
        )
    return tables


def _design(file: Path, number: int, table: dict[str, Any]) -> LandmarkDesign:
    """Design of a table; errors name the file, the landmark and the field."""
    name = table.get("name")
    place = (
        f"{file}: landmark {name!r}"
        if name and isinstance(name, str)
        else f"{file}: [[landmark]] number {number}"
    )
    try:
        return _Entry.model_validate(table).design(file.parent)
    except ValidationError as error:
        # people count shapes from 1
        faults = re.sub(
            r"\bshapes\.(\d+)",
            lambda row: f"shape {int(row[1]) + 1}",
            faults_in(error, _Entry),
        )
        raise CalibrationError(f"{place}: {faults}") from error
    except ValueError as error:
        raise CalibrationError(f"{place}: {error}") from error


DEFAULT_DESIGNS = load_designs(Path(__file__).with_name("default_landmarks.toml"))
"""Disc, square, triangle and cross, identities 1 to 4."""
