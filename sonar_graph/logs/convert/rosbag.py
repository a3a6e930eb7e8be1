"""ROS 1 bags, ROS 1 messages in MCAP, and the sqlite3 bags of ROS 2 as MCAP logs, through the rosbags library.

Every topic is converted. Payloads become CDR. Types get the definition of ROS 2 Jazzy where it has them, with fields
mapped where the two differ, and otherwise the definition in the bag. Stamps, in messages and of recording, stay the
same to the nanosecond.
"""

from __future__ import annotations

import bz2
import os
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from importlib import import_module
from itertools import islice
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, BinaryIO

import lz4.frame

from sonar_graph.errors import LogError, SonarGraphError
from sonar_graph.files import regular, written_whole
from sonar_graph.logs.cdr import DRIVER_DEFINITIONS
from sonar_graph.logs.mcap import (
    ALREADY_MCAP,
    LARGEST_BYTES,
    LARGEST_RATIO,
    START_BYTES,
    LogWriter,
    Progress,
    SchemaText,
    latched,
    why_no_bag,
)

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader
    from rosbags.interfaces import Connection
    from rosbags.interfaces.typing import Typesdict
    from rosbags.typesys.store import Typestore


_RENAMED = {"tf/msg/tfMessage": "tf2_msgs/msg/TFMessage"}
_PIECE_BYTES = 1 << 20
_METADATA = "metadata.yaml"
# that of rosbags
_ZSTD = "compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd"
_STEPS = 1000
_MOST_TRIED = 5
"""Messages with which a definition is tried."""
_INSTALL = "pip install 'sonar-graph[rosbag]'"
Recode = Callable[[bytes], memoryview]


@dataclass
class BagConversion:
    """Result of the conversion of a bag."""

    topics: int
    messages: int = 0
    duration_s: float = 0.0
    left_out: dict[str, str] = field(default_factory=dict)
    """Topics without some or all of their messages, with the reason."""

    @property
    def content(self) -> str:
        """Duration and counts."""
        return (
            f"{self.duration_s:.1f} s, {self.messages} messages on {self.topics} topics"
        )

    def shortcomings(self, most: int | None = None) -> list[str]:  # noqa: ARG002
        """Lines about all topics that are left out."""
        return [
            f"left out: {topic}: {reason}" for topic, reason in self.left_out.items()
        ]


def convert_rosbag(
    source: Path,
    output: Path,
    progress: Progress | None = None,
    definitions: Path | None = None,
) -> BagConversion:
    """Write an MCAP log of a whole bag; an existing file is replaced only when the new one is complete.

    Parameters
    ----------
    source
        A ROS 1 ``.bag``; the folder of a ROS 2 bag, or the ``.db3`` file in it; an MCAP file of ROS 1 messages.
    output
        The MCAP file.
    progress
        Called now and then with the number of messages done and in all.
    definitions
        Folder with ``package/msg/Type.msg`` files, for types that neither the bag nor `DRIVER_DEFINITIONS` has.

    Raises
    ------
    LogError
        When the rosbags library is not installed, the bag cannot be read, or the log cannot be written.
    """
    with _open_bag(Path(source)) as bag, written_whole(output) as stream:
        _define(bag, _own_definitions(definitions) if definitions else {})
        return _copy(bag, LogWriter(stream), progress)


