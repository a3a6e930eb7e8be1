"""Text tables as a `Sequence`: a TOML file maps columns to roles, with the keys of a log configuration.

Each table of the file is a role, as in a log configuration (docs/tutorials/04_your_own_log.md), with columns in place
of fields, and with the keys of `CsvForm`. What stands before the first table holds for all::

    stamp = "time"
    stamp_unit_s = "ms"

    [imu]
    file = "imu.csv"
    angular_velocity = ["gyro_x", "gyro_y", "gyro_z"]
    angular_velocity_scale = "deg/s"
    linear_acceleration = ["acc_x", "acc_y", "acc_z"]
    rotation = "frd"
"""

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ValidationError

from sonar_graph.calibration import STANDARD_GRAVITY, Calibration
from sonar_graph.errors import LogError
from sonar_graph.files import as_path, read_toml, spelt
from sonar_graph.logs.adapters import (
    ADAPTERS,
    Adapter,
    DetectionRowsAdapter,
    DvlAdapter,
    LandmarkRowsAdapter,
    Setup,
    did_you_mean,
    plain_lines,
)
from sonar_graph.logs.checks import stamp_faults
from sonar_graph.logs.convert.csv_evidence import marked_valid, time_units
from sonar_graph.logs.convert.csv_table import CsvFile, CsvForm, CsvTable
from sonar_graph.logs.reading import common_origin, require_use
from sonar_graph.measurements import Floats
from sonar_graph.sequence import Sequence
from sonar_graph.settings import faults_in, toml_key

CSV_ADAPTERS: dict[str, type[Adapter]] = {
    role: adapter for role, adapter in ADAPTERS.items() if role != "sonar"
} | {
    "detections": DetectionRowsAdapter,
    "true_landmarks": LandmarkRowsAdapter,
}
"""Adapter of each role that a table can play."""
NOT_OF_TABLES = {"type", "topic", "frame_id_field", "frame_id"}
"""Keys of a log configuration that have no sense for a table."""
SHARED = CsvForm.model_fields.keys() - {"file", "columns"} | {
    "stamp",
    "stamp_unit_s",
    "stamp_offset_s",
}
"""Keys that may stand before the first table, for all of them."""
STAMP = "time"
"""Default column of the time."""
TUM_COLUMNS = (STAMP, "x", "y", "z", "qx", "qy", "qz", "qw")
"""Columns of a trajectory as `write_tum` writes it."""


@dataclass(frozen=True)
class CsvRole:
    """A role with the file and the columns that play it."""

    role: str
    form: CsvForm
    adapter: Adapter


def parse_csv_config(values: Mapping[str, Any], source: str) -> dict[str, CsvRole]:
    """Roles by name from values as TOML gives them; a LogError that names ``source``, table and key that cannot be."""
    tables = {key: value for key, value in values.items() if isinstance(value, Mapping)}
    shared = {key: value for key, value in values.items() if key not in tables}
    for key in shared:
        if key not in SHARED:
            raise LogError(
                f"{source}: {key}: stands before the first table and so for all of them; a role is a table such as "
                "[imu], and other keys belong into one"
            )
    for role in tables:
        if role not in CSV_ADAPTERS:
            hint = did_you_mean(role, CSV_ADAPTERS, "[{}]")
            raise LogError(
                f"{source}: there is no role [{role}]; {hint}tables are for {', '.join(CSV_ADAPTERS)}"
            )
    found = {role: _role(role, shared | dict(tables[role]), source) for role in tables}
    for role in ("imu", "dvl"):
        if role not in found:
            raise LogError(
                f"{source}: has no table [{role}]; every estimator needs IMU and Doppler log"
            )
    return found


def _role(role: str, table: dict[str, Any], source: str) -> CsvRole:
    """A role from its table, checked by the models of the form and of the adapter."""
    kind = CSV_ADAPTERS[role]
    defaults = kind.model_construct(type="csv")
    form: dict[str, Any] = {}
    stated: dict[str, Any] = {}
    for key, value in table.items():
        field = kind.model_fields.get(key)
        # the form of the file, a setting of the adapter, or false: the vehicle does not have it
        if key in CsvForm.model_fields:
            form[key] = value
        # an unknown key is kept for the error that names it
        elif (
            value is not False
            or field is None
            or isinstance(getattr(defaults, key, None), bool)
        ):
            stated[key] = _as_names(kind, key, value)
        elif field.is_required():
            # a sensor without it, such as an IMU without accelerometers
            stated[key] = None
    for key in stated.keys() & NOT_OF_TABLES:
        raise LogError(
            f"{source}: [{role}] {key}: is for messages; a table has columns: take it out"
        )
    place = f"{source}: [{role}]"
    adapter = _checked(kind, {"type": "csv", "stamp": STAMP} | stated, place)
    return CsvRole(role, _checked(CsvForm, form, place), adapter)


