"""Doppler logs of any driver: velocities or beams, covariances, units, axes, and doubts about them."""

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sonar_graph.errors import LogError
from tests.logs.conftest import tree

from .conftest import (
    STEP_NS,
    T0_NS,
    Case,
    Entry,
    dvl,
    imu,
    rows_of,
    vector,
    water_linked_text,
)

VELOCITY = (1.0, 2.0, 3.0)
KNOWN = [0.1, 0.01, 0, 0.01, 0.2, 0, 0, 0, 0.3]
COV = np.reshape(KNOWN, (3, 3))
UNKNOWN = np.full((3, 3), np.nan)
DEVIATIONS = np.diag(np.sqrt(np.diag(COV)))
INDEFINITE = [1.0, 2.0, 0.0, 2.0, 1.0, 0.0, 0.0, 0.0, 1.0]
# of one direction only, which is a covariance to rounding
ALONG = [float(np.float32(1e-4))] * 9
ROWS = T0_NS + np.arange(9) * STEP_NS


def beam(number: int) -> dict[str, Any]:
    return {
        "id": number,
        "velocity": 0.1 * number,
        "distance": 2.0,
        "rssi": 0.0,
        "nsd": 0.0,
        "valid": True,
    }


def water_linked(
    *rows: dict[str, Any], covariance: str = "float64 temperature"
) -> Entry:
    common = {
        "velocity": vector(*VELOCITY),
        "fom": 0.02,
        "velocity_valid": True,
        "beams": [],
        "form": "json_v3",
    }
    return (
        *rows_of("/dvl/data", "dvl_msgs/msg/DVL", rows, **common),
        water_linked_text(covariance),
    )


def simulator(*covariances: list[float]) -> Entry:
    rows = [{"velocity_covariance": covariance} for covariance in covariances]
    common = {"velocity": vector(*VELOCITY), "beams": []}
    return rows_of("/rov/dvl", "stonefish_ros2/msg/DVL", rows, **common)


def covariances(*given: list[float]) -> Entry:
    topic, kind, messages = dvl(len(given))
    for message, covariance in zip(messages, given, strict=True):
        message["velocity_covar"] = covariance
    return topic, kind, messages


def twists(
    topic: str,
    kind: str = "geometry_msgs/msg/TwistWithCovarianceStamped",
    **fields: Any,
) -> Entry:
    twist = {"linear": vector(*VELOCITY), "angular": vector(7, 8, 9)}
    inner = {
        "twist": twist,
        "covariance": np.diag([1.0, 2, 3, 4, 5, 6]).ravel().tolist(),
    }
    return rows_of(topic, kind, [{"twist": inner, **fields}] * 3, "dvl_link")


# --- beams ----------------------------------------------------------------------------------------------------------


def janus(tilt_deg: float, *azimuths_deg: float) -> np.ndarray:
    """Beam directions by turning the vertical: first outwards, then about itself."""
    turns = [[tilt_deg, azimuth] for azimuth in azimuths_deg]
    return Rotation.from_euler("yz", turns, degrees=True).apply([0, 0, 1])


def packets(velocities: Any, first: float = 0.0, step: float = 0.0) -> Entry:
    """Messages of an unknown type, without a header."""
    rows = [
        {"timestamp": first + step * i, "range": [1.0] * 4, "velocity": list(v)}
        for i, v in enumerate(velocities)
    ]
    return "/pd0", "provider_dvl/msg/PD0Packet", rows


TABLE = '[dvl]\ntopic = "/pd0"\ntype = "provider_dvl/msg/PD0Packet"\n'
OF_ARRAY = TABLE + 'velocity = ["velocity[0]", "velocity[1]", "velocity[2]"]\n'
GEOMETRY = "tilt_deg = 30, azimuth_deg = [45, -45, -135, 135]"
OF_BEAMS = TABLE + f'beams = {{velocity = "velocity", {GEOMETRY}}}\nstamp = "log"'
PAIR = janus(30, 45, -45, -135, 135) @ VELOCITY
MICROSECONDS = '"timestamp"\nstamp_unit_s = 1e-6\nstamp_offset_s = 3e8'
FRD = '[dvl]\nrotation = "frd"\n'
WATER_LINKED_BEAMS = """[dvl]
valid_where = {}
[dvl.beams]
velocity = "beams.velocity"
valid = "beams.valid"
tilt_deg = 22.5
azimuth_deg = [45, -45, -135, 135]"""
SOLVED = [
    np.linalg.pinv(janus(22.5, 45, -45, -135, 135)[k:]) @ np.arange(k, 4) * 0.1
    for k in (0, 1)
]

