"""ROS 2 topics over zenoh, in the form of rmw_zenoh: no ROS installation is needed.

    key         <domain>/<topic>/<package>::msg::dds_::<Name>_/<type hash>
    payload     the CDR of the message, as MCAP stores it
    attachment  int64 sequence number, int64 time of sending (ns), length and 16 bytes of the sender's identity

The sequence number counts losses. Type hashes (RIHS01) and definitions of standard types are those of rosbags. Source:
design page of rmw_zenoh, and its attachments since version 0.2.4.
"""

from __future__ import annotations

import json
import os
import struct
import time
from collections.abc import Callable, Iterable
from functools import lru_cache
from typing import Any, Self

from sonar_graph.errors import LogError
from sonar_graph.live.live_messages import Message
from sonar_graph.logs.cdr import DEFINITIONS, definition, short_name

ATTACHMENT = struct.Struct("<qqB16s")
DEFAULT_ROUTER = "tcp/localhost:7447"


def topic_key(domain: int, topic: str, type_name: str, type_hash: str) -> str:
    """Key of a topic: ``0/imu/data/sensor_msgs::msg::dds_::Imu_/RIHS01_...``."""
    package, _, name = short_name(type_name).partition("/")
    return f"{domain}/{topic.strip('/')}/{package}::msg::dds_::{name}_/{type_hash}"


@lru_cache(maxsize=1024)
def parse_key(key: str) -> tuple[str, str] | None:
    """Topic and type of a key; None for what is no topic of ROS 2."""
    _, _, rest = key.partition("/")
    topic, _, dds_name = rest.rpartition("/")[0].rpartition("/")
    package, middle, name = dds_name.partition("::msg::dds_::")
    if not (topic and middle and name.endswith("_")):
        return None
    return f"/{topic}", f"{package}/msg/{name[:-1]}"


@lru_cache
def _types() -> Any:
    """Types of ROS 2 Jazzy, and those that this package writes."""
    try:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError as error:
        raise LogError("live needs rosbags: pip install 'sonar-graph[live]'") from error
    store = get_typestore(Stores.ROS2_JAZZY)
    # drivers and this package have types that are not of the distribution
    for name, text in DEFINITIONS.items():
        full = name.replace("/", "/msg/")
        if full not in store.types:
            store.register(get_types_from_msg(text, full))
    return store


def type_hash(type_name: str) -> str:
    """Hash of a message type (RIHS01) by which subscribers find it."""
    found: str = _types().hash_rihs01(type_name)
    return found


def definition_of(type_name: str) -> str:
    """Definition of a type as MCAP stores it; a LogError for one that is not known."""
    if short_name(type_name) in DEFINITIONS:
        return definition(type_name)
    try:
        text, _ = _types().generate_msgdef(type_name, ros_version=2)
    except KeyError as error:
        raise LogError(
            f"the definition of {type_name} is not known, and zenoh does not send it: use foxglove_bridge"
        ) from error
    found: str = text
    return found


def open_session(connect: Iterable[str] = (), listen: Iterable[str] = ()) -> Any:
    """Session of zenoh: a client of a router, or with ``listen`` the router itself; nothing else is opened.

    A LogError where the package is missing or the address cannot be reached.
    """
    try:
        import zenoh
    except ImportError as error:
        raise LogError("live needs zenoh: pip install 'sonar-graph[live]'") from error
    config = zenoh.Config()
    connect = list(connect)
    listen = list(listen)
    where = ", ".join([*connect, *listen])
    settings = {
        "mode": "router" if listen else "client",
        "connect/endpoints": connect,
        "listen/endpoints": listen,
        "timestamping/enabled": True,  # by which latched messages are kept
        "scouting/multicast/enabled": False,  # no other machine is looked for
        "scouting/gossip/enabled": False,
    }
    try:
        for key, value in settings.items():
            config.insert_json5(key, json.dumps(value))
    except zenoh.ZError as error:
        raise LogError(
            f"{where}: no endpoint of zenoh; expected one such as {DEFAULT_ROUTER}"
        ) from error
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        fault = "connect: is a router (rmw_zenohd) or `sonar-graph play` there?"
        if listen:
            fault = "listen: is the port taken? name another"
        raise LogError(f"{where}: zenoh cannot {fault}") from error


