"""Headings, position fixes and true positions of any driver: units, axes, mountings, origins, and doubts about them."""

import re
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sonar_graph.errors import LogError
from sonar_graph.logs import inspect_log
from sonar_graph.logs.adapters.aiding_messages import is_unwrapped
from sonar_graph.measurements import UNMEASURED_M2
from tests.logs.conftest import quaternion, tree

from .conftest import (
    DEFINITIONS,
    IMU,
    Case,
    Entry,
    dvl,
    imu,
    interface,
    pressures,
    rows_of,
    vector,
)

FRD_DVL = '[dvl]\nrotation = "frd"\n'
"""Without a warning about the Doppler log."""
FIX = "sensor_msgs/msg/NavSatFix"
POINT = "geometry_msgs/msg/PointStamped"
TURNED = "geometry_msgs/msg/QuaternionStamped"
POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
DEFINITIONS[FIX] = interface(
    "std_msgs/Header header, sensor_msgs/NavSatStatus status, float64 latitude, float64 longitude, float64 altitude, "
    "float64[9] position_covariance, uint8 position_covariance_type",
    sensor_msgs__NavSatStatus="int8 status, uint16 service",
)
DEFINITIONS[TURNED] = interface(
    "std_msgs/Header header, geometry_msgs/Quaternion quaternion"
)
NAN = float("nan")
METRE_DEG = np.degrees(1 / (6_335_439.327 + 20))
"""Of latitude at the equator and 20 m, by the meridian's radius of curvature a (1 - e²)."""
SQUARE = [4.0, 1.0, 0.0, 1.0, 9.0, 0.0, 0.0, 0.0, 16.0]


def oriented(
    rotation: Rotation, variance: float = 0.01, first: float = 0.01, topic: str = "/imu"
) -> Entry:
    """IMU messages with an orientation and the first and last variance of it."""
    row = {
        "angular_velocity": vector(0, 0, 0),
        "linear_acceleration": vector(0, 0, 9.8),
        "orientation": quaternion(rotation),
        "orientation_covariance": [first, 0, 0, 0, 0.01, 0, 0, 0, variance],
    }
    return rows_of(topic, IMU, [row] * 2, "imu_link")


def fix(north_m: float = 0.0, **other: Any) -> dict[str, Any]:
    """A satellite fix near the equator, so far north of 1e-3 degrees; a metre is a metre there."""
    at = {
        "latitude": 1e-3 + north_m * METRE_DEG,
        "longitude": 7.0,
        "altitude": 20.0,
        "status": {"status": 0},
    }
    return at | {"position_covariance": SQUARE, "position_covariance_type": 3} | other


def fixes(*rows: dict[str, Any], topic: str = "/gps/fix") -> Entry:
    return rows_of(topic, FIX, rows, "gps_link")


def points(*places: tuple[float, float, float], topic: str = "/usbl/point") -> Entry:
    return rows_of(topic, POINT, [{"point": vector(*place)} for place in places])


def moving(*yaws_rad: float, step_m: float = 1.0) -> Entry:
    turns = [quaternion(Rotation.from_euler("z", yaw)) for yaw in yaws_rad]
    poses = [
        {"position": vector(step_m * row, 0, 0), "orientation": turn}
        for row, turn in enumerate(turns)
    ]
    rows = [{"pose": {"pose": pose}} for pose in poses]
    return rows_of("/ground_truth/odometry", "nav_msgs/msg/Odometry", rows)


