"""A map of known landmarks as a file that a person can write and a run writes.

TOML, as a run writes it::

    source = "dive-1.mcap, isam2"
    ids = [4, 9]
    positions_m = [[5.0, 0.0, -1.7], [7.0, -3.0, -1.7]]
    covariance_m2 = [[...], ...]          # joint, three rows a landmark

CSV, as a survey gives it: columns ``id``, ``x_m``, ``y_m``, ``z_m`` and ``sigma_m``, or ``sigma_x_m``, ``sigma_y_m``,
``sigma_z_m``. The ``landmarks.csv`` of a comparison has the covariance of each landmark (``cov_xx`` to ``cov_zz``); the
correlations between landmarks are missing there, so that a vehicle in such a map is less certain of itself than it could
be, or too certain of what many landmarks share.
"""

import csv
import math
import zlib
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sonar_graph.calibration import UNKNOWN_HEIGHT, KnownMap
from sonar_graph.errors import CalibrationError, LogError
from sonar_graph.files import parsed_toml, replacing, text_of
from sonar_graph.measurements import FIRST_TOO_LARGE_ID
from sonar_graph.navigation import NO_MAP
from sonar_graph.sequence import Sequence
from sonar_graph.settings import parse, toml_value
from sonar_graph.states import counted

PLACE = ("x_m", "y_m", "z_m")
SIGMAS = ("sigma_x_m", "sigma_y_m", "sigma_z_m")
TRIANGLE = ("cov_xx", "cov_xy", "cov_xz", "cov_yy", "cov_yz", "cov_zz")
COLUMNS = f"id, {', '.join(PLACE)} and either sigma_m, or {', '.join(SIGMAS)}, or {', '.join(TRIANGLE)}"
MOST_M = 1e5
"""A coordinate beyond it is in another unit, or of a grid of a country."""
FROM_NEAR_BY = "give metres from an origin near by, along the world's axes"


class ReadMap(NamedTuple):
    """A map and the remarks about it."""

    map: KnownMap
    warnings: list[str]


def read_map(path: Path) -> ReadMap:
    r"""Map of known landmarks from a TOML or CSV file.

    Raises
    ------
    LogError
        Naming file, row and column, and what was expected.

    Examples
    --------
    >>> from pathlib import Path
    >>> _ = Path("survey.csv").write_text("id,x_m,y_m,z_m,sigma_m\n4,5.0,0.0,-1.7,0.05\n")
    >>> read_map(Path("survey.csv")).map.ids
    (4,)
    """
    if path.is_dir():
        inside = sorted(path.rglob("map.toml"))
        such = f", such as {inside[0]}" if inside else ""
        raise LogError(f"{path}: expected a map as a file, not a folder{such}")
    try:
        text = text_of(path, "utf-8-sig")  # tables of spreadsheets begin with a mark
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise LogError(f"{path}: expected a map as TOML or CSV text") from error
    warnings = []
    if path.suffix.lower() == ".toml":
        try:
            values = parsed_toml(text, path, LogError)
        except LogError as error:
            raise LogError(
                f"{error}; a table of a survey has a name that ends in .csv"
            ) from error
        known = parse(KnownMap, values, str(path), LogError)
    else:
        known, is_marginal = of_table(text, path)
        if is_marginal:
            warnings.append(
                f"{path}: covariances of single landmarks, and no correlations between them; the map.toml of a run has them"
            )
    if max(known.ids) >= FIRST_TOO_LARGE_ID:
        raise LogError(
            f"{path}: landmark {max(known.ids)}: give identities below {FIRST_TOO_LARGE_ID}, as detections have them"
        )
    variances_m2 = np.diag(known.joint()).reshape(-1, 3)  # (m, 3)
    if variances_m2.min() <= 0.0:
        exact = known.ids[int(variances_m2.min(axis=1).argmin())]
        raise LogError(
            f"{path}: landmark {exact}: expected variances above 0 m², such as 1e-6 of a survey to 1 mm"
        )
    # national grids and millimetres are the usual mistakes
    farthest_m = float(np.abs(np.array(known.positions_m)).max())
    if farthest_m > MOST_M:
        raise LogError(f"{path}: a landmark at {farthest_m:.0f} m: {FROM_NEAR_BY}")
    return ReadMap(known, warnings)


