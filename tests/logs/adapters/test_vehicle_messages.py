"""IMU, depth and reference poses of any driver: units, axes, and doubts about both."""

from __future__ import annotations

import re
from typing import Any

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sonar_graph.logs.adapters.vehicle_messages import body_to_ros, ros_to_body

FRD_DVL = '[dvl]\nrotation = "frd"\nsound_speed = false\n'
"""Without a warning about the Doppler log."""


def mounted(foreign: Any, link: str, xyz: tuple[float, ...], x: float = 0.0) -> Any:
    """A frame below the body, rolled so far that its quaternion has this x."""
    rotation = {"x": x, "y": 0.0, "z": 0.0, "w": float(np.sqrt(1 - x**2))}
    transform = {"translation": foreign.vector(*xyz), "rotation": rotation}
    entry = {"header": foreign.header(0, "base_link"), "child_frame_id": link, "transform": transform}
    return "/tf_static", "tf2_msgs/msg/TFMessage", [{"transforms": [entry]}]


# --- IMU ------------------------------------------------------------------------------------------------------------


def test_units_are_scaled_and_axes_turned(foreign: Any, read: Any) -> None:
    toml = '[imu]\nrotation = "frd"\nangular_velocity_scale = 0.017453292519943295\nlinear_acceleration_scale = 9.80665'
    sequence = read(foreign.imu(force=(0, 0, -1), rate=(0, 0, 90)), foreign.dvl(), toml=toml)
    np.testing.assert_allclose(sequence.imu.specific_force, [[0, 0, 9.80665]] * 5)
    np.testing.assert_allclose(sequence.imu.angular_velocity, [[0, 0, -np.pi / 2]] * 5, atol=1e-15)


GRAVITY: dict[tuple[float, ...], str | None] = {
    (0, 0, 9.8): None,
    (5, 0, 8.4): None,
    (float("nan"),) * 3: None,
    (0, 0, 1): "the typical specific force is 1 m/s2 instead of 9.81",
    (9.8, 0, 0): "gravity is felt along +x",
    (-9.8, 0, 0): "gravity is felt along -x",
    (0, 9.8, 0): "+y (9.80 m/s2) instead of the body's +z: give rotation = [90, 0, 0]",
    (0, -9.8, 0): "gravity is felt along -y",
    (0, 0, -9.8): 'give rotation = "frd"',
}


@pytest.mark.parametrize(("force", "warning"), GRAVITY.items(), ids=str)
def test_gravity_that_is_not_felt_upwards_is_told_with_the_rotation_that_puts_it_right(
    foreign: Any, read: Any, force: tuple[float, ...], warning: str | None
) -> None:
    notes = read(foreign.imu(force=force), foreign.dvl(), toml=FRD_DVL).notes
    assert (warning is None) == ("log.warnings" not in notes)
    assert warning is None or warning in notes["log.warnings"]
    if proposed := re.search(r'give (rotation = ("\w+"|\[.*?\]))', notes.get("log.warnings", "")):
        sequence = read(foreign.imu(force=force), foreign.dvl(), toml=f"{FRD_DVL}[imu]\n{proposed[1]}")
        np.testing.assert_allclose(sequence.imu.specific_force, [[0, 0, 9.8]] * 5, atol=1e-12)
    assert bool(proposed) == (warning is not None and abs(sum(force)) > 9)


def test_a_mounting_puts_gravity_right_and_is_found_by_the_frame_that_is_named(foreign: Any, read: Any) -> None:
    tree = mounted(foreign, "real_link", (1, 2, 3), float(np.sqrt(0.5)))
    toml = FRD_DVL + '[imu]\nframe_id = "real_link"'
    sequence = read(foreign.imu(force=(0, 9.8, 0)), foreign.dvl(), tree, toml=toml)
    assert "log.warnings" not in sequence.notes
    assert sequence.calibration.imu.mounting.translation_m == (1, 2, 3)


def test_a_force_that_is_zero_throughout_was_not_measured(foreign: Any, read: Any) -> None:
    sequence = read(foreign.imu(force=(0, 0, 0)), foreign.dvl(), toml=FRD_DVL)
    assert np.isnan(sequence.imu.specific_force).all()
    assert sequence.notes["log.warnings"] == (
        "imu: linear_acceleration.x, linear_acceleration.y, linear_acceleration.z are 0 in every message, which no "
        "accelerometer measures: taken as not measured"
    )
    topic, kind, messages = foreign.imu()
    messages[2]["linear_acceleration"] = foreign.vector(0, 0, 0)
    np.testing.assert_array_equal(read((topic, kind, messages), foreign.dvl()).imu.specific_force[2], [0, 0, 0])


def test_a_wild_angular_rate_is_mentioned(foreign: Any, read: Any) -> None:
    topic, kind, messages = foreign.imu(rows=300)
    messages[150]["angular_velocity"] = foreign.vector(0, 0, 30)
    notes = read((topic, kind, messages), foreign.dvl(rows=300)).notes
    assert "imu: 1 angular rate stands out from both neighbours, by 30 rad/s" in notes["log.warnings"]


