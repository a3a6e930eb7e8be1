"""What artificial landmarks look like: flat masks of how strongly they scatter sound.

A design is a square picture with a physical size. Each pixel says how many decibels the landmark scatters above the
floor around it; NaN where it has no material and the floor shows. One's own designs need no code: a TOML file such as
``default_landmarks.toml`` beside this module, with drawn shapes or with a PNG file for each landmark::

    [[landmark]]
    id = 7
    name = "ring"
    size_m = 0.40                 # side of the square picture
    height_m = 0.013              # how far it stands above the floor; may be left out
    picture = "ring.png"          # grey 0 ... 255; beside the TOML file
    black_db = -8.0               # what 0 means ...
    white_db = 12.0               # ... and what 255 means; transparent pixels are floor

What can be recognised: one figure that is brighter than the floor, in one piece, about the middle of the square. Each
connected bright part of an image is a candidate of its own, and only those are compared with designs that have an area
between ``detection.min_area_m2`` and ``detection.max_area_m2`` and are no longer than ``detection.max_extent_m``
(0.008 m², 0.2 m² and 0.7 m unless set otherwise). Dark parts may lie apart. What no setting makes visible is refused
here; bright parts that lie apart, are too small or too large are refused by the recogniser, on whose settings that
depends (`sonar_graph.sonar.cfar`). What reaches over the square is cut off at its edges.

The landmarks of the 2014 experiment were never published. All designs here, sizes and levels included, are ours.
"""

from __future__ import annotations

import hashlib
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError, model_validator

from sonar_graph.calibration import Section
from sonar_graph.errors import CalibrationError
from sonar_graph.measurements import Floats
from sonar_graph.settings import faults_in

PIXEL_M = 0.002
"""Size of the pixels into which drawn shapes are turned."""
LEAST_SIZE_M, MOST_SIZE_M = 0.02, 2.0
MOST_PIXELS = 2000
"""Along the side of a picture."""
MOST_ID = 2**31 - 1
LEAST_BRIGHT_DB = 3.0
"""What nowhere scatters as much more than the floor does not stand out of its speckle."""
OWN_DESIGNS = "landmark designs"
"""The note of a log that says which landmarks lie there, where they are not those that ship."""
_Level = Annotated[float, Field(ge=-100, le=100, allow_inf_nan=False)]
_Length = Annotated[float, Field(allow_inf_nan=False)]


@dataclass(frozen=True, eq=False)
class LandmarkDesign:
    """One landmark: its identity and its picture in sound."""

    id: int
    """Identity, as in maps and detections."""
    name: str
    size_m: float
    """Side of the square that the mask covers."""
    mask: Floats
    """Level over the floor in dB, shape (n, n); NaN: floor. Seen from above with the first row at +y and the first
    column at -x."""
    height_m: float = 0.013
    """How far its face stands above the floor: 12 mm of foam on 1 mm of metal."""

    def level_db(self, x_m: Floats, y_m: Floats) -> Floats:
        """Level over the floor at points of the design's own frame (origin at its centre); NaN outside of it."""
        pixels = len(self.mask)
        column = np.floor((np.asarray(x_m) / self.size_m + 0.5) * pixels).astype(np.int64)
        row = np.floor((0.5 - np.asarray(y_m) / self.size_m) * pixels).astype(np.int64)
        inside = (column >= 0) & (column < pixels) & (row >= 0) & (row < pixels)
        last = pixels - 1
        return np.where(inside, self.mask[np.clip(row, 0, last), np.clip(column, 0, last)], np.nan)

    def digest(self) -> str:
        """16 hexadecimal digits that change with name, size, height or mask (from 0.01 dB on)."""
        counts = np.where(np.isnan(self.mask), -(2**31), np.round(100 * np.nan_to_num(self.mask)))
        text = f"{self.name}\n{self.size_m:.6f}\n{self.height_m:.6f}\n{self.mask.shape}\n"
        return hashlib.sha256(text.encode() + counts.astype("<i4").tobytes()).hexdigest()[:16]

    def looks_like(self, other: LandmarkDesign) -> bool:
        """Whether the other one has the same picture and size, turned by quarters or not."""
        return self.size_m == other.size_m and any(
            np.array_equal(np.rot90(self.mask, quarters), other.mask, equal_nan=True) for quarters in range(4)
        )