def of_table(text: str, path: Path) -> tuple[KnownMap, bool]:
    """Map of a CSV table, and whether it has covariances of single landmarks."""
    reader = csv.DictReader(text.splitlines(), skipinitialspace=True)
    heads = [head.strip() for head in reader.fieldnames or []]
    reader.fieldnames = heads
    # landmarks.csv of a comparison
    is_marginal = set(TRIANGLE) <= set(heads)
    has_axes = set(SIGMAS) <= set(heads)
    if not {"id", *PLACE} <= set(heads) or not (
        is_marginal or has_axes or "sigma_m" in heads
    ):
        # as spreadsheets of some countries write
        if {";", "\t"} & set(text.partition("\n")[0]):
            raise LogError(
                f"{path}: expected the columns {COLUMNS}; separate them by commas, with points in decimals"
            )
        missing = [name for name in ("id", *PLACE) if name not in heads] or ["a sigma"]
        lacking = "" if len(missing) > 2 else f"{' and '.join(missing)}: missing: "
        raise LogError(
            f"{path}: {lacking}expected the columns {COLUMNS}, not {', '.join(heads) or 'an empty file'}"
        )
    if has_axes < bool(set(SIGMAS) & set(heads)):
        raise LogError(f"{path}: expected all of {', '.join(SIGMAS)}, or sigma_m alone")
    if twice := [head for head in heads if heads.count(head) > 1]:
        raise LogError(f"{path}: two columns are called {twice[0]}; keep one")
    ids: list[int] = []
    places: list[list[float]] = []
    blocks: list[np.ndarray] = []
    for row in reader:
        where = f"{path}, line {reader.line_num}"
        # the key of cells beyond the heading
        if None in row:
            raise LogError(
                f"{where}: {len(heads) + len(row[None])} cells, the heading names {len(heads)}"
            )

        def number(column: str, row: dict[str, str] = row, where: str = where) -> float:
            try:
                # Python takes 1_0 for 10
                value = float((row[column] or "").replace("_", "?"))
            except ValueError:
                value = math.nan
            if not math.isfinite(value):
                shown = repr(row[column]) if row[column] else "an empty cell"
                raise LogError(f"{where}: {column}: expected a number, not {shown}")
            return value

        # a table of floats may hold 4.0, and not 4.5
        value = number("id")
        if value != int(value):
            raise LogError(f"{where}: id: expected a whole number, not {row['id']!r}")
        written = row["id"].strip()
        # a float would round identities of more than 15 digits
        landmark_id = int(written) if written.isdecimal() else int(value)
        if landmark_id in ids:
            raise LogError(
                f"{where}: landmark {landmark_id} stands twice; keep one line"
            )
        if landmark_id >= FIRST_TOO_LARGE_ID:
            raise LogError(
                f"{where}: id: give identities below {FIRST_TOO_LARGE_ID}, as detections have them"
            )
        ids.append(landmark_id)
        place = [number(column) for column in PLACE]
        if max(map(abs, place)) > MOST_M:
            raise LogError(
                f"{where}: a landmark at {max(map(abs, place)):.0f} m: {FROM_NEAR_BY}"
            )
        places.append(place)
        if is_marginal:
            block = np.zeros((3, 3))
            # upper triangle, mirrored below
            block[np.triu_indices(3)] = [number(column) for column in TRIANGLE]
            blocks.append(block + np.triu(block, 1).T)
        else:
            columns = SIGMAS if has_axes else ("sigma_m",) * 3
            sigmas = [number(column) for column in columns]
            if not 0.0 < min(sigmas) <= max(sigmas) <= MOST_M:
                raise LogError(
                    f"{where}: {columns[0]}: expected a sigma above 0 m, such as 0.001, and below {MOST_M:g}"
                )
            blocks.append(np.diag(np.square(sigmas)))
    if not ids:
        raise LogError(f"{path}: no landmark: give a line for each below the heading")
    # no correlations between landmarks: the file has none
    joint = np.zeros((3 * len(ids), 3 * len(ids)))
    for k, block in enumerate(blocks):
        joint[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = block
    values = {
        "ids": ids,
        "positions_m": places,
        "covariance_m2": joint.tolist(),
        "source": path.name,
    }
    return parse(KnownMap, values, str(path), LogError), is_marginal


def write_map(path: Path, known: KnownMap) -> None:
    """Write a map as TOML."""
    fields = known.model_dump()
    text = "".join(f"{name} = {toml_value(value)}\n" for name, value in fields.items())
    try:
        with replacing(Path(path)) as partial:
            partial.write_text(text, encoding="utf-8")
    except OSError as error:
        raise LogError(f"{path} cannot be written: {error.strerror}") from error


def map_origin(sequence: Sequence) -> str:
    """Name of a log in the source of its map, with a checksum of its first rates, since names repeat."""
    # rates of a real gyro do not repeat
    first = sequence.imu.angular_velocity[:100]
    return f"{sequence.name} ({zlib.crc32(first.tobytes()):08x})"


def in_map(sequence: Sequence, path: Path | None) -> Sequence:
    """A sequence with the map of a file, or as it is. Its start is found in the map where the log states no place.

    The note ``log.map`` of the sequence describes what was done.
    """
    if path is None:
        if (
            sequence.calibration.start.source == "map"
            and sequence.calibration.map is None
        ):
            raise CalibrationError(NO_MAP)
        return sequence
    known, warnings = read_map(path)
    given = sequence.calibration
    has_height = UNKNOWN_HEIGHT not in sequence.notes.get("log.start", "")
    start = given.start.in_map(has_height=has_height)
    if start.source == "map" and not has_height:
        warnings.append(
            "neither depth nor fixes tell the height of the vehicle in the map, which the filters linearise badly; state "
            "it as z of `position_m = [0, 0, -2]` under [start] in a file for --calibration"
        )
    note = f"{counted(len(known.ids), 'landmark')} of {path.name}"
    if start.source == "map":
        note += "; the start is looked for in it, by identified landmarks"
    # the map has the measurements of this log in it already
    if known.source.startswith(f"{map_origin(sequence)}, "):
        warnings.append(
            f"{path}: this map was made from the same log, whose measurements count twice then: results look too certain"
        )
    changes = {"map": known, "start": start}
    calibration = sequence.calibration.model_copy(update=changes)
    notes = {**sequence.notes, "log.map": note}
    if start.source == "map":
        # no convention places the vehicle any more
        notes.pop("log.start", None)
    if warnings:
        earlier = [notes["log.warnings"]] if "log.warnings" in notes else []
        notes["log.warnings"] = "; ".join([*earlier, *warnings])
    return replace(sequence, calibration=calibration, notes=notes)
