"""A first guess at what the columns of text tables are, as a commented TOML file for the user to edit.

``csv_quantities.toml`` lists what a column may hold, with the names and units that headers use. The values have to
agree: a column that never changes is no motion, and a magnitude that no vehicle reaches is of another unit. Where names
or values leave a choice, the role stands as a comment that names the candidates. Under every file all columns are
listed.
"""

import re
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from sonar_graph.errors import LogError
from sonar_graph.logs.adapters import (
    ANGLES,
    FORCES,
    LAST_S,
    LENGTHS,
    PRESSURES,
    RATES,
    SPEEDS,
    TIMES,
    plain_lines,
)
from sonar_graph.logs.convert.csv_evidence import (
    FEWEST_ROWS,
    UNITS,
    VALIDITY,
    is_absent,
    marked_valid,
    time_units,
)
from sonar_graph.logs.convert.csv_log import TUM_COLUMNS, table_files
from sonar_graph.logs.convert.csv_table import (
    CsvFile,
    CsvForm,
    date_ns,
    plain_name,
    reads_as,
)
from sonar_graph.measurements import Floats
from sonar_graph.settings import toml_value

_FORMS: tuple[dict[str, Any], ...] = tuple(
    encoding | decimal
    for encoding in ({}, {"encoding": "cp1252"}, {"encoding": "utf-16"})
    for decimal in ({}, {"decimal": ","})
)
"""Forms that are tried, the usual one first; the one in which most cells have values counts."""
_TIMES = (
    r"t|time|stamp|timestamp|unix|epoch|secs?|seconds|utc|datetime|zeit",
    r"(.*_)?time_?stamp(_.*)?|time_.*|.*_time|date.*|.*zeit",
)
"""Names of columns of the time, the likeliest first."""
_NOT_MEASURED = r"(set_?point|desired|demand|command|cmd|err|error|std|sigma|var|cov|bias|uncertainty)(_|$)"
_DEPTHS = ("height", "pressure")
_LISTS = ("ids", "probabilities")
"""Keys with a column for each candidate."""
_OF_IMU = "in the table of an IMU, without a unit: places, or angles (the third is then the yaw of [heading])?"


_INTRODUCTION = """\
# Columns of text tables, for `sonar-graph convert csv --config`. A guess by names and values: check every line.
# Columns are given by name or by number, counted from 1. Axes: rotation = "frd" for x forward, y right, z
# down, or [roll, pitch, yaw] in degrees of ours_R_driver. Units: a factor, or a name such as "deg/s".
# All keys: docs/tutorials/11_tables.md#the-keys"""
_UNITS = {
    "rates": RATES,
    "forces": FORCES,
    "speeds": SPEEDS,
    "lengths": LENGTHS,
    "pressures": PRESSURES,
    "angles": ANGLES,
}


@dataclass(frozen=True)
class Quantity:
    """What columns may hold, from ``csv_quantities.toml``: one column a component; names differ in that alone."""

    key: str
    """Key of the configuration."""
    stem: str
    parts: tuple[str, ...] = ("",)
    """Patterns of the components; one without a name for a single column."""
    units: Mapping[str, float] | None = None
    scale: str = "scale"
    usual: tuple[float, float] = (0.0, np.inf)
    more: str = ""


@dataclass(frozen=True)
class TemplatePart:
    """A role that a table may play, from ``csv_quantities.toml``."""

    files: str
    empty: str
    needs: tuple[str, ...]
    may: Mapping[str, str] = field(default_factory=dict)


def _quantities(key: str, shared: dict[str, Any]) -> list[Quantity]:
    columns = shared.pop("columns")
    shared["units"] = _UNITS.get(shared.get("units", ""))
    return [Quantity(key, **(shared | column)) for column in columns]


_KNOWN = tomllib.loads(
    files("sonar_graph.logs.convert")
    .joinpath("csv_quantities.toml")
    .read_text(encoding="utf-8")
)
_SPELLINGS = {
    spelling: unit
    for unit, spellings in _KNOWN["spellings"].items()
    for spelling in spellings.split()
}
"""Names of units by their spellings in headers."""
QUANTITIES = {
    key: _quantities(key, table) for key, table in _KNOWN["quantities"].items()
}
"""What columns may hold by key; of several the first that fits counts."""
PARTS = {role: TemplatePart(**table) for role, table in _KNOWN["roles"].items()}


