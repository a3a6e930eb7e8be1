"""Wrong uses on the way from own files to a report: one line each, with the place and what to do."""

import re
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sonar_graph.errors import LogError
from sonar_graph.logs import write_log
from sonar_graph.logs.convert import read_csv
from sonar_graph.measurements import Dvl
from sonar_graph.testing import small_world

IMU = """[imu]
file = "imu.csv"
angular_velocity = ["wx", "wy", "wz"]
linear_acceleration = ["ax", "ay", "az"]
"""
DVL = '[dvl]\nfile = "dvl.csv"\nvelocity = ["vx", "vy", "vz"]\n'
TRUTH = '[truth]\nfile = "truth.csv"\nposition = ["x", "y", "z"]\n'


GOOD = IMU + DVL


def lines_of(names: str, stamps_ns: np.ndarray, *columns: np.ndarray) -> list[str]:
    table = np.column_stack([stamps_ns * 1e-9, *columns]).tolist()
    return [f"time,{names}", *(",".join(map(repr, row)) for row in table)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Tables and logs of one dive, good ones and spoilt ones."""
    path = tmp_path_factory.mktemp("own")
    world = small_world()
    of_imu = world.imu.angular_velocity, world.imu.specific_force
    imu = lines_of("wx,wy,wz,ax,ay,az", world.imu.stamps_ns, *of_imu)
    dvl = lines_of("vx,vy,vz", world.dvl.stamps_ns, world.dvl.velocity)
    late = list(imu)
    late[20], late[900] = late[900], late[20]
    tables = {"imu": imu, "dvl": dvl, "late": late, "header": imu[:1], "empty": []}
    tables["comma"] = [line.replace(",", ";").replace(".", ",") for line in dvl]
    later = lines_of("vx,vy,vz", world.dvl.stamps_ns + 10**15, world.dvl.velocity)
    tables["gap"] = later
    for name, row, pattern, cell in (
        ("word", 7, "(?<=,)[^,]*", "fast"),
        ("short", 9, ",[^,]*$", ""),
        ("noon", 5, "^[^,]*", "noon"),
    ):
        spoilt = re.sub(pattern, cell, imu[row], count=1)
        tables[name] = [*imu[:row], spoilt, *imu[row + 1 :]]
    for name, lines in tables.items():
        (path / f"{name}.csv").write_text("".join(f"{line}\n" for line in lines))
    (path / "image.csv").write_bytes(b"\x89PNG\0\0")
    of_imu = "word", "short", "noon", "header", "empty", "image", "late"
    configurations = {
        **{name: GOOD.replace("imu.csv", f"{name}.csv") for name in of_imu},
        **{name: GOOD.replace("dvl.csv", f"{name}.csv") for name in ("comma", "gap")},
        "good": GOOD,
        "no_dvl": IMU,
        "truth": GOOD + TRUTH,
        "half": GOOD.replace('"vx", ', ""),
        "column": GOOD.replace('"wx"', '"gyro_x"'),
        "role": GOOD.replace("[dvl]", "[dlv]"),
        "key": GOOD + 'units = "mm/s"\n',
        "unit": GOOD + 'scale = "furlongs"\n',
        "topic": GOOD + 'topic = "/dvl"\n',
        "close_unit": GOOD + 'scale = "cm/sec"\n',
        "number": GOOD.replace('"vx"', "44"),
        "upper": GOOD.replace("dvl.csv", "DVL.csv"),
    }
    for name, text in configurations.items():
        (path / f"{name}.toml").write_text(text)
    write_log(path / "dive.mcap", world)
    fast = Dvl(world.dvl.stamps_ns, 1000.0 * world.dvl.velocity, world.dvl.velocity_cov)
    write_log(path / "fast.mcap", replace(world, dvl=fast, detections=None))
    return path


CSV = "convert csv . -o new.mcap --config"
WRONG = {
    f"{CSV} absent.toml": r"absent\.toml",
    "convert csv absent.csv --config good.toml -o new.mcap": r"absent\.csv",
    "convert csv imu.csv dvl.csv -o new.mcap": r"--config is missing; `.* csv imu\.csv dvl\.csv --toml > dive",
    "convert csv imu.csv dvl.csv --config good.toml": "-o is missing",
    "convert csv imu.csv --config good.toml -o new.mcap": r"dvl\.csv is not among the tables; add dvl\.csv to the comm",
    f"{CSV} no_dvl.toml": r"no_dvl\.toml: has no table \[dvl\]; every estimator needs IMU and Doppler log",
    f"{CSV} truth.toml": r"truth\.csv is not among the tables; add truth\.csv to the command",
    f"{CSV} upper.toml": r"DVL\.csv is not among the tables; .*put the name right; given: .*dvl\.csv",
    f"{CSV} number.toml": r"dvl\.csv: has no column '44' \(\[dvl\]\); it has time, .* numbered from 1$",
    f"{CSV} close_unit.toml": r"\[dvl\] scale: did you mean cm/s[?] expected a factor or one of the units m/s, cm/s",
    f"{CSV} half.toml": r"half\.toml: \[dvl\] velocity: expected 3 values",
    f"{CSV} column.toml": r"imu\.csv: has no column 'gyro_x' \(\[imu\]\); it has time, wx, wy, wz",
    f"{CSV} role.toml": r"there is no role \[dlv\]; did you mean \[dvl\][?]",
    f"{CSV} key.toml": r"key\.toml: \[dvl\] units: there is no such field",
    f"{CSV} unit.toml": r"unit\.toml: \[dvl\] scale: expected a factor or one of the units m/s, cm/s, mm/s",
    f"{CSV} topic.toml": r"\[dvl\] topic: is for messages; a table has columns: take it out",
    f"{CSV} word.toml": r"word\.csv, line 8: column wx: 'fast' is no number; expected one, or nothing where",
    f"{CSV} short.toml": r"short\.csv, line 10: has 6 cells; expected 7",
    f"{CSV} noon.toml": r"noon\.csv, line 6: column time: 'noon' is no time; expected a number",
    f"{CSV} header.toml": r"header\.csv: has no line with numbers like 1\.5; expected a table",
    f"{CSV} empty.toml": r"empty\.csv: has no line with numbers like 1\.5; expected a table",
    f"{CSV} image.toml": r"image\.csv, line 1: is no text",
    f"{CSV} comma.toml": r'comma\.csv: has no line with numbers like 1\.5; .* need decimal = ","',
    f"{CSV} gap.toml": "no common time; of another clock or unit[?] See stamp",
    "inspect dive.mcap --log-config good.toml": r"good\.toml: says which text tables .* csv TABLES --config good\.toml",
    "compare imu.csv -o out": r"a text that begins with 'time,wx.*text tables by `sonar-graph convert csv`",
    "calibration --template absent.mcap": r"absent\.mcap",
}  # fmt: skip


@pytest.mark.parametrize(("command", "expected"), WRONG.items())
def test_a_wrong_use_is_one_line_that_says_what_to_do(
    folder, command, expected, refuse
):
    refuse(folder, command, expected)


def test_times_that_run_backwards_are_sorted_and_named(run, folder, tmp_path, capsys):
    config = folder / "late.toml"
    words = "convert", "csv", folder, "--config", config, "-o", tmp_path / "late.mcap"
    assert run(*words) == 0
    told = r"warning: imu: 2 times backwards, by .* rows are sorted"
    assert re.search(told, capsys.readouterr().err)


def test_a_truth_of_tables_may_lack_its_orientation(folder, tmp_path):
    truth = small_world().truth
    lines = lines_of("x,y,z", truth.stamps_ns, truth.positions)
    (tmp_path / "truth.csv").write_text("\n".join(lines))
    tables = [folder / "imu.csv", folder / "dvl.csv", tmp_path / "truth.csv"]
    config = tomllib.loads(GOOD + TRUTH)
    config["truth"]["orientation"] = False
    found = read_csv(tables, config).truth
    assert (len(found), found.has_orientation) == (len(truth), False)
    config["truth"]["orientations"] = False
    with pytest.raises(LogError, match="orientations: there is no such field"):
        read_csv(tables, config)


def test_tables_with_another_unit_of_velocity_are_reported(folder, tmp_path, reply):
    (tmp_path / "dive.toml").write_text(GOOD + "scale = 1000\n")
    unit = r"warning: DVL: unit: velocities look 1000 times too large .*`scale = 0\.001` .*dive\.toml"
    for config, told in (
        (tmp_path / "dive.toml", unit),
        (folder / "good.toml", "^((?!: unit).)*$"),
    ):
        words = folder, "--config", config, "-o", tmp_path / "new.mcap"
        said = reply(0, "convert", "csv", *words).err
        assert re.search(told, " ".join(said.split()))


def test_inspect_ends_with_a_status_for_scripts(run, folder, tmp_path):
    world = small_world()
    frd = replace(world.imu, specific_force=world.imu.specific_force * [1, -1, -1])
    write_log(tmp_path / "frd.mcap", replace(world, imu=frd))
    content = (folder / "dive.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(content[: len(content) // 2])
    for code, *words in (
        (0, folder / "dive.mcap", "--quick"),
        (3, folder / "fast.mcap"),
        (3, tmp_path / "frd.mcap", "--quick"),
        (1, tmp_path / "cut.mcap", "--quick"),
    ):
        assert run("inspect", *words) == code


@pytest.mark.parametrize("content", ['{"a": 1}', "words", "[]"])
def test_a_json_file_of_others_does_not_become_a_model(content, basin, refuse):
    (basin.parent / "mine.json").write_text(content)
    said = "and sonar-graph did not write it; choose another name, or give --overwrite"
    refuse(basin.parent, "calibrate basin.mcap -o mine.json", said)
