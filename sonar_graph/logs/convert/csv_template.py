"""A first guess at what the columns of text tables are, as a commented TOML file for the user to edit.

The guess goes by names and by units in the header, such as ``gyro_x [deg/s]`` or ``depth_mm``, and by the names of the
files where several roles have alike columns. Under every file all columns are listed with their first values.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sonar_graph.errors import LogError
from sonar_graph.logs.adapters import (
    ANGLES,
    FORCES,
    LENGTHS,
    PRESSURES,
    RATES,
    SPEEDS,
    TIMES,
)
from sonar_graph.logs.convert.csv_log import FEWEST_ROWS, IMU_RATES_HZ, table_files
from sonar_graph.logs.convert.csv_table import CsvFile, is_value, plain_name
from sonar_graph.measurements import Floats
from sonar_graph.settings import toml_value

_SPELLINGS = {
    **{
        "deg": "deg",
        "degree": "deg",
        "degrees": "deg",
        "°": "deg",
        "rad": "rad",
        "radians": "rad",
    },
    **{
        "deg/s": "deg/s",
        "°/s": "deg/s",
        "dps": "deg/s",
        "degs": "deg/s",
        "deg_s": "deg/s",
        "rad/s": "rad/s",
    },
    **{
        "rad_s": "rad/s",
        "rads": "rad/s",
        "mrad/s": "mrad/s",
        "m/s2": "m/s2",
        "m/s^2": "m/s2",
        "m/s²": "m/s2",
    },
    **{
        "m_s2": "m/s2",
        "g": "g",
        "mg": "mg",
        "m/s": "m/s",
        "mps": "m/s",
        "m_s": "m/s",
        "cm/s": "cm/s",
    },
    **{
        "cm_s": "cm/s",
        "mm/s": "mm/s",
        "mm_s": "mm/s",
        "mmps": "mm/s",
        "km/h": "km/h",
        "kn": "kn",
        "knots": "kn",
    },
    **{
        "m": "m",
        "cm": "cm",
        "mm": "mm",
        "ft": "ft",
        "pa": "Pa",
        "hpa": "hPa",
        "mbar": "mbar",
        "kpa": "kPa",
    },
    **{
        "dbar": "dbar",
        "bar": "bar",
        "psi": "psi",
        "s": "s",
        "sec": "s",
        "ms": "ms",
        "us": "us",
        "µs": "us",
    },
    **{"usec": "us", "ns": "ns", "nsec": "ns", "min": "min"},
}
"""Units as headers write them, in small letters, by their names in a log configuration."""
_RATE, _FORCE = (
    r"gyr|omega|angular_?vel|(?:ang|turn|angular)_?rate|^rate|^w$",
    r"acc|force|^a$|^f$",
)
_VELOCITY, _PLACE = r"vel|speed|^v$|dvl|bottom", r"pos|^$|^p$|^t$|translation|location"
_TRUTH, _MAP, _FIX = (
    r"truth|ground|^gt|_gt|reference|mocap",
    r"landmark|beacon|marker|target|map",
    r"gps|gnss|usbl|fix",
)
_TIME = r"^(t|time|stamp|timestamp|unix|epoch|secs?|seconds|utc|datetime|date)$|time_?stamp|^time"
_OF_IMU = "in the table of an IMU, without a unit: places, or angles (the third is then the yaw of [heading])?"
_UNITS_OF_TIME = ("s", "ms", "us", "ns")
_SIMILAR = 30.0
"""Ratio of the spans of two tables up to which their times have one unit."""
_LAST_S = 1e10
"""Seconds since 1970 of the year 2286: a larger number counts milliseconds, or what is smaller still."""


@dataclass(frozen=True)
class _Column:
    """Name of a column in small letters, its unit, and the name to give."""

    given: str
    name: str
    unit: str | None


@dataclass(frozen=True)
class _Guess:
    """A role that a file may play, with the lines of its table."""

    role: str
    file: str
    lines: list[str]
    doubt: str = ""
    """Question for the user, where the table is to be commented out."""

    @property
    def rank(self) -> tuple[bool, bool]:
        """Order of guesses at one role, the best first: without doubt, and fixes by their latitude and longitude."""
        is_geodetic = any(line.startswith("geodetic") for line in self.lines)
        return bool(self.doubt), self.role == "positions" and not is_geodetic


def csv_template(tables: list[Path]) -> str:
    """TOML to start from for `read_csv`: a guess for every role, and all columns with their first values.

    Parameters
    ----------
    tables
        Files, or folders that hold them; files that hold no table are named in a comment.

    Raises
    ------
    LogError
        When a file does not exist, or none holds a table.
    """
    files: dict[str, CsvFile] = {}
    parts, faults = [], []
    for name, path in table_files(tables).items():
        try:
            files[name] = CsvFile(path)
        except LogError as error:
            faults.append(str(error))
    if not files:
        raise LogError(faults[0])
    parts.append(
        "# Columns of text tables, for `sonar-graph convert csv --config`. A guess by their names: check every line.\n"
        '# Columns are given by name or by number, counted from 1. Axes: rotation = "frd" for x forward, y right, z\n'
        '# down, or [roll, pitch, yaw] in degrees of ours_R_driver. Units: a factor, or a name such as "deg/s".\n'
        "# All keys: docs/tutorials/04_your_own_log.md"
    )
    roles: dict[str, _Guess] = {}
    units = _time_units(files)
    for name, file in files.items():
        for guess in _guess(name, file, units.get(name)):
            if guess.role not in roles or guess.rank < roles[guess.role].rank:
                roles[guess.role] = guess
        parts.append(_listing(name, file))
    for role, empty in _EMPTY.items():
        likely = next((name for name in files if role in name.lower()), "...")
        guess = roles.get(role) or _Guess(role, likely, empty, "nothing found")
        lines = [f"[{role}]", f"file = {toml_value(guess.file)}", *guess.lines]
        if guess.doubt:
            lines = [f"# {line}" for line in [f"[{role}]  # {guess.doubt}", *lines[1:]]]
        parts.append("\n".join(lines))
    parts += [f"# not a table: {fault}" for fault in faults]
    return "\n\n".join(parts) + "\n"


_EMPTY = {
    "imu": [
        'angular_velocity = ["...", "...", "..."]',
        'linear_acceleration = ["...", "...", "..."]',
    ],
    "dvl": ['velocity = ["...", "...", "..."]'],
    "depth": [
        'height = "..."',
        "scale = -1  # of a depth, downwards; or pressure = ...",
    ],
    "heading": [
        'yaw = "..."',
        'scale = "deg"',
        'world = "ned"  # a bearing, clockwise from north',
    ],
    "positions": [
        'geodetic = {latitude = "...", longitude = "..."}  # or position = [x, y, z]'
    ],
    "detections": ['range = "..."', 'azimuth = "..."', 'ids = ["..."]'],
    "truth": [
        'position = ["...", "...", "..."]  # or geodetic = {latitude = ..., longitude = ...}'
    ],
    "true_landmarks": ['id = "..."', 'position = ["...", "...", "..."]'],
}
"""Keys to fill in, of roles that nothing was found for."""


def _listing(name: str, file: CsvFile) -> str:
    layout = file.layout
    lines = [
        f"# {name}: {len(layout.names)} columns"
        + f"; {layout.remark}" * bool(layout.remark)
    ]
    for number, (column, first) in enumerate(
        zip(layout.names, layout.first, strict=True), 1
    ):
        lines.append(
            f"#   {number:2d}  {column + ' = ' if layout.is_named else ''}{first}"
        )
    return "\n".join(lines)


def _guess(name: str, file: CsvFile, unit: str | None) -> Iterator[_Guess]:
    """Roles that a file may play, with the unit of its times."""
    columns, is_truth = (
        [_column(column) for column in file.layout.names],
        bool(re.search(_TRUTH, name.lower())),
    )
    stamp, where, forces = (
        _stamp(columns, file, unit),
        _where(columns, file),
        _triple(columns, _FORCE),
    )
    motion = _motion(columns, forces, is_truth=is_truth)
    if motion:
        lines = motion[1]
        if motion[0] == "dvl":
            lines = [*lines, *_validity(columns, file)]
        yield _Guess(motion[0], name, [*stamp, *lines])
    elif (rates := _triple(columns, _RATE)) and not where:
        lines = [
            _list("angular_velocity", rates),
            *_scale("angular_velocity_scale", rates[0], RATES),
        ]
        yield _Guess(
            "imu",
            name,
            [*stamp, *lines, "linear_acceleration = false"],
            "no accelerometer: is this the IMU?",
        )
    spread, bearing = (
        _one(columns, r"range|distance|^r$"),
        _one(columns, r"azimuth|bearing"),
    )
    label = _one(columns, r"^id$|_id$|label|class|landmark|beacon")
    is_timed = _one(columns, _TIME) is not None
    if spread and bearing:
        yield _Guess(
            "detections", name, [*stamp, *_detections(columns, spread, bearing, label)]
        )
        return
    turn = _named(columns, "q_?x", "q_?y", "q_?z", "q_?w")
    angles = _named(columns, "roll|phi", "pitch|theta", "yaw|psi|heading")
    if where and label and _place(columns) and not is_timed:
        yield _Guess(
            "true_landmarks", name, [f"id = {toml_value(label.given)}", *where]
        )
    elif where and (
        is_truth
        or ((turn or angles) and not re.search(_FIX, name.lower()) and not forces)
    ):
        yield _Guess("truth", name, [*stamp, *where, *_orientation(turn, angles)])
        return
    elif where:
        place = _place(columns)
        is_metric = where[0].startswith("geodetic") or (
            place is not None and place[0].unit in LENGTHS
        )
        doubt = "" if is_metric or not motion or motion[0] != "imu" else _OF_IMU
        yield _Guess("positions", name, [*stamp, *where], doubt)
    if depth := _one(columns, r"depth") or _one(columns, r"press"):
        values = file.numbers(file.layout.names[columns.index(depth)])
        is_constant = (
            len(values) >= FEWEST_ROWS and not np.ptp(values[np.isfinite(values)]) > 0
        )
        yield _Guess(
            "depth",
            name,
            [*stamp, *_depth(depth)],
            "never changes: a depth?" if is_constant else "",
        )
    if yaw := _one(columns, r"^(yaw|heading|compass|hdg|psi)"):
        lines = [
            f"yaw = {toml_value(yaw.given)}",
            *_scale("scale", yaw, ANGLES),
            'world = "ned"',
        ]
        yield _Guess("heading", name, [*stamp, *lines])


def _motion(
    columns: list[_Column], forces: list[_Column] | None, *, is_truth: bool
) -> tuple[str, list[str]] | None:
    """Role and lines of an IMU, else of a Doppler log: velocities beside a truth are true ones."""
    rates = _triple(columns, _RATE) or _named(columns, "p", "q", "r")
    velocity = _triple(columns, _VELOCITY) or _named(columns, "u", "v", "w")
    if forces and (chosen := rates or velocity):
        doubt = "" if rates else "  # by their place; are these rates?"
        lines = [
            _list("angular_velocity", chosen) + doubt,
            *_scale("angular_velocity_scale", chosen[0], RATES),
        ]
        lines += [
            _list("linear_acceleration", forces),
            *_scale("linear_acceleration_scale", forces[0], FORCES),
        ]
        return "imu", [*lines, '# rotation = "frd"  # where gravity is felt along -z']
    if velocity and not is_truth:
        lines = [_list("velocity", velocity), *_scale("scale", velocity[0], SPEEDS)]
        return "dvl", [*lines, '# rotation = "frd"']
    return None


def _validity(columns: list[_Column], file: CsvFile) -> list[str]:
    """Line that leaves out invalid rows; in use where a column of 0 and 1 has a name that says valid."""
    status = _one(columns, r"valid|lock") or _one(columns, r"status")
    if status is None:
        return []
    line = f"valid_where = {{{toml_value(status.given)} = 1}}"
    is_mask = bool(
        np.isin(
            file.numbers(file.layout.names[columns.index(status)]), (0.0, 1.0)
        ).all()
    )
    return [
        line
        if is_mask and "status" not in status.name
        else f"# {line}  # which value is valid?"
    ]


def _detections(
    columns: list[_Column], spread: _Column, bearing: _Column, label: _Column | None
) -> list[str]:
    """Lines of ranges and azimuths, with what is said of their identities."""
    sure, track = (
        _one(columns, r"prob|posterior|score|confidence"),
        _one(columns, r"track"),
    )
    return [
        f"range = {toml_value(spread.given)}",
        *_scale("range_scale", spread, LENGTHS),
        f"azimuth = {toml_value(bearing.given)}",
        *_scale("azimuth_scale", bearing, ANGLES),
        f"ids = {toml_value([label.given])}"
        if label
        else "ids = false  # no column of identities was found",
        *([f"probabilities = [{toml_value(sure.given)}]"] if sure else []),
        *([f"track = {toml_value(track.given)}"] if track else []),
        '# rotation = "frd"  # azimuth positive to the right',
    ]


def _place(columns: list[_Column]) -> list[_Column] | None:
    """Columns of a position in metres, z up."""
    east_north_up = "east|easting|e", "north|northing|n", "up|z|alt|altitude|height"
    return _triple(columns, _PLACE) or _named(columns, *east_north_up)


def _where(columns: list[_Column], file: CsvFile) -> list[str]:
    """Lines of a position: geodetic, or in metres with z up or down; none without one."""
    latitude, longitude = _one(columns, r"^lat"), _one(columns, r"^(lon|lng)")
    if latitude and longitude:
        height = _one(columns, r"^(alt|height)")
        more = f", height = {toml_value(height.given)}" if height else ""
        first = file.layout.first[columns.index(latitude)]
        more += (
            ', unit = "ddmm.mmmm"' if is_value(first) and abs(float(first)) > 90 else ""
        )
        return [
            f"geodetic = {{latitude = {toml_value(latitude.given)}, longitude = {toml_value(longitude.given)}{more}}}"
        ]
    if place := _place(columns):
        return [_list("position", place), *_scale("scale", place[0], LENGTHS)]
    down = _named(columns, "north|n", "east|e", "down|d")
    return (
        [_list("position", down), *_scale("scale", down[0], LENGTHS), 'world = "ned"']
        if down
        else []
    )


def _depth(column: _Column) -> list[str]:
    """Lines of a depth or a pressure."""
    if column.unit in PRESSURES or "press" in column.name:
        return [
            f"pressure = {toml_value(column.given)}",
            *_scale("scale", column, PRESSURES),
        ]
    factor = LENGTHS.get(column.unit or "m", 1.0)
    return [
        f"height = {toml_value(column.given)}",
        f"scale = {-factor:g}  # downwards, to metres up",
    ]


def _orientation(turn: list[_Column] | None, angles: list[_Column] | None) -> list[str]:
    if turn:
        return [_list("orientation", turn)]
    return (
        [_list("rpy", angles), *_scale("rpy_scale", angles[0], ANGLES)]
        if angles
        else []
    )


def _time_units(files: dict[str, CsvFile]) -> dict[str, str]:
    """Units of the times by file: that of the header, or the one in which the fastest table has the rate of an IMU.

    Tables of one dive span about the same time, so one unit holds for all of a similar span. No time lies behind
    `_LAST_S`.
    """
    found: dict[str, str] = {}
    times: dict[str, Floats] = {}
    for name, file in files.items():
        columns = [_column(column) for column in file.layout.names]
        time = _one(columns, _TIME) or columns[0]
        numbers = file.numbers(file.layout.names[columns.index(time)], None)
        if time.unit in TIMES:
            found[name] = time.unit
        elif np.isfinite(numbers).any():
            times[name] = np.unique(numbers[np.isfinite(numbers)])
    possible = {
        name: [unit for unit in _UNITS_OF_TIME if values[-1] * TIMES[unit] < _LAST_S]
        for name, values in times.items()
    }
    steps = {
        name: np.median(np.diff(values))
        for name, values in times.items()
        if len(values) >= FEWEST_ROWS
    }
    if steps:
        fastest = min(steps, key=lambda name: float(steps[name]))
        slowest_hz, fastest_hz = IMU_RATES_HZ
        for unit in possible[fastest]:
            if slowest_hz <= 1 / (steps[fastest] * TIMES[unit]) <= fastest_hz:
                ratios = {
                    name: np.ptp(values) / np.ptp(times[fastest])
                    for name, values in times.items()
                }
                found |= {
                    name: unit
                    for name, ratio in ratios.items()
                    if 1 / _SIMILAR < ratio < _SIMILAR
                }
                break
    return {name: units[0] for name, units in possible.items() if units} | found


def _stamp(columns: list[_Column], file: CsvFile, unit: str | None) -> list[str]:
    """Lines for the time: its column, and its unit."""
    column = _one(columns, _TIME) or (columns[0] if columns else None)
    if column is None:
        return []
    first = file.layout.first[columns.index(column)]
    line = f"stamp = {toml_value(column.given)}"
    if not is_value(first):
        return [f"{line}  # {first!r} is no time"]
    return [
        line,
        *([f"stamp_unit_s = {toml_value(unit)}"] if unit not in (None, "s") else []),
    ]


def _column(given: str) -> _Column:
    """Column with its unit, from ``[...]``, ``(...)`` or the end of its name."""
    bare = plain_name(given)
    unit = given[len(bare) :].strip(" []()").lower() or None
    name = re.sub(r"[\s.\-]+", "_", re.sub(r"(?<=[a-z])(?=[A-Z])", "_", bare)).lower()
    if unit is None:
        for spelling in sorted(_SPELLINGS, key=len, reverse=True):
            if name.endswith(f"_{spelling}") and len(spelling) + 1 < len(name):
                unit, name = spelling, name[: -len(spelling) - 1]
                break
    return _Column(bare if bare != given else given, name, _SPELLINGS.get(unit or ""))


def _triple(columns: list[_Column], pattern: str) -> list[_Column] | None:
    """Columns x, y, z of one quantity whose name without the axis fits a pattern."""
    stems: dict[str, dict[str, _Column]] = {}
    for column in columns:
        if match := re.fullmatch(
            r"(.*?)_?([xyz])(?:_?axis)?|([xyz])_(.*)", column.name
        ):
            stem, axis = (match[1], match[2]) if match[2] else (match[4], match[3])
            stems.setdefault(stem, {})[axis] = column
    found = [
        axes
        for stem, axes in stems.items()
        if len(axes) == 3 and re.search(pattern, stem)
    ]
    # velocity over the bottom before that through water
    found.sort(key=lambda axes: "bottom" not in axes["x"].name)
    return [found[0][axis] for axis in "xyz"] if found else None


def _named(columns: list[_Column], *patterns: str) -> list[_Column] | None:
    """Columns whose whole names fit patterns, one each."""
    found = [
        next(
            (c for c in columns if re.fullmatch(f"(?:.*_)?(?:{pattern})", c.name)), None
        )
        for pattern in patterns
    ]
    chosen = [column for column in found if column is not None]
    return chosen if len(chosen) == len(patterns) else None


def _one(columns: list[_Column], pattern: str) -> _Column | None:
    return next((column for column in columns if re.search(pattern, column.name)), None)


def _list(key: str, columns: list[_Column]) -> str:
    return f"{key} = {toml_value([column.given for column in columns])}"


def _scale(key: str, column: _Column, units: dict[str, float]) -> list[str]:
    """Line with the unit, where the header states another than that of this package."""
    if column.unit not in units or units[column.unit] == 1.0:
        return (
            []
            if column.unit in units
            else [
                f"# {key} = {toml_value(list(units)[1])}  # the header states no unit"
            ]
        )
    return [f"{key} = {toml_value(column.unit)}"]
