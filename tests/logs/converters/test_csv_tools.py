"""Tables as tools write them are read right by the template's guess, or the template has a question."""

import tomllib
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from sonar_graph.errors import LogError
from sonar_graph.logs.convert import csv_template, read_csv
from sonar_graph.logs.convert.csv_evidence import time_units

ROWS = 600
OF_IMU = "time,gyro_x,gyro_y,gyro_z,acc_x,acc_y,acc_z"
EPOCH_S = 1_777_638_600.0
"""2026-05-01T12:30:00Z."""


def dive(imu_hz: float = 50.0, every: int = 10) -> SimpleNamespace:
    """Rates and forces of a dive; its Doppler log, depths and bearings have every n-th time of the IMU."""
    rng = np.random.default_rng(7)
    s = np.arange(ROWS) / imu_hz
    slow = s[::every]
    turns = np.column_stack([np.sin(slow), np.cos(slow), np.sin(2 * slow)])
    return SimpleNamespace(
        s=s,
        slow=slow,
        rate=rng.normal(0, 0.1, (ROWS, 3)),
        force=rng.normal([0, 0, 9.81], 0.05, (ROWS, 3)),
        velocity=turns * [0.3, 0.1, 0.05] + [0.8, 0, 0],
        depth=4 + np.sin(0.3 * slow),
        bearing=(300 + 40 * np.sin(0.5 * slow)) % 360,
    )


def write(
    path: Path, header: str, *columns, sep=",", number=repr, encoding="utf-8"
) -> None:
    """Write a header and rows of columns, each text or numbers."""
    cells = [
        [cell if isinstance(cell, str) else number(float(cell)) for cell in column]
        for column in columns
    ]
    rows = map(sep.join, zip(*cells, strict=True))
    path.write_text("\n".join([header, *rows]) + "\n", encoding)


def dates(s: np.ndarray, form: str, tail: int = 3) -> list[str]:
    """Dates with a fraction of a second of some digits where the form has an ``@``."""
    whole = [datetime.fromtimestamp(EPOCH_S, UTC) + timedelta(seconds=t) for t in s]
    return [
        when.strftime(form).replace("@", f"{when.microsecond:06d}"[:tail])
        for when in whole
    ]


def template(folder: Path) -> tuple[str, dict]:
    text = csv_template([folder])
    return text, tomllib.loads(text)


def guessed(folder: Path):
    return read_csv(folder, template(folder)[1])


def assert_is(sequence, dive: SimpleNamespace) -> None:
    seconds = (sequence.imu.stamps_ns - sequence.imu.stamps_ns[0]) * 1e-9
    np.testing.assert_allclose(seconds, dive.s, rtol=0, atol=1e-3)
    for found, expected in (
        (sequence.imu.angular_velocity, dive.rate),
        (sequence.dvl.velocity, dive.velocity),
        (-sequence.depth.z_m, dive.depth),
    ):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)


@pytest.fixture
def d() -> SimpleNamespace:
    return dive()


@pytest.fixture
def folder(tmp_path):
    folder = tmp_path / "tables"
    folder.mkdir()
    return folder


def plain(
    folder: Path,
    d: SimpleNamespace,
    *names: str,
    scale: float = 1.0,
    start_s: float = 0.0,
) -> None:
    """The tables of a dive that a test does not write in its own way."""
    t, slow = (np.round((start_s + s) * scale, 9) for s in (d.s, d.slow))
    if "imu" in names:
        write(folder / "imu.csv", OF_IMU, t, *d.rate.T, *d.force.T)
    if "dvl" in names:
        write(folder / "dvl.csv", "time,vel_x,vel_y,vel_z", slow, *d.velocity.T)
    if "depth" in names:
        write(folder / "depth.csv", "time,depth", slow, d.depth)


def comma(value: float) -> str:
    return repr(value).replace(".", ",")


TOOLS = {
    "Excel in German": (
        '"Zeit";"Gyro X (°/s)";"Gyro Y (°/s)";"Gyro Z (°/s)";"Acc X [g]";"Acc Y [g]";"Acc Z [g]"',
        '"Zeit";"Vel X [cm/s]";"Vel Y [cm/s]";"Vel Z [cm/s]";"Tiefe [m]"',
        "%d.%m.%Y %H:%M:%S,@",
        (1 / 9.80665, 100, 1),
        {"sep": ";", "number": comma, "encoding": "cp1252"},
    ),
    "writetable of MATLAB": (
        "Time,gyro_x_deg_s_,gyro_y_deg_s_,gyro_z_deg_s_,acc_x_m_s2_,acc_y_m_s2_,acc_z_m_s2_",
        "Time,vel_x_mm_s_,vel_y_mm_s_,vel_z_mm_s_,depth_m_",
        "%d-%b-%Y %H:%M:%S.@",
        (1, 1000, 1),
        {},
    ),
    "a second line with units": (
        "Time;GyrX;GyrY;GyrZ;AccX;AccY;AccZ\nms;deg/s;deg/s;deg/s;mg;mg;mg",
        "Time;VelX;VelY;VelZ;Depth\nms;mm/s;mm/s;mm/s;cm",
        None,
        (1 / 9.80665e-3, 1000, 100),
        {"sep": ";"},
    ),
}
"""Headers of IMU and Doppler log, dates, factors of forces, velocities and depths, and form; rates are in degrees."""