@dataclass(frozen=True)
class _Column:
    """Name of a column to give, the same in small letters without its unit, and its unit."""

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
    rank: tuple[bool, int, bool] = (True, 0, True)
    """Order of guesses at one role, the best first: without doubt, of the better quantity, named by the file."""


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
    found: dict[str, _Table] = {}
    faults: list[str] = []
    for name, path in table_files(tables).items():
        try:
            found[name] = _Table(name, path)
        except LogError as error:
            faults.append(str(error))
    if not found:
        raise LogError(faults[0])
    guesses = [guess for table in found.values() for guess in table.guesses()]
    stamps = _stamps(found, {guess.file: guess.role for guess in reversed(guesses)})
    parts = [_INTRODUCTION, *(table.listing() for table in found.values())]
    for role, part in PARTS.items():
        options = [guess for guess in guesses if guess.role == role]
        least = min((guess.rank for guess in options), default=None)
        best = [guess for guess in options if guess.rank == least]
        if not best:
            likely = next((name for name in found if role in name.lower()), "...")
            best = [_Guess(role, likely, part.empty.splitlines(), "nothing found")]
        names = ", ".join(guess.file for guess in best)
        choice = f"which of {names}? uncomment one" if len(best) > 1 else ""
        for guess in best:
            form = found[guess.file].form_lines if guess.file in found else []
            stamp = stamps.get(guess.file, []) if role != "true_landmarks" else []
            lines = [f"file = {toml_value(guess.file)}", *form, *stamp, *guess.lines]
            head = f"[{role}]"
            if doubt := guess.doubt or choice:
                head = f"# [{role}]  # {doubt}"
                lines = [f"# {line}" for line in lines]
            parts.append("\n".join([head, *lines]))
    parts += [f"# not a table: {fault}" for fault in faults]
    return "\n\n".join(parts) + "\n"