def _checked(model: type[BaseModel], values: dict[str, Any], place: str) -> Any:
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise LogError(f"{place} {faults_in(error, model)}") from error


def _as_names(kind: type[Adapter], key: str, value: Any) -> Any:
    """Numbers of columns as names, where a key of an adapter names columns."""
    field = kind.model_fields.get(key)
    # a key without texts has numbers of its own, such as an angle
    texts = "" if field is None else str(field.annotation)
    if "str" not in texts and "FieldPath" not in texts:
        return value
    if isinstance(value, list):
        return [_as_names(kind, key, item) for item in value]
    return str(value) if type(value) is int else value


def read_csv(
    tables: str | Path | Iterable[str | Path],
    config: str | Path | Mapping[str, Any],
    name: str = "",
) -> Sequence:
    r"""Read text tables as a `Sequence`.

    Parameters
    ----------
    tables
        Files, or a folder that holds them.
    config
        TOML file that maps columns to roles, or the same as a dict; `csv_template` begins one.
    name
        Name of the sequence; by default the name of the configuration, or of the IMU's file.

    Returns
    -------
    Sequence
        Measurements with the calibration's defaults. The notes ``csv.*`` name what was left out and looks wrong.

    Raises
    ------
    LogError
        When a file, a column or a key is not what it should be: it names the file, and the line or the columns.

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> from sonar_graph.logs.convert import read_csv
    >>> with TemporaryDirectory() as folder:
    ...     imu, dvl = Path(folder, "imu.csv"), Path(folder, "dvl.csv")
    ...     _ = imu.write_text("time,p,q,r,ax,ay,az\n0.0,0,0,9,0,0,-1\n0.1,0,0,9,0,0,-1\n")
    ...     _ = dvl.write_text("time,u,v,w\n0.0,150,0,0\n0.1,150,0,0\n")
    ...     angles = {"angular_velocity": ["p", "q", "r"], "angular_velocity_scale": "deg/s", "rotation": "frd"}
    ...     forces = {"linear_acceleration": ["ax", "ay", "az"], "linear_acceleration_scale": "g"}
    ...     dvl_table = {"file": "dvl.csv", "velocity": ["u", "v", "w"], "scale": "mm/s", "rotation": "frd"}
    ...     sequence = read_csv([imu, dvl], {"imu": {"file": "imu.csv"} | angles | forces, "dvl": dvl_table})
    >>> sequence.imu.specific_force[0].round(3), sequence.dvl.velocity[0]
    (array([-0.   ,  0.   ,  9.807]), array([ 0.15,  0.  ,  0.  ]))
    """
    given = [tables] if isinstance(tables, str | Path) else tables
    files = table_files(as_path(one, "read_csv(tables)") for one in given)
    source = "config"
    values = config
    if not isinstance(values, Mapping):
        source = str(config)
        values = read_toml(as_path(config, "read_csv(tables, config)"), LogError)
        name = name or spelt(Path(source).stem)
    roles = parse_csv_config(values, source)
    found = {role: _table(one, files, source) for role, one in roles.items()}
    # before anything is read: a wrong unit of time makes all other messages misleading
    _require_units(roles, found)
    blocks, notes = _measurements(roles, found)
    require_use(source, blocks["imu"], blocks["dvl"])
    from sonar_graph.logs.measured_start import with_measured_start  # loads numba

    calibration, notes["log.start"] = with_measured_start(Calibration(), blocks)
    name = name or spelt(found["imu"].file.path.stem)
    return Sequence(name=name, calibration=calibration, notes=notes, **blocks)


def with_truth(
    sequence: Sequence, path: Path, config: Mapping[str, Any] | None = None
) -> Sequence:
    """The sequence with true poses from a text table, in place of its own.

    Parameters
    ----------
    path
        A table: as `write_tum` writes one, ``t x y z qx qy qz qw`` in seconds and metres, ``t x y z`` alone, or with a
        header that names the columns.
    config
        Keys of ``[truth]`` as for `read_csv`, such as ``stamp_offset_s``, ``world`` and ``position``.

    Raises
    ------
    LogError
        When the table cannot be read, or has no time in common with the sequence.

    Examples
    --------
    >>> from pathlib import Path
    >>> from sonar_graph.logs import write_tum
    >>> from sonar_graph.logs.convert import with_truth
    >>> from sonar_graph.testing import small_world
    >>> world = small_world()
    >>> write_tum(Path("truth.tum"), world.true_poses)
    >>> len(with_truth(world, Path("truth.tum")).truth) == len(world.truth)
    True
    """
    stated = config or {}
    # fields of messages are no columns
    if stated.keys() & {"topic", "type"}:
        stated = {}
    one = _role("truth", _columns_of_poses(CsvFile(path), stated), str(path))
    table = _table(one, {path.name: path}, str(path))
    adapter: Any = one.adapter
    truth, dropped = adapter.read(table, Setup())
    if truth is None:
        raise _useless(table, one.role, dropped)
    first_ns = int(truth.stamps_ns[0])
    last_ns = int(truth.stamps_ns[-1])
    if last_ns < sequence.start_ns or first_ns > sequence.end_ns:
        raise LogError(
            f"{path}: its poses are from {first_ns * 1e-9:.3f} to {last_ns * 1e-9:.3f} s, the log from "
            f"{sequence.start_ns * 1e-9:.3f} to {sequence.end_ns * 1e-9:.3f} s; where both begin together, "
            f"`stamp_offset_s = {(sequence.start_ns - first_ns) * 1e-9:.3f}` under [truth] in the log configuration, "
            "`stamp_unit_s` there for times that are not in seconds"
        )
    notes = {**sequence.notes, "truth": f"poses from {path.name}"}
    notes.pop("log.truth", None)
    if faults := _left_out("truth", dropped):
        before = notes.get("log.dropped")
        notes["log.dropped"] = "; ".join(filter(None, (before, *faults)))
    return replace(sequence, truth=truth, notes=notes)


