"""The calibration file to begin from lists what there is, and changes nothing until it is edited."""

import re
import tomllib

from sonar_graph.calibration import Calibration
from sonar_graph.logs import PartialCalibration, read_log
from sonar_graph.settings import settings_of


def printed(run, capsys, *words: object) -> str:
    capsys.readouterr()
    assert run("calibration", "--template", *words) == 0
    return capsys.readouterr().out


def test_a_template_names_every_field_and_changes_none(run, capsys, tmp_path):
    text = printed(run, capsys)
    (tmp_path / "vehicle.toml").write_text(text)
    given = PartialCalibration.read(tmp_path / "vehicle.toml").before("log")
    sections = "imu, dvl, depth, heading, positions, sonar, start"
    assert given.endswith(f"vehicle.toml: {sections}; else log")
    uncommented = re.sub(r"^# (?=\[|[\w.]+ = )", "", text, flags=re.MULTILINE)
    values = tomllib.loads(uncommented)
    assert values.pop("earth_rate_latitude_rad") == 0.0
    given = Calibration.model_validate(values)
    absent = {"floor", "planar", "map"}
    assert given.model_copy(update=dict.fromkeys(absent)) == Calibration()
    named = {name for name, _, _ in settings_of(Calibration)} - absent
    assert all(name.rpartition(".")[2] in text for name in named)
    assert {"z_m", "sigma_m"} <= values["floor"].keys()


def test_a_template_of_a_log_gives_its_calibration(run, capsys, basin, tmp_path):
    path = tmp_path / "vehicle.toml"
    path.write_text(printed(run, capsys, basin))
    stated = read_log(basin).calibration
    said = tomllib.loads(path.read_text())
    assert "floor" in said
    assert Calibration.model_validate(said) == stated
    assert read_log(basin, calibration=path).calibration == stated