class _Shape(Section):
    """A filled circle or polygon of one level."""

    level_db: _Level
    circle_m: tuple[_Length, _Length, _Length] | None = None
    polygon_m: list[tuple[_Length, _Length]] | None = Field(None, min_length=3)

    @model_validator(mode="after")
    def _is_one_shape(self) -> _Shape:
        if (self.circle_m is None) == (self.polygon_m is None):
            raise ValueError("give either circle_m = [x, y, radius] or polygon_m = [[x, y], ...]")
        return self

    def covers(self, x_m: Floats, y_m: Floats) -> NDArray[np.bool_]:
        """Which points lie inside."""
        if self.circle_m is not None:
            centre_x, centre_y, radius = self.circle_m
            return np.asarray(np.hypot(x_m - centre_x, y_m - centre_y) <= radius)
        return _in_polygon(np.array(self.polygon_m), x_m, y_m)


class _Entry(Section):
    """A ``[[landmark]]`` of a TOML file."""

    id: int = Field(ge=0, le=MOST_ID)
    name: str = Field(min_length=1)
    size_m: float = Field(ge=LEAST_SIZE_M, le=MOST_SIZE_M, allow_inf_nan=False)
    height_m: float = Field(0.013, ge=0, le=1, allow_inf_nan=False)
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
        """Drawn, or with its picture from the folder.

        Raises
        ------
        ValueError
            When the picture is none, or the landmark could not be told from the floor.
        """
        mask = self._drawn() if self.picture is None else _pictured(folder / self.picture, self.black_db, self.white_db)
        _check_stands_out(mask)
        return LandmarkDesign(self.id, self.name, self.size_m, mask, self.height_m)

    def _drawn(self) -> Floats:
        pixels = round(self.size_m / PIXEL_M)
        middles_m = ((np.arange(pixels) + 0.5) / pixels - 0.5) * self.size_m
        x_m, y_m = np.meshgrid(middles_m, -middles_m)
        mask = np.full((pixels, pixels), np.nan)
        for number, shape in enumerate(self.shapes, 1):
            covered = shape.covers(x_m, y_m)
            if not covered.any():
                half_m = self.size_m / 2
                raise ValueError(
                    f"shape {number} covers nothing of the square, which reaches from {-half_m:g} to {half_m:g} m in x "
                    "and y; move it, or leave it out"
                )
            mask[covered] = shape.level_db
        return mask


def _pictured(path: Path, black_db: float, white_db: float) -> Floats:
    """The mask that a picture shows.

    Raises
    ------
    ValueError
        When there is none that can be one.
    """
    try:
        picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) if path.is_file() else None
    except cv2.error:
        picture = None
    if picture is None or picture.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"{path} is not a picture; give a PNG file of 8 or 16 bits beside the TOML")
    height, width = picture.shape[:2]
    if height != width:
        raise ValueError(f"{path} is {width} x {height}, not square")
    if width > MOST_PIXELS:
        raise ValueError(f"{path} is {width} x {height}; make it {MOST_PIXELS} x {MOST_PIXELS} or smaller")
    full = 255.0 if picture.dtype == np.uint8 else 65535.0
    transparent = picture[..., 3] < full / 2 if picture.ndim == 3 and picture.shape[2] == 4 else False
    grey = picture if picture.ndim == 2 else cv2.cvtColor(picture[..., :3], cv2.COLOR_BGR2GRAY)
    return np.where(transparent, np.nan, black_db + grey / full * (white_db - black_db))