def _columns_of_poses(file: CsvFile, stated: Mapping[str, Any]) -> dict[str, Any]:
    """Keys for a table of poses, beside those that are stated: its columns have the usual names, or none."""
    names = tuple(file.names)
    form = dict[str, Any]()
    if not file.is_named:
        names = TUM_COLUMNS[: len(names)]
        form = {"columns": names}
        if len(file.names) not in (4, len(TUM_COLUMNS)):
            raise LogError(
                f"{file.path}, line {file.first_line}: {len(file.names)} cells; expected `t x y z qx qy qz qw` or "
                "`t x y z`, or a header that names the columns"
            )
    times = (name for name in names if _TIME.fullmatch(name.lower()))
    form["stamp"] = next(times, names[0])
    if place := _axes(names, _PLACE, "xyz"):
        form["position"] = place
    elif "position" not in stated:
        raise LogError(
            f"{file.path}: has no columns x, y, z but {', '.join(names)}; name them in the log configuration "
            "(--log-config FILE): under [truth] `position = [...]`, and `orientation = [...]` with the columns of the "
            "quaternion's x, y, z, w"
        )
    if turn := _axes(names, _TURN, "xyzw"):
        form["orientation"] = turn
    return form | dict(stated)


_TIME = re.compile(r"t|time|(time_?)?stamps?|secs?|seconds")
_PLACE = re.compile(r"(?:[tp]|pos_?|position_?)?([xyz])(?:_m)?")
_TURN = re.compile(r"(?:q|quat|orientation)_?([xyzw])")
"""Usual names of columns of the time, of places, of quaternions."""


def _axes(
    names: tuple[str, ...], usual: re.Pattern[str], axes: str
) -> list[str] | None:
    """Columns along each axis by their usual names; None where one is missing."""
    found = {axis[1]: name for name in names if (axis := usual.fullmatch(name.lower()))}
    return [found[axis] for axis in axes] if set(axes) <= found.keys() else None


def _left_out(role: str, dropped: Mapping[str, int]) -> list[str]:
    return [f"{role}: {count} {fault}" for fault, count in dropped.items()]


def _useless(table: CsvTable, role: str, dropped: Mapping[str, int]) -> LogError:
    """The error of a table without a row that can be used."""
    faults = ", ".join(f"{count} {fault}" for fault, count in dropped.items())
    return LogError(
        f"{table.file.path}: [{role}] none of its {len(table)} rows can be used: {faults}"
    )


def _measurements(
    roles: Mapping[str, CsvRole], tables: Mapping[str, CsvTable]
) -> tuple[dict[str, Any], dict[str, str]]:
    """Measurements by role, and notes about what was assumed, left out, and looks wrong."""
    adapters: dict[str, Any] = {role: one.adapter for role, one in roles.items()}
    _, about_origin = common_origin("positions", adapters, tables)
    notes = {"log.origin": about_origin} if about_origin else {}
    blocks: dict[str, Any] = {}
    left_out: list[str] = []
    doubts: list[str] = []
    for role, table in tables.items():
        adapter = adapters[role]
        if assumed := adapter.assumption(STANDARD_GRAVITY):
            notes["log.depth"] = assumed
        # axes of the vehicle: a mounting is of the calibration, which tables do not have
        origin, _ = common_origin(role, adapters, tables)
        rows, dropped = adapter.read(table, Setup(origin=origin))
        if rows is None:
            raise _useless(table, role, dropped)
        blocks[role] = rows
        left_out += _left_out(role, dropped)
        warnings = list(adapter.warnings(table))
        if role != "true_landmarks":
            warnings += stamp_faults(table.stamps_ns, table.stamps_ns)
        if role == "dvl":
            warnings += _unused_validity(roles[role], table)
        doubts += [f"{role}: {text}" for text in warnings]
        stated = adapter.model_dump(
            include=adapter.model_fields_set - {"type"}, exclude_none=True
        )
        settings = "; ".join(plain_lines(stated))
        notes[f"csv.{role}"] = f"{table.file.path.name}: {settings}"
    notes |= {"csv.left_out": "; ".join(left_out)} if left_out else {}
    notes |= {"csv.warnings": "; ".join(doubts)} if doubts else {}
    return blocks, notes


