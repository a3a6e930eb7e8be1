"""Messages that a live run sends: poses, frames, landmarks and state.

=========================  ===================================================================================
``/sonar_graph/odometry``  ``nav_msgs/Odometry`` in ``map`` at the rate of the IMU, with covariance and velocity
``/tf``                    ``map`` to ``odom`` (jumps) and ``odom`` to ``base_link`` (smooth), as REP-105 has them
``/sonar_graph/pose``      ``geometry_msgs/PoseWithCovarianceStamped``: the estimates themselves
``/sonar_graph/landmarks`` ``sonar_graph_msgs/LandmarkMap``
``/sonar_graph/markers``   ``visualization_msgs/MarkerArray``: the same for viewers, 95 % ellipsoids
``/sonar_graph/detections``  ``sonar_graph_msgs/LandmarkDetections`` of each sonar image that was recognised here
``/sonar_graph/state``     ``diagnostic_msgs/DiagnosticArray``: latency, queue, losses, what is withheld
=========================  ===================================================================================
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import gtsam
import numpy as np

from sonar_graph.errors import LogError
from sonar_graph.live.foxglove_link import FoxgloveLink
from sonar_graph.live.predictor import Prediction
from sonar_graph.live.zenoh_link import Publisher, ZenohLink
from sonar_graph.logs import detection_messages, landmark_map_message, landmark_markers, pose_messages
from sonar_graph.logs.adapters import body_to_ros
from sonar_graph.logs.cdr import Bytes, Decoder, Messages, definition, encode, parse_definition
from sonar_graph.measurements import NS_PER_S, LandmarkDetections
from sonar_graph.states import Estimate, LandmarkMap, Trajectory

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
WORLD_FRAME, ODOM_FRAME, BODY_FRAME = "map", "odom", "base_link"
COLOUR = (0.12, 0.47, 0.71, 0.9)
TEXT_HEIGHT_M = 0.15


class Outlet(Protocol):
    """Something that sends messages of the topics in `TOPICS`."""

    def put(self, topic: str, payload: bytes) -> None:
        """Send one message."""


class Form:
    """A message of fixed layout whose numbers are replaced in place, since encoding anew takes ten times as long."""

    def __init__(self, type_name: str, values: Mapping[str, Any], lengths: Mapping[str, int] | None = None) -> None:
        struct = parse_definition(type_name, definition(type_name))
        self.bytes: Bytes = encode(struct, 1, values, lengths)
        (messages,) = Decoder(struct).decode([(np.zeros(1, np.int64), self.bytes)]).groups
        self._messages: Messages = messages
        self._views: dict[str, Any] = {}

    def __setitem__(self, path: str, value: Any) -> None:
        view = self._views.get(path)
        if view is None:
            view = self._views[path] = self._messages[path]
            assert np.shares_memory(view, self.bytes)
        view[...] = value


def quaternion_xyzw(pose: gtsam.Pose3) -> tuple[float, float, float, float]:
    """Quaternion of a pose, scalar last."""
    q: Any = pose.rotation().toQuaternion()
    return q.x(), q.y(), q.z(), q.w()


def payload_of_pose(estimate: Estimate) -> bytes:
    """``PoseWithCovarianceStamped`` of an estimate."""
    entry = pose_messages("", Trajectory.from_estimates([estimate]))
    return entry.payloads[0].tobytes()


def payload_of_detections(detections: LandmarkDetections | None, stamp_ns: int) -> bytes:
    """``LandmarkDetections`` of a sonar image, also of one without any."""
    if detections is not None:
        return detection_messages("", detections)[0].payloads[0].tobytes()
    seconds, nanoseconds = divmod(stamp_ns, NS_PER_S)
    struct = parse_definition(TOPICS[DETECTED], definition(TOPICS[DETECTED]))
    return encode(struct, 1, {"header.stamp.sec": seconds, "header.stamp.nanosec": nanoseconds})[0].tobytes()


def payloads_of_map(landmarks: LandmarkMap, stamp_ns: int) -> tuple[bytes, bytes]:
    """``LandmarkMap`` and ``MarkerArray`` of a map."""
    markers = landmark_markers("", landmarks, stamp_ns, COLOUR, TEXT_HEIGHT_M)
    return landmark_map_message("", landmarks, stamp_ns).payloads[0].tobytes(), markers.payloads[0].tobytes()


class PoseForms:
    """Messages of predictions."""

    def __init__(self) -> None:
        self._odometry = Form(ODOMETRY, {"header.frame_id": WORLD_FRAME, "child_frame_id": BODY_FRAME})
        self._frames = [
            Form(
                TF,
                {"transforms.header.frame_id": parent, "transforms.child_frame_id": child},
                {"transforms": 1},
            )
            for parent, child in ((WORLD_FRAME, ODOM_FRAME), (ODOM_FRAME, BODY_FRAME))
        ]

    def odometry(self, at: Prediction) -> bytes:
        """``nav_msgs/Odometry``."""
        R = at.world_T_body.rotation().matrix()
        form = self._odometry
        form["header.stamp.sec"], form["header.stamp.nanosec"] = divmod(at.stamp_ns, NS_PER_S)
        numbers = [*at.world_T_body.translation(), *quaternion_xyzw(at.world_T_body)]
        for path, value in zip(_POSE, numbers, strict=True):
            form[path] = value
        form["pose.covariance"] = body_to_ros(at.covariance[None], R[None]).reshape(36)
        for axis, value in zip("xyz", at.velocity_m_s, strict=True):
            form[f"twist.twist.linear.{axis}"] = value
        return form.bytes.tobytes()

    def correction(self, stamp_ns: int, map_T_odom: gtsam.Pose3) -> bytes:
        """``tf2_msgs/TFMessage`` of ``odom`` in ``map``."""
        return _frame(self._frames[0], stamp_ns, map_T_odom)

    def body(self, at: Prediction) -> bytes:
        """``tf2_msgs/TFMessage`` of the body in ``odom``."""
        return _frame(self._frames[1], at.stamp_ns, at.odom_T_body)


def _frame(form: Form, stamp_ns: int, pose: gtsam.Pose3) -> bytes:
    form["transforms.header.stamp.sec"], form["transforms.header.stamp.nanosec"] = divmod(stamp_ns, NS_PER_S)
    for axis, value in zip("xyz", pose.translation(), strict=True):
        form[f"transforms.transform.translation.{axis}"] = value
    for axis, value in zip("xyzw", quaternion_xyzw(pose), strict=True):
        form[f"transforms.transform.rotation.{axis}"] = value
    return form.bytes.tobytes()


def payload_of_state(stamp_ns: int, is_well: bool, summary: str, values: Mapping[str, str]) -> bytes:
    """``DiagnosticArray`` with one status."""
    seconds, nanoseconds = divmod(stamp_ns, NS_PER_S)
    said: dict[str, Any] = {"header.stamp.sec": seconds, "header.stamp.nanosec": nanoseconds}
    said |= {"status.level": 0 if is_well else 1, "status.name": "sonar_graph", "status.message": summary}
    said |= {"status.values.key": list(values), "status.values.value": list(values.values())}
    struct = parse_definition(STATE, definition(STATE))
    return encode(struct, 1, said, {"status": 1, "status.values": len(values)})[0].tobytes()


_POSE = [f"pose.pose.position.{axis}" for axis in "xyz"] + [f"pose.pose.orientation.{axis}" for axis in "xyzw"]


class ZenohOutlet:
    """Topics of ROS 2 over zenoh."""

    def __init__(self, session: Any, domain: int) -> None:
        self._publishers = {topic: Publisher(session, domain, topic, kind) for topic, kind in TOPICS.items()}

    def put(self, topic: str, payload: bytes) -> None:
        """Send one message."""
        self._publishers[topic].put(payload)


class FoxgloveOutlet:
    """Server for Foxglove and Lichtblick, on the loopback only."""

    def __init__(self, port: int) -> None:
        try:
            import foxglove
        except ImportError as error:
            raise LogError("--foxglove needs foxglove-sdk: pip install 'sonar-graph[live]'") from error
        try:
            self._server = foxglove.start_server(name="sonar-graph", host="127.0.0.1", port=port)
        except RuntimeError as error:
            raise LogError(
                f"--foxglove {port}: cannot listen on 127.0.0.1:{port}: {error}; name another port"
            ) from error
        self._channels = {}
        for topic, kind in TOPICS.items():
            schema = foxglove.Schema(name=kind, encoding="ros2msg", data=definition(kind).encode())
            self._channels[topic] = foxglove.Channel(topic, schema=schema, message_encoding="cdr")

    def put(self, topic: str, payload: bytes) -> None:
        """Send one message."""
        self._channels[topic].log(payload)


Link = ZenohLink | FoxgloveLink


def open_link(endpoints: list[str], domain: int) -> Link:
    """Link to a foxglove_bridge (``ws://...``), or to zenoh routers; a LogError where none is there."""
    bridges = [one for one in endpoints if one.startswith(("ws://", "wss://"))]
    if bridges and len(endpoints) > 1:
        raise LogError(f"{bridges[0]}: a foxglove_bridge is connected to alone; name one endpoint")
    return FoxgloveLink(bridges[0]) if bridges else ZenohLink(endpoints, domain)


def open_outlets(link: Link, foxglove_port: int | None) -> list[Outlet]:
    """Outlets over zenoh, if that is the link, and, with a port, for viewers."""
    outlets: list[Outlet] = [ZenohOutlet(link.session, link.domain)] if isinstance(link, ZenohLink) else []
    if foxglove_port is not None:
        outlets.append(FoxgloveOutlet(foxglove_port))
    return outlets