class _Table:
    """A file that holds a table, with its columns."""

    def __init__(self, name: str, path: Path) -> None:
        self.name = name
        self.file, self.form_lines = _file(path)
        names = self.file.names
        self.columns = [_column(given, names) for given in names]
        self._values: dict[str, Floats] = {}
        self.time = self._time()

    def values(self, columns: list[_Column]) -> Floats:
        """Numbers of some columns, shape (n, number of columns)."""
        # one pass over the file for all of them
        new = [column.given for column in columns if column.given not in self._values]
        if new:
            self._values |= dict(zip(new, self.file.numbers(*new), strict=True))
        return np.column_stack([self._values[column.given] for column in columns])

    def first(self, column: _Column) -> str:
        """First cell of a column."""
        return self.file.first[self.columns.index(column)]

    def listing(self) -> str:
        """Comment with all columns and their first values."""
        file = self.file
        lines = [f"# {self.name}: {len(file.names)} columns"]
        cells = zip(file.names, file.first, strict=True)
        for number, (column, cell) in enumerate(cells, 1):
            named = f"{column} = " if file.is_named else ""
            lines.append(f"#   {number:2d}  {named}{cell}")
        return "\n".join(lines)

    def find(self, keys: str, columns: list[_Column]) -> "_Match | None":
        """Columns that hold one of some quantities, the first without doubt if there is one."""
        matches = []
        for rank, key in enumerate(keys.split()):
            fitting = ((one, _fitting(one, columns)) for one in QUANTITIES[key])
            quantity, options = next((f for f in fitting if f[1]), (None, []))
            # zeros of a driver without accelerometers
            if key == "linear_acceleration":
                options = [one for one in options if np.any(self.values(one))]
            # those that never change do not count where others do
            moving = [one for one in options if not self.is_constant(one)]
            if quantity and options:
                matches.append(_Match(self, quantity, moving or options, rank))
        return min(matches, key=lambda match: bool(match.doubt()), default=None)

    def is_constant(self, columns: list[_Column]) -> bool:
        """True where no column ever changes."""
        values = self.values(columns)
        values = values[np.isfinite(values).all(axis=1)]
        return len(values) >= FEWEST_ROWS and not np.ptp(values, axis=0).any()

    def _time(self) -> _Column | None:
        """Column of the time: by its name, else the first; its values have to grow."""
        named = [
            column
            for pattern in _TIMES
            for column in self.columns
            if re.fullmatch(pattern, column.name)
        ]
        first = [] if self.find("id", self.columns[:1]) else self.columns[:1]
        for column in named + first:
            steps = np.diff(self.values([column])[:, 0])
            # some loggers write a few rows late
            is_growing = not len(steps) or (np.mean(steps >= 0) > 0.9 and steps.any())
            if reads_as(date_ns, self.first(column)) or is_growing:
                return column
        return None

    def guesses(self) -> Iterator[_Guess]:
        """Roles that the table may play."""
        is_truth = bool(re.search(PARTS["truth"].files, self.name.lower()))
        true = [
            c
            for c in self.columns
            if is_truth or re.search(PARTS["truth"].files, c.name)
        ]
        measured = [c for c in self.columns if not re.search(_NOT_MEASURED, c.name)]
        live = [c for c in measured if c not in (*true, self.time)]
        # "angular_velocity" is a velocity by its name
        rates = self.find("angular_velocity", live)
        not_rates = [c for c in live if not rates or c not in rates.chosen]
        has_forces = self.find("linear_acceleration", live) is not None
        has_place = self.find("position", live) is not None
        has_angles = self.find("orientation rpy", live) is not None
        yield from self._play("truth", true)
        if has_forces:
            yield from self._play("imu", live)
        elif not has_place:
            yield from self._play("imu", live, "no accelerometer: is this the IMU?")
        yield from self._play("dvl", not_rates)
        if detections := list(self._play("detections", live)):
            yield from detections
        elif self.time is None and self.find("id", live):
            yield from self._play("true_landmarks", live)
        elif (
            has_place
            and has_angles
            and not has_forces
            and not re.search(PARTS["positions"].files, self.name.lower())
        ):
            # a pose is computed by another system
            yield from self._play("truth", live)
        else:
            place = self.find("geodetic position", live)
            is_clear = place is None or not place.is_without_unit() or not has_forces
            yield from self._play("positions", live, "" if is_clear else _OF_IMU)
            yield from self._play("depth", live)
            yield from self._play("heading", live)

    def _play(
        self, role: str, columns: list[_Column], doubt: str = ""
    ) -> Iterator[_Guess]:
        """Guess at a role where the table has all that it needs; the first question about a quantity counts."""
        lines: list[str] = []
        part = PARTS[role]
        rank = 0
        for keys in (*part.needs, *part.may):
            match = self.find(keys, columns)
            if match:
                lines += match.lines()
                doubt = doubt or match.doubt()
                if keys in part.needs:
                    rank += match.rank
                if role == "dvl":
                    lines += self._validity(match)
            elif keys in part.needs:
                return
            elif part.may[keys]:
                lines.append(part.may[keys])
        is_named = bool(re.search(part.files, self.name.lower()))
        yield _Guess(role, self.name, lines, doubt, (bool(doubt), rank, not is_named))

    def _validity(self, velocity: "_Match") -> list[str]:
        """Line that leaves out invalid rows; in use where the valid mark is known."""
        names = [c.given for c in self.columns if c not in velocity.chosen]
        values = self.values(velocity.chosen)
        for name, mark, _ in marked_valid(self.file, names, values):
            return [f"valid_where = {{{toml_value(name)} = {mark}}}"]
        unclear = [n for n in names if any(word in n.lower() for word in VALIDITY)]
        return [
            f"# valid_where = {{{toml_value(name)} = 1}}  # which value is valid?"
            for name in unclear[:1]
        ]


