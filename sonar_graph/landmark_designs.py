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

The landmarks of the 2014 experiment were never published. All designs here, sizes and levels included, are ours.
"""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, TypeAdapter, ValidationError, model_validator

from sonar_graph.calibration import Section
from sonar_graph.errors import CalibrationError
from sonar_graph.measurements import Floats

PIXEL_M = 0.002
"""Size of the pixels into which drawn shapes are turned."""


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


class _Shape(Section):
    """A filled circle or polygon of one level."""

    level_db: float
    circle_m: tuple[float, float, float] | None = None
    polygon_m: list[tuple[float, float]] | None = Field(None, min_length=3)

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

    id: int = Field(ge=0)
    name: str
    size_m: float = Field(gt=0)
    height_m: float = Field(0.013, ge=0)
    shapes: tuple[_Shape, ...] = ()
    picture: str | None = None
    black_db: float = -8.0
    white_db: float = 12.0

    @model_validator(mode="after")
    def _has_one_source(self) -> _Entry:
        if (self.picture is None) == (not self.shapes):
            raise ValueError("give either shapes or picture")
        return self

    def design(self, folder: Path) -> LandmarkDesign:
        """Drawn, or with its picture from the folder."""
        mask = self._drawn() if self.picture is None else self._pictured(folder / self.picture)
        return LandmarkDesign(self.id, self.name, self.size_m, mask, self.height_m)

    def _drawn(self) -> Floats:
        pixels = round(self.size_m / PIXEL_M)
        middles_m = ((np.arange(pixels) + 0.5) / pixels - 0.5) * self.size_m
        x_m, y_m = np.meshgrid(middles_m, -middles_m)
        mask = np.full((pixels, pixels), np.nan)
        for shape in self.shapes:
            mask[shape.covers(x_m, y_m)] = shape.level_db
        return mask

    def _pictured(self, path: Path) -> Floats:
        picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) if path.is_file() else None
        if picture is None:
            raise CalibrationError(f"landmark {self.name}: {path} is not a picture; give a PNG file beside the TOML")
        if picture.shape[0] != picture.shape[1]:
            raise CalibrationError(
                f"landmark {self.name}: {path} is {picture.shape[1]} x {picture.shape[0]}, not square"
            )
        transparent = picture[..., 3] < 128 if picture.ndim == 3 and picture.shape[2] == 4 else False
        grey = picture if picture.ndim == 2 else cv2.cvtColor(picture[..., :3], cv2.COLOR_BGR2GRAY)
        share = grey / (65535.0 if grey.dtype == np.uint16 else 255.0)
        return np.where(transparent, np.nan, self.black_db + share * (self.white_db - self.black_db))


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
        entries = TypeAdapter(dict[str, list[_Entry]]).validate_python(values)
    except OSError as error:
        raise CalibrationError(f"{file} cannot be read: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise CalibrationError(f"{file} is not TOML: {error}") from error
    except ValidationError as error:
        faults = "; ".join(f"{'.'.join(map(str, e['loc']))}: {e['msg']}" for e in error.errors())
        raise CalibrationError(f"{file}: {faults}") from error
    if unknown := set(entries) - {"landmark"}:
        raise CalibrationError(f"{file}: unknown table {', '.join(sorted(unknown))}; landmarks are [[landmark]] tables")
    return [entry.design(file.parent) for entry in entries.get("landmark", [])]


def _check_distinct(path: Path, designs: Sequence[LandmarkDesign]) -> None:
    first: dict[int, str] = {}
    for design in designs:
        if design.id in first:
            raise CalibrationError(f"{path}: {first[design.id]} and {design.name} both have the id {design.id}")
        first[design.id] = design.name


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
