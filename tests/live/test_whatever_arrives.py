"""Live equals log for what drivers and networks send: wrong stamps, broken messages, sensors that begin late."""

import struct
from collections.abc import Callable

import numpy as np
import pytest

from sonar_graph import read_log, write_log
from sonar_graph.devices import velocity_of_beams
from sonar_graph.live import Engine, Message, definition_of
from sonar_graph.live.arrivals import MOTION
from sonar_graph.live.engine import OVERLOADED
from sonar_graph.live.live_messages import dropped_messages
from sonar_graph.logs import LiveRecord
from sonar_graph.logs.adapters import LogConfig
from sonar_graph.logs.cdr import encode, parse_definition
from sonar_graph.testing import small_world
from tests.live.traffic import NS, assert_record_equals, live, messages_of

DVL = "/dvl/data"
IMU = "/imu/data"
DETECTIONS = "/sonar/landmarks"


@pytest.fixture(scope="module")
def messages(tmp_path_factory) -> list[Message]:
    log = tmp_path_factory.mktemp("arrivals") / "log.mcap"
    write_log(log, small_world())
    return messages_of(log, np.random.default_rng(3), 0.05)


def stamp_of(message):
    seconds, ns = struct.unpack_from("<iI", message.payload, 4)
    return seconds * NS + ns


def stamped(message, stamp_ns):
    stamp = struct.pack("<iI", *divmod(stamp_ns, NS))
    payload = message.payload[:4] + stamp + message.payload[12:]
    return message._replace(payload=payload)


def message_of(topic, kind, stamp_ns, values, frame="", lengths=None):
    definition = parse_definition(kind, definition_of(kind))
    if kind != "tf2_msgs/msg/TFMessage":
        seconds, nanoseconds = divmod(stamp_ns, NS)
        stamp = {"header.stamp.sec": seconds, "header.stamp.nanosec": nanoseconds}
        values = values | stamp | {"header.frame_id": frame}
    payload = encode(definition, 1, values, lengths)[0].tobytes()
    return Message(topic, kind, payload, stamp_ns + 2_000_000)


def imu(message, up):
    """Turning slowly, with this specific force along z."""
    values = {"linear_acceleration.z": up, "angular_velocity.z": 0.1}
    made = message_of(IMU, "sensor_msgs/msg/Imu", stamp_of(message), values, "imu")
    return made._replace(arrival_ns=message.arrival_ns)


def dvl(message, beams, mode=1):
    kind = "marine_acoustic_msgs/msg/Dvl"
    values = {"velocity_mode": mode, "num_good_beams": beams, "velocity.x": 0.5}
    made = message_of(DVL, kind, stamp_of(message), values, "dvl")
    return made._replace(arrival_ns=message.arrival_ns)


def fix(stamp_ns, number, status=0, frame=""):
    values = {
        "status.status": status,
        "latitude": 48 + 1e-6 * number,
        "longitude": 8 + 1e-5 * number,
        "altitude": 3.1,
    }
    return message_of("/gps/fix", "sensor_msgs/msg/NavSatFix", stamp_ns, values, frame)


def transform(at_ns, child, turn=(0.0, 0.0, 1.0, 0.0)):
    names = {"header.frame_id": "base_link", "child_frame_id": child}
    values = {f"transforms.{name}": [frame] for name, frame in names.items()}
    for axis, part in zip("xyzw", turn, strict=True):
        values[f"transforms.transform.rotation.{axis}"] = np.array([[part]])
    kind = "tf2_msgs/msg/TFMessage"
    return message_of("/tf_static", kind, at_ns, values, lengths={"transforms": 1})


def compass(stamp_ns):
    kind = "geometry_msgs/msg/QuaternionStamped"
    values = {"quaternion.w": 1.0, "quaternion.z": 0.1}
    return message_of("/heading/q", kind, stamp_ns, values, "ahrs")


def detections(stamp_ns, candidates, is_sound=True):
    values = {"range_m": np.array([[5.0, 6.0]])}
    if is_sound:
        values |= {
            "azimuth_rad": np.array([[0.1, -0.2]]),
            "covariance": np.tile([0.01, 0.0, 0.0, 0.001], (1, 2)),
            "candidate_ids": np.tile(np.arange(candidates), (1, 2)),
            "track": np.array([[0, 1]]),
            "id_probability": np.full((1, 2 * candidates), 0.9 / candidates),
        }
    return message_of(
        DETECTIONS, "sonar_graph_msgs/msg/LandmarkDetections", stamp_ns, values, "sonar"
    )


def in_order(messages):
    return sorted(messages, key=lambda message: message.arrival_ns)


def without(messages, topic):
    return [message for message in messages if message.topic != topic]


def changed(messages, topic, change: Callable[[Message, float], Message]):
    """Messages of a topic changed; with seconds since the first message."""
    first_ns = messages[0].arrival_ns
    return [
        change(m, (m.arrival_ns - first_ns) * 1e-9) if m.topic == topic else m
        for m in messages
    ]


