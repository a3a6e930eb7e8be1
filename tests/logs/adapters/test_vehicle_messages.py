"""IMU, depth, reference poses and landmarks of any driver: units, axes, identities, and doubts about them."""

import re
from typing import Any

import gtsam
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sonar_graph.errors import LogError
from sonar_graph.logs.adapters import body_to_ros, range_and_azimuth
from tests.logs.conftest import quaternion, tree

from .conftest import STEP_NS, T0_NS, Case, Entry, dvl, imu, pressures, rows_of, vector

FRD_DVL = '[dvl]\nrotation = "frd"\n'
"""Without a warning about the Doppler log."""
ONE_ATMOSPHERE = 101_325.0
TEN_METRES_OF_SEA = 1025 * 9.80665 * 10
POSE = "geometry_msgs/msg/PoseStamped"
POSE_WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
HALF = float(np.sqrt(0.5))
NAN = float("nan")


def poses(
    rotation: Rotation,
    covariance: Any = None,
    topic: str = "/ground_truth/pose",
    kind: str = "",
) -> Entry:
    pose = {"position": vector(1, 2, 3), "orientation": quaternion(rotation)}
    if covariance is None:
        return rows_of(topic, POSE, [{"pose": pose}] * 3)
    row = {"pose": {"pose": pose, "covariance": list(covariance)}}
    return rows_of(topic, kind or POSE_WITH_COVARIANCE, [row] * 3)


TURN = Rotation.from_euler("z", 1)
SEA = "[depth]\nwater_density_kg_m3 = 1025\n"
NO_FORCE = (
    "imu: linear_acceleration.x, linear_acceleration.y, linear_acceleration.z are 0 in every message, which no "
    "accelerometer measures: taken as not measured"
)
DIGITS = "9" * 30
UNMEASURED = [-1.0] + [0.0] * 8
UNMEASURED_RATE = {"angular_velocity_covariance": UNMEASURED}
UNMEASURED_FORCE = {"linear_acceleration_covariance": UNMEASURED}


def detection(
    position: tuple[float, ...], *results: tuple[str, float], variance: float = 0.0
) -> dict[str, Any]:
    covariance = (np.eye(6) * variance).ravel().tolist()
    pose = {"pose": {"position": vector(*position)}, "covariance": covariance}
    hypotheses = [{"class_id": name, "score": score} for name, score in results]
    return {
        "results": [{"hypothesis": one, "pose": pose} for one in hypotheses],
        "bbox": {"center": {"position": vector(position[0] + 10, *position[1:])}},
        "id": "track",
    }


def arrays(*frames: list[dict[str, Any]]) -> Entry:
    rows = [{"detections": frame} for frame in frames]
    return rows_of("/landmarks", "vision_msgs/msg/Detection3DArray", rows, "sonar")


def one(*results: tuple[str, float], **other: Any) -> Entry:
    """A log with one detection, two metres to the left."""
    return arrays([detection((0, 2, 0), *results, **other)])


