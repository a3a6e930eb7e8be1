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

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from struct import Struct
from typing import Any, Protocol

import numpy as np

from sonar_graph.errors import LogError
from sonar_graph.live.foxglove_link import FoxgloveLink
from sonar_graph.live.predictor import Prediction
from sonar_graph.live.zenoh_link import Publisher, ZenohLink
from sonar_graph.logs import detection_messages, landmark_map_message, landmark_markers
from sonar_graph.logs.cdr import Decoder, definition, encode, parse_definition
from sonar_graph.measurements import NS_PER_S, Floats, LandmarkDetections
from sonar_graph.numerics import Mat6, compiled, mat, mat6, quaternion, store6
from sonar_graph.states import Estimate, LandmarkMap

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

    def __init__(
        self,
        type_name: str,
        values: Mapping[str, Any],
        lengths: Mapping[str, int] | None = None,
    ) -> None:
        struct = parse_definition(type_name, definition(type_name))
        encoded = encode(struct, 1, values, lengths)
        (messages,) = Decoder(struct).decode([(np.zeros(1, np.int64), encoded)]).groups
        self._bytes, self._layout = bytearray(encoded.tobytes()), messages.layout

    def stamp(self, path: str) -> Callable[[int, int], None]:
        """Function that writes seconds and nanoseconds of the stamp that is there."""
        return partial(
            Struct("<iI").pack_into, self._bytes, self._layout.column(path).starts[0]
        )

    def numbers(self, path: str, count: int) -> Floats:
        """Successive numbers from a field on, in place, shape (count,)."""
        return np.frombuffer(
            self._bytes, "<f8", count, self._layout.column(path).starts[0]
        )

    def payload(self) -> bytes:
        """The message as it is now."""
        return bytes(self._bytes)


@compiled
def write_pose(world_T_body: Floats, place: Floats) -> None:
    """Fill in position and quaternion, scalar last, shape (7,)."""
    v, w = quaternion(mat(world_T_body))
    scale = 1.0 / math.sqrt(v @ v + w * w)
    place[0], place[1], place[2] = (
        world_T_body[0, 3],
        world_T_body[1, 3],
        world_T_body[2, 3],
    )
    place[3], place[4], place[5], place[6] = (
        scale * v.x,
        scale * v.y,
        scale * v.z,
        scale * w,
    )


@compiled
def write_covariance(world_T_body: Floats, covariance: Floats, out: Floats) -> None:
    """Fill in the covariance as `body_to_ros` has it: of [position, rotation] along the world's axes, shape (6, 6)."""
    R, P = mat(world_T_body), mat6(covariance)
    store6(Mat6(R @ P.d @ R.T, R @ P.c @ R.T, R @ P.b @ R.T, R @ P.a @ R.T), out)


def payload_of_detections(
    detections: LandmarkDetections | None, stamp_ns: int
) -> bytes:
    """``LandmarkDetections`` of a sonar image, also of one without any."""
    if detections is not None:
        return detection_messages("", detections)[0].payloads[0].tobytes()
    seconds, nanoseconds = divmod(stamp_ns, NS_PER_S)
    struct = parse_definition(TOPICS[DETECTED], definition(TOPICS[DETECTED]))
    return encode(
        struct, 1, {"header.stamp.sec": seconds, "header.stamp.nanosec": nanoseconds}
    )[0].tobytes()


def payloads_of_map(landmarks: LandmarkMap, stamp_ns: int) -> tuple[bytes, bytes]:
    """``LandmarkMap`` and ``MarkerArray`` of a map."""
    markers = landmark_markers("", landmarks, stamp_ns, COLOUR, TEXT_HEIGHT_M)
    return landmark_map_message("", landmarks, stamp_ns).payloads[
        0
    ].tobytes(), markers.payloads[0].tobytes()