# fmt: off
CASES: dict[str, Case] = {
    # types of drivers
    "Water Linked": (
        [water_linked(*({"beams": [beam(i) for i in range(n)]} for n in (4, 3, 0, 4)), {"velocity_valid": False})], "",
        {"dvl.stamps_ns": ROWS[:4], "dvl.velocity": [VELOCITY] * 4, "dvl.velocity_cov": [np.eye(3) * 0.02**2] * 4,
         "log.dropped": "dvl: 1 with velocity_valid not true"}),
    "fork with rows": (
        [water_linked({"cov": [vector(*row) for row in COV.tolist()]}, covariance="geometry_msgs/Vector3[] cov")], "",
        {"dvl.velocity_cov": [COV]}),
    "fork without its rows": (
        [water_linked({"cov": []}, covariance="geometry_msgs/Vector3[] cov")], "", {"dvl.velocity_cov": [UNKNOWN]}),
    "fork with a matrix": (
        [water_linked({"covariance": KNOWN}, covariance="float64[9] covariance")], "", {"dvl.velocity_cov": [COV]}),
    "simulator": (
        [simulator(KNOWN, [0.0] * 9, [-1.0] + [0.0] * 8)], "", {"dvl.velocity_cov": [COV, UNKNOWN],
         "log.dropped": "dvl: 1 with a covariance that says invalid"}),
    "twist by its name": (
        [twists("/dvl/twist")], "",
        {"dvl.velocity": [VELOCITY] * 3, "dvl.velocity_cov": [np.diag([1.0, 2, 3])] * 3}),
    "twist beside a Doppler log": ([dvl(4), twists("/dvl/twist")], "", {"dvl.stamps_ns": ROWS[:4]}),
    "twist of odometry, in the frame of its child": (
        [twists("/odom", "nav_msgs/msg/Odometry", child_frame_id="child"), tree("child", (0.5, 0, 0), z=1.0)],
        '[dvl]\ntopic = "/odom"',
        {"dvl.velocity": [VELOCITY] * 3, "calibration.dvl.mounting.translation_m": (0.5, 0, 0)}),
    "twist of odometry without a child, in the frame of the header": (
        [twists("/dvl/odom", "nav_msgs/msg/Odometry"), tree("dvl_link", (0.5, 0, 0), z=1.0)], "",
        {"calibration.dvl.mounting.translation_m": (0.5, 0, 0)}),
    "velocities that are no numbers": (
        [twists("/dvl/twist"), packets([(1.0, np.inf, 3.0, 0.0), (1.0, 2.0, 3.0, 0.0)])], f'{OF_ARRAY}stamp = "log"',
        {"dvl.velocity": [VELOCITY], "log.dropped": "dvl: 1 with values that are not finite"}),
    # units and meanings
    "millimetres": (
        [dvl(velocity=vector(1e3, 2e3, 3e3), velocity_covar=[1e6 * one for one in KNOWN])], "[dvl]\nscale = 0.001",
        {"dvl.velocity": [VELOCITY] * 5, "dvl.velocity_cov": [COV] * 5}),
    "deviations": (
        [dvl(velocity_covar=DEVIATIONS.ravel().tolist())], '[dvl]\ncovariance = {meaning = "standard deviation"}',
        {"dvl.velocity_cov": [DEVIATIONS**2] * 5}),
    "zeros, minus one and what no errors can have": (
        [covariances(KNOWN, [0.0] * 9, [-1.0] + [0.0] * 8, INDEFINITE)], "",
        {"dvl.velocity_cov": [COV, UNKNOWN, UNKNOWN, UNKNOWN],
         "log.warnings": "dvl: velocity_covar: no covariance in 1 of 4 messages",
         "log.noise": "dvl: 3 of 4 rows say no covariance, dvl.velocity_sigma_m_s"}),
    "minus one is invalid": (
        [covariances(KNOWN, [0.0] * 9, [-1.0] + [0.0] * 8)], '[dvl]\ncovariance = {negative = "invalid"}',
        {"dvl.velocity_cov": [COV, UNKNOWN], "dvl.stamps_ns": ROWS[:2]}),
    "zeros are invalid": (
        [covariances(KNOWN, [0.0] * 9, [-1.0] + [0.0] * 8)], '[dvl]\ncovariance = {zero = "invalid"}',
        {"dvl.velocity_cov": [COV, UNKNOWN], "dvl.stamps_ns": ROWS[[0, 2]]}),
    "no covariance": ([covariances(KNOWN)], "[dvl]\ncovariance = false", {"dvl.velocity_cov": [UNKNOWN]}),
    "one direction": ([covariances(ALONG)], FRD, {"log.warnings": None, "log.noise": None}),
    # an unknown type needs only its fields, and a stamp of any unit
    **{f"own type, stamp {stamp}": (
        [packets([(1.0, 2.0, 3.0, 0.01)] * 3, first, step)], f"{OF_ARRAY}stamp = {stamp}",
        {"dvl.velocity": [VELOCITY] * 3, "dvl.velocity_cov": [UNKNOWN] * 3,
         "dvl.stamps_ns": T0_NS + np.arange(3) * steps_ns})
       for stamp, first, step, steps_ns in (
           ('"log"', 0.0, 0.0, 10**8), ('"timestamp"', 1.7e9, 0.25, 250_000_000), (MICROSECONDS, 1.4e15, 1e5, 10**8))},
    "three beams or more": (
        [packets([PAIR, PAIR * [1, 1, np.nan, 1], PAIR * [1, np.nan, np.nan, 1]])], OF_BEAMS,
        {"dvl.velocity": [VELOCITY] * 2, "log.dropped": "dvl: 1 with fewer than 3 valid beams"}),
    "beams before a velocity, but for those that a driver calls invalid": (
        [water_linked(*[{"beams": [beam(i) | {"valid": i >= bad} for i in range(4)]} for bad in (0, 1, 2, 4)])],
        WATER_LINKED_BEAMS, {"dvl.stamps_ns": ROWS[:2], "dvl.velocity": SOLVED,
         "log.dropped": "dvl: 2 with fewer than 3 valid beams"}),
    "z down": ([dvl()], "", {"log.warnings": "marine_acoustic_msgs/msg/Dvl has z downwards"}),
    "z down, mounted": ([dvl(), tree("sensor", x=1.0)], "", {"log.warnings": None}),
}
# fmt: on


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_messages_of_any_driver_become_velocities(foreign, case):
    entries, *others = case
    foreign.check([imu(), *entries], *others)