@pytest.mark.parametrize("tool", TOOLS)
def test_tables_of_a_tool_are_read_without_an_edit(folder, tool, d):
    of_imu, of_dvl, form, (force, velocity, depth), how = TOOLS[tool]
    stamps, slow = (1e3 * s if form is None else dates(s, form) for s in (d.s, d.slow))
    columns = (*np.degrees(d.rate).T, *(force * d.force).T)
    write(folder / "imu.csv", of_imu, stamps, *columns, **how)
    columns = (*(velocity * d.velocity).T, depth * d.depth)
    write(folder / "dvl.csv", of_dvl, slow, *columns, **how)
    imu = template(folder)[1]["imu"]
    if "encoding" in how:
        assert (imu["decimal"], imu["encoding"]) == (",", "cp1252")
    assert_is(guessed(folder), d)


def test_qgroundcontrol_has_no_imu_and_the_template_asks(folder):
    d = dive(imu_hz=10.0, every=1)
    stamps = dates(d.s, "%Y-%m-%d %H:%M:%S.@")
    rates = "rollRate", "pitchRate", "yawRate"
    header = f"Timestamp,heading,{','.join(rates)},groundSpeed,battery0.id"
    flat = np.zeros(ROWS)
    columns = d.bearing, *np.degrees(d.rate).T, flat, flat
    write(folder / "vehicle.csv", header, stamps, *columns)
    plain(folder, d, "dvl", start_s=EPOCH_S)
    text, config = template(folder)
    # the battery has an identity
    assert config.keys() == {"dvl", "heading"}
    assert config["heading"]["scale"] == "deg"
    assert "# [imu]  # no accelerometer: is this the IMU?" in text
    with pytest.raises(LogError, match=r"has no table \[imu\]"):
        guessed(folder)
    question, rest = text.split("# [imu]", 1)
    table, rest = rest.split("\n\n", 1)
    table = f"[imu]{table}".replace("\n# ", "\n")
    sequence = read_csv(folder, tomllib.loads(f"{question}{table}\n\n{rest}"))
    np.testing.assert_allclose(sequence.imu.angular_velocity, d.rate, atol=1e-9)
    assert np.isnan(sequence.imu.specific_force).all()
    expected = np.unwrap(np.radians(90 - d.bearing))
    np.testing.assert_allclose(np.unwrap(sequence.heading.yaw_rad), expected, atol=1e-9)