YAW = Rotation.from_euler("z", 0.5)
NED_NORTH_WEST = Rotation.from_euler("ZYX", [np.radians(-45), 0.1, 0.2])
OFFSET = "[heading]\nyaw_offset_rad = 0.25"
COMPASS = 'type = "std_msgs/msg/Float64"\nyaw = "data"\nstamp = "log"\nframe_id_field = false\nworld = "ned"\n'
BY_EAST = f"{FRD_DVL}[positions.geodetic]\norigin_deg_m = [1e-3, 7.0, 15.0]"
# the numbers of the covariance stand in for angles
NED_ON_EARTH = f"""{FRD_DVL}[truth]
type = "sensor_msgs/msg/NavSatFix"
topic = "/truth/fix"
world = "ned"
geodetic = {{latitude = "latitude", longitude = "longitude", height = "altitude"}}
rpy = ["position_covariance[1]", "position_covariance[2]", "position_covariance[3]"]
"""
# fmt: off
CASES: dict[str, Case] = {
    "orientation of a turned IMU": (
        [oriented(YAW), dvl(), tree("imu_link", z=np.sin(0.1), w=np.cos(0.1))], "",
        {"heading.yaw_rad": [0.3] * 2, "calibration.imu.mounting.rpy_rad": [0, 0, 0.2]}),
    "orientation of an IMU on its side, by the rotation of the IMU": (
        [oriented(Rotation.from_euler("ZYX", [0.5, 0.0, np.pi / 2])), dvl()], "[imu]\nrotation = [90, 0, 30]",
        {"heading.yaw_rad": [0.5 - np.radians(30)] * 2}),
    "orientation in north-east-down": (
        [oriented(NED_NORTH_WEST), dvl()], '[heading]\nworld = "ned"\nrotation = "frd"',
        {"heading.yaw_rad": [np.radians(135)] * 2}),
    "declination": ([oriented(YAW), dvl()], OFFSET, {"heading.yaw_rad": [0.75] * 2}),
    "orientation without a variance, taken all the same": (
        [oriented(YAW, variance=0.0), dvl()], "[heading]\nneeds_variance = false",
        {"heading.yaw_rad": [0.5] * 2, "heading.sigma_rad": [NAN] * 2,
         "log.noise": "heading: 2 of 2 rows say no covariance, heading.sigma_rad"}),
    "stamps of an orientation are the IMU's": (
        [oriented(YAW), dvl()], "[imu]\nstamp_offset_s = 0.05",
        {"heading.stamps_ns": 1_700_000_000_050_000_000 + np.array([0, 100_000_000])}),
    "bearing taken for rad": (
        [("/compass", "std_msgs/msg/Float64", [{"data": bearing} for bearing in (0.0, 350.0)])],
        f"[heading]\n{COMPASS}", {"log.warnings": "heading: data is up to 350, more than a whole circle in rad"}),
    "sigma of more than a turn": (
        [oriented(YAW, variance=40.0), dvl()], "", {"heading.sigma_rad": [40.0**0.5] * 2,
         "log.warnings": "heading: 2 of 2 rows have a sigma beyond a full turn"}),
    "fixes off the Earth": (
        [points((1, 2, 3), (1.1e7, 0, 0))], "", {"positions.position_m": [[1, 2, 3], [1.1e7, 0, 0]],
         "log.warnings": "positions: 1 of 2 rows have a position beyond 10000 km: estimators do not use them"}),
    "acoustic fixes": (
        [rows_of("/usbl/pose", POSE, [{"pose": {"pose": {"position": vector(1, 2, -3)}, "covariance": [0.0] * 36}}])],
        "", {"positions.position_m": [[1, 2, -3]]}),
    "fixes in millimetres of a map grid in north-east-down": (
        [points((4.67e9, 5e8, 3000.0))], '[positions]\nworld = "ned"\nscale = 1e-3\norigin_m = [4.67e6, 499990.0, 1.0]',
        {"positions.position_m": [[10, 0, -2]]}),
    "a true orientation that never changes": (
        [moving(0.3, 0.3, 0.3)], FRD_DVL, {"log.warnings": "truth: its orientation is the same in all 3 messages, "
         "although it moves by 2 m: if that is none, `orientation = false` under [truth]"}),
    "a true orientation that changes": ([moving(0.3, 0.3, 0.4)], FRD_DVL, {"log.warnings": None}),
    "a true orientation of a vehicle that stays": (
        [moving(0.3, 0.3, step_m=0.5)], FRD_DVL, {"log.warnings": None}),
    "a true orientation that is none": (
        [moving(0.3, 0.3, 0.3)], FRD_DVL + "[truth]\norientation = false",
        {"truth.positions": [[0, 0, 0], [1, 0, 0], [2, 0, 0]], "truth.quaternions_xyzw": np.full((3, 4), NAN),
         "log.warnings": None}),
    "true positions of a total station": (
        [points((1, 2, 3), (1, 2, 4), topic="/ground_truth/point")], '[truth]\nworld = "ned"',
        {"truth.positions": [[2, 1, -3], [2, 1, -4]], "truth.quaternions_xyzw": np.full((2, 4), NAN)}),
}
EARTH: dict[str, Case] = {
    "first fix is the origin": (
        [fixes(fix(), fix(10.0, altitude=22.0)), tree("gps_link", (1, 2, 3), w=1.0)], "",
        {"positions.position_m": [[0, 0, 0], [0, 10, 2]], "positions.covariance_m2": [np.reshape(SQUARE, (3, 3))] * 2,
         "calibration.positions.antenna_m": (1, 2, 3),
         "log.origin": "latitude 0.00100000°, longitude 7.00000000°, height 20.000 m, the first fix"}),
    "depths give the height of fixes without an origin": (
        [fixes(fix(), fix(10.0, altitude=22.0)), pressures(1.3e5, 1.31e5)], "",
        {"positions.position_m": [[0, 0, 0], [0, 10, 0]], "positions.covariance_m2": [
            [[4, 1, 0], [1, 9, 0], [0, 0, UNMEASURED_M2]]] * 2,
         "log.origin": "the first fix; depths give the height, not the fixes"}),
    "origin that is said": (
        [fixes(fix(10.0))], BY_EAST, {"positions.position_m": [[0, 10, 5]], "log.origin": "as configured"}),
    "no fix": (
        [fixes(fix(status={"status": -1}), fix(latitude=0.0, longitude=0.0), fix(latitude=NAN), fix(), fix(3.0))], "",
        {"positions.position_m": [[0, 0, 0], [0, 3, 0]], "log.dropped": "positions: 3 without a fix"}),
    "covariance that is not known": (
        [fixes(fix(position_covariance_type=0), fix(position_covariance=[0.0] * 9))], "",
        {"positions.covariance_m2": np.full((2, 3, 3), NAN),
         "log.noise": "positions: 2 of 2 rows say no covariance"}),
    "no height": (
        [fixes(fix(), fix(altitude=NAN), fix(altitude=NAN, position_covariance_type=0))], "",
        {"positions.position_m": [[0, 0, 0]] * 3, "positions.covariance_m2": [
            np.reshape(SQUARE, (3, 3)), [[4, 1, 0], [1, 9, 0], [0, 0, UNMEASURED_M2]],
            np.diag([2.5**2, 2.5**2, UNMEASURED_M2])]}),
    "true positions from satellites, with the origin of the fixes": (
        [fixes(fix()), fixes(fix(2.0), fix(3.0), topic="/truth/fix")], "",
        {"truth.positions": [[0, 2, 0], [0, 3, 0]], "positions.position_m": [[0, 0, 0]]}),
    "true places on the Earth have no axes of their own": (
        [fixes(fix()), fixes(fix(2.0), fix(3.0), topic="/truth/fix")], NED_ON_EARTH,
        {"truth.positions": [[0, 2, 0], [0, 3, 0]]}),
}
# fmt: on


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_headings_and_fixes_of_any_driver_become_measurements(foreign, case):
    assert "log.origin" not in foreign.check(*case).notes