@pytest.mark.parametrize(
    ("entry", "toml", "message"),
    [
        (
            packets([PAIR]),
            OF_ARRAY.replace("[2]", "[4]") + 'stamp = "log"',
            r"/pd0: field velocity\[4\] .* 4 elements",
        ),
        (
            packets([PAIR]),
            OF_ARRAY.replace("velocity[2]", "velocity") + 'stamp = "log"',
            "is an array of 4; name one",
        ),
        (
            packets([PAIR * [1, *[np.nan] * 3]] * 5),
            OF_BEAMS,
            "none of its 5 messages can be used: 5 with fewer than 3 valid beams",
        ),
    ],
)
def test_what_cannot_be_a_doppler_log_is_named(foreign, entry, toml, message):
    with pytest.raises(LogError, match=message):
        foreign.read(imu(), entry, toml=toml)


@pytest.mark.parametrize(
    ("rotation", "R"),
    [
        ('"frd"', np.diag([1, -1, -1])),
        ("[0, 0, 90]", np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])),
        ("[30, 0, 0]", Rotation.from_euler("x", 30, degrees=True).as_matrix()),
    ],
)
def test_the_axes_of_a_driver_are_turned_into_ours(foreign, rotation, R):
    """A covariance is turned as the velocity is."""
    toml = f"[dvl]\nrotation = {rotation}"
    sequence = foreign.read(imu(), dvl(velocity_covar=KNOWN), toml=toml)
    np.testing.assert_allclose(sequence.dvl.velocity, [R @ VELOCITY] * 5, atol=1e-15)
    np.testing.assert_allclose(sequence.dvl.velocity_cov[0], R @ COV @ R.T, atol=1e-15)
