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
        "linear_acceleration": vector(0, 0, 9.8),
        "orientation": quaternion(rotation),
        "orientation_covariance": [first, 0, 0, 0, 0.01, 0, 0, 0, variance],
    }
    rows = [row] * 2
    return rows_of(topic, IMU, rows, "imu_link", angular_velocity=vector(0, 0, 0))


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


def pressures(*values: float) -> Entry:
    rows = [{"fluid_pressure": value} for value in values]
    return rows_of("/bar30", "sensor_msgs/msg/FluidPressure", rows, variance=0.0)


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
    "orientation that says its variance": (
        [oriented(YAW), dvl()], "", {"heading.yaw_rad": [0.5] * 2, "heading.sigma_rad": [0.1] * 2}, {}),
    "orientation of a turned IMU": (
        [oriented(YAW), dvl(), tree("imu_link", z=np.sin(0.1), w=np.cos(0.1))], "",
        {"heading.yaw_rad": [0.3] * 2, "calibration.imu.mounting.rpy_rad": [0, 0, 0.2]}, {}),
    "orientation of an IMU on its side, by the rotation of the IMU": (
        [oriented(Rotation.from_euler("ZYX", [0.5, 0.0, np.pi / 2])), dvl()], "[imu]\nrotation = [90, 0, 30]",
        {"heading.yaw_rad": [0.5 - np.radians(30)] * 2}, {}),
    "orientation in north-east-down": (
        [oriented(NED_NORTH_WEST), dvl()], '[heading]\nworld = "ned"\nrotation = "frd"',
        {"heading.yaw_rad": [np.radians(135)] * 2}, {}),
    "declination": ([oriented(YAW), dvl()], OFFSET, {"heading.yaw_rad": [0.75] * 2}, {}),
    "orientation without a variance, taken all the same": (
        [oriented(YAW, variance=0.0), dvl()], "[heading]\nneeds_variance = false",
        {"heading.yaw_rad": [0.5] * 2, "heading.sigma_rad": [NAN] * 2},
        {"log.noise": "heading: 2 of 2 rows say no covariance, heading.sigma_rad"}),
    "stamps of an orientation are the IMU's": (
        [oriented(YAW), dvl()], "[imu]\nstamp_offset_s = 0.05",
        {"heading.stamps_ns": 1_700_000_000_050_000_000 + np.array([0, 100_000_000])}, {}),
    "quaternion of a heading by name": (
        [rows_of("/gps/heading", TURNED, [{"quaternion": quaternion(YAW)}] * 3)], "",
        {"heading.yaw_rad": [0.5] * 3}, {}),
    "bearing in degrees": (
        [("/compass", "std_msgs/msg/Float64", [{"data": bearing} for bearing in (0.0, 90.0, 350.0)])],
        f"[heading]\n{COMPASS}scale = {float(np.radians(1))!r}", {"heading.yaw_rad": np.radians([90, 0, -260])}, {}),
    "bearing taken for rad": (
        [("/compass", "std_msgs/msg/Float64", [{"data": bearing} for bearing in (0.0, 350.0)])],
        f"[heading]\n{COMPASS}", {}, {"log.warnings": "heading: data is up to 350, more than a whole circle in rad"}),
    "sigma of more than a turn": (
        [oriented(YAW, variance=40.0), dvl()], "", {"heading.sigma_rad": [40.0**0.5] * 2},
        {"log.warnings": "heading: 2 of 2 rows have a sigma beyond a full turn"}),
    "fixes off the Earth": (
        [points((1, 2, 3), (1.1e7, 0, 0))], "", {"positions.position_m": [[1, 2, 3], [1.1e7, 0, 0]]},
        {"log.warnings": "positions: 1 of 2 rows have a position beyond 10000 km: estimators do not use them"}),
    "acoustic fixes": (
        [rows_of("/usbl/pose", POSE, [{"pose": {"pose": {"position": vector(1, 2, -3)}, "covariance": [0.0] * 36}}])],
        "", {"positions.position_m": [[1, 2, -3]]}, {}),
    "fixes in millimetres of a map grid in north-east-down": (
        [points((4.67e9, 5e8, 3000.0))], '[positions]\nworld = "ned"\nscale = 1e-3\norigin_m = [4.67e6, 499990.0, 1.0]',
        {"positions.position_m": [[10, 0, -2]]}, {}),
    "true positions of a total station": (
        [points((1, 2, 3), (1, 2, 4), topic="/ground_truth/point")], '[truth]\nworld = "ned"',
        {"truth.positions": [[2, 1, -3], [2, 1, -4]], "truth.quaternions_xyzw": np.full((2, 4), NAN)}, {}),
}
EARTH: dict[str, Case] = {
    "first fix is the origin": (
        [fixes(fix(), fix(10.0, altitude=22.0)), tree("gps_link", (1, 2, 3), w=1.0)], "",
        {"positions.position_m": [[0, 0, 0], [0, 10, 2]], "positions.covariance_m2": [np.reshape(SQUARE, (3, 3))] * 2,
         "calibration.positions.antenna_m": (1, 2, 3)},
        {"log.origin": "latitude 0.00100000°, longitude 7.00000000°, height 20.000 m, the first fix"}),
    "depths give the height of fixes without an origin": (
        [fixes(fix(), fix(10.0, altitude=22.0)), pressures(1.3e5, 1.31e5)], "",
        {"positions.position_m": [[0, 0, 0], [0, 10, 0]], "positions.covariance_m2": [
            [[4, 1, 0], [1, 9, 0], [0, 0, UNMEASURED_M2]]] * 2},
        {"log.origin": "the first fix; depths give the height, not the fixes"}),
    "origin that is said": (
        [fixes(fix(10.0))], BY_EAST, {"positions.position_m": [[0, 10, 5]]}, {"log.origin": "as configured"}),
    "no fix": (
        [fixes(fix(status={"status": -1}), fix(latitude=0.0, longitude=0.0), fix(latitude=NAN), fix(), fix(3.0))], "",
        {"positions.position_m": [[0, 0, 0], [0, 3, 0]]}, {"log.dropped": "positions: 3 without a fix"}),
    "covariance that is not known": (
        [fixes(fix(position_covariance_type=0), fix(position_covariance=[0.0] * 9))], "",
        {"positions.covariance_m2": np.full((2, 3, 3), NAN)},
        {"log.noise": "positions: 2 of 2 rows say no covariance"}),
    "no height": (
        [fixes(fix(), fix(altitude=NAN), fix(altitude=NAN, position_covariance_type=0))], "",
        {"positions.position_m": [[0, 0, 0]] * 3, "positions.covariance_m2": [
            np.reshape(SQUARE, (3, 3)), [[4, 1, 0], [1, 9, 0], [0, 0, UNMEASURED_M2]],
            np.diag([2.5**2, 2.5**2, UNMEASURED_M2])]}, {}),
    "true positions from satellites, with the origin of the fixes": (
        [fixes(fix()), fixes(fix(2.0), fix(3.0), topic="/truth/fix")], "",
        {"truth.positions": [[0, 2, 0], [0, 3, 0]], "positions.position_m": [[0, 0, 0]]}, {}),
    "true places on the Earth have no axes of their own": (
        [fixes(fix()), fixes(fix(2.0), fix(3.0), topic="/truth/fix")], NED_ON_EARTH,
        {"truth.positions": [[0, 2, 0], [0, 3, 0]]}, {}),
}
# fmt: on


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_headings_and_fixes_of_any_driver_become_measurements(foreign, case):
    assert "log.origin" not in foreign.check(*case).notes