def _require_units(
    roles: Mapping[str, CsvRole], tables: Mapping[str, CsvTable]
) -> None:
    """Refuse times whose unit is not stated, where they are not plausible in seconds, or in other units too."""
    times: dict[str, Floats] = {
        role: np.unique(table.stamps_ns).astype(np.float64) * 1e-9
        for role, table in tables.items()
        if role != "true_landmarks" and len(table)
    }
    unknown = [
        role
        for role in times
        if "stamp_unit_s" not in roles[role].adapter.model_fields_set
        and not tables[role].has_dates
    ]
    known = dict.fromkeys(times.keys() - unknown, "s")
    units = time_units(times, {role: role for role in times}, known)
    for role in unknown:
        found = units.get(role, ["s"])
        # only the IMU has to be sure: a slower sensor may have run for a part of the dive
        if found == ["s"] or (role != "imu" and "s" in found):
            continue
        step_s = float(np.median(np.diff(times[role])))
        table = tables[role]
        likely = " or ".join(f'"{unit}"' for unit in found if unit != "s")
        raise LogError(
            f"{table.file.path}: [{role}] stamp: {roles[role].adapter.stamp} has steps of {step_s:g}, which in seconds "
            f"are {_SENSORS.get(role, 'rows')} of {1 / step_s:.3g} Hz; write `stamp_unit_s = {likely or '...'}` before "
            'the first table, or `stamp_unit_s = "s"` where these are seconds'
        )


_SENSORS = {"imu": "an IMU", "dvl": "a Doppler log"}


def _unused_validity(dvl: CsvRole, table: CsvTable) -> Iterator[str]:
    """Warning about a column that marks invalid velocities, and that nothing uses."""
    # velocities along beams have no components that could repeat one number
    if not isinstance(dvl.adapter, DvlAdapter) or dvl.adapter.velocity is None:
        return
    velocity = table.beside(dvl.adapter.velocity)
    used = set(dvl.adapter.fields_used())
    unused = [name for name in table.file.names if name not in used]
    for name, mark, marks in marked_valid(table.file, unused, velocity):
        invalid = int(np.count_nonzero(marks != mark))
        if invalid:
            yield (
                f"column {name} is {1 - mark} in {invalid} of {len(marks)} rows and not used: "
                f"`valid_where = {{{toml_key(name)} = {mark}}}` under [dvl] leaves them out"
            )


def _table(one: CsvRole, files: Mapping[str, Path], source: str) -> CsvTable:
    """Rows of the file that plays a role."""
    wanted = one.form.file
    place = f"{source}: [{one.role}] file:"
    if wanted is None:
        if len(files) != 1:
            raise LogError(
                f"{place} is missing; expected one of {', '.join(files) or 'no files'}"
            )
        (wanted,) = files
    if wanted not in files:
        # a file that only the command forgot, or a slip
        beside = [path.parent / wanted for path in files.values()]
        add = next((path for path in beside if path.is_file()), wanted)
        raise LogError(
            f"{place} {wanted} is not among the tables; add {add} to the command, or put the name right; "
            f"given: {', '.join(files)}"
        )
    adapter = one.adapter
    has_times = one.role != "true_landmarks"
    return CsvTable(
        CsvFile(files[wanted], one.form),
        one.role,
        adapter.fields_used(),
        adapter.stamp if has_times else None,
        adapter.stamp_unit_s,
        adapter.stamp_offset_s,
    )


def table_files(given: Iterable[Path]) -> dict[str, Path]:
    """Files by name: those given, and those of folders; a LogError where one is missing or two share a name."""
    found: dict[str, Path] = {}
    for path in given:
        if not path.exists():
            raise LogError(
                f"{path}: there is no such file; give the tables, or the folder that holds them"
            )
        inside = [path]
        if path.is_dir():
            inside = sorted(one for one in path.iterdir() if one.is_file())
        if not inside:
            raise LogError(
                f"{path}: holds no files; give the folder that holds the tables"
            )
        # a configuration names files without their folders
        for one in inside:
            if not found.setdefault(one.name, one).samefile(one):
                raise LogError(
                    f"{one} and {found[one.name]} share a name; rename one, a table names its file by name"
                )
    return found
