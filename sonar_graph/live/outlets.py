"""Messages that a live run sends: poses, frames, landmarks and state.

=========================  ===================================================================================
``/sonar_graph/odometry``  ``nav_msgs/Odometry`` in ``map`` at the rate of the IMU, with covariance and velocity
``/tf``                    ``map`` to ``odom`` (jumps), ``odom`` to ``base_link`` (smooth, 50 a second): REP-105
``/sonar_graph/pose``      ``geometry_msgs/PoseWithCovarianceStamped``: the estimates themselves
``/sonar_graph/landmarks`` ``sonar_graph_msgs/LandmarkMap``
``/sonar_graph/markers``   ``visualization_msgs/MarkerArray``: the same for viewers, 95 % ellipsoids
``/sonar_graph/detections``  ``sonar_graph_msgs/LandmarkDetections`` of each sonar image that was recognised here
``/sonar_graph/state``     ``diagnostic_msgs/DiagnosticArray``: latency, queue, losses, what is withheld
=========================  ===================================================================================
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from struct import Struct
from typing import Any

import gtsam
import numpy as np

from sonar_graph.errors import LogError
from sonar_graph.live.foxglove_link import FoxgloveLink
from sonar_graph.live.predictor import Prediction
from sonar_graph.live.zenoh_link import Publisher, ZenohLink
from sonar_graph.logs import detection_messages, landmark_map_message, landmark_markers
from sonar_graph.logs.adapters import body_to_ros
from sonar_graph.logs.cdr import Decoder, definition, encode, parse_definition
from sonar_graph.measurements import NS_PER_S, Floats, LandmarkDetections
from sonar_graph.states import Estimate, LandmarkMap, counted

ODOMETRY = "nav_msgs/msg/Odometry"
TF = "tf2_msgs/msg/TFMessage"
MARKERS = "visualization_msgs/msg/MarkerArray"
STATE = "diagnostic_msgs/msg/DiagnosticArray"
DETECTED = "/sonar_graph/detections"
TOPICS = {
    "/sonar_graph/odometry": ODOMETRY,
    "/tf": TF,
    "/sonar_graph/pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "/sonar_graph/landmarks": "sonar_graph_msgs/msg/LandmarkMap",
    "/sonar_graph/markers": MARKERS,
    "/sonar_graph/state": STATE,
    DETECTED: "sonar_graph_msgs/msg/LandmarkDetections",
}
OWN = "/sonar_graph/"
WORLD_FRAME = "map"
ODOM_FRAME = "odom"
BODY_FRAME = "base_link"
STAMP = Struct("<iI")
"""Seconds and nanoseconds."""
COLOUR = (0.12, 0.47, 0.71, 0.9)
TEXT_HEIGHT_M = 0.15


Outlet = Callable[[str, bytes], None]
"""Sends one message of the topics in `TOPICS`."""


class Form:
    """A message of fixed layout whose stamp and numbers are replaced, since encoding a new one takes seven times as long.

    ``stamp`` and ``numbers`` are the paths of the seconds and of the first of the numbers, which follow each other.
    """

    def __init__(
        self,
        type_name: str,
        values: Mapping[str, Any],
        numbers: str = "pose.pose.position.x",
        stamp: str = "header.stamp.sec",
        lengths: Mapping[str, int] | None = None,
    ) -> None:
        struct = parse_definition(type_name, definition(type_name))
        encoded = encode(struct, 1, values, lengths)
        (messages,) = Decoder(struct).decode([(np.zeros(1, np.int64), encoded)]).groups
        self._bytes = bytearray(encoded.tobytes())
        self._stamp_at = messages.layout.column(stamp).starts[0]
        self._numbers_at = messages.layout.column(numbers).starts[0]

    def payload(self, stamp_ns: int, *numbers: Floats) -> bytes:
        """The message at a stamp."""
        STAMP.pack_into(self._bytes, self._stamp_at, *divmod(stamp_ns, NS_PER_S))
        # numbers in a message are not aligned, so that no array can be a view of them
        content = np.concatenate([part.ravel() for part in numbers]).tobytes()
        self._bytes[self._numbers_at : self._numbers_at + len(content)] = content
        return bytes(self._bytes)


def frame_form(parent: str, child: str) -> Form:
    """``tf2_msgs/TFMessage`` of one frame in another."""
    part = "transforms.header"
    names = {f"{part}.frame_id": parent, "transforms.child_frame_id": child}
    numbers = "transforms.transform.translation.x"
    return Form(TF, names, numbers, f"{part}.stamp.sec", {"transforms": 1})


def place(world_T_body: Floats) -> Floats:
    """Position and quaternion, scalar last, of a pose as a matrix, shape (7,)."""
    turn: Any = gtsam.Rot3(world_T_body[:3, :3]).toQuaternion()
    return np.concatenate([world_T_body[:3, 3], turn.coeffs()])


class PoseForms:
    """Messages of predictions and estimates."""

    def __init__(self) -> None:
        in_world = {"header.frame_id": WORLD_FRAME}
        self._odometry = Form(ODOMETRY, in_world | {"child_frame_id": BODY_FRAME})
        self._estimate = Form(TOPICS["/sonar_graph/pose"], in_world)
        self._correction = frame_form(WORLD_FRAME, ODOM_FRAME)
        self._body = frame_form(ODOM_FRAME, BODY_FRAME)

    def odometry(self, at: Prediction) -> bytes:
        """``nav_msgs/Odometry``."""
        T = at.world_T_body
        covariance = body_to_ros(at.covariance[None], T[None, :3, :3])
        # velocities follow the covariance of the pose
        return self._odometry.payload(
            at.stamp_ns, place(T), covariance, at.velocity_m_s
        )

    def estimate(self, at: Estimate) -> bytes:
        """``PoseWithCovarianceStamped``; zeros in place of a covariance that is not known."""
        T = at.world_T_body.matrix()
        covariance = body_to_ros(at.covariance[None], T[None, :3, :3])
        return self._estimate.payload(at.stamp_ns, place(T), covariance)

    def correction(self, stamp_ns: int, map_T_odom: Floats) -> bytes:
        """``tf2_msgs/TFMessage`` of ``odom`` in ``map``."""
        return self._correction.payload(stamp_ns, place(map_T_odom))

    def body(self, at: Prediction) -> bytes:
        """``tf2_msgs/TFMessage`` of the body in ``odom``."""
        return self._body.payload(at.stamp_ns, place(at.odom_T_body))


def encoded(
    kind: str, stamp_ns: int, values: Mapping[str, Any], lengths: Any = None
) -> bytes:
    """A message with a header."""
    seconds, nanoseconds = divmod(stamp_ns, NS_PER_S)
    stamp = {"header.stamp.sec": seconds, "header.stamp.nanosec": nanoseconds}
    struct = parse_definition(kind, definition(kind))
    return encode(struct, 1, {**stamp, **values}, lengths)[0].tobytes()


def payload_of_detections(
    detections: LandmarkDetections | None, stamp_ns: int
) -> bytes:
    """``LandmarkDetections`` of a sonar image, also of one without any."""
    if detections is not None:
        return detection_messages("", detections)[0].payloads[0].tobytes()
    return encoded(TOPICS[DETECTED], stamp_ns, {})


def payloads_of_map(landmarks: LandmarkMap, stamp_ns: int) -> tuple[bytes, bytes]:
    """``LandmarkMap`` and ``MarkerArray`` of a map."""
    in_map = landmark_map_message("", landmarks, stamp_ns)
    markers = landmark_markers("", landmarks, stamp_ns, COLOUR, TEXT_HEIGHT_M)
    return in_map.payloads[0].tobytes(), markers.payloads[0].tobytes()


def payload_of_state(
    stamp_ns: int, is_well: bool, summary: str, values: Mapping[str, str]
) -> bytes:
    """``DiagnosticArray`` with one status."""
    said = {
        "status.level": 0 if is_well else 1,
        "status.name": "sonar_graph",
        "status.message": summary,
        "status.values.key": list(values),
        "status.values.value": list(values.values()),
    }
    return encoded(STATE, stamp_ns, said, {"status": 1, "status.values": len(values)})


@dataclass
class Status:
    """Numbers of the line that the user sees each second; counts are those since the line before.

    Examples
    --------
    >>> Status().line(dropped=0, latency_ms=2.0, period_s=1.0)
    'no pose yet: it needs rows of IMU and Doppler log'
    >>> Status(withheld=("not yet located",)).line(dropped=0, latency_ms=2.0, period_s=1.0)
    'no pose yet: not yet located'
    """

    start_ns: int = 0
    """Stamp of the first prediction."""
    at: Prediction | None = None
    """Newest prediction."""
    newest_ns: int = 0
    """Stamp of the newest prediction since the estimator began."""
    predictions: int = 0
    estimates: int = 0
    landmarks: int = 0
    detected_ns: int = 0
    """Stamp of the newest frame with a detection; 0: none has come."""
    withheld: Collection[str] = ()
    """What the estimator could not use, in its own words."""
    last: str = ""
    """The line before."""

    def predicted(self, at: Prediction) -> None:
        """Count a prediction."""
        self.start_ns = self.start_ns or at.stamp_ns
        self.at = at
        self.newest_ns = at.stamp_ns
        self.predictions += 1

    def line(self, *, dropped: int, latency_ms: float, period_s: float) -> str:
        """The line, and counts from zero again; empty where it is the same as before, as after the end of a log."""
        line = self._line(dropped, latency_ms, period_s)
        self.predictions = 0
        self.estimates = 0
        if line == self.last:
            return ""
        self.last = line
        return line

    def _line(self, dropped: int, latency_ms: float, period_s: float) -> str:
        told = "; ".join(self.withheld)
        if self.at is None:
            return f"no pose yet: {told or 'it needs rows of IMU and Doppler log'}"
        T = self.at.world_T_body
        C = body_to_ros(self.at.covariance[None], T[None, :3, :3])[0]
        # of the position, along the world's axes
        sigmas_m = np.sqrt(np.diag(C)[:3])
        numbers = zip("xyz", T[:3, 3], sigmas_m, strict=True)
        place = ", ".join(f"{axis} {x:.2f} ± {sigma:.2f}" for axis, x, sigma in numbers)
        age_s = (self.at.stamp_ns - self.detected_ns) / NS_PER_S
        seen = (
            f"last seen {age_s:.1f} s ago" if self.detected_ns else "no detection yet"
        )
        parts = [
            f"{(self.at.stamp_ns - self.start_ns) / NS_PER_S:.0f} s",
            f"{place} m",
            f"{self.predictions / period_s:.0f} poses/s, {self.estimates / period_s:.0f} estimates/s",
            f"{counted(self.landmarks, 'landmark')}, {seen}",
            f"{dropped} dropped",
            f"latency {latency_ms:.0f} ms",
        ]
        return " | ".join(parts)


def zenoh_outlet(session: Any, domain: int) -> Outlet:
    """Topics of ROS 2 over zenoh."""
    publishers = {
        topic: Publisher(session, domain, topic, kind, may_drop=True)
        for topic, kind in TOPICS.items()
    }
    return lambda topic, payload: publishers[topic].put(payload)


def foxglove_outlet(port: int) -> Outlet:
    """Server for Foxglove and Lichtblick, on the loopback only."""
    try:
        import foxglove
    except ImportError as error:
        raise LogError(
            "--foxglove needs foxglove-sdk: pip install 'sonar-graph[live]'"
        ) from error
    try:
        server = foxglove.start_server(name="sonar-graph", host="127.0.0.1", port=port)
    except RuntimeError as error:
        raise LogError(
            f"--foxglove {port}: cannot listen on 127.0.0.1:{port}: {error}; name another port"
        ) from error
    channels = {}
    for topic, kind in TOPICS.items():
        data = definition(kind).encode()
        schema = foxglove.Schema(name=kind, encoding="ros2msg", data=data)
        channel = foxglove.Channel(topic, schema=schema, message_encoding="cdr")
        channels[topic] = channel

    def put(topic: str, payload: bytes, _server: object = server) -> None:
        # the server lives as long as this function
        channels[topic].log(payload)

    return put


Link = ZenohLink | FoxgloveLink


def open_link(endpoints: list[str], domain: int) -> Link:
    """Link to a foxglove_bridge (``ws://...``), or to zenoh routers; a LogError where it is not there."""
    bridges = [one for one in endpoints if one.startswith(("ws://", "wss://"))]
    if bridges and len(endpoints) > 1:
        raise LogError(
            f"{bridges[0]}: a foxglove_bridge is connected to alone; name one endpoint"
        )
    return FoxgloveLink(bridges[0]) if bridges else ZenohLink(endpoints, domain)


def open_outlets(link: Link, foxglove_port: int | None) -> list[Outlet]:
    """Outlets over zenoh, if that is the link, and, with a port, for viewers."""
    # a foxglove_bridge takes no messages back
    outlets = list[Outlet]()
    if isinstance(link, ZenohLink):
        outlets.append(zenoh_outlet(link.session, link.domain))
    if foxglove_port is not None:
        outlets.append(foxglove_outlet(foxglove_port))
    return outlets