# --- depth ----------------------------------------------------------------------------------------------------------

ONE_ATMOSPHERE, TEN_METRES_OF_SEA = 101_325.0, 1025 * 9.80665 * 10


def pressures(foreign: Any, values: list[float], variance: float = 0.0) -> tuple[str, str, list[dict[str, Any]]]:
    rows = [{"header": foreign.header(i), "fluid_pressure": p, "variance": variance} for i, p in enumerate(values)]
    return "/bar30", "sensor_msgs/msg/FluidPressure", rows


@pytest.mark.parametrize(
    ("settings", "values"),
    [
        ("", [ONE_ATMOSPHERE, ONE_ATMOSPHERE + TEN_METRES_OF_SEA]),
        ("atmosphere_pa = 0", [0.0, TEN_METRES_OF_SEA]),
        ("scale = 100", [1013.25, 1013.25 + TEN_METRES_OF_SEA / 100]),
    ],
)
def test_pressure_becomes_height_in_any_water_and_unit(
    foreign: Any, read: Any, settings: str, values: list[float]
) -> None:
    toml = f"[depth]\nwater_density_kg_m3 = 1025\n{settings}"
    sequence = read(foreign.imu(), foreign.dvl(), pressures(foreign, values), toml=toml)
    np.testing.assert_allclose(sequence.depth.z_m, [0, -10], atol=1e-9)
    assert "1025 kg/m3" in sequence.notes["log.depth"]
    assert "fresh" not in sequence.notes["log.depth"]


def test_a_variance_is_scaled_with_its_pressure(foreign: Any, read: Any) -> None:
    deviation_m = 0.05
    deviation_mbar = deviation_m * 1000 * 9.80665 / 100
    entry = pressures(foreign, [1500.0], variance=deviation_mbar**2)
    sequence = read(foreign.imu(), foreign.dvl(), entry, toml="[depth]\nscale = 100")
    np.testing.assert_allclose(sequence.depth.variance_m2, [deviation_m**2])


def test_a_pressure_that_is_no_absolute_one_in_pascals_is_mentioned(foreign: Any, read: Any) -> None:
    sequence = read(foreign.imu(), foreign.dvl(), pressures(foreign, [1013.25, 1500.0]))
    assert "less than the atmosphere's: give scale (100 for hPa or mbar)" in sequence.notes["log.warnings"]
    sound = read(foreign.imu(), foreign.dvl(), pressures(foreign, [ONE_ATMOSPHERE, 1.5e5]))
    assert "atmosphere" not in sound.notes["log.warnings"]


@pytest.mark.parametrize(("meaning", "expected"), [("variance", 0.04), ("standard deviation", 0.04**2)])
def test_poses_are_depths_with_a_variance(foreign: Any, read: Any, meaning: str, expected: float) -> None:
    covariance = np.zeros(36)
    covariance[14] = 0.04
    pose = {"pose": {"position": foreign.vector(7, 8, -3)}, "covariance": covariance.tolist()}
    messages = [{"header": foreign.header(i), "pose": pose} for i in range(3)]
    entry = ("/waterlinked_dvl/dead_reckoning_report", POSE_WITH_COVARIANCE, messages)
    toml = f'[depth]\ntopic = "{entry[0]}"\nvariance = {{meaning = "{meaning}"}}'
    sequence = read(foreign.imu(), foreign.dvl(), entry, toml=toml)
    assert sequence.depth.z_m.tolist() == [-3] * 3
    assert "depth" not in sequence.notes["log.calibration"]  # a pose in the world has no port to mount
    np.testing.assert_allclose(sequence.depth.variance_m2, expected)


def test_a_bare_number_counted_downwards_is_a_depth(foreign: Any, read: Any) -> None:
    entry = ("/depth", "std_msgs/msg/Float64", [{"data": float(i)} for i in range(3)])
    toml = '[depth]\ntype = "std_msgs/msg/Float64"\nheight = "data"\nscale = -1\nstamp = "log"\nframe_id_field = false'
    sequence = read(foreign.imu(), foreign.dvl(), entry, toml=toml)
    assert sequence.depth.z_m.tolist() == [0, -1, -2]
    assert np.isnan(sequence.depth.variance_m2).all()
    assert "log.depth" not in sequence.notes


# --- reference poses ------------------------------------------------------------------------------------------------

POSE, POSE_WITH_COVARIANCE = "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped"
TRUTH = "/ground_truth/pose"


def poses(foreign: Any, kind: str, rotation: Rotation, covariance: Any = (0.0,) * 36, topic: str = TRUTH) -> Any:
    x, y, z, w = rotation.as_quat().tolist()
    inner = {"position": foreign.vector(1, 2, 3), "orientation": {"x": x, "y": y, "z": z, "w": w}}
    whole = {"pose": inner, "covariance": list(covariance)} if kind == POSE_WITH_COVARIANCE else inner
    return topic, kind, [{"header": foreign.header(i), "pose": whole} for i in range(3)]