@pytest.mark.parametrize(("imu_hz", "every"), [(1000.0, 200), (100.0, 20), (200.0, 40)])
@pytest.mark.parametrize("scale", [1.0, 1e3, 1e6, 1e9])
def test_units_of_times_follow_from_the_sensors_rates(folder, imu_hz, every, scale):
    # enough rows of the Doppler log for a rate
    d = dive(imu_hz, every // 4)
    plain(folder, d, "imu", "dvl", "depth", scale=scale)
    sequence = guessed(folder)
    assert sequence.duration_s == pytest.approx(d.s[-1], rel=0.1)
    last_ns = sequence.dvl.stamps_ns[-1]
    assert sequence.depth.stamps_ns[-1] == pytest.approx(last_ns, abs=1)


def test_a_unit_in_the_header_that_contradicts_the_steps_is_a_question(folder, d):
    plain(folder, d, "imu", "dvl", "depth", scale=1e3)
    for path in folder.iterdir():
        path.write_text(path.read_text().replace("time", "time [s]"))
    assert "# the header states s, the steps do not fit:" in template(folder)[0]
    with pytest.raises(LogError, match='stamp_unit_s = "ms"'):
        guessed(folder)


@pytest.mark.parametrize(
    ("name", "values"),
    [("depth", "depth"), ("dvl", "vel_x,vel_y,vel_z"), ("heading", "yaw")],
)
def test_a_column_that_never_changes_is_no_motion(folder, name, values, d):
    plain(folder, d, "imu", "dvl", "depth")
    columns = [np.full(ROWS, 0.5) for _ in values.split(",")]
    write(folder / f"{name}.csv", f"time,{values}", d.s, *columns)
    text, config = template(folder)
    assert name not in config
    assert f"# [{name}]  # never changes" in text


# --- tables of other tools, and what they must not be taken for -------------------------------------------------------


def test_pressures_below_that_of_the_air_count_from_the_surface(folder, d):
    plain(folder, d, "imu", "dvl")
    decibar = d.depth * 9.80665 / 10
    write(folder / "ctd.csv", "time;Pressure (dbar)", d.slow, decibar, sep=";")
    np.testing.assert_allclose(-guessed(folder).depth.z_m, d.depth, rtol=5e-3)


def test_plotjuggler_and_rostopic_names_with_paths(folder, d):
    rates, forces = (
        [f"/imu/{kind}/{axis}" for axis in "xyz"]
        for kind in ("angular_velocity", "linear_acceleration")
    )
    header = ",".join(["__time", *rates, *forces])
    write(folder / "imu.csv", header, EPOCH_S + d.s, *d.rate.T, *d.force.T)
    ns = [str(round(EPOCH_S) * 10**9 + round(t * 1e9)) for t in d.slow]
    header = "%time,field.header.frame_id,field.velocity.x,field.velocity.y,field.velocity.z,field.depth"
    columns = (ns, ["dvl"] * len(ns), *d.velocity.T, d.depth)
    write(folder / "dvl.csv", header, *columns)
    assert_is(guessed(folder), d)


@pytest.mark.parametrize("form", ["%m/%d/%Y %H:%M:%S.@", "%H:%M:%S.@"])
def test_times_whose_day_or_second_is_not_known_are_refused(folder, form, d):
    plain(folder, d, "dvl", "depth")
    write(folder / "imu.csv", OF_IMU, dates(d.s, form), *d.rate.T, *d.force.T)
    with pytest.raises(LogError, match=r"is no time; expected a number .* or a date"):
        guessed(folder)


def test_numbers_with_thousands_separators_are_refused(folder, d):
    plain(folder, d, "imu", "dvl")
    cells = [f"{depth:,.1f}" for depth in 1000 * d.depth]
    write(folder / "depth.csv", "time;depth [mm]", d.slow, cells, sep=";")
    message = r"depth\.csv, line 2: .*'4,000\.0' is no number"
    with pytest.raises(LogError, match=message):
        guessed(folder)


@pytest.mark.parametrize(("name", "held"), [("velocity_valid", 1), ("velo_flag", 0)])
def test_a_column_of_validity_is_proposed_and_missed_where_it_is_not_used(
    folder, name, held, d
):
    """By its name, or by velocities that are zero in the marked rows; the header has no unit."""
    plain(folder, d, "imu", "depth")
    is_lost = np.isin(np.arange(len(d.slow)), range(10, 20))
    velocity = 1000 * d.velocity * np.where(is_lost, held, 1)[:, None]
    marks = ["false" if lost else "true" for lost in is_lost]
    header = f"time,vel_x,vel_y,vel_z,{name}"
    write(folder / "dvl.csv", header, d.slow, *velocity.T, marks)
    config = template(folder)[1]
    assert config["dvl"]["scale"] == "mm/s"
    found = read_csv(folder, config).dvl.velocity
    np.testing.assert_allclose(found, d.velocity[~is_lost], atol=1e-9)
    assert config["dvl"].pop("valid_where") == {name: 1}
    warning = read_csv(folder, config).notes["csv.warnings"]
    assert f"column {name} is 0 in 10 of 60 rows and not used" in warning
    assert f"`valid_where = {{{name} = 1}}`" in warning


def test_a_sonar_without_identities_states_it_by_false(folder, d):
    plain(folder, d, "imu", "dvl")
    (folder / "seen.csv").write_text("time,range,azimuth\n1.0,3.0,0.1\n2.0,3.0,0.2\n")
    config = template(folder)[1]
    assert config["detections"]["ids"] is False
    assert (read_csv(folder, config).detections.candidate_ids == -1).all()


@pytest.mark.parametrize(("factor", "unit"), [(1.0, "s"), (1e9, "ns")])
def test_a_table_of_another_clock_is_not_read_as_faster_than_any_sensor(factor, unit):
    """Seconds since 1970 beside a dive from 0: as nanoseconds they would lie in it, at a gigahertz."""
    times = {"imu": np.arange(0, 60, 0.02), "truth": factor * (1.76e9 + np.arange(300))}
    assert time_units(times, {one: one for one in times}, {})["truth"] == [unit]