@pytest.mark.parametrize("case", EARTH.values(), ids=EARTH)
def test_positions_on_the_earth_become_metres_from_an_origin(foreign, case):
    """To a tenth of a millimetre, by the radius of curvature."""
    *others, expected = case
    foreign.check(*others, {"log.origin": "of the world"} | expected, atol=1e-4)


def test_of_several_orientations_that_of_the_imu_in_use_counts(foreign):
    entries = [oriented(YAW), oriented(Rotation.identity(), topic="/imu/second"), dvl()]
    for topic, yaw_rad in (("/imu", 0.5), ("/imu/second", 0.0)):
        sequence = foreign.read(*entries, topics={"imu": topic})
        assert sequence.heading.yaw_rad.tolist() == pytest.approx([yaw_rad] * 2)
        assert f"heading: {topic};" in sequence.notes["log.topics"] + ";"
    third = ("/imu/third", *imu()[1:])
    message = r"for heading, 2 topics fit: .*\[heading\] topic"
    with pytest.raises(LogError, match=message):
        foreign.read(*entries, third, topics={"imu": "/imu/third"})


def test_what_is_called_truth_is_no_measurement_unless_it_is_chosen(foreign):
    """A NavSatFix of any other name is; and an inspection offers no truth as a Doppler log."""
    truth = fixes(fix(), fix(1.0), topic="/truth/fix")
    assert foreign.read(truth).positions is None
    assert len(foreign.read(truth, topics={"positions": "/truth/fix"}).positions) == 2
    for topic, is_offered in (("/ground_truth/odometry", False), ("/odometry", True)):
        odometry = rows_of(topic, "nav_msgs/msg/Odometry", [{}] * 2)
        summary = inspect_log(foreign.write(imu(), odometry))
        reasons = {role.role: role.reason for role in summary.roles}
        assert (f"{topic} only if chosen" in reasons["dvl"]) == is_offered
        (offered,) = re.findall(r"\[dvl\](.*)\[depth\]", summary.toml, re.DOTALL)
        assert (topic in offered) == is_offered