@contextmanager
def _open_bag(source: Path) -> Iterator[AnyReader | Ros1InMcap]:
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.rosbag1 import reader as rosbag1
        from rosbags.rosbag2 import reader as rosbag2
        from rosbags.rosbag2 import storage_mcap
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise LogError(
            f"{source}: bags are read by the rosbags library, which is not installed: {_INSTALL}"
        ) from error
    # its own have no limit
    rosbag1.decompressors.update(bz2=limited_bz2, lz4=limited_lz4)
    storage_mcap.DECOMPRESSORS.update(
        lz4=lambda one, _: limited_lz4(one), zstd=lambda one, _: limited_zstd(one)
    )
    vars(rosbag2).update(
        zstd=SimpleNamespace(open=limited_zstd_file, decompress=limited_zstd)
    )
    path = source
    if source.suffix == ".db3" and (source.parent / _METADATA).exists():
        path = source.parent
    parts = path.iterdir() if path.is_dir() else ()
    try:
        # a pipe or a device among the files would block the library
        for part in [source, *parts]:
            regular(part)
    except OSError as error:
        raise LogError(f"{error.filename} cannot be read: {error.strerror}") from error
    is_mcap = source.is_file() and source.suffix == ".mcap"
    if source.is_file() and not is_mcap:
        with source.open("rb") as stream:
            fault = why_no_bag(source, stream.read(START_BYTES))
        if fault is not None:
            raise LogError(f"{source} is {fault}")
    try:
        if is_mcap:
            with source.open("rb") as stream:
                yield Ros1InMcap(stream, source)
            return
        # types of bags that do not define them, as those of Humble and before
        typestore = get_typestore(Stores.ROS2_JAZZY)
        with AnyReader([path], default_typestore=typestore) as bag:
            yield bag
    except SonarGraphError:
        raise
    except Exception as error:  # the library raises whatever its parts raise
        # of the log, such as a full disk
        if isinstance(error, OSError) and not isinstance(error, FileNotFoundError):
            raise
        advice = _ADVICE.get(source.suffix, _ADVICE[""])
        raise LogError(
            f"{source} cannot be read as a bag: {error}; {advice}"
        ) from error


_ADVICE = {
    ".bag": "of one that was not closed `rosbag reindex` makes a whole one",
    ".db3": "give the folder with the .db3 file and its metadata.yaml (`ros2 bag reindex` makes one)",
    "": "give a ROS 1 .bag, or the folder of a ROS 2 bag with its metadata.yaml",
}
"""What to do about a bag that cannot be read, by the end of its name."""


def limited_bz2(packed: bytes) -> bytes:
    """Content of a bz2 chunk; a LogError where it is cut off or has more than `LARGEST_BYTES`."""
    return _unpacked(bz2.BZ2Decompressor(), packed)


def limited_lz4(packed: bytes) -> bytes:
    """Content of an lz4 chunk; a LogError as of `limited_bz2`."""
    return _unpacked(lz4.frame.LZ4FrameDecompressor(), packed)


def limited_zstd(packed: bytes) -> bytes:
    """Content of a zstd chunk or message; a LogError as of `limited_bz2`."""
    return _unpacked(import_module(_ZSTD).ZstdDecompressor(), packed)


def _unpacked(chunk: Any, packed: bytes) -> bytes:
    content = bytearray()
    # in pieces: the decompressor of lz4 reserves as much memory as it is allowed to fill
    while not chunk.eof and len(content) <= LARGEST_BYTES:
        part = chunk.decompress(packed, _PIECE_BYTES)
        if not part and chunk.needs_input:
            break
        content += part
        # the decompressor keeps what it has not used
        packed = b""
    if len(content) > LARGEST_BYTES:
        raise LogError(
            f"a chunk of the bag has more than {LARGEST_BYTES} bytes, which is too much at once: `rosbag decompress` "
            "and `rosbag filter`, or `ros2 bag convert`, write smaller chunks"
        )
    if not chunk.eof:
        raise LogError("a chunk is cut off")
    return bytes(content)


@contextmanager
def limited_zstd_file(packed: BinaryIO, mode: str) -> Iterator[SimpleNamespace]:
    """Open a compressed file of a bag; a LogError where it unpacks to far more than a recording of its size does."""
    size = os.fstat(packed.fileno()).st_size
    unpacked = 0
    most = max(LARGEST_BYTES, size * LARGEST_RATIO)
    with import_module(_ZSTD).open(packed, mode) as stream:

        def read(count: int) -> bytes:
            nonlocal unpacked
            piece: bytes = stream.read(count)
            unpacked += len(piece)
            if unpacked > most:
                raise LogError(
                    f"{packed.name}: its {size} bytes unpack to more than {most}, as no recording's do; where it is "
                    "sound, unpack it with `zstd -d` into a folder of its own, and give the file there"
                )
            return piece

        yield SimpleNamespace(read=read)