def subscribe(
    session: Any,
    domain: int,
    received: Callable[[Message], None],
    is_wanted: Callable[[str, str], bool] = lambda *_: True,
) -> Any:
    """Give the wanted messages of a domain to a function that returns at once: zenoh's own thread calls it.

    Latched transforms that were sent before are given too. What is returned keeps the subscription.
    """
    import zenoh.ext

    def take(sample: Any) -> None:
        arrival_ns = time.time_ns()
        found = parse_key(str(sample.key_expr))
        if found is None or not is_wanted(*found):
            return
        message = Message(*found, sample.payload.to_bytes(), arrival_ns)
        data = b"" if sample.attachment is None else sample.attachment.to_bytes()
        # other publishers of zenoh attach nothing, or something else
        if len(data) >= ATTACHMENT.size:
            sequence, sent_ns, _, sender = ATTACHMENT.unpack_from(data)
            message = message._replace(
                sequence=sequence, sent_ns=sent_ns, sender=sender
            )
        received(message)

    def take_latched(sample: Any) -> None:
        content = (str(sample.key_expr), sample.payload.to_bytes())
        # what was kept by several senders comes several times
        if content not in latched:
            latched.add(content)
            take(sample)

    latched: set[tuple[str, bytes]] = set()
    # what this program publishes itself is not received
    remote = zenoh.Locality.REMOTE
    kept = zenoh.ext.declare_advanced_subscriber(
        session,
        f"{domain}/tf_static/**",
        take_latched,
        allowed_origin=remote,
        history=zenoh.ext.HistoryConfig(detect_late_publishers=True),
    )
    others = session.declare_subscriber(
        f"{domain}/**",
        lambda s: None if "/tf_static/" in str(s.key_expr) else take(s),
        allowed_origin=remote,
    )
    return kept, others


class Publisher:
    """Publisher of one topic.

    ``may_drop``: a subscriber that stalls misses messages, instead of holding up everybody.
    """

    def __init__(
        self,
        session: Any,
        domain: int,
        topic: str,
        type_name: str,
        *,
        may_drop: bool = False,
    ) -> None:
        import zenoh.ext

        key = topic_key(domain, topic, type_name, type_hash(type_name))
        control = (
            zenoh.CongestionControl.DROP if may_drop else zenoh.CongestionControl.BLOCK
        )
        if topic.endswith("_static"):  # for subscribers that come later
            self._publisher: Any = zenoh.ext.declare_advanced_publisher(
                session,
                key,
                congestion_control=control,
                cache=zenoh.ext.CacheConfig(max_samples=1),
                publisher_detection=True,
            )
        else:
            self._publisher = session.declare_publisher(
                key, congestion_control=control, express=True
            )
        self._sender = os.urandom(16)
        self._sequence = 0

    @property
    def is_heard(self) -> bool:
        """True while anybody subscribes to it; False for static frames: zenoh does not report their subscribers."""
        status = getattr(self._publisher, "matching_status", None)
        return status is not None and bool(status.matching)

    def put(self, payload: bytes) -> None:
        """Send one message."""
        self._sequence += 1
        self._publisher.put(
            payload,
            attachment=ATTACHMENT.pack(
                self._sequence, time.time_ns(), 16, self._sender
            ),
        )


class ZenohLink:
    """Topics of a domain by a router."""

    def __init__(self, connect: Iterable[str], domain: int) -> None:
        self.session = open_session(connect)
        self.domain = domain
        self._subscriptions: tuple[Any, ...] = ()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.session.close()

    def definition_of(self, type_name: str) -> str:
        """Definition of a type."""
        return definition_of(type_name)

    def listen(
        self, received: Callable[[Message], None], is_wanted: Callable[[str, str], bool]
    ) -> None:
        """Begin to give messages of the topics that are wanted, by name and type, to a function of zenoh's thread."""
        self._subscriptions = subscribe(self.session, self.domain, received, is_wanted)

    def stop(self) -> None:
        """End that."""
        for one in self._subscriptions:
            one.undeclare()
