"""Kinds of files that are no MCAP logs, known by their first bytes, and what makes a log of each."""

from pathlib import Path

MCAP_MAGIC = b"\x89MCAP0\r\n"
"""First and last bytes of an MCAP file."""
BAG_MAGIC = (b"#ROSBAG", b"SQLite format 3")
"""First bytes of ROS 1 bags and of the files of ROS 2 bags."""
ALREADY_MCAP = "already an MCAP file: read it directly, "
START_BYTES = 64
"""Leading bytes that identify the type of a file."""


TABLES = "write what it holds as text tables, for `sonar-graph convert csv`"
CONVERT = "`sonar-graph convert {} {{file}} -o {{stem}}.mcap` makes a log of it"
FOREIGN: tuple[tuple[bytes, str, str], ...] = (
    (b"#ROSBAG", "a ROS 1 bag", CONVERT.format("rosbag")),
    (b"SQLite format 3", "a ROS 2 bag of the sqlite3 kind", CONVERT.format("rosbag")),
    (b"DDF\x05", "an ARIS' recording", CONVERT.format("aris")),
    *((b"DDF" + bytes([version]), "a DIDSON's recording", CONVERT.format("didson")) for version in range(5)),
    (b"\x28\xb5\x2f\xfd", "compressed by zstd", "`zstd -d {file}` unpacks it"),
    (b"\x04\x22\x4d\x18", "compressed by lz4", "`lz4 -d {file}` unpacks it"),
    (b"\x1f\x8b", "compressed by gzip", "`gunzip {file}` unpacks it"),
    (b"BZh", "compressed by bzip2", "`bunzip2 {file}` unpacks it"),
    (b"\xfd7zXZ", "compressed by xz", "`unxz {file}` unpacks it"),
    (b"PK\x03\x04", "a zip archive", "`unzip {file}` unpacks it"),
    (b"\xa3\x95", "an ArduPilot log (.bin)", "`mavlogdump.py --format csv --types IMU {file} > imu.csv` of pymavlink, "
     "and so on, writes tables for `sonar-graph convert csv`"),
    (b"ULog", "a PX4 log (.ulg)", "`ulog2csv {file}` of pyulog writes tables for `sonar-graph convert csv`"),
    (b"\x7f\x7f", "a PD0 recording of a Doppler log", f"mhkit.dolfyn reads it in Python: {TABLES}"),
    (b"\xa5\x0a", "a Nortek recording (.ad2cp)", f"mhkit.dolfyn reads it in Python: {TABLES}"),
    (b"\x89HDF", "an HDF5 file", TABLES),
    (b"MATLAB", "a MATLAB file", TABLES),
    (b"\x93NUMPY", "a numpy array", TABLES),
)  # fmt: skip
"""First bytes of files of other kinds, what these are, and how their content becomes a log."""


def kind_and_advice(path: Path, start: bytes) -> str:
    """The end of "`path` is not an MCAP file but ...", from the first `START_BYTES` bytes of the file."""
    if path.suffix.lower() == ".oculus":
        return "a file of the Oculus viewer, which is not read; `sonar-graph convert oculus` reads network messages"
    if start.startswith(b"SO") and b"\0" in start:
        return f"an Oculus' recording; `sonar-graph convert oculus {path} -o {path.stem}.mcap` makes a log of it"
    if start[8:9] in (b"\xfd", b"\xfe") and path.suffix == ".tlog":
        return f"MAVLink telemetry (.tlog); `mavlogdump.py --format csv` of pymavlink reads it: {TABLES}"
    return foreign_kind(path, start) or _unknown_kind(
        start,
        "logs are .mcap files; ROS bags become one by `sonar-graph convert rosbag`, text tables by "
        "`sonar-graph convert csv`",
    )


def foreign_kind(path: Path, start: bytes) -> str | None:
    """Kind of a file by its first bytes, and what makes a log of it; None where these are of no such kind."""
    for magic, kind, advice in FOREIGN:
        if start.startswith(magic):
            return f"{kind}; {advice.format(file=path, stem=path.stem)}"
    return None


def why_no_bag(path: Path, start: bytes) -> str | None:
    """The end of "`path` is ..." where the first bytes are not those of a bag; None where they are."""
    if start.startswith(BAG_MAGIC):
        return None
    if start.startswith(MCAP_MAGIC):
        return f"{ALREADY_MCAP}`sonar-graph inspect {path}`"
    kind = foreign_kind(path, start) or _unknown_kind(
        start, "give a ROS 1 .bag, or the folder of a ROS 2 bag"
    )
    return f"no bag but {kind}"


def _unknown_kind(start: bytes, advice: str) -> str:
    if not start.strip(b"\0"):
        kind = "zeros" if start else "empty"
        return f"{kind}: copy it again, or see whether the recorder wrote anything"
    # the last character may be cut
    text = start.decode("utf-8", "replace").rstrip("\ufffd")
    is_text = (
        all(character.isprintable() or character.isspace() for character in text)
        and "\ufffd" not in text
    )
    if text and is_text:
        first_line = text.strip().partition("\n")[0]
        return f"a text that begins with {first_line[:40]!r}; {advice}"
    return f"something else; {advice}"