def _own_definitions(folder: Path) -> dict[str, str]:
    """Texts of the ``package/msg/Type.msg`` files in a folder, by type; a LogError without any."""
    found = {}
    for file in sorted(folder.rglob("*.msg")):
        package = file.parent.parent if file.parent.name == "msg" else file.parent
        found[f"{package.name}/msg/{file.stem}"] = file.read_text(encoding="utf-8")
    if not found:
        raise LogError(
            f"{folder}: holds no .msg files; give the folder with package/msg/Type.msg"
        )
    return found


def _define(bag: AnyReader | Ros1InMcap, own: dict[str, str]) -> None:
    """Add definitions of types that a bag has not: those of a user, or else known ones that fit the first messages."""
    from rosbags.typesys import get_types_from_msg

    store = bag.typestore
    of_bag = set(store.fielddefs)
    for name, text in own.items():
        if name not in of_bag:
            store.register(get_types_from_msg(text, name))
    for connection in bag.connections:
        kind = connection.msgtype
        # a bag of ROS 1 defines its types itself
        if kind in store.fielddefs or not bag.is2:
            continue
        messages = bag.messages(connections=[connection])
        firsts = [raw for _, _, raw in islice(messages, _MOST_TRIED)]
        # versions of a driver differ in their fields: the first that fits counts
        for text in DRIVER_DEFINITIONS.get(kind, ()):
            types = get_types_from_msg(text, kind)
            if all(_follows(store, types, kind, raw) for raw in firsts):
                _add_types(store, types)
                break


def _add_types(store: Typestore, types: Typesdict) -> None:
    """Add the types that a store does not define."""
    known = store.fielddefs
    store.register({name: t for name, t in types.items() if name not in known})


def _follows(store: Typestore, types: Typesdict, kind: str, payload: bytes) -> bool:
    """True where a payload is a message of a type by these definitions."""
    from rosbags.serde import SerdeError
    from rosbags.typesys import Stores, get_typestore

    trial = get_typestore(Stores.EMPTY)
    trial.register({**types, **store.fielddefs})
    try:
        trial.deserialize_cdr(payload, kind)
    except (SerdeError, AssertionError):
        return False
    return True