FRAMES = [
    [],
    [detection((3, 4, 0), ("7", 0.6), ("8", 0.3)), detection((0, -2, 0), ("1", 1.0))],
    [detection((1, 0, 0), ("12", 0.5)), detection((2, 0, 0))],
    [detection((1, 1, 0), ("1", 0.1), ("2", 0.2), ("3", 0.3))],
]
OWN = {
    "range_m": [2.5],
    "azimuth_rad": [0.1],
    "covariance": [1.0, 0, 0, 1.0],
    "candidate_ids": [1],
}
# fmt: off
CASES: dict[str, Case] = {
    "yaw of the gyros alone with the wrong sign, after the axes of both": (
        [imu(force=(0, 0, -9.8), rate=(0.1, 0.2, 0.3)), dvl()],
        '[imu]\nrotation = "frd"\nangular_velocity_axes = ["x", "y", "-z"]',
        {"imu.specific_force": [[0, 0, 9.8]] * 5, "imu.angular_velocity": [[0.1, -0.2, 0.3]] * 5}),
    "gravity put right by the mounting of the frame that is named": (
        [imu(force=(0, 9.8, 0)), dvl(), tree("real_link", (1, 2, 3), x=HALF, w=HALF)],
        FRD_DVL + '[imu]\nframe_id = "real_link"',
        {"calibration.imu.mounting.translation_m": (1, 2, 3), "log.warnings": None}),
    "force of zero throughout": (
        [imu(force=(0, 0, 0)), dvl()], FRD_DVL, {"imu.specific_force": [[NAN] * 3] * 5, "log.warnings": NO_FORCE}),
    "force of zero once": (
        [imu(rows=2, at_1={"linear_acceleration": vector(0, 0, 0)}), dvl()], "",
        {"imu.specific_force": [[0, 0, 9.8], [0, 0, 0]]}),
    "a row without a rate, and one without a force": (
        [imu(at_1=UNMEASURED_RATE, at_2=UNMEASURED_FORCE), dvl()], "",
        {"imu.stamps_ns": T0_NS + STEP_NS * np.array([0, 2, 3, 4]),
         "imu.specific_force": [[0, 0, 9.8], [NAN] * 3, *[[0, 0, 9.8]] * 2],
         "log.dropped": "imu: 1 without angular rate"}),
    "a rate that is no number": (
        [imu(at_2={"angular_velocity": vector(NAN, 0, 0)}), dvl()], "",
        {"imu.stamps_ns": T0_NS + STEP_NS * np.array([0, 1, 3, 4]),
         "log.dropped": "imu: 1 with values that are not finite"}),
    "wild rate": (
        [imu(300, at_150={"angular_velocity": vector(0, 0, 30)}), dvl(300)], "",
        {"log.warnings": "imu: 1 angular rate stands out from both neighbours, by 30 rad/s"}),
    # depth
    **{f"pressure, {settings or 'as it is'}": (
        [pressures(*values)], FRD_DVL + SEA + settings, {"depth.z_m": [0, -10], "depth.variance_m2": [NAN] * 2,
         "log.depth": "/ (1025 kg/m3 x 9.80665 m/s2)", "log.warnings": None})
       for settings, values in {
           "": (ONE_ATMOSPHERE, ONE_ATMOSPHERE + TEN_METRES_OF_SEA),
           "atmosphere_pa = 0": (0.0, TEN_METRES_OF_SEA),
           "scale = 100": (1013.25, 1013.25 + TEN_METRES_OF_SEA / 100)}.items()},
    "variance of a pressure in mbar": (
        [pressures(1500.0, variance=(0.05 * 1000 * 9.80665 / 100) ** 2)], "[depth]\nscale = 100",
        {"depth.variance_m2": [0.05**2]}),
    "pressure below the atmosphere's": (
        [pressures(1013.25, 1500.0)], FRD_DVL,
        {"log.warnings": "less than the atmosphere's: give scale (100 for hPa or mbar)"}),
    **{f"pose as a depth with a {meaning}": (
        [poses(TURN, [*[0.0] * 14, 0.04, *[0.0] * 21], "/dead_reckoning")],
        f'[depth]\ntopic = "/dead_reckoning"\nscale = -1\nvariance = {{meaning = "{meaning}"}}',
        {"depth.z_m": [-3] * 3, "depth.variance_m2": [variance_m2] * 3, "log.depth": None})
       for meaning, variance_m2 in {"variance": 0.04, "standard deviation": 0.04**2}.items()},
    # reference poses
    **{f"odometry {chosen or 'by its name'}": (
        [poses(TURN, [0.0] * 36, topic, "nav_msgs/msg/Odometry"), poses(TURN, topic="/pose")],
        chosen, {"truth.positions": [(1, 2, 3)] * 3, "log.truth": None})
       for topic, chosen in {"/odom": '[truth]\ntopic = "/odom"', "/rov/ground_truth": ""}.items()},
    **{f"a pose at {entry[0]}": ([entry], "", {"log.truth": f"{entry[0]} only if chosen"})
       for entry in (poses(TURN, [0.0] * 36, "/odom", "nav_msgs/msg/Odometry"), poses(TURN, topic="/pose"))},
    # the driver's x is our y: with it along the world's x, our x points along the world's -y
    "pose of a turned body": (
        [poses(Rotation.identity())], "[truth]\nrotation = [0, 0, 90]",
        {"truth.positions": [[1, 2, 3]] * 3,
         "truth.matrices": [Rotation.from_euler("z", -90, degrees=True).as_matrix()] * 3}),
    # landmarks
    "positions as range and azimuth, results as the posterior": (
        [arrays(*FRAMES)], "",
        {"detections.stamps_ns": T0_NS + STEP_NS * np.array([1, 1, 2, 3]),
         "detections.range_m": [5, 2, 1, 2**0.5],
         "detections.azimuth_rad": [np.arctan2(4, 3), -np.pi / 2, 0, np.pi / 4],
         "detections.candidate_ids": [[7, 8, -1], [1, -1, -1], [12, -1, -1], [1, 2, 3]],
         "detections.id_probability": [[0.6, 0.3, 0], [1, 0, 0], [0.5, 0, 0], [0.1, 0.2, 0.3]],
         "detections.range_azimuth_cov": np.full((4, 2, 2), np.nan), "log.dropped": "detections: 1 without a result"}),
    "classes with names": (
        [one(("buoy", 0.9), ("3", 0.1))], '[detections]\nids = {"buoy" = 42}',
        {"detections.candidate_ids": [[42, 3]]}),
    "an identity far below zero": (
        [arrays([detection((i, 0, 0), (name, 0.9)) for i, name in enumerate((f"-{DIGITS}", "3"), start=1)])], "",
        {"detections.range_m": [2], "detections.candidate_ids": [[3]]}),
    "position of the box": (
        [arrays([detection((1, 0, 0), ("1", 1.0))])], '[detections]\nposition = "bbox"',
        {"detections.range_m": [11]}),
    "own detections beside an array": (
        [rows_of("/own", "sonar_graph_msgs/msg/LandmarkDetections", [OWN], id_probability=[1.0]), one(("1", 1.0))], "",
        {"detections.range_m": [2.5]}),
    "a known covariance": (
        [one(("1", 1.0), variance=0.04)], "", {"detections.range_azimuth_cov": [np.diag([0.04, 0.04 / 4])]}),
}
REFUSED = {
    "a name": (one(("buoy", 0.9)), "", r"""class 'buoy' is no integer identity.*ids = \{"buoy" = 1\}"""),
    "no posterior": (one(("1", 0.9), ("2", 0.8)), "", r"/landmarks: scores of one detection add up to 1\.7"),
}
GRAVITY: dict[tuple[float, ...], str | None] = {
    (0, 0, 9.8): None, (5, 0, 8.4): None, (NAN,) * 3: None,
    (0, 0, 1): "the typical specific force is 1 m/s2 instead of 9.81",
    (9.8, 0, 0): "gravity is felt along +x", (-9.8, 0, 0): "gravity is felt along -x",
    (0, 9.8, 0): "+y (9.80 m/s2) instead of the body's +z: give rotation = [90, 0, 0]",
    (0, -9.8, 0): "gravity is felt along -y", (0, 0, -9.8): 'give rotation = "frd"',
}
# fmt: on


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_messages_of_any_driver_become_measurements(foreign, case):
    sequence = foreign.check(*case)
    assert (sequence.truth is None) == ("truth" not in sequence.notes["log.topics"])
    if (
        case[2].get("log.depth", "") is None
    ):  # a pose in the world or a bare number has no port to mount
        assert "depth" not in sequence.notes["log.calibration"]
    if said := sequence.notes.get("log.depth"):
        assert ("fresh water assumed" in said) == ("1000 kg/m3" in said)


