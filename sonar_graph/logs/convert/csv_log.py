"""Text tables as a `Sequence`: a TOML file says which columns are what, in the words of a log configuration.

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
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from sonar_graph.calibration import Calibration
from sonar_graph.errors import LogError
from sonar_graph.files import as_path, spelt, text_of
from sonar_graph.logs.adapters import (
    ADAPTERS,
    TIMES,
    Adapter,
    DepthAdapter,
    DetectionRowsAdapter,
    Dropped,
    LandmarkRowsAdapter,
    plain_lines,
)
from sonar_graph.logs.checks import stamp_faults
from sonar_graph.logs.convert.csv_table import CsvFile, CsvForm, CsvTable
from sonar_graph.logs.reading import common_origin, require_use, rows_of
from sonar_graph.sequence import Sequence
from sonar_graph.settings import faults_in, toml_key

CSV_ADAPTERS: dict[str, type[Adapter]] = {
    role: adapter for role, adapter in ADAPTERS.items() if role != "sonar"
} | {
    "detections": DetectionRowsAdapter,
    "true_landmarks": LandmarkRowsAdapter,
}
"""Adapter of each role that a table can play."""
NOT_OF_TABLES = ("type", "topic", "frame_id_field", "frame_id")
"""Keys of a log configuration that have no sense for a table."""
IMU_RATES_HZ = (5.0, 5000.0)
"""Rates of inertial sensors, by which the unit of times is known."""
FEWEST_ROWS = 10
"""Rows from which a rate, and a column that never changes, are known."""
STAMP = "time"
"""Column of the time where nothing says another."""


@dataclass(frozen=True)
class CsvRole:
    """A role with the file and the columns that play it."""

    role: str
    form: CsvForm
    adapter: Adapter
    keys: dict[str, str]
    """Key of the configuration by column."""


def read_csv_config(path: Path) -> dict[str, CsvRole]:
    """Read a TOML file that says which columns of which tables are what; its roles by name.

    A LogError where it cannot be read, is not TOML, or says something that cannot be; it names table and key.
    """
    try:
        values = tomllib.loads(text_of(path))
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise LogError(f"{path}: not TOML: {error}") from error
    return parse_csv_config(values, str(path))


def parse_csv_config(values: Mapping[str, Any], source: str) -> dict[str, CsvRole]:
    """Roles from values as TOML gives them; errors as in `read_csv_config`, with the name of a ``source``."""
    shared = {
        key: value for key, value in values.items() if not isinstance(value, Mapping)
    }
    tables = {key: value for key, value in values.items() if isinstance(value, Mapping)}
    for key in shared:
        if key not in {
            *CsvForm.model_fields,
            "stamp",
            "stamp_unit_s",
            "stamp_offset_s",
        } - {"file", "columns"}:
            place = (
                "it belongs into the table of a role"
                if key not in CSV_ADAPTERS
                else f"expected a table, [{key}]"
            )
            raise LogError(
                f"{source}: {key}: stands before the first table and so for all of them; {place}"
            )
    for role in tables:
        if role not in CSV_ADAPTERS:
            close = get_close_matches(role, CSV_ADAPTERS, 1)
            hint = f"did you mean [{close[0]}]? " if close else ""
            raise LogError(
                f"{source}: there is no role [{role}]; {hint}tables are for {', '.join(CSV_ADAPTERS)}"
            )
    found = {
        role: _role(role, shared | dict(table), source)
        for role, table in tables.items()
    }
    for role in ("imu", "dvl"):
        if role not in found:
            raise LogError(
                f"{source}: has no table [{role}]; every estimator needs IMU and Doppler log"
            )
    return found


def _role(role: str, table: dict[str, Any], source: str) -> CsvRole:
    kind = CSV_ADAPTERS[role]
    base = kind.model_construct(type="csv")
    said: dict[str, Any] = {}
    for key, value in table.items():
        is_taken_away = (
            value is False
            and key in kind.model_fields
            and not isinstance(getattr(base, key, None), bool)
        )
        if not is_taken_away:
            said[key] = _as_names(kind, key, value)
        elif kind.model_fields[
            key
        ].is_required():  # a sensor without it, such as an IMU without accelerometers
            said[key] = None
    form = {key: said.pop(key) for key in list(said) if key in CsvForm.model_fields}
    for key in said.keys() & NOT_OF_TABLES:
        raise LogError(
            f"{source}: [{role}] {key}: is for messages; a table has columns: take it out"
        )
    try:
        as_form = CsvForm.model_validate(form)
    except ValidationError as error:
        raise LogError(f"{source}: [{role}] {faults_in(error, CsvForm)}") from error
    try:
        adapter = kind.model_validate({"type": "csv", "stamp": STAMP, **said})
    except ValidationError as error:
        raise LogError(f"{source}: [{role}] {faults_in(error, kind)}") from error
    keys = {path: key for key, path in _paths(said) if path in set(adapter.fields())}
    return CsvRole(
        role,
        as_form,
        adapter,
        {path: keys.get(path, path) for path in adapter.fields()},
    )


def _as_names(kind: type[Adapter], key: str, value: Any) -> Any:
    """Numbers of columns as names, where a key of an adapter or of a form names columns."""
    known = kind.model_fields.get(key)
    if known is None or "str" not in str(known.annotation):
        return value
    if isinstance(value, list):
        return [str(item) if type(item) is int else item for item in value]
    return str(value) if type(value) is int else value


def _paths(table: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from ((prefix + key, path) for path in value)
            yield from _paths(value, f"{prefix}{key}.")
        for item in value if isinstance(value, list) else [value]:
            yield prefix + key, str(item)


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
        TOML file that says which columns are what, or the same as a dict; `csv_template` begins one.
    name
        Name of the sequence; the name of the configuration, or of the IMU's file, where there is none.

    Returns
    -------
    Sequence
        Measurements with the calibration's defaults. The notes ``csv.*`` say what was left out and looks wrong.

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
    given = [tables] if isinstance(tables, str | Path) else list(tables)
    files = table_files([as_path(one, "read_csv(tables)") for one in given])
    if isinstance(config, Mapping):
        source, roles = "config", parse_csv_config(config, "config")
    else:
        source, roles = (
            str(config),
            read_csv_config(as_path(config, "read_csv(tables, config)")),
        )
    found = {role: _table(one, files, source) for role, one in roles.items()}
    adapters = {role: one.adapter for role, one in roles.items()}
    calibration, notes = Calibration(), dict[str, str]()
    origin, said = common_origin(adapters, found)
    notes |= {"log.origin": said} if said else {}
    blocks: dict[str, Any] = {}
    dropped: dict[str, Dropped] = {}
    for role, table in found.items():
        if isinstance(adapter := adapters[role], DepthAdapter) and (
            assumed := adapter.assumption(calibration.gravity_m_s2)
        ):
            notes["log.depth"] = assumed
        blocks[role], dropped[role] = rows_of(
            adapter, table, calibration, np.eye(3), origin
        )
        if blocks[role] is None:
            faults = ", ".join(
                f"{count} {fault}" for fault, count in dropped[role].items()
            )
            raise LogError(
                f"{table.file.path}: [{role}] none of its {len(table)} rows can be used: {faults}"
            )
    _require_unit(roles["imu"], found["imu"])
    require_use(source, blocks["imu"], blocks["dvl"])
    doubts = [
        f"{role}: {text}"
        for role, table in found.items()
        for text in adapters[role].warnings(table)
    ]
    doubts += [
        f"{role}: {text}"
        for role, table in found.items()
        if role != "true_landmarks"
        for text in stamp_faults(table.stamps_ns, table.stamps_ns)
    ]
    doubts += list(_unused_validity(roles["dvl"], found["dvl"]))
    left_out = [
        f"{role}: {count} {fault}"
        for role, faults in dropped.items()
        for fault, count in faults.items()
    ]
    notes |= {
        f"csv.{role}": f"{one.file.path.name}: {'; '.join(_said(roles[role]))}"
        for role, one in found.items()
    }
    notes |= {"csv.left_out": "; ".join(left_out)} if left_out else {}
    notes |= {"csv.warnings": "; ".join(doubts)} if doubts else {}
    from sonar_graph.logs.measured_start import with_measured_start  # loads numba

    calibration, notes["log.start"] = with_measured_start(calibration, blocks)
    name = name or spelt(
        found["imu"].file.path.stem
        if isinstance(config, Mapping)
        else Path(config).stem
    )
    return Sequence(name=name, calibration=calibration, notes=notes, **blocks)


def _require_unit(imu: CsvRole, table: CsvTable) -> None:
    """Refuse times whose unit nothing states, and in which the IMU has the rate of none."""
    if "stamp_unit_s" in imu.adapter.model_fields_set or len(table) < FEWEST_ROWS:
        return
    step_s = float(np.median(np.diff(np.unique(table.stamps_ns)))) * 1e-9
    if not IMU_RATES_HZ[0] / 10 <= 1 / step_s <= IMU_RATES_HZ[1]:
        likely = next(
            (
                unit
                for unit in ("ms", "us", "ns")
                if IMU_RATES_HZ[0] <= 1 / (step_s * TIMES[unit]) <= IMU_RATES_HZ[1]
            ),
            None,
        )
        guess = (
            f'write `stamp_unit_s = "{likely}"` before the first table'
            if likely
            else "write stamp_unit_s"
        )
        raise LogError(
            f"{table.file.path}: [imu] stamp: {imu.adapter.stamp} has steps of {step_s:g}, which in seconds are "
            f'an IMU of {1 / step_s:.3g} Hz; {guess}, or `stamp_unit_s = "s"` where these are seconds'
        )


def _unused_validity(dvl: CsvRole, table: CsvTable) -> Iterator[str]:
    """Warning about a column that seems to mark invalid velocities, and that nothing uses."""
    for name in table.file.layout.names:
        if name in dvl.keys or not re.search(r"valid|lock", name.lower()):
            continue
        values = table.file.numbers(name, None)
        invalid = int(np.count_nonzero(values == 0))
        if invalid and np.isin(values, (0.0, 1.0)).all():
            yield (
                f"dvl: column {name} is 0 in {invalid} of {len(values)} rows and not used: "
                f"`valid_where = {{{toml_key(name)} = 1}}` under [dvl] leaves them out"
            )


def _said(one: CsvRole) -> list[str]:
    """What the configuration says of a role, for the notes."""
    base = type(one.adapter).model_construct(type="csv", stamp=STAMP)
    said = {key: getattr(one.adapter, key) for key in type(one.adapter).model_fields}
    return plain_lines(
        {key: value for key, value in said.items() if value != getattr(base, key, None)}
    )


def _table(one: CsvRole, files: Mapping[str, Path], source: str) -> CsvTable:
    """Rows of the file that plays a role."""
    wanted = one.form.file
    if wanted is None and len(files) != 1:
        raise LogError(
            f"{source}: [{one.role}] file: is missing; expected one of {', '.join(files) or 'no files'}"
        )
    if wanted is not None and wanted not in files:
        same = next((name for name in files if name.lower() == wanted.lower()), None)
        beside = next(
            (
                path
                for given in files.values()
                if (path := given.parent / wanted).is_file()
            ),
            wanted,
        )
        hint = f"did you mean {same!r}?" if same else f"add {beside} to the command;"
        raise LogError(
            f"{source}: [{one.role}] file: {wanted} is not among the tables; {hint} given: {', '.join(files)}"
        )
    path = next(iter(files.values())) if wanted is None else files[wanted]
    adapter, is_timed = one.adapter, one.role != "true_landmarks"
    return CsvTable(
        CsvFile(path, one.form),
        one.role,
        one.keys,
        adapter.stamp if is_timed else None,
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
        inside = (
            sorted(one for one in path.iterdir() if one.is_file())
            if path.is_dir()
            else [path]
        )
        if not inside:
            raise LogError(
                f"{path}: holds no files; give the folder that holds the tables"
            )
        for one in inside:
            if one.name in found and not found[one.name].samefile(one):
                raise LogError(
                    f"{one} and {found[one.name]} share a name; rename one, a table says `file` by name"
                )
            found[one.name] = one
    return found