@pytest.mark.parametrize("case", EARTH.values(), ids=EARTH)
def test_positions_on_the_earth_become_metres_from_an_origin(foreign, case):
    """To a tenth of a millimetre, by the radius of curvature."""
    *others, notes = case
    notes = {"log.origin": "of the world"} | notes
    foreign.check(*others, notes, atol=1e-4)


def test_of_several_orientations_that_of_the_imu_in_use_counts(foreign):
    entries = [oriented(YAW), oriented(Rotation.identity(), topic="/imu/second"), dvl()]
    for topic, yaw_rad in (("/imu", 0.5), ("/imu/second", 0.0)):
        sequence = foreign.read(*entries, topics={"imu": topic})
        assert sequence.heading.yaw_rad.tolist() == pytest.approx([yaw_rad] * 2)
        assert f"heading: {topic};" in sequence.notes["log.topics"] + ";"
    with pytest.raises(
        LogError, match=r"for heading, 2 topics fit: .*\[heading\] topic"
    ):
        foreign.read(
            *entries[:2], imu_of("/imu/third"), dvl(), topics={"imu": "/imu/third"}
        )


def imu_of(topic: str) -> Entry:
    return topic, *imu()[1:]


def test_what_is_called_truth_is_no_measurement_unless_it_is_chosen(
    foreign,
):
    """A NavSatFix of any other name is; and an inspection offers no truth as a Doppler log."""
    truth = fixes(fix(), fix(1.0), topic="/truth/fix")
    assert foreign.read(truth).positions is None
    assert len(foreign.read(truth, topics={"positions": "/truth/fix"}).positions) == 2
    odometry = rows_of("/ground_truth/odometry", "nav_msgs/msg/Odometry", [{}] * 2)
    summary = inspect_log(foreign.write(imu(), odometry))
    reasons = {role.role: role.reason for role in summary.roles}
    assert "ground_truth" not in reasons["dvl"]
    (offered,) = re.findall(r"\[dvl\](.*)\[depth\]", summary.toml, re.DOTALL)
    assert "/ground_truth/odometry" not in offered
    other = inspect_log(foreign.write(imu(), ("/odometry", *odometry[1:])))
    reasons = {role.role: role.reason for role in other.roles}
    assert "/odometry only if chosen" in reasons["dvl"]