@pytest.mark.parametrize("kind", [POSE, POSE_WITH_COVARIANCE])
def test_poses_are_truth_where_their_name_says_so(foreign: Any, read: Any, kind: str) -> None:
    turn = Rotation.from_euler("z", 1)
    sequence = read(foreign.imu(), foreign.dvl(), poses(foreign, kind, turn))
    np.testing.assert_array_equal(sequence.truth.positions, [[1, 2, 3]] * 3)
    np.testing.assert_allclose(sequence.truth.quaternions_xyzw, [turn.as_quat()] * 3)
    guess = read(foreign.imu(), foreign.dvl(), poses(foreign, kind, turn, topic="/pose"))
    assert guess.truth is None
    assert "/pose only if chosen" in guess.notes["log.truth"]


AXES: dict[str, tuple[str, Rotation, list[float], Rotation]] = {
    # in NED and FRD: heading 30 degrees from north towards east, nose up by 10, right side down by 5; in ENU and FLU:
    # 60 degrees from east towards north, pitch changes sign, roll does not
    "ned": (
        'world = "ned"\nrotation = "frd"',
        Rotation.from_euler("ZYX", [30, 10, 5], degrees=True),
        [2, 1, -3],
        Rotation.from_euler("ZYX", [60, -10, 5], degrees=True),
    ),
    # the driver's x is our y: with it along the world's x, our x points along the world's -y
    "turned": ("rotation = [0, 0, 90]", Rotation.identity(), [1, 2, 3], Rotation.from_euler("z", -90, degrees=True)),
}


@pytest.mark.parametrize(("settings", "recorded", "position", "expected"), AXES.values(), ids=AXES)
def test_axes_of_world_and_body_become_ours(
    foreign: Any, read: Any, settings: str, recorded: Rotation, position: list[float], expected: Rotation
) -> None:
    toml = f"[truth]\n{settings}"
    truth = read(foreign.imu(), foreign.dvl(), poses(foreign, POSE, recorded), toml=toml).truth
    np.testing.assert_array_equal(truth.positions, [position] * 3)
    np.testing.assert_allclose(truth.rotations().as_matrix(), [expected.as_matrix()] * 3, atol=1e-12)


@pytest.mark.parametrize("meaning", ["variance", "standard deviation"])
def test_covariances_follow_the_axes_and_what_they_mean(foreign: Any, read: Any, meaning: str) -> None:
    deviations = np.array([0.1, 0.2, 0.3, 0.01, 0.02, 0.03])
    given = np.diag(deviations**2 if meaning == "variance" else deviations).ravel().tolist()
    toml = f'[truth]\nworld = "ned"\nrotation = "frd"\ncovariance_meaning = "{meaning}"'
    entry = poses(foreign, POSE_WITH_COVARIANCE, Rotation.identity(), given)
    truth = read(foreign.imu(), foreign.dvl(), entry, toml=toml).truth
    # body x is north, y (left) west, z up: [rotation, translation] in the body, signs drop out of a diagonal
    np.testing.assert_allclose(truth.covariances, [np.diag(deviations[[3, 4, 5, 0, 1, 2]] ** 2)] * 3, atol=1e-15)


def random_covariances(seed: int, n: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(n, 6, 6))
    return root @ root.transpose(0, 2, 1), Rotation.random(n, rng).as_matrix()


@given(st.integers(0, 1000))
def test_ros_to_body_undoes_body_to_ros(seed: int) -> None:
    covariances, rotations = random_covariances(seed, 3)
    np.testing.assert_allclose(ros_to_body(body_to_ros(covariances, rotations), rotations), covariances, atol=1e-12)


def test_a_covariance_for_ros_is_that_of_sampled_poses_in_fixed_axes() -> None:
    covariances, rotations = random_covariances(1, 1)
    pose = gtsam.Pose3(gtsam.Rot3(rotations[0]), np.array([1.0, 2, 3]))
    samples = np.random.default_rng(2).multivariate_normal(np.zeros(6), covariances[0] * 1e-8, 20_000)
    moved = [pose.compose(gtsam.Pose3.Expmap(sample)) for sample in samples]
    translations = np.array([m.translation() - pose.translation() for m in moved])
    turns = np.array([gtsam.Rot3.Logmap(m.rotation().compose(pose.rotation().inverse())) for m in moved])
    sampled = np.cov(np.hstack([translations, turns]).T) * 1e8
    np.testing.assert_allclose(sampled, body_to_ros(covariances, rotations)[0], atol=0.05 * np.abs(sampled).max())


def test_an_unknown_covariance_is_nan_here_and_zero_or_negative_there() -> None:
    _, rotations = random_covariances(0, 2)
    assert not body_to_ros(np.full((2, 6, 6), np.nan), rotations).any()
    theirs = np.zeros((2, 6, 6))
    theirs[1, 0, 0] = -1
    assert np.isnan(ros_to_body(theirs, rotations)).all()