class PoseForm(Form):
    """A message with a stamp, a pose and its covariance."""

    def __init__(self, type_name: str, values: Mapping[str, Any]) -> None:
        super().__init__(type_name, {"header.frame_id": WORLD_FRAME, **values})
        self._stamp = self.stamp("header.stamp.sec")
        self._in_message, self._numbers = (
            self.numbers("pose.pose.position.x", 43),
            np.empty(43),
        )
        self._place, self._covariance = (
            self._numbers[:7],
            self._numbers[7:].reshape(6, 6),
        )

    def write(self, stamp_ns: int, world_T_body: Floats, covariance: Floats) -> None:
        """Write them; the covariance is known."""
        write_pose(world_T_body, self._place)
        write_covariance(world_T_body, covariance, self._covariance)
        self._stamp(*divmod(stamp_ns, NS_PER_S))
        # which numbers of a message are not aligned for
        self._in_message[:] = self._numbers


class FrameForm(Form):
    """``tf2_msgs/TFMessage`` of one frame in another."""

    def __init__(self, parent: str, child: str) -> None:
        names = {
            "transforms.header.frame_id": parent,
            "transforms.child_frame_id": child,
        }
        super().__init__(TF, names, {"transforms": 1})
        self._stamp = self.stamp("transforms.header.stamp.sec")
        self._in_message, self._place = (
            self.numbers("transforms.transform.translation.x", 7),
            np.empty(7),
        )

    def of(self, stamp_ns: int, pose: Floats) -> bytes:
        """The message at a stamp."""
        write_pose(pose, self._place)
        self._stamp(*divmod(stamp_ns, NS_PER_S))
        self._in_message[:] = self._place
        return self.payload()


class PoseForms:
    """Messages of predictions and estimates."""

    def __init__(self) -> None:
        self._odometry = PoseForm(ODOMETRY, {"child_frame_id": BODY_FRAME})
        self._velocity = self._odometry.numbers("twist.twist.linear.x", 3)
        self._estimate = PoseForm(TOPICS["/sonar_graph/pose"], {})
        self._correction, self._body = (
            FrameForm(WORLD_FRAME, ODOM_FRAME),
            FrameForm(ODOM_FRAME, BODY_FRAME),
        )

    def odometry(self, at: Prediction) -> bytes:
        """``nav_msgs/Odometry``."""
        self._odometry.write(at.stamp_ns, at.world_T_body, at.covariance)
        self._velocity[:] = at.velocity_m_s
        return self._odometry.payload()

    def estimate(self, at: Estimate) -> bytes:
        """``PoseWithCovarianceStamped``; zeros in place of a covariance that is not known."""
        covariance = np.ascontiguousarray(np.nan_to_num(at.covariance, nan=0.0))
        self._estimate.write(
            at.stamp_ns, np.ascontiguousarray(at.world_T_body.matrix()), covariance
        )
        return self._estimate.payload()

    def correction(self, stamp_ns: int, map_T_odom: Floats) -> bytes:
        """``tf2_msgs/TFMessage`` of ``odom`` in ``map``."""
        return self._correction.of(stamp_ns, map_T_odom)

    def body(self, at: Prediction) -> bytes:
        """``tf2_msgs/TFMessage`` of the body in ``odom``."""
        return self._body.of(at.stamp_ns, at.odom_T_body)


def payload_of_state(
    stamp_ns: int, is_well: bool, summary: str, values: Mapping[str, str]
) -> bytes:
    """``DiagnosticArray`` with one status."""
    seconds, nanoseconds = divmod(stamp_ns, NS_PER_S)
    said: dict[str, Any] = {
        "header.stamp.sec": seconds,
        "header.stamp.nanosec": nanoseconds,
    }
    said |= {
        "status.level": 0 if is_well else 1,
        "status.name": "sonar_graph",
        "status.message": summary,
    }
    said |= {
        "status.values.key": list(values),
        "status.values.value": list(values.values()),
    }
    struct = parse_definition(STATE, definition(STATE))
    return encode(struct, 1, said, {"status": 1, "status.values": len(values)})[
        0
    ].tobytes()