def _check_stands_out(mask: Floats) -> None:
    """Refuse what is never a candidate.

    Raises
    ------
    ValueError
        When it has no material, or no bright part.
    """
    if np.isnan(mask).all():
        raise ValueError("its picture is wholly transparent; give it material, pixels that are opaque")
    brightest_db = float(np.nanmax(mask))
    if brightest_db < LEAST_BRIGHT_DB:
        raise ValueError(
            f"nowhere more than {brightest_db:g} dB over the floor, it would never stand out of it; "
            f"give a part of it at least {LEAST_BRIGHT_DB:g} dB"
        )


def load_designs(path: Path) -> tuple[LandmarkDesign, ...]:
    """The landmarks of a TOML file, or of all TOML files of a folder in the order of their names.

    Parameters
    ----------
    path
        A file with ``[[landmark]]`` tables as in the module's description, or a folder of such files.

    Raises
    ------
    CalibrationError
        Naming the file and field, when there is none, one is impossible, or two share an identity.
    """
    path = Path(path)
    files = sorted(path.glob("*.toml")) if path.is_dir() else [path]
    designs = [design for file in files for design in _read(file)]
    if not designs:
        raise CalibrationError(f"{path}: no landmark designs; give a TOML file with [[landmark]] tables")
    _check_distinct(path, designs)
    return tuple(designs)


def _read(file: Path) -> list[LandmarkDesign]:
    try:
        values = tomllib.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise CalibrationError(f"{file} cannot be read: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise CalibrationError(f"{file} is not TOML: {error}") from error
    return [_design(file, number, table) for number, table in enumerate(_tables(file, values), 1)]


def _tables(file: Path, values: Mapping[str, Any]) -> list[dict[str, Any]]:
    if unknown := sorted(values.keys() - {"landmark"}):
        meant = "; did you mean [[landmark]]?" if unknown[0].lower().startswith("landmark") else ";"
        raise CalibrationError(f"{file}: {unknown[0]}: unknown{meant} a designs file has [[landmark]] tables only")
    tables = values.get("landmark", [])
    if not isinstance(tables, list) or not all(isinstance(table, dict) for table in tables):
        raise CalibrationError(f"{file}: landmark: write [[landmark]] with two brackets above each landmark")
    return tables


def _design(file: Path, number: int, table: Mapping[str, Any]) -> LandmarkDesign:
    name = table.get("name")
    place = f"{file}: landmark {name!r}" if name and isinstance(name, str) else f"{file}: [[landmark]] number {number}"
    try:
        return _Entry.model_validate(table).design(file.parent)
    except ValidationError as error:
        raise CalibrationError(f"{place}: {_counted_from_one(faults_in(error, _Entry))}") from error
    except ValueError as error:
        raise CalibrationError(f"{place}: {error}") from error


def _counted_from_one(faults: str) -> str:
    return re.sub(r"\bshapes\.(\d+)", lambda row: f"shape {int(row[1]) + 1}", faults)


def _check_distinct(path: Path, designs: Sequence[LandmarkDesign]) -> None:
    for one, other in combinations(designs, 2):
        if one.id == other.id:
            raise CalibrationError(f"{path}: {one.name} and {other.name} both have the id {one.id}; change one")
        if one.looks_like(other):
            raise CalibrationError(
                f"{path}: {one.name} (id {one.id}) and {other.name} (id {other.id}) look the same, so that nothing "
                "tells them apart; change or leave out one"
            )


def _in_polygon(vertices: Floats, x: Floats, y: Floats) -> NDArray[np.bool_]:
    """Which points a polygon holds: a ray to the right crosses its edges an odd number of times."""
    inside = np.zeros(np.shape(x), dtype=bool)
    for (x1, y1), (x2, y2) in zip(vertices, np.roll(vertices, -1, axis=0), strict=True):
        if y1 == y2:
            continue
        crossing = x1 + (y - y1) * (x2 - x1) / (y2 - y1)
        inside ^= ((y1 > y) != (y2 > y)) & (x < crossing)
    return inside


DEFAULT_DESIGNS = load_designs(Path(__file__).with_name("default_landmarks.toml"))
"""Disc, square, triangle and cross, identities 1 to 4."""
