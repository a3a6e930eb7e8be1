"""Where a calibration comes from: mountings of ``/tf_static``, the record of the log, and the user's file."""

from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonar_graph.calibration import (
    Calibration,
    Mounting,
)
from sonar_graph.errors import CalibrationError, LogError
from sonar_graph.images import SonarFrames
from sonar_graph.logs import (
    METADATA,
    PartialCalibration,
    read_images_alone,
    read_log,
    sonar_image_messages,
)
from sonar_graph.logs.mcap import Outgoing, write_recording
from sonar_graph.logs.roles import TF
from sonar_graph.logs.vehicle_setup import encode_mountings, gathered, mounting_of
from sonar_graph.logs.writing import dvl_messages, imu_messages, static_message
from sonar_graph.settings import flattened, nested

from .conftest import tree

TREE_M = (1.0, 2.0, 3.0)
T0_NS = 1_700_000_000_000_000_000
FLOOR = Calibration.model_validate({"floor": {"z_m": -1, "sigma_m": 0.1}})


def said(**values: Any) -> PartialCalibration:
    return PartialCalibration.parse(values, "vehicle.toml")


def written(
    path: Path,
    sequence: Any,
    tree: Calibration | None = None,
    record: dict[str, str] | None = None,
    *more: Outgoing,
) -> Path:
    """A log of IMU and DVL with the mountings of a calibration and a metadata record."""
    messages = [imu_messages("/imu", sequence.imu), dvl_messages("/dvl", sequence.dvl)]
    if tree is not None:
        messages.append(static_message("/tf_static", TF, 0, encode_mountings(tree)))
    records = {METADATA: record} if record else {}
    write_recording(path, [*messages, *more], records)
    return path


# --- mountings ------------------------------------------------------------------------------------------------------


def test_the_mounting_of_an_imaging_sonar_comes_from_tf_static(make_sequence, tmp_path):
    sequence = make_sequence()
    rpy_rad = (0.0, 0.5, 0.0)
    tree = Calibration.model_validate({"sonar": {"mounting": {"rpy_rad": rpy_rad}}})
    stamps_ns = sequence.imu.stamps_ns[:2]
    intensity = np.zeros((2, 3, 4), np.uint8)
    frames = SonarFrames(
        stamps_ns, intensity, np.arange(1.0, 5), np.array([0.1, 0, -1])
    )
    images = sonar_image_messages("/sonar/image", frames)
    path = written(tmp_path / "a.mcap", sequence, tree, None, images)
    found = read_log(path)
    note = "defaults; mountings from /tf_static: imu, dvl, sonar"
    assert found.notes["log.calibration"].startswith(note)
    for calibration in (found.calibration, read_images_alone(path).calibration):
        assert calibration.sonar.mounting.rpy_rad == pytest.approx(rpy_rad, abs=1e-12)
    given = said(sonar={"mounting": {"rpy_rad": [0.0, 0.0, 1.0]}})
    stated = read_images_alone(path, calibration=given).calibration
    assert stated.sonar.mounting.rpy_rad == (0.0, 0.0, 1.0)


STEP = gtsam.Pose3(gtsam.Rot3.Rz(0.5), np.array([1.0, 0.0, -0.2]))
BELOW = gtsam.Pose3(gtsam.Rot3.Rx(0.1), np.array([0.0, 0.0, 0.3]))
NAMED_TREES: dict[str, tuple[str, dict[str, tuple[str, gtsam.Pose3 | str]], gtsam.Pose3]] = {
    "a namespace in the tree alone": ("dvl", {"auv1/dvl": ("auv1/base_link", STEP)}, STEP),
    "a namespace in the messages alone": ("auv1/dvl", {"dvl": ("base_link", STEP)}, STEP),
    "a footprint alone": ("dvl", {"dvl": ("base_footprint", STEP)}, STEP),
    "a footprint above the body": (
        "dvl", {"base_link": ("base_footprint", BELOW), "dvl": ("base_link", STEP)}, STEP),
    "a footprint that carries both": (
        "dvl", {"base_link": ("base_footprint", BELOW), "dvl": ("base_footprint", STEP)}, BELOW.inverse() * STEP),
    "a frame in between": ("dvl", {"dvl": ("arm", STEP), "arm": ("base_link", BELOW)}, BELOW * STEP),
    "two vehicles": (
        "b/dvl", {"a/dvl": ("a/base_link", BELOW), "b/dvl": ("b/base_link", STEP)}, STEP),
    "a faulty transform above the body": (
        "dvl", {"dvl": ("base_link", STEP), "base_link": ("map", "has numbers that are not finite")}, STEP),
}  # fmt: skip