def doppler_stamps(messages):
    return [stamp_of(message) for message in messages if message.topic == DVL]


def first_imu(messages):
    return next(message for message in messages if message.topic == IMU)


def scrambled(messages, from_s):
    """Messages, some cut and some with random bytes."""
    noise = np.random.default_rng(0)
    first_ns = messages[0].arrival_ns
    found = []
    for message in messages:
        data = message.payload
        draw = noise.random()
        at = int(noise.integers(4, len(data)))
        is_due = message.arrival_ns > first_ns + from_s * NS
        if message.topic != "/tf_static" and is_due and draw < 0.1:
            data = data[:at] + noise.bytes(len(data) - at) * (draw < 0.05)
        found.append(message._replace(payload=data))
    return found


def out_of_order(messages):
    """Messages that change places within a second."""
    times_ns = [message.arrival_ns for message in messages]
    delays_ns = np.random.default_rng(7).uniform(0, 1e9, len(messages))
    pairs = zip(np.argsort(times_ns + delays_ns), times_ns, strict=True)
    return [messages[i]._replace(arrival_ns=at_ns) for i, at_ns in pairs]


CASES: dict[str, Callable[[list[Message]], list[Message]]] = {
    "every message twice": lambda m: [again for x in m for again in (x, x)],
    "messages in any order": out_of_order,
    "a first stamp an hour ahead": lambda m: [
        stamped(first_imu(m), stamp_of(first_imu(m)) + 3600 * NS),
        *m,
    ],
    "a first stamp of 1970, and an IMU that begins late": lambda m: [
        stamped(first_imu(m), 5 * NS),
        *(x for x in m if x.topic != IMU or x.arrival_ns > m[0].arrival_ns + 4 * NS),
    ],
    "a clock that is set by a month": lambda m: [
        stamped(x, stamp_of(x) + 30 * 86_400 * NS)
        if x.topic != "/tf_static" and x.arrival_ns > m[0].arrival_ns + 8 * NS
        else x
        for x in m
    ],
    "arrivals an hour back in the first second": lambda m: [
        x._replace(arrival_ns=x.arrival_ns - 3600 * NS)
        if x.arrival_ns > m[0].arrival_ns + NS
        else x
        for x in m
    ],
    "broken messages from the first on": lambda m: scrambled(m, 0.0),
    "broken messages later": lambda m: scrambled(m, 5.0),
    "times of sending before 1970": lambda m: [x._replace(sent_ns=-5) for x in m],
    "accelerations that are zero at first, and again later": lambda m: changed(
        m,
        IMU,
        lambda x, at_s: imu(x, 9.81 if at_s > 4 and int(at_s * 50) % 5 else 0.0),
    ),
    "beams that are counted from eight seconds on": lambda m: changed(
        m, DVL, lambda x, at_s: dvl(x, 4 * (at_s > 8))
    ),
    "an IMU that is unreadable at first": lambda m: changed(
        m, IMU, lambda x, at_s: x if at_s > 4 else x._replace(payload=x.payload[:30])
    ),
    "fixes on the Earth": lambda m: in_order(
        [*m, *(fix(at, i) for i, at in enumerate(doppler_stamps(m)))]
    ),
    "fixes that begin late": lambda m: in_order(
        [
            *m,
            *(
                fix(at, i, status=0 if i > 40 else -1)
                for i, at in enumerate(doppler_stamps(m))
            ),
        ]
    ),
    "a first fix that is late": lambda m: in_order(
        [*m]
        + [
            fix(at, i)._replace(arrival_ns=at + (3 * NS if i == 0 else 10_000_000))
            for i, at in enumerate(doppler_stamps(m))
        ]
    ),
    "a compass whose frame comes late": lambda m: in_order(
        [
            *m,
            *map(compass, doppler_stamps(m)),
            transform(m[0].arrival_ns + 5 * NS, "ahrs"),
        ]
    ),
    "other numbers of candidates": lambda m: in_order(
        without(m, DETECTIONS)
        + [
            detections(at + more, 1 + more % 3)
            for at in doppler_stamps(m)
            for more in (0, 7_000_000, 14_000_000)
        ]
    ),
}


OPTIONS = {
    "rotated axes": {
        "config": LogConfig.parse(
            {role: {"rotation": [10.0, 20.0, 30.0]} for role in MOTION}, "mine.toml"
        )
    },
    "a rate that is no short number": {"rate_hz": 100 / 3},
}


@pytest.mark.parametrize("case", [*CASES, *OPTIONS])
def test_a_record_gives_the_steps_that_were_live(tmp_path, messages, case):
    """Of thirteen seconds: the latest change is after twelve."""
    until_ns = messages[0].arrival_ns + 13 * NS
    come = [message for message in messages if message.arrival_ns < until_ns]
    come = CASES[case](come) if case in CASES else come
    options = OPTIONS.get(case, {})
    assert_record_equals(*live(tmp_path / "record.mcap", come, **options))