@dataclass(frozen=True)
class _Match:
    """Columns of a table that may hold a quantity, the likeliest first."""

    table: _Table
    quantity: Quantity
    options: list[list[_Column]]
    rank: int
    """Number of better quantities that the role could have instead."""

    @property
    def chosen(self) -> list[_Column]:
        """The likeliest columns."""
        return self.options[0]

    def values(self) -> Floats:
        """Numbers of the chosen columns, shape (n, components), without empty rows."""
        values = self.table.values(self.chosen)
        return values[~is_absent(values)]

    def is_without_unit(self) -> bool:
        """True for places of an unknown unit."""
        units = self.quantity.units
        return units is not None and self.chosen[0].unit not in units

    def doubt(self) -> str:
        """Question about the columns or their unit; empty without doubt."""
        quantity = self.quantity
        if quantity.units is None:
            return ""
        # gravity may look constant to a coarse sensor, motion does not
        if quantity.key != "linear_acceleration" and self.table.is_constant(
            self.chosen
        ):
            return f"never changes: a {'depth' if quantity.key in _DEPTHS else quantity.key}?"
        if len(self.options) > 1:
            names = [", ".join(c.given for c in option) for option in self.options]
            return f"{quantity.key}: {' or '.join(names)}?"
        stated = self.chosen[0].unit
        fits = self._fitting_units()
        known = " or ".join(fits)
        if fits and stated in quantity.units and stated not in fits:
            return f"{quantity.key}: the header states {stated}, the values are those of {known}"
        if len(fits) > 1 and self.is_without_unit() and not self._is_first(fits):
            return f"unit of {quantity.key}: {known}?"
        return ""

    def _fitting_units(self) -> list[str]:
        """Units in which the values have usual magnitudes; none where that is not known."""
        lowest, highest = self.quantity.usual
        values = self.values()
        if len(values) < FEWEST_ROWS or not np.isfinite(highest):
            return []
        sizes = np.linalg.norm(values, axis=1)
        if self.quantity.key in ("yaw", "azimuth", "rpy"):
            sizes = np.abs(values).max(axis=1)
        # gravity is there all the time, the fastest motion is rare: but for spikes the largest counts
        size = float(np.percentile(sizes, 50 if lowest else 99))
        if self.quantity.key == "pressure":
            # a dive begins near the surface
            size = float(sizes.min())
        units = self.quantity.units or {}
        return [u for u, factor in units.items() if lowest <= size * factor <= highest]

    def _is_first(self, fits: list[str]) -> bool:
        return next(iter(self.quantity.units or {})) in fits

    def lines(self) -> list[str]:
        """Lines of the configuration: columns, and their unit."""
        key = self.quantity.key
        names = [column.given for column in self.chosen]
        # latitudes and depths have units of their own kind
        if key == "geodetic":
            return [self._geodetic()]
        if key == "height":
            factor = LENGTHS.get(self.chosen[0].unit or "m", 1.0)
            if (self.values() < 0).all():
                # a vehicle does not fly: these count upwards
                factor = -factor
            return [
                f"height = {toml_value(names[0])}",
                f"scale = {-factor:g}  # to metres upwards",
            ]
        is_single = self.quantity.parts == ("",) and key not in _LISTS
        more = []
        if key == "pressure":
            # pressures of a stated unit that are less than half that of the air
            factor = PRESSURES.get(self.chosen[0].unit or "", np.inf)
            if self.values().min(initial=np.inf) * factor < 5e4:
                text = (
                    "atmosphere_pa = 0  # less than that of the air: from the surface"
                )
                more = [text]
        return [
            f"{key} = {toml_value(names[0] if is_single else names)}",
            *self._unit_line(),
            *more,
            *filter(None, [self.quantity.more]),
        ]

    def _unit_line(self) -> list[str]:
        """The unit, where it is another than that of this package, or not stated."""
        units = self.quantity.units or {}
        unit = self.chosen[0].unit
        if not units or units.get(unit or "") == 1.0:
            return []
        line = f"{self.quantity.scale} = "
        if unit is not None and unit in units:
            return [line + toml_value(unit)]
        fits = self._fitting_units()
        if not fits or self._is_first(fits):
            usual = toml_value(list(units)[1])
            return [f"# {line}{usual}  # the header states no unit"]
        found = toml_value(fits[0])
        return [f"{line}{found}  # by its values; the header states no unit"]

    def _geodetic(self) -> str:
        latitude, longitude = self.chosen
        more = ""
        for column in self.table.columns:
            if re.match(r"(.*_)?(alt|altitude|height)(_|$)", column.name):
                more = f", height = {toml_value(column.given)}"
                break
        if np.abs(self.values()[:, 0]).max(initial=0.0) > 90:
            more += ', unit = "ddmm.mmmm"'
        return f"geodetic = {{latitude = {toml_value(latitude.given)}, longitude = {toml_value(longitude.given)}{more}}}"


def _file(path: Path) -> tuple[CsvFile, list[str]]:
    """A file read in the form in which most cells of its first row have values, and the lines that state it."""
    best: tuple[int, CsvFile, dict[str, Any]] | None = None
    fault: LogError | None = None
    for form in _FORMS:
        try:
            file = CsvFile(path, CsvForm(**form))
        except LogError as error:
            # a file that no form fits keeps the error of the usual form
            fault = fault or error
            continue
        count = sum(map(file.form.is_value, file.first))
        # numbers like 1,5 have no value with a decimal point, so the wrong form has fewer
        if best is None or count > best[0]:
            best = (count, file, form)
        if count == len(file.first):
            break
    if best is None:
        raise fault or LogError(f"{path}: holds no table")
    _, file, stated = best
    if _is_tum(file):
        stated = stated | {"columns": TUM_COLUMNS}
        file = CsvFile(path, CsvForm.model_validate(stated))
    return file, plain_lines(stated)


