"""ROS 2 topics from a foxglove_bridge, which exists for every distribution and middleware.

A message is an opcode (1), the number of the subscription (uint32), a time (uint64, ns), and the CDR of the message;
definitions come with the advertised channels. There are no sequence numbers: what the bridge drops for a slow client is
not counted. Source of the form: the Foxglove WebSocket protocol, version 1.
"""

from __future__ import annotations

import json
import struct
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from typing import Any, Self

from sonar_graph.errors import LogError
from sonar_graph.live.live_messages import Message
from sonar_graph.live.zenoh_link import definition_of

SUBPROTOCOLS = ["foxglove.sdk.v1", "foxglove.websocket.v1"]
HEAD = struct.Struct("<BIQ")
MESSAGE_DATA = 1
RETRY_S = 1.0
MOST_BYTES = 1 << 26
"""Size of a message beyond which the connection is refused."""


class FoxgloveLink:
    """Client of a foxglove_bridge; a connection that breaks is made again.

    Parameters
    ----------
    url
        Such as ``ws://robot:8765``.
    """

    def __init__(self, url: str) -> None:
        self.breaks = 0
        """Number of times that the connection broke."""
        self._url = url
        self._definitions: dict[str, str] = {}
        self._is_ended = threading.Event()
        self._open = ExitStack()
        self._thread: threading.Thread | None = None
        self._socket = self._connected()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def definition_of(self, type_name: str) -> str:
        """Definition that the bridge advertised for a type, or that of ROS 2."""
        return self._definitions.get(type_name) or definition_of(type_name)

    def listen(
        self, received: Callable[[Message], None], is_wanted: Callable[[str, str], bool]
    ) -> None:
        """Begin to give messages of the topics that are wanted, by name and type, to a function of a thread."""
        self._thread = threading.Thread(
            target=self._work, args=(received, is_wanted), daemon=True
        )
        self._thread.start()

    def stop(self) -> None:
        """End the connection."""
        self._is_ended.set()
        self._open.close()
        if self._thread is not None:
            self._thread.join(2.0 * RETRY_S)

    def _connected(self) -> Any:
        try:
            from websockets.exceptions import WebSocketException
            from websockets.sync.client import connect
        except ImportError as error:
            raise LogError(
                "ws:// needs websockets: pip install 'sonar-graph[live]'"
            ) from error
        try:
            options: dict[str, Any] = {
                "subprotocols": SUBPROTOCOLS,
                "max_size": MOST_BYTES,
                "compression": None,
            }
            return self._open.enter_context(connect(self._url, **options))
        except (OSError, WebSocketException, ValueError) as error:
            raise LogError(
                f"{self._url}: cannot connect: is a foxglove_bridge there? {error}"
            ) from error

    def _work(
        self, received: Callable[[Message], None], is_wanted: Callable[[str, str], bool]
    ) -> None:
        from websockets.exceptions import ConnectionClosed

        while not self._is_ended.is_set():
            # a robot's radio breaks off now and then
            with suppress(ConnectionClosed):
                self._pass_on(received, is_wanted)
            self.breaks += not self._is_ended.is_set()
            self._open.close()
            while not self._is_ended.wait(RETRY_S):
                try:
                    self._socket = self._connected()
                    break
                except LogError:
                    continue

    def _pass_on(
        self, received: Callable[[Message], None], is_wanted: Callable[[str, str], bool]
    ) -> None:
        topics: dict[int, tuple[str, str]] = {}
        for data in self._socket:
            if isinstance(data, str):
                said = json.loads(data)
                is_offer = said.get("op") == "advertise"
                subscriptions = []
                for channel in said["channels"] if is_offer else ():
                    name = (channel["topic"], channel["schemaName"])
                    if channel["encoding"] != "cdr" or not is_wanted(*name):
                        continue
                    number = channel["id"]
                    topics[number] = name
                    subscriptions.append({"id": number, "channelId": number})
                    # IDL is not read: the definition of ROS 2 is taken then
                    if channel.get("schemaEncoding") in (None, "ros2msg"):
                        self._definitions[name[1]] = channel["schema"]
                if subscriptions:
                    wish = {"op": "subscribe", "subscriptions": subscriptions}
                    self._socket.send(json.dumps(wish))
            # other opcodes are of services and parameters
            elif len(data) >= HEAD.size and data[0] == MESSAGE_DATA:
                _, number, sent_ns = HEAD.unpack_from(data)
                if number in topics:
                    payload = data[HEAD.size :]
                    now_ns = time.time_ns()
                    received(Message(*topics[number], payload, now_ns, 0, sent_ns))