@dataclass
class Status:
    """Numbers of the line that the user sees each second; counts are those since the line before.

    Examples
    --------
    >>> Status().line(dropped=0, latency_ms=2.0, period_s=1.0)
    'no pose yet: it needs rows of IMU and Doppler log'
    """

    start_ns: int = 0
    """Stamp of the first prediction."""
    at: Prediction | None = None
    """Newest prediction."""
    predictions: int = 0
    estimates: int = 0
    landmarks: int = 0
    detected_ns: int = 0
    """Stamp of the newest frame with a detection; 0: none has come."""

    def predicted(self, at: Prediction) -> None:
        """Count a prediction."""
        self.start_ns = self.start_ns or at.stamp_ns
        self.at = at
        self.predictions += 1

    def line(self, *, dropped: int, latency_ms: float, period_s: float) -> str:
        """The line, and counts from zero again."""
        if self.at is None:
            return "no pose yet: it needs rows of IMU and Doppler log"
        world_R_body = self.at.world_T_body[:3, :3]
        of_position = world_R_body @ self.at.covariance[3:, 3:] @ world_R_body.T
        sigmas_m = np.sqrt(np.diag(of_position))  # (3,), along the world's axes
        place = ", ".join(
            f"{axis} {value:.2f} ± {sigma:.2f}"
            for axis, value, sigma in zip(
                "xyz", self.at.world_T_body[:3, 3], sigmas_m, strict=True
            )
        )
        age_s = (self.at.stamp_ns - self.detected_ns) / NS_PER_S
        seen = (
            f"last seen {age_s:.1f} s ago" if self.detected_ns else "no detection yet"
        )
        parts = [
            f"{(self.at.stamp_ns - self.start_ns) / NS_PER_S:.0f} s",
            f"{place} m",
            f"{self.predictions / period_s:.0f} poses/s, {self.estimates / period_s:.0f} estimates/s",
            f"{self.landmarks} landmarks, {seen}",
            f"{dropped} dropped",
            f"latency {latency_ms:.0f} ms",
        ]
        self.predictions = 0
        self.estimates = 0
        return " | ".join(parts)


class ZenohOutlet:
    """Topics of ROS 2 over zenoh."""

    def __init__(self, session: Any, domain: int) -> None:
        self._publishers = {
            topic: Publisher(session, domain, topic, kind, may_drop=True)
            for topic, kind in TOPICS.items()
        }

    def put(self, topic: str, payload: bytes) -> None:
        """Send one message."""
        self._publishers[topic].put(payload)


class FoxgloveOutlet:
    """Server for Foxglove and Lichtblick, on the loopback only."""

    def __init__(self, port: int) -> None:
        try:
            import foxglove
        except ImportError as error:
            raise LogError(
                "--foxglove needs foxglove-sdk: pip install 'sonar-graph[live]'"
            ) from error
        try:
            self._server = foxglove.start_server(
                name="sonar-graph", host="127.0.0.1", port=port
            )
        except RuntimeError as error:
            raise LogError(
                f"--foxglove {port}: cannot listen on 127.0.0.1:{port}: {error}; name another port"
            ) from error
        self._channels = {}
        for topic, kind in TOPICS.items():
            schema = foxglove.Schema(
                name=kind, encoding="ros2msg", data=definition(kind).encode()
            )
            self._channels[topic] = foxglove.Channel(
                topic, schema=schema, message_encoding="cdr"
            )

    def put(self, topic: str, payload: bytes) -> None:
        """Send one message."""
        self._channels[topic].log(payload)


Link = ZenohLink | FoxgloveLink


def open_link(endpoints: list[str], domain: int) -> Link:
    """Link to a foxglove_bridge (``ws://...``), or to zenoh routers; a LogError where none is there."""
    bridges = [one for one in endpoints if one.startswith(("ws://", "wss://"))]
    if bridges and len(endpoints) > 1:
        raise LogError(
            f"{bridges[0]}: a foxglove_bridge is connected to alone; name one endpoint"
        )
    return FoxgloveLink(bridges[0]) if bridges else ZenohLink(endpoints, domain)


def open_outlets(link: Link, foxglove_port: int | None) -> list[Outlet]:
    """Outlets over zenoh, if that is the link, and, with a port, for viewers."""
    outlets: list[Outlet] = (
        [ZenohOutlet(link.session, link.domain)] if isinstance(link, ZenohLink) else []
    )
    if foxglove_port is not None:
        outlets.append(FoxgloveOutlet(foxglove_port))
    return outlets