def moving(*yaws_rad: float, step_m: float = 1.0) -> Entry:
    rows = [
        {
            "pose": {
                "pose": {
                    "position": vector(step_m * i, 0, 0),
                    "orientation": quaternion(Rotation.from_euler("z", y)),
                }
            }
        }
        for i, y in enumerate(yaws_rad)
    ]
    return rows_of("/ground_truth/odometry", "nav_msgs/msg/Odometry", rows)


def test_a_constant_true_orientation_raises_a_doubt(
    foreign,
):
    still = moving(0.3, 0.3, 0.3)
    notes = foreign.read(still, toml=FRD_DVL).notes["log.warnings"]
    assert (
        "truth: its orientation is the same in all 3 messages, although it moves by 2 m: if that is none"
        in notes
    )
    assert "`orientation = false` under [truth]" in notes
    for sound in (moving(0.3, 0.3, 0.4), moving(0.3, 0.3, step_m=0.5)):
        assert (
            "orientation" not in foreign.read(sound, toml=FRD_DVL).notes["log.warnings"]
        )
    without = foreign.read(still, toml=f"{FRD_DVL}[truth]\norientation = false")
    assert "orientation" not in without.notes["log.warnings"]
    assert without.truth.positions.tolist() == [[0, 0, 0], [1, 0, 0], [2, 0, 0]]
    assert not without.truth.has_orientation


@pytest.mark.parametrize(
    ("toml", "said"),
    [
        ('[heading]\ntype = "a/msg/B"', "give either orientation"),
        ('[positions]\ntype = "a/msg/B"', "give either position"),
    ],
)
def test_a_table_without_a_source_of_its_numbers_is_refused(foreign, toml, said):
    with pytest.raises(LogError, match=said):
        foreign.read(toml=toml)


def aided(*, wrong: int = -1) -> list[Entry]:
    """Heading of 2 rad and five fixes 3 m east of each other's first, of a vehicle at 1 m/s; one row may be wrong."""
    yaws_rad = [2.0] * 5
    places = [(3.0, 4.0, 0.5)] * 5
    if wrong >= 0:
        yaws_rad[wrong] = np.pi
        places[wrong] = (900.0, 900.0, 0.0)
    turns = [quaternion(Rotation.from_euler("z", yaw)) for yaw in yaws_rad]
    rows = [{"quaternion": turn} for turn in turns]
    headings = rows_of("/gps/heading", TURNED, rows)
    return [headings, points(*places), dvl(velocity=vector(0, 0, 0)), imu()]


ANTENNA = "[positions]\nantenna_m = [1.0, 0.0, 0.0]\n"


@pytest.mark.parametrize("wrong", [-1, 0, 4])
def test_an_unknown_start_is_that_of_the_first_headings_and_fixes(
    foreign, tmp_path, wrong
):
    """With three times their sigma, of a vehicle at rest; one wrong row does not count."""
    calibration = tmp_path / "vehicle.toml"
    calibration.write_text(ANTENNA)
    sequence = foreign.read(*aided(wrong=wrong), calibration=calibration)
    start = sequence.calibration.start
    assert start.rpy_rad == pytest.approx((0, 0, 2.0), abs=1e-4)
    assert start.position_m == pytest.approx(
        (3 - np.cos(2), 4 - np.sin(2), 0.5), abs=1e-4
    )
    assert start.rpy_sigma_rad == pytest.approx(
        (0.1, 0.1, 3 * np.hypot(0.02, 0.05)), abs=1e-4
    )
    assert start.position_sigma_m[0] == pytest.approx(3 * 2.5, abs=1e-4)
    assert (
        "heading and position by the first headings and fixes: position_m = ["
        in sequence.notes["log.start"]
    )


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
    log = foreign.write(oriented(YAW, **said), dvl())
    assert foreign.read(oriented(YAW, **said), dvl()).heading is None
    (role,) = [role for role in inspect_log(log).roles if role.role == "heading"]
    assert role.topic is None
    assert "/imu says of no orientation that it is measured" in role.reason
    assert "needs_variance = false" in role.reason