@pytest.mark.parametrize(("force", "warning"), GRAVITY.items(), ids=str)
def test_gravity_along_another_axis_is_reported_with_its_rotation(
    foreign, force, warning
):
    entries = [imu(force=force), dvl()]
    notes = foreign.check(entries, FRD_DVL, {"log.doubtful": warning}).notes
    said = notes.get("log.doubtful", "")
    if proposed := re.search(r'give (rotation = ("\w+"|\[.*?\]))', said):
        toml = f"{FRD_DVL}[imu]\n{proposed[1]}"
        foreign.check(entries, toml, {"imu.specific_force": [[0, 0, 9.8]] * 5})
    assert bool(proposed) == (warning is not None and abs(sum(force)) > 9)


def test_a_covariance_for_ros_is_that_of_changed_poses_in_fixed_axes():
    rng = np.random.default_rng(1)
    root = rng.normal(size=(6, 6))
    world_R_body = Rotation.random(random_state=rng).as_matrix()
    pose = gtsam.Pose3(gtsam.Rot3(world_R_body), np.array([1.0, 2, 3]))
    moved = [pose.compose(gtsam.Pose3.Expmap(step)) for step in 1e-6 * root.T]
    shifts = [m.translation() - pose.translation() for m in moved]
    turns = [
        gtsam.Rot3.Logmap(m.rotation().compose(pose.rotation().inverse()))
        for m in moved
    ]
    columns = 1e6 * np.hstack([shifts, turns])
    found = body_to_ros((root @ root.T)[None], world_R_body[None])
    np.testing.assert_allclose(found[0], columns.T @ columns, atol=1e-4)


@pytest.mark.parametrize(("entry", "toml", "message"), REFUSED.values(), ids=REFUSED)
def test_results_that_are_no_detections_are_refused(foreign, entry, toml, message):
    with pytest.raises(LogError, match=message):
        foreign.read(entry, toml=toml)


@given(st.tuples(*[st.floats(-10, 10)] * 3), st.integers(0, 1000))
def test_a_covariance_of_range_and_azimuth_is_that_of_differences(position, seed):
    assume(np.hypot(*position[:2]) > 0.5)
    root = np.random.default_rng(seed).normal(size=(3, 3)) * 1e-4
    _, _, spread = range_and_azimuth(np.array([position]), (root @ root.T)[None])
    # central differences along the columns of the root give the same matrix
    ahead, behind = (
        range_and_azimuth(position + step, np.zeros((3, 3, 3)))[:2]
        for step in (root.T, -root.T)
    )
    ranges, turned = np.subtract(ahead, behind) / 2
    columns = np.array([ranges, np.angle(np.exp(2j * turned)) / 2])
    np.testing.assert_allclose(spread[0], columns @ columns.T, rtol=1e-4, atol=1e-13)