def _is_tum(file: CsvFile) -> bool:
    """True for poses without a header in the format of TUM, whose last four numbers are a unit quaternion."""
    if file.is_named or len(file.names) != len(TUM_COLUMNS):
        return False
    quaternions = np.column_stack(file.numbers("5", "6", "7", "8"))
    lengths = np.linalg.norm(quaternions, axis=1)
    return bool((np.abs(lengths - 1.0) < 1e-3).all())


def _stamps(
    tables: Mapping[str, _Table], roles: Mapping[str, str]
) -> dict[str, list[str]]:
    """Lines for the times by file: column and unit, which all tables together have to prove."""
    lines: dict[str, list[str]] = {}
    times: dict[str, Floats] = {}
    for name, table in tables.items():
        if table.time is None:
            lines[name] = ['# stamp = "..."  # no column of the time was found']
            continue
        lines[name] = [f"stamp = {toml_value(table.time.given)}"]
        values = table.values([table.time])
        if np.isfinite(values).any():
            times[name] = np.unique(values[np.isfinite(values)])
        elif not reads_as(date_ns, first := table.first(table.time)):
            lines[name].append(
                f"# {first!r} is no time; write such as 2026-05-01T12:30:00.25Z"
            )
    if times and "imu" not in roles.values():
        # the fastest table is probably that of the IMU
        fastest = min(times, key=lambda name: np.ptp(times[name]) / len(times[name]))
        roles = {**roles, fastest: "imu"}
    proven = time_units(times, {name: roles.get(name, "") for name in times}, {})
    of_imu = [proven[name] for name in proven if roles.get(name) == "imu"]
    for name, values in times.items():
        column = tables[name].time
        stated = column.unit if column and column.unit in TIMES else None
        # with too few rows for a rate: what keeps the time before the year 2286
        early = [u for u in UNITS if values[-1] * TIMES[u] < LAST_S]
        units = proven.get(name, early[:1])
        if stated in (*units, "min") or (stated and name not in proven):
            units = [str(stated)]
        elif stated:
            lines[name].append(f"# the header states {stated}, the steps do not fit:")
            units = [*units, stated]
        else:
            units = [unit for unit in units if [unit] in of_imu] or units
        if len(units) > 1 or not units:
            choice = " or ".join(map(toml_value, units)) or "not plausible in any"
            lines[name].append(f"# stamp_unit_s = ...  # which unit? {choice}")
        elif units[0] != "s":
            lines[name].append(f"stamp_unit_s = {toml_value(units[0])}")
    return lines


def _column(given: str, names: list[str]) -> _Column:
    """Column with its unit, from ``[...]``, ``(...)`` or the end of its name."""
    bare = plain_name(given)
    unit = given[len(bare) :].strip(" []()").lower() or None
    apart = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", bare)
    name = re.sub(r"[\s.\-]+", "_", apart).lower().strip("_")
    # the longest first: m_s before s
    if unit is None:
        for spelling in sorted(_SPELLINGS, key=len, reverse=True):
            if name.endswith(f"_{spelling}"):
                unit = spelling
                name = name.removesuffix(f"_{spelling}")
                break
    # the short name, where no other column has it in another unit
    is_short = [plain_name(other) for other in names].count(bare) == 1
    return _Column(bare if is_short else given, name, _SPELLINGS.get(unit or ""))


def _fitting(quantity: Quantity, columns: list[_Column]) -> list[list[_Column]]:
    """Columns for all components of a quantity, for each name without the component that has them all."""
    found: dict[str, dict[int, _Column]] = {}
    # components by what is left of the name: two sensors in one table stay apart
    for column in columns:
        for place, part in enumerate(quantity.parts):
            pattern = (
                rf"(.*?)_?(?:{part})(?:_?axis)?|(?:{part})_(.*)" if part else "(.*)()"
            )
            if match := re.fullmatch(pattern, column.name):
                stem = match[1] or match[2] or ""
                found.setdefault(stem if part else column.name, {})[place] = column
    return [
        [of_stem[place] for place in range(len(quantity.parts))]
        for stem, of_stem in found.items()
        if len(of_stem) == len(quantity.parts) and re.search(quantity.stem, stem)
    ]
