from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonar_graph.calibration import Calibration, DvlCalibration, ImuCalibration, Mounting
from sonar_graph.errors import CalibrationError
from sonar_graph.logs.mcap.writer import write_recording
from sonar_graph.logs.reading import read_log
from sonar_graph.logs.roles import TF
from sonar_graph.logs.vehicle_setup import METADATA, PartialCalibration, encode_mountings, gathered
from sonar_graph.logs.writing import dvl_messages, imu_messages, static_message, write_log

TREE_M = (1.0, 2.0, 3.0)


def said(source: str = "vehicle.toml", **values: Any) -> PartialCalibration:
    return PartialCalibration.parse(values, source)


def leaves(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    found = {}
    for name, value in values.items():
        found |= leaves(value, f"{prefix}{name}.") if isinstance(value, dict) else {prefix + name: value}
    return found


FIELDS = {
    "gravity_m_s2": st.floats(9, 10),
    "use_gravity": st.booleans(),
    "imu.gyro_bias_sigma": st.floats(0, 1),
    "imu.mounting.translation_m": st.tuples(*[st.floats(-1, 1)] * 3),
    "dvl.mounting.translation_m": st.tuples(*[st.floats(-1, 1)] * 3),
    "dvl.mounting.rpy_rad": st.tuples(*[st.floats(-1, 1)] * 3),
    "depth.port_m": st.tuples(*[st.floats(-1, 1)] * 3),
    "start.position_m": st.tuples(*[st.floats(-1, 1)] * 3),
}
SOME = st.fixed_dictionaries({}, optional=FIELDS)


def nested(flat: dict[str, Any]) -> dict[str, Any]:
    tree: dict[str, Any] = {}
    for path, value in flat.items():
        *sections, name = path.split(".")
        at = tree
        for section in sections:
            at = at.setdefault(section, {})
        at[name] = value
    return tree


@given(SOME, SOME, st.sets(st.sampled_from(["imu", "dvl", "depth", "sonar"])))
def test_every_field_comes_from_the_first_that_says_it(
    of_file: dict[str, Any], of_record: dict[str, Any], in_tree: set[str]
) -> None:
    recorded = Calibration.model_validate(nested(of_record))
    tree = {name: Mounting(translation_m=TREE_M, rpy_rad=(0, 0, 1)) for name in in_tree}
    found = leaves(gathered(said(**nested(of_file)), recorded, tree).model_dump())
    expected = leaves(Calibration().model_dump())
    for name in in_tree:
        expected |= (
            {"depth.port_m": TREE_M}
            if name == "depth"
            else {f"{name}.mounting.translation_m": TREE_M, f"{name}.mounting.rpy_rad": (0, 0, 1)}
        )
    assert found == expected | of_record | of_file


def test_what_a_file_leaves_out_stays_as_the_log_says(make_sequence: Any, tmp_path: Path) -> None:
    sequence = make_sequence()
    write_log(tmp_path / "a.mcap", sequence)
    changes = said(imu={"gyro_noise_density": 0.5}, gravity_m_s2=9.7)
    found = read_log(tmp_path / "a.mcap", calibration=changes)
    imu = sequence.calibration.imu.model_copy(update={"gyro_noise_density": 0.5})
    assert imu.mounting != Mounting()
    assert found.calibration == sequence.calibration.model_copy(update={"imu": imu, "gravity_m_s2": 9.7})
    assert found.notes["log.calibration"] == (
        "from vehicle.toml: imu.gyro_noise_density, gravity_m_s2; else from the log"
    )


def test_what_a_file_leaves_out_stays_as_tf_static_says(bench: Any) -> None:
    tree = [bench.transform("base_link", "imu_link", (1, 0, 0)), bench.transform("base_link", "dvl_link", (0, 2, 0), 1)]
    log = bench.write(*bench.basics(), ("/tf_static", "tf", [{"transforms": tree}]))
    changes = said(dvl={"mounting": {"translation_m": [0, 3, 0]}})
    found = read_log(log, calibration=changes)
    assert found.calibration.imu.mounting.translation_m == (1, 0, 0)
    assert found.calibration.dvl.mounting.translation_m == (0, 3, 0)
    np.testing.assert_allclose(found.calibration.dvl.mounting.rpy_rad, (0, 0, 1), atol=1e-12)
    assert found.notes["log.calibration"] == (
        "from vehicle.toml: dvl.mounting.translation_m; else defaults; mountings from /tf_static: imu, dvl"
    )


def test_a_sensor_mounted_by_the_file_is_not_told_to_be_missing(bench: Any) -> None:
    log = bench.write(*bench.basics())
    plain, given_ = read_log(log), read_log(log, calibration=said(dvl={"mounting": {"rpy_rad": [0, 0, 1]}}))
    assert "dvl (dvl_link)" in plain.notes["log.calibration"]
    assert "dvl (dvl_link)" not in given_.notes["log.calibration"]
    assert "imu (imu_link)" in given_.notes["log.calibration"]
    assert "z downwards" in plain.notes["log.warnings"]
    assert "z downwards" not in given_.notes.get("log.warnings", "")
    other = read_log(log, calibration=said(gravity_m_s2=9.81))
    assert "z downwards" in other.notes["log.warnings"], "the file says nothing of how the instrument sits"


def test_a_record_that_says_little_leaves_the_rest_to_tf_static(make_sequence: Any, tmp_path: Path) -> None:
    sequence = make_sequence()
    mounting = Mounting(translation_m=TREE_M)
    tree = encode_mountings(Calibration(imu=ImuCalibration(mounting=mounting), dvl=DvlCalibration(mounting=mounting)))
    write_recording(
        tmp_path / "a.mcap",
        [
            static_message("/tf_static", TF, 0, tree),
            imu_messages("/imu", sequence.imu),
            dvl_messages("/dvl", sequence.dvl),
        ],
        {METADATA: {"calibration": json.dumps({"imu": {"mounting": {"translation_m": [7, 8, 9]}}})}},
    )
    calibration = read_log(tmp_path / "a.mcap").calibration
    assert calibration.imu.mounting.translation_m == (7, 8, 9)
    assert calibration.dvl.mounting.translation_m == TREE_M


def test_false_takes_away_what_may_be_absent() -> None:
    recorded = Calibration.model_validate({"floor": {"z_m": -1, "sigma_m": 0.1}})
    assert gathered(said(floor=False, use_gravity=False), recorded, {}) == Calibration(use_gravity=False)
    with pytest.raises(CalibrationError, match="imu: "):
        said(imu=False)


def test_a_section_may_be_completed_by_the_log() -> None:
    recorded = Calibration.model_validate({"floor": {"z_m": -1, "sigma_m": 0.1}})
    floor = gathered(said(floor={"z_m": -2}), recorded, {}).floor
    assert floor is not None
    assert (floor.z_m, floor.sigma_m) == (-2, 0.1)
    with pytest.raises(CalibrationError, match=r"^vehicle\.toml: floor\.sigma_m: is missing$"):
        gathered(said(floor={"z_m": -2}), None, {})


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"imu": {"gyro_sigma": 1}}, r"^vehicle\.toml: imu\.gyro_sigma: there is no such field"),
        ({"floor": {"z": 1}}, r"^vehicle\.toml: .*floor\.z: there is no such field"),
        ({"start": {"position_m": [1, 2]}}, r"start\.position_m: expected 3 values, not \[1, 2\]"),
        ({"depth": {"sigma_m": -1}}, r"depth\.sigma_m: .* greater than 0"),
    ],
)
def test_mistakes_are_found_before_a_log_is_read(values: dict[str, Any], message: str) -> None:
    with pytest.raises(CalibrationError, match=message):
        PartialCalibration.parse(values, "vehicle.toml")