@pytest.mark.parametrize("wrong", [None, 0, 4])
def test_an_unknown_start_is_that_of_the_first_headings_and_fixes(
    foreign, tmp_path, wrong
):
    """With three times their sigma, of a vehicle at rest; one wrong row does not count."""
    yaws_rad = np.full(5, 2.0)
    places = np.tile([3.0, 4.0, 0.5], (5, 1))
    if wrong is not None:
        yaws_rad[wrong] = np.pi
        places[wrong] = 900.0
    turns = map(quaternion, Rotation.from_euler("z", yaws_rad[:, None]))
    headings = rows_of("/gps/heading", TURNED, [{"quaternion": turn} for turn in turns])
    entries = [headings, points(*places.tolist()), dvl(velocity=vector(0, 0, 0)), imu()]
    calibration = tmp_path / "vehicle.toml"
    calibration.write_text("[positions]\nantenna_m = [1.0, 0.0, 0.0]\n")
    sequence = foreign.read(*entries, calibration=calibration)
    start = sequence.calibration.start
    antenna_m = np.array([np.cos(2), np.sin(2), 0])
    for found, expected in (
        (start.rpy_rad, (0, 0, 2)),
        (start.position_m, (3, 4, 0.5) - antenna_m),
        (start.rpy_sigma_rad, (0.1, 0.1, 3 * np.hypot(0.02, 0.05))),
        (start.position_sigma_m[0], 3 * 2.5),
    ):
        assert found == pytest.approx(expected, abs=1e-4)
    said = "heading and position by the first headings and fixes: position_m = ["
    assert said in sequence.notes["log.start"]


def test_a_heading_that_counts_turns_is_in_rad_and_one_that_jumps_is_not():
    turns = np.linspace(0.3, 9.0, 50)
    assert is_unwrapped(turns)
    assert not is_unwrapped(np.degrees(turns))
    assert not is_unwrapped(np.degrees(turns) % 360)
    assert not is_unwrapped(turns + 90)


@pytest.mark.parametrize(
    "said", [{"variance": 0.0}, {"first": -1.0}, {"variance": NAN}]
)
def test_an_orientation_that_says_no_variance_is_no_heading_and_is_named(foreign, said):
    entries = oriented(YAW, **said), dvl()
    assert foreign.read(*entries).heading is None
    roles = {role.role: role for role in inspect_log(foreign.write(*entries)).roles}
    assert roles["heading"].topic is None
    reason = roles["heading"].reason
    assert "/imu says of no orientation that it is measured" in reason
    assert "needs_variance = false" in reason
