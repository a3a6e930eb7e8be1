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
    SonarCalibration,
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
    tree: Calibration | None,
    record: dict[str, str] | None = None,
    *more: Outgoing,
) -> Path:
    """A log of IMU and DVL with the mountings of a calibration and a metadata record."""
    messages = [imu_messages("/imu", sequence.imu), dvl_messages("/dvl", sequence.dvl)]
    messages += more
    if tree is not None:
        messages.insert(0, static_message("/tf_static", TF, 0, encode_mountings(tree)))
    write_recording(path, messages, {METADATA: record} if record else {})
    return path


# --- mountings ------------------------------------------------------------------------------------------------------


def test_the_mounting_of_an_imaging_sonar_comes_from_tf_static(make_sequence, tmp_path):
    sequence = make_sequence()
    mounting = Mounting(rpy_rad=(0.0, 0.5, 0.0))
    frames = SonarFrames(
        sequence.imu.stamps_ns[:2],
        np.zeros((2, 3, 4), np.uint8),
        np.arange(1.0, 5),
        np.array([0.1, 0.0, -0.1]),
    )
    tree = Calibration(sonar=SonarCalibration(mounting=mounting))
    images = sonar_image_messages("/sonar/image", frames)
    written(tmp_path / "a.mcap", sequence, tree, None, images)
    found = read_log(tmp_path / "a.mcap")
    np.testing.assert_allclose(
        found.calibration.sonar.mounting.rpy_rad, mounting.rpy_rad, atol=1e-12
    )
    assert found.notes["log.calibration"].startswith(
        "defaults; mountings from /tf_static: imu, dvl, sonar"
    )
    alone = read_images_alone(tmp_path / "a.mcap").calibration.sonar
    np.testing.assert_allclose(alone.mounting.rpy_rad, mounting.rpy_rad, atol=1e-12)
    stated = read_images_alone(
        tmp_path / "a.mcap",
        calibration=said(sonar={"mounting": {"rpy_rad": [0.0, 0.0, 1.0]}}),
    )
    assert stated.calibration.sonar.mounting.rpy_rad == (0.0, 0.0, 1.0)


STEP = gtsam.Pose3(gtsam.Rot3.Rz(0.5), np.array([1.0, 0.0, -0.2]))
BELOW = gtsam.Pose3(gtsam.Rot3.Rx(0.1), np.array([0.0, 0.0, 0.3]))
NAMED_TREES: dict[str, tuple[str, dict[str, tuple[str, gtsam.Pose3 | str]], gtsam.Pose3]] = {
    "a namespace": ("bluerov2/dvl", {"bluerov2/dvl": ("bluerov2/base_link", STEP)}, STEP),
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
    mountings = []
    # two seconds after the first file, and an hour later: another recording
    for number, later_s in enumerate((0, 2, 3602)):
        bench.t0_ns = T0_NS + later_s * 10**9
        stamps_ns = [bench.t0_ns + i * 10**8 for i in range(20)]
        topics = [
            ("/dvl", "dvl", [bench.dvl(ns) for ns in stamps_ns]),
            ("/imu", "imu", [bench.imu(ns) for ns in stamps_ns]),
            (topic, kind, [] if number else messages),
        ]
        path = bench.write(*topics, name=f"dive_{number}.mcap")
        found = read_log(path)
        mountings.append(found.calibration.dvl.mounting.translation_m)
        placed = "none; not" if later_s == 3602 else "dvl (dvl_link); not"
        said = f"defaults; mountings from /tf_static: {placed} in the tree, taken as"
        assert found.notes["log.calibration"].startswith(said)
    assert mountings == [TREE_M, TREE_M, (0, 0, 0)]


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
    floor = gathered(said(floor={"z_m": -2}), FLOOR, {}).floor
    assert floor is not None
    assert (floor.z_m, floor.sigma_m) == (-2, 0.1)
    assert gathered(said(floor=False, use_gravity=False), FLOOR, {}) == Calibration(
        use_gravity=False
    )
    with pytest.raises(
        CalibrationError, match=r"^vehicle\.toml: floor\.sigma_m: is missing$"
    ):
        gathered(said(floor={"z_m": -2}), None, {})


MISTAKES: list[tuple[dict[str, Any], str]] = [
    (
        {"imu": {"gyro_sigma": 1}},
        r"^vehicle\.toml: imu\.gyro_sigma: there is no such field",
    ),
    ({"floor": {"z": 1}}, r"^vehicle\.toml: .*floor\.z: there is no such field"),
    (
        {"start": {"position_m": [1, 2]}},
        r"start\.position_m: expected 3 values, not \[1, 2\]",
    ),
    ({"depth": {"sigma_m": -1}}, r"depth\.sigma_m: .* greater than 0"),
    ({"imu": False}, r"imu: expected a section, \[imu\] in TOML, not false$"),
    (
        {"heading": False},
        r"heading: .* not false; to leave heading unused: use = false under \[heading\] in the log",
    ),
    (
        {"heading": {"bias_sigma_rad": False}},
        r"heading\.bias_sigma_rad: expected a number, not false$",
    ),
]
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
        path = written(tmp_path / "a.mcap", make_sequence(), None, record)
        with pytest.raises(error, match=message):
            read_log(path)