class Ros1InMcap:
    """ROS 1 messages of an MCAP file, in the form in which `AnyReader` gives those of a bag."""

    is2 = False

    def __init__(self, stream: BinaryIO, path: Path) -> None:
        from mcap.reader import make_reader
        from rosbags.interfaces import (
            Connection,
            ConnectionExtRosbag1,
            MessageDefinition,
            MessageDefinitionFormat,
        )
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self._reader = make_reader(stream)
        try:
            summary = self._reader.get_summary()
        except Exception:  # the reader raises whatever its parts raise
            summary = None
        if summary is None or summary.statistics is None:
            raise LogError(
                f"{path} is {ALREADY_MCAP}`sonar-graph inspect {path}`; where it has ROS 1 messages, "
                "`mcap recover` first writes the summary that it lacks"
            )
        every = summary.channels.items()
        channels = {k: one for k, one in every if one.message_encoding == "ros1"}
        if not channels:
            raise LogError(f"{path} is {ALREADY_MCAP}`sonar-graph inspect {path}`")
        self.typestore = get_typestore(Stores.EMPTY)
        self.connections: list[Connection] = []
        statistics = summary.statistics
        counts = statistics.channel_message_counts
        self.duration = statistics.message_end_time - statistics.message_start_time
        for number, channel in channels.items():
            schema = summary.schemas[channel.schema_id]
            kind = schema.name
            if "/msg/" not in kind:
                kind = kind.replace("/", "/msg/")
            text = schema.data.decode()
            self.typestore.register(get_types_from_msg(text, kind))
            self.connections.append(
                Connection(
                    number,
                    channel.topic,
                    kind,
                    MessageDefinition(MessageDefinitionFormat.MSG, text),
                    # the sum over the definition, which nothing here needs
                    "",
                    counts.get(number, 0),
                    # the file does not state which topics were latched
                    ConnectionExtRosbag1(
                        None, int(channel.topic.endswith("tf_static"))
                    ),
                    self,
                )
            )

    def messages(
        self, connections: list[Connection]
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """Messages with their times of recording, in the order of these."""
        by_number = {connection.id: connection for connection in connections}
        for _, channel, message in self._reader.iter_messages():
            if (connection := by_number.get(channel.id)) is not None:
                yield connection, message.log_time, message.data


def _copy(
    bag: AnyReader | Ros1InMcap, writer: LogWriter, progress: Progress | None
) -> BagConversion:
    """Copy the messages of a bag to a log."""
    from rosbags.serde import SerdeError
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    # of types that both define, that of Jazzy counts: readers of the log know it
    known = bag.typestore.fielddefs
    _add_types(store, known)
    connections = [c for c in bag.connections if c.msgtype in known]
    left_out = {
        c.topic: f"{c.msgtype} is not defined in the bag: add --definitions FOLDER, which holds {c.msgtype}.msg"
        for c in bag.connections
        if c not in connections
    }
    # numbers of connections repeat in the files of a bag that is split
    channels = {(c.id, id(c.owner)): _channel(c, store, writer) for c in connections}
    recoders = {
        kind: _recoder(kind, bag, store) for kind in {c.msgtype for c in connections}
    }
    conversion = BagConversion(
        len({c.topic for c in connections}),
        duration_s=bag.duration * 1e-9,
        left_out=left_out,
    )
    broken: Counter[str] = Counter()
    total = sum(c.msgcount for c in connections)
    # without connections the library would give the messages of all
    messages = bag.messages(connections=connections) if connections else ()
    for number, (connection, time_ns, raw) in enumerate(messages):
        try:
            payload = bytes(recoders[connection.msgtype](raw))
        except SerdeError:
            broken[connection.topic] += 1
            continue
        channel = channels[connection.id, id(connection.owner)]
        writer.mcap.add_message(channel, time_ns, payload, time_ns)
        conversion.messages += 1
        if progress and number % _STEPS == 0:
            progress(number, total)
    for topic, count in broken.items():
        left_out[topic] = f"{count} messages are not of their type"
    writer.finish()
    return conversion


def _channel(connection: Connection, store: Typestore, writer: LogWriter) -> int:
    """Channel of a connection.

    Late subscribers get the last message where the connection is ``latching`` in ROS 1, "transient local" in ROS 2.
    """
    from rosbags.interfaces import ConnectionExtRosbag2

    type_name = _RENAMED.get(connection.msgtype, connection.msgtype)
    text, _ = store.generate_msgdef(type_name, ros_version=2)
    if isinstance(connection.ext, ConnectionExtRosbag2):
        profiles = connection.ext.offered_qos_profiles
        is_latched = any(one.durability.value == 1 for one in profiles)
    else:
        is_latched = bool(connection.ext.latching)
    schema = SchemaText(type_name, "ros2msg", text.encode())
    return writer.channel(connection.topic, schema, metadata=latched(is_latched))


def _recoder(own: str, bag: AnyReader | Ros1InMcap, store: Typestore) -> Recode:
    """Conversion of payloads of a type in the bag to CDR of the type as the log defines it."""
    from rosbags.convert.converter import is_same_wireformat, migrate_bytes

    type_name = _RENAMED.get(own, own)
    if is_same_wireformat(bag.typestore, store, own, type_name):
        # CDR of the same fields needs no change
        return memoryview if bag.is2 else partial(store.ros1_to_cdr, typename=type_name)
    kinds = bag.typestore, store, own, type_name
    return partial(migrate_bytes, *kinds, {}, src_is2=bag.is2, dst_is2=True)