def test_a_velocity_of_beams_does_not_depend_on_other_pings():
    noise = np.random.default_rng(0)
    directions = noise.normal(size=(4, 3))
    along = noise.normal(size=(50, 4))
    valid = noise.random((50, 4)) < 0.9

    def velocities(rows):
        return velocity_of_beams(directions, along[rows], valid[rows], 0.01)[0]

    alone = [velocities([row]) for row in range(50)]
    assert velocities(range(50)).tobytes() == np.concatenate(alone).tobytes()


def number_of_detections(steps):
    return sum(len(step.detections) for step in steps if step.detections is not None)


def test_what_is_sound_of_a_late_sensor_is_used(tmp_path, messages):
    """Unreadable first messages neither end the run nor cost the sensor; its mounting counts too."""
    stamps_ns = enumerate(doppler_stamps(messages)[50:])
    late = [detections(at_ns, 2, is_sound=i > 3) for i, at_ns in stamps_ns]
    come = in_order(without(messages, DETECTIONS) + late)
    engine, steps = live(tmp_path / "record.mcap", come)
    assert_record_equals(engine, steps)
    assert engine.generation == 1
    assert number_of_detections(steps) > 50
    stated = small_world().calibration.sonar.mounting.translation_m
    assert engine.calibration.sonar.mounting.translation_m == pytest.approx(stated)


def test_a_late_sensor_that_cannot_be_used_is_named_and_costs_nothing(
    tmp_path, messages
):
    stamps_ns = enumerate(doppler_stamps(messages)[60:])
    late = [fix(at_ns, i, frame="gps") for i, at_ns in stamps_ns]
    frame = transform(messages[0].arrival_ns + 5 * NS, "gps", (0.0, 0.0, 0.0, 0.0))
    come = in_order([*messages, frame, *late])
    engine, steps = live(tmp_path / "record.mcap", come)
    assert_record_equals(engine, steps)
    assert engine.generation == 0
    assert len(steps) == 200
    (line,) = (one for one in engine.remarks if "/gps/fix is not used" in one)
    assert "quaternion" in line


def test_what_is_waited_for_is_said_once(tmp_path, messages):
    """A Doppler log without bottom lock at first."""
    come = changed(messages, DVL, lambda m, at_s: dvl(m, 4, int(at_s > 5)))
    engine, steps = live(tmp_path / "record.mcap", come)
    assert_record_equals(engine, steps)
    waits = [one for one in engine.remarks if "waiting:" in one]
    assert 1 <= sum("velocity_mode" in one for one in waits) <= 4
    assert not engine.waits_for


def test_detections_that_a_slow_estimator_missed_are_not_recorded(tmp_path, messages):
    """They are counted once, also where all began anew before, with a sensor that came late."""
    late_ns = messages[0].arrival_ns + 5 * NS
    path = tmp_path / "record.mcap"
    with LiveRecord(path) as record:
        engine = Engine(record, definition_of)
        for message in messages:
            if message.topic != "/depth/pose" or message.arrival_ns > late_ns:
                engine.take(message)
            for step in engine.steps() if engine.generation == 1 else ():
                for _ in range(2):  # a step is asked for again
                    left = engine.without_detections(step, message.arrival_ns)
                    assert left.detections is None
        for step in engine.finish():
            engine.without_detections(step, message.arrival_ns)
    dropped = dropped_messages(path)
    assert engine.counts.dropped == {(DETECTIONS, OVERLOADED): len(dropped)}
    assert len(dropped) >= 30
    assert read_log(path).detections is None


def test_rows_that_are_sound_count_beside_others_that_are_not(tmp_path, messages):
    """One range of two that is not a number does not cost the other."""
    six, nan = (struct.pack("<d", number) for number in (6.0, np.nan))
    whole = [detections(at, 1) for at in doppler_stamps(messages)]
    half = [m._replace(payload=m.payload.replace(six, nan)) for m in whole]
    come = in_order(without(messages, DETECTIONS) + half)
    engine, steps = live(tmp_path / "record.mcap", come)
    assert number_of_detections(steps) > 90
    assert_record_equals(engine, steps)


def test_a_topic_in_use_stays_so_when_all_begins_anew(tmp_path, messages):
    first_ns = messages[0].arrival_ns
    topics = {DETECTIONS: 9, DVL: 5}
    late = {
        topic: [
            m for m in messages if m.topic == topic and m.arrival_ns > first_ns + s * NS
        ]
        for topic, s in topics.items()
    }
    second = [m._replace(topic="/dvl2/data") for m in late[DVL]]
    come = in_order([*without(messages, DETECTIONS), *late[DETECTIONS], *second])
    engine, steps = live(tmp_path / "record.mcap", come)
    assert engine.generation == 1
    assert number_of_detections(steps) > 0
    assert_record_equals(engine, steps)
