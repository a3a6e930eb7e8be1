from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sonar_graph.errors import LogError, MissingTopicError

VELOCITY = (1.0, 2.0, 3.0)
KNOWN = [0.1, 0.01, 0, 0.01, 0.2, 0, 0, 0, 0.3]


def beam(number: int) -> dict[str, Any]:
    return {"id": number, "velocity": 0.1 * number, "distance": 2.0, "rssi": 0.0, "nsd": 0.0, "valid": True}


def water_linked(foreign: Any, rows: list[dict[str, Any]], **other: Any) -> list[dict[str, Any]]:
    return [
        {"header": foreign.header(i), "velocity": foreign.vector(*VELOCITY), "fom": 0.02, "velocity_valid": True}
        | {"beams": [], "form": "json_v3", **other, **row}
        for i, row in enumerate(rows)
    ]


def test_water_linked_has_a_standard_deviation_and_any_number_of_beams(foreign: Any, read: Any) -> None:
    rows = [{"beams": [beam(i) for i in range(n)]} for n in (4, 3, 0, 4)] + [{"velocity_valid": False}]
    sequence = read(foreign.imu(), ("/dvl/data", "dvl_msgs/msg/DVL", water_linked(foreign, rows)))
    assert ((sequence.dvl.stamps_ns - foreign.t0_ns) // foreign.step_ns).tolist() == [0, 1, 2, 3]
    np.testing.assert_array_equal(sequence.dvl.velocity, [VELOCITY] * 4)
    np.testing.assert_allclose(sequence.dvl.velocity_cov, [np.eye(3) * 0.02**2] * 4)
    assert sequence.notes["log.dropped"] == "dvl: 1 with velocity_valid not true"


def test_forks_of_water_linked_bring_the_whole_covariance(foreign: Any, read: Any) -> None:
    as_rows = {"cov": [foreign.vector(*row) for row in np.reshape(KNOWN, (3, 3)).tolist()]}
    none = {"cov": []}
    forks = [("geometry_msgs/Vector3[] cov", [as_rows] * 2), ("float64[9] covariance", [{"covariance": KNOWN}] * 2)]
    for text, rows in forks:
        entry = ("/dvl", "dvl_msgs/msg/DVL", water_linked(foreign, rows), foreign.water_linked(text))
        np.testing.assert_array_equal(read(foreign.imu(), entry).dvl.velocity_cov, [np.reshape(KNOWN, (3, 3))] * 2)
    entry = ("/dvl", "dvl_msgs/msg/DVL", water_linked(foreign, [none] * 2), foreign.water_linked(forks[0][0]))
    assert np.isnan(read(foreign.imu(), entry).dvl.velocity_cov).all()


def test_simulators_say_invalid_by_minus_one_and_unknown_by_zeros(foreign: Any, read: Any) -> None:
    covariances = [KNOWN, [0.0] * 9, [-1.0] + [0.0] * 8]
    messages = [
        {"header": foreign.header(i), "velocity": foreign.vector(*VELOCITY), "velocity_covariance": c, "beams": []}
        for i, c in enumerate(covariances)
    ]
    sequence = read(foreign.imu(), ("/rov/dvl", "stonefish_ros2/msg/DVL", messages))
    assert len(sequence.dvl) == 2
    np.testing.assert_array_equal(sequence.dvl.velocity_cov[0], np.reshape(KNOWN, (3, 3)))
    assert np.isnan(sequence.dvl.velocity_cov[1]).all()
    assert sequence.notes["log.dropped"] == "dvl: 1 with a covariance that says invalid"


def twists(foreign: Any, covariance: list[float] | None = None) -> list[dict[str, Any]]:
    twist = {"linear": foreign.vector(*VELOCITY), "angular": foreign.vector(7, 8, 9)}
    inner = {"twist": twist, "covariance": covariance or np.diag([1.0, 2, 3, 4, 5, 6]).ravel().tolist()}
    return [{"header": foreign.header(i, "dvl_link"), "twist": inner} for i in range(3)]


TWIST = "geometry_msgs/msg/TwistWithCovarianceStamped"
ODOMETRY = "nav_msgs/msg/Odometry"


def test_a_twist_is_a_doppler_log_where_its_name_says_so_or_it_is_chosen(foreign: Any, read: Any) -> None:
    entry, wheels = ("/dvl/twist", TWIST, twists(foreign)), ("/wheels", TWIST, twists(foreign))
    sequence = read(foreign.imu(), entry)
    np.testing.assert_array_equal(sequence.dvl.velocity, [VELOCITY] * 3)
    np.testing.assert_array_equal(sequence.dvl.velocity_cov, [np.diag([1.0, 2, 3])] * 3)
    assert len(read(foreign.imu(), foreign.dvl(rows=4), entry).dvl) == 4, "a real Doppler log goes before"
    with pytest.raises(MissingTopicError, match="/wheels only if chosen: --topic dvl=/wheels"):
        read(foreign.imu(), wheels)
    assert len(read(foreign.imu(), wheels, topics={"dvl": "/wheels"}).dvl) == 3


def test_the_twist_of_odometry_is_in_the_frame_of_its_child(foreign: Any, read: Any) -> None:
    odometry = [
        {"header": message["header"] | {"frame_id": "odom"}, "child_frame_id": "dvl_link", "twist": message["twist"]}
        for message in twists(foreign)
    ]
    rotation = {"x": 0.0, "y": 0.0, "z": 1.0, "w": 0.0}
    link = {"header": foreign.header(0, "base_link"), "child_frame_id": "dvl_link"}
    link["transform"] = {"translation": foreign.vector(0.5, 0, 0), "rotation": rotation}
    tree = ("/tf_static", "tf2_msgs/msg/TFMessage", [{"transforms": [link]}])
    sequence = read(foreign.imu(), ("/odom", ODOMETRY, odometry), tree, topics={"dvl": "/odom"})
    np.testing.assert_array_equal(sequence.dvl.velocity, [VELOCITY] * 3)
    assert sequence.calibration.dvl.mounting.translation_m == (0.5, 0, 0)


@pytest.mark.parametrize(
    ("rotation", "expected"),
    [
        ('"flu"', (1, 2, 3)),
        ('"frd"', (1, -2, -3)),
        ("[180, 0, 0]", (1, -2, -3)),
        ("[0, 0, 90]", (-2, 1, 3)),
        ("[30, 0, 0]", (1, 3**0.5 - 1.5, 1 + 1.5 * 3**0.5)),
    ],
)
def test_the_axes_of_a_driver_are_turned_into_ours(
    foreign: Any, read: Any, rotation: str, expected: tuple[float, ...]
) -> None:
    toml = f"[dvl]\nrotation = {rotation}"
    sequence = read(foreign.imu(), foreign.dvl(velocity_covar=KNOWN), toml=toml)
    np.testing.assert_allclose(sequence.dvl.velocity, [expected] * 5, atol=1e-15)
    # a covariance is turned as the velocity is: by the matrix that did it
    columns = [
        read(foreign.imu(), foreign.dvl(velocity=foreign.vector(*unit)), toml=toml).dvl.velocity[0]
        for unit in np.eye(3).tolist()
    ]
    R = np.column_stack(columns)
    np.testing.assert_allclose(sequence.dvl.velocity_cov[0], R @ np.reshape(KNOWN, (3, 3)) @ R.T, atol=1e-15)


DEVIATIONS = np.diag(np.sqrt(np.diag(np.reshape(KNOWN, (3, 3)))))
SQUARED = 'covariance = {meaning = "standard deviation"}'


@pytest.mark.parametrize(
    ("unit", "given", "toml", "expected"),
    [
        (1000, (np.array(KNOWN) * 1e6).tolist(), "scale = 0.001", np.reshape(KNOWN, (3, 3))),
        (1, DEVIATIONS.ravel().tolist(), "", DEVIATIONS),
        (1, DEVIATIONS.ravel().tolist(), SQUARED, DEVIATIONS**2),
    ],
)
def test_units_and_meanings_of_a_velocity_and_its_covariance(
    foreign: Any, read: Any, unit: float, given: list[float], toml: str, expected: np.ndarray
) -> None:
    entry = foreign.dvl(velocity=foreign.vector(*(unit * v for v in VELOCITY)), velocity_covar=given)
    sequence = read(foreign.imu(), entry, toml=f"[dvl]\n{toml}")
    np.testing.assert_allclose(sequence.dvl.velocity, [VELOCITY] * 5)
    np.testing.assert_allclose(sequence.dvl.velocity_cov, [expected] * 5)


@pytest.mark.parametrize(
    ("toml", "rows", "unknown"),
    [
        ("", 3, [False, True, True]),
        ('covariance = {negative = "invalid"}', 2, [False, True]),
        ('covariance = {zero = "invalid"}', 2, [False, True]),
        ("covariance = false", 3, [True, True, True]),
    ],
)
def test_the_meaning_of_zeros_and_of_minus_one_can_be_said(
    foreign: Any, read: Any, toml: str, rows: int, unknown: list[bool]
) -> None:
    topic, kind, messages = foreign.dvl(rows=3)
    for message, covariance in zip(messages, [KNOWN, [0.0] * 9, [-1.0] + [0.0] * 8], strict=True):
        message["velocity_covar"] = covariance
    found = read(foreign.imu(), (topic, kind, messages), toml=f"[dvl]\n{toml}").dvl.velocity_cov
    assert np.isnan(found).all(axis=(1, 2)).tolist() == unknown
    assert len(found) == rows


def packets(velocities: list[list[float]]) -> tuple[str, str, list[dict[str, Any]]]:
    rows = [{"timestamp": 0.0, "range": [1.0] * 4, "velocity": v} for v in velocities]
    return "/pd0", "provider_dvl/msg/PD0Packet", rows


TABLE = '[dvl]\ntopic = "/pd0"\ntype = "provider_dvl/msg/PD0Packet"\n'
OF_ARRAY = TABLE + 'velocity = ["velocity[0]", "velocity[1]", "velocity[2]"]\n'


@pytest.mark.parametrize(
    ("stamp", "first", "step", "steps_ns"),
    [
        ('"log"', 0.0, 0.0, 10**8),
        ('"timestamp"\nstamp_unit_s = 1e-6\nstamp_offset_s = 3e8', 1.4e15, 1e5, 10**8),
        ('"timestamp"', 1.7e9, 0.25, 250_000_000),
    ],
)
def test_a_type_of_which_nothing_is_known_needs_only_its_fields_and_a_stamp_of_any_unit(
    foreign: Any, read: Any, stamp: str, first: float, step: float, steps_ns: int
) -> None:
    topic, kind, rows = packets([[1.0, 2.0, 3.0, 0.01]] * 3)
    rows = [row | {"timestamp": first + step * i} for i, row in enumerate(rows)]
    dvl = read(foreign.imu(), (topic, kind, rows), toml=f"{OF_ARRAY}stamp = {stamp}").dvl
    np.testing.assert_array_equal(dvl.velocity, [VELOCITY] * 3)
    assert np.isnan(dvl.velocity_cov).all()
    assert (dvl.stamps_ns - foreign.t0_ns).tolist() == [0, steps_ns, 2 * steps_ns]


@pytest.mark.parametrize(
    ("toml", "message"),
    [
        (OF_ARRAY.replace("[2]", "[4]") + 'stamp = "log"', r"/pd0: field velocity\[4\] .* has 4 elements"),
        (OF_ARRAY.replace("velocity[2]", "velocity") + 'stamp = "log"', r"velocity .* is an array of 4; name one"),
        (OF_ARRAY, r"/pd0: its provider_dvl/msg/PD0Packet has no field header\.stamp\.sec"),
        (OF_ARRAY.replace("velocity[2]", "speed"), r"\[dvl\] velocity: .*PD0Packet has no field speed; it has: "),
    ],
)
def test_a_field_that_is_not_there_is_named(foreign: Any, read: Any, toml: str, message: str) -> None:
    with pytest.raises(LogError, match=message):
        read(foreign.imu(), packets([[1.0, 2.0, 3.0, 0.0]] * 3), toml=toml)


def janus(tilt_deg: float, azimuth_deg: list[float]) -> np.ndarray:
    """Beam directions by turning the vertical: first outwards, then about itself."""
    return np.array(
        [Rotation.from_euler("yz", [tilt_deg, azimuth], degrees=True).apply([0, 0, 1]) for azimuth in azimuth_deg]
    )


GEOMETRY = "tilt_deg = 30, azimuth_deg = [45, -45, -135, 135]"
OF_BEAMS = TABLE + f'beams = {{velocity = "velocity", {GEOMETRY}}}\nstamp = "log"'


def test_a_velocity_is_solved_from_three_beams_or_more(foreign: Any, read: Any) -> None:
    rows = np.tile(janus(30, [45, -45, -135, 135]) @ VELOCITY, (3, 1))
    rows[1, 2] = rows[2, 1:3] = np.nan
    sequence = read(foreign.imu(), packets(rows.tolist()), toml=OF_BEAMS)
    np.testing.assert_allclose(sequence.dvl.velocity, [VELOCITY] * 2, atol=1e-12)
    assert sequence.notes["log.dropped"] == "dvl: 1 with fewer than 3 valid beams"


def test_beams_of_known_noise_count_even_alone(foreign: Any, read: Any) -> None:
    """What one or two beams measured is measured, and nothing else is claimed."""
    directions = janus(30, [45, -45, -135, 135])
    rows = np.tile(directions @ VELOCITY, (5, 1))
    kept = [[0, 1, 2, 3], [0, 1, 3], [1, 2], [3], []]
    for row, beams in zip(rows, kept, strict=True):
        row[np.setdiff1d(range(4), beams)] = np.nan
    toml = TABLE + f'beams = {{velocity = "velocity", sigma_m_s = 0.02, {GEOMETRY}}}\nscale = 0.5\nstamp = "log"'
    sequence = read(foreign.imu(), packets((2 * rows).tolist()), toml=toml)
    assert sequence.notes["log.dropped"] == "dvl: 1 without a valid beam"
    np.testing.assert_allclose(sequence.dvl.velocity[:2], [VELOCITY] * 2, atol=1e-12)
    for beams, velocity, cov in zip(kept[:4], sequence.dvl.velocity, sequence.dvl.velocity_cov, strict=True):
        along = directions[beams]
        np.testing.assert_allclose(along @ velocity, along @ VELOCITY, atol=1e-12)
        information = along.T @ along / 0.02**2
        np.testing.assert_allclose(np.linalg.inv(cov), information, atol=2e-4, rtol=1e-5)


def test_beams_go_before_the_velocity_that_a_driver_makes_of_them(foreign: Any, read: Any) -> None:
    rows = [{"velocity": foreign.vector(9, 9, 9), "beams": [beam(i) for i in range(4)]} for _ in range(3)]
    expected = np.linalg.pinv(janus(22.5, [45, -45, -135, 135])) @ [0.0, 0.1, 0.2, 0.3]
    said = (
        '[dvl]\nvalid_where = {}\n[dvl.beams]\nvelocity = "beams.velocity"\nvalid = "beams.valid"\nsigma_m_s = 0.01\n'
    )
    toml = said + "tilt_deg = 22.5\nazimuth_deg = [45, -45, -135, 135]"
    entry = ("/dvl/data", "dvl_msgs/msg/DVL", water_linked(foreign, rows))
    np.testing.assert_allclose(read(foreign.imu(), entry, toml=toml).dvl.velocity, [expected] * 3, atol=1e-9)
    rows[1]["velocity_valid"] = rows[1]["beams"][2]["valid"] = rows[1]["beams"][3]["valid"] = False
    entry = ("/dvl/data", "dvl_msgs/msg/DVL", water_linked(foreign, rows))
    variances = np.trace(read(foreign.imu(), entry, toml=toml).dvl.velocity_cov, axis1=1, axis2=2)
    assert (variances > 1).tolist() == [False, True, False]


SINE, COSINE = float(np.sin(np.radians(22.5))), float(np.cos(np.radians(22.5)))


def unit_vectors(foreign: Any, across: float, down: float) -> dict[str, Any]:
    return {"beam_unit_vec": [foreign.vector(x, y, down) for x in (-across, across) for y in (-across, across)]}


@pytest.mark.parametrize(
    ("across", "down", "tilt", "warned"),
    [
        (0.6533, SINE, None, "tilted by 67.5°, which no Doppler log is: the driver seems to publish the sine of 22.5°"),
        (SINE / 2**0.5, COSINE, None, None),
        (SINE / 2**0.5, COSINE, 30, "tilted by 22.5°, the configured beams by 30°"),
        (SINE / 2**0.5, COSINE, 22.5, None),
        (0.6533, 0.8, None, "no unit vectors"),
        (SINE / 2**0.5, SINE, None, "z = 0.383, the sine of the tilt of 22.5°, where its cosine 0.924 should be"),
    ],
)
def test_beam_directions_are_doubted_and_never_used(
    foreign: Any, read: Any, across: float, down: float, tilt: float | None, warned: str | None
) -> None:
    geometry = f"beams = {{tilt_deg = {tilt}, azimuth_deg = [45, -45, 135, -135]}}" if tilt else ""
    entry = foreign.dvl(sound_speed=1480.0, **unit_vectors(foreign, across, down))
    sequence = read(foreign.imu(), entry, toml=f'[dvl]\nrotation = "frd"\n{geometry}')
    assert (warned is None) == ("log.warnings" not in sequence.notes)
    assert warned is None or warned in sequence.notes["log.warnings"]
    np.testing.assert_array_equal(np.abs(sequence.dvl.velocity), [VELOCITY] * 5)


@pytest.mark.parametrize(("azimuth_deg", "warned"), [("[45, -45, 135, -135]", True), ("[-135, 135, -45, 45]", False)])
def test_published_directions_that_are_not_the_configured_ones_are_named_with_topic_and_field(
    foreign: Any, read: Any, azimuth_deg: str, warned: bool
) -> None:
    toml = f"""[dvl]
rotation = "frd"
beams = {{velocity = "beam_velocity", tilt_deg = 22.5, azimuth_deg = {azimuth_deg}, sigma_m_s = 0.01}}"""
    along = (janus(22.5, [-135, 135, -45, 45]) @ VELOCITY).tolist()
    entry = foreign.dvl(sound_speed=1480.0, beam_velocity=along, **unit_vectors(foreign, SINE / 2**0.5, COSINE))
    sequence = read(foreign.imu(), entry, toml=toml)
    said = sequence.notes.get("log.warnings", "")
    assert ("beam_unit_vec: beam directions and the configured ones differ by up to" in said) == warned
    assert (f"topic {entry[0]}: " in said) == warned
    assert np.allclose(sequence.dvl.velocity, np.array(VELOCITY) * [1, -1, -1], atol=1e-6) != warned


def test_fields_that_a_driver_leaves_alone_are_mentioned(foreign: Any, read: Any) -> None:
    lying = foreign.dvl(beam_ranges_valid=True, range=[2.0, 0.0, 2.0, 2.0], sound_speed=0.0)
    warnings = read(foreign.imu(), lying).notes["log.warnings"]
    assert "beam_ranges_valid is true in 5 messages that have a range of 0 or less" in warnings
    assert "sound_speed is 0 in every message" in warnings
    honest = foreign.dvl(beam_ranges_valid=True, range=[2.0] * 4, sound_speed=1480.0)
    assert "log.warnings" not in read(foreign.imu(), honest, toml='[dvl]\nrotation = "frd"').notes


def test_z_down_by_definition_is_mentioned_where_nothing_says_how_the_instrument_sits(foreign: Any, read: Any) -> None:
    entry = foreign.dvl(sound_speed=1480.0)
    assert "marine_acoustic_msgs/msg/Dvl has z downwards" in read(foreign.imu(), entry).notes["log.warnings"]
    link = {"header": foreign.header(0, "base_link"), "child_frame_id": "sensor"}
    link["transform"] = {"translation": foreign.vector(0, 0, 0), "rotation": {"x": 1.0, "y": 0.0, "z": 0.0, "w": 0.0}}
    tree = ("/tf_static", "tf2_msgs/msg/TFMessage", [{"transforms": [link]}])
    assert "log.warnings" not in read(foreign.imu(), entry, tree).notes


INDEFINITE = [1.0, 2.0, 0.0, 2.0, 1.0, 0.0, 0.0, 0.0, 1.0]


def test_a_covariance_that_no_errors_can_have_is_not_used_and_named(foreign: Any, read: Any) -> None:
    topic, kind, messages = foreign.dvl()
    for message, covariance in zip(messages, [KNOWN, INDEFINITE, [0.0] * 9, INDEFINITE, KNOWN], strict=True):
        message["velocity_covar"] = covariance
    sequence = read(foreign.imu(), (topic, kind, messages))
    unknown = np.isnan(sequence.dvl.velocity_cov).all(axis=(1, 2))
    assert unknown.tolist() == [False, True, True, True, False]
    assert "dvl: velocity_covar: no covariance in 2 of 5 messages" in sequence.notes["log.warnings"]
    assert sequence.notes["log.noise"].startswith("dvl: 3 of 5 rows say no covariance, dvl.velocity_sigma_m_s")


def test_a_covariance_of_one_direction_only_is_one_to_rounding(foreign: Any, read: Any) -> None:
    topic, kind, messages = foreign.dvl()
    along = np.outer([1, 1, 1], [1, 1, 1]) * 1e-4
    for message in messages:
        message["velocity_covar"] = along.astype(np.float32).astype(float).ravel().tolist()
    notes = read(foreign.imu(), (topic, kind, messages)).notes
    assert "no covariance" not in notes["log.warnings"] + notes.get("log.noise", "")


def test_one_beam_throughout_is_refused(foreign: Any, read: Any) -> None:
    rows = np.full((5, 4), 0.3)
    rows[:, 1:] = np.nan
    toml = TABLE + f'beams = {{velocity = "velocity", sigma_m_s = 0.02, {GEOMETRY}}}\nstamp = "log"'
    with pytest.raises(LogError, match="DVL: too few valid beams in all 5 rows"):
        read(foreign.imu(), packets(rows.tolist()), toml=toml)