@pytest.mark.parametrize(
    ("frame", "frames", "body_T_sensor"), NAMED_TREES.values(), ids=NAMED_TREES
)
def test_a_frame_is_found_below_the_body_of_any_name(
    frame,
    frames,
    body_T_sensor,
):
    found = mounting_of(frame, frames)
    assert found is not None
    assert found.pose().equals(body_T_sensor, 1e-12)


def test_the_tree_of_a_split_bag_is_read_from_the_files_before(bench):
    topic, kind, messages = tree("dvl_link", TREE_M, w=1.0)
    # two seconds after the first file, and an hour later: another recording
    for number, later_s in enumerate((0, 2, 3602)):
        bench.t0_ns = T0_NS + later_s * 10**9
        basics = bench.basics(20)
        entries = [*basics, (topic, kind, [] if number else messages)]
        found = read_log(bench.write(*entries, name=f"dive_{number}.mcap"))
        is_known = later_s != 3602
        placed = "dvl (dvl_link)" if is_known else "none"
        note = (
            f"defaults; mountings from /tf_static: {placed}; not in the tree, taken as"
        )
        assert found.notes["log.calibration"].startswith(note)
        mounting = found.calibration.dvl.mounting
        assert mounting.translation_m == (TREE_M if is_known else (0, 0, 0))


# --- precedence -----------------------------------------------------------------------------------------------------

VECTOR = st.tuples(*[st.floats(-1, 1)] * 3)
FIELDS = {
    "gravity_m_s2": st.floats(9, 10),
    "use_gravity": st.booleans(),
    "imu.gyro_bias_sigma": st.floats(0, 1),
    "imu.mounting.translation_m": VECTOR,
    "dvl.mounting.translation_m": VECTOR,
    "dvl.mounting.rpy_rad": VECTOR,
    "depth.port_m": VECTOR,
    "start.position_m": VECTOR,
}
SOME = st.fixed_dictionaries({}, optional=FIELDS)


@given(SOME, SOME, st.sets(st.sampled_from(["imu", "dvl", "depth", "sonar"])))
def test_every_field_comes_from_the_first_that_says_it(of_file, of_record, in_tree):
    recorded = Calibration.model_validate(nested(of_record))
    tree = {name: Mounting(translation_m=TREE_M, rpy_rad=(0, 0, 1)) for name in in_tree}
    found = flattened(gathered(said(**nested(of_file)), recorded, tree).model_dump())
    expected = flattened(Calibration().model_dump())
    for name in in_tree - {"depth"}:
        expected |= {
            f"{name}.mounting.translation_m": TREE_M,
            f"{name}.mounting.rpy_rad": (0, 0, 1),
        }
    expected |= {"depth.port_m": TREE_M} if "depth" in in_tree else {}
    assert found == expected | of_record | of_file


def test_a_section_is_completed_by_the_log_or_taken_away_by_false():
    lower = said(floor={"z_m": -2})
    floor = gathered(lower, FLOOR, {}).floor
    assert (floor.z_m, floor.sigma_m) == (-2, 0.1)
    none = said(floor=False, use_gravity=False)
    assert gathered(none, FLOOR, {}) == Calibration(use_gravity=False)
    message = r"^vehicle\.toml: floor\.sigma_m: is missing$"
    with pytest.raises(CalibrationError, match=message):
        gathered(lower, None, {})


MISTAKES: list[tuple[dict[str, Any], str]] = [
    ({"imu": {"gyro_sigma": 1}}, r"^vehicle\.toml: imu\.gyro_sigma: there is no such field"),
    ({"floor": {"z": 1}}, r"^vehicle\.toml: .*floor\.z: there is no such field"),
    ({"start": {"position_m": [1, 2]}}, r"start\.position_m: expected 3 values, not \[1, 2\]"),
    ({"depth": {"sigma_m": -1}}, r"depth\.sigma_m: .* greater than 0"),
    ({"imu": False}, r"imu: expected a section, \[imu\] in TOML, not false$"),
    ({"heading": False}, r"heading: .* not false; to leave heading unused: use = false under \[heading\] in the log"),
    ({"heading": {"bias_sigma_rad": False}}, r"heading\.bias_sigma_rad: expected a number, not false$"),
]  # fmt: skip
BROKEN_RECORDS: list[tuple[dict[str, str], type[Exception], str]] = [
    ({"calibration": "{"}, LogError, "calibration is not JSON"),
    ({"calibration": '{"imu": {"nonsense": 1}}'}, CalibrationError, "imu.nonsense"),
    ({"notes": "[]"}, LogError, "notes must be a JSON object"),
]


def test_mistakes_are_found_before_a_log_is_read_and_broken_records_named(
    make_sequence, tmp_path
):
    for values, message in MISTAKES:
        with pytest.raises(CalibrationError, match=message):
            said(**values)
    for record, error, message in BROKEN_RECORDS:
        path = written(tmp_path / "a.mcap", make_sequence(), record=record)
        with pytest.raises(error, match=message):
            read_log(path)
