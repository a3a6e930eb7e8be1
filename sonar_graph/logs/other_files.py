"""Files that are given as a log and are none: what they seem to be, and what to do."""

from __future__ import annotations

from pathlib import Path

from mcap.writer import MCAP0_MAGIC

BAG_MAGIC = (b"#ROSBAG", b"SQLite format 3")
"""How ROS 1 bags and the files of ROS 2 bags begin."""
START_BYTES = 64
"""How much of a file's beginning tells."""


def kind_and_advice(path: Path, start: bytes) -> str:
    """What completes "is not an MCAP file but ...".

    Parameters
    ----------
    path
        Of the file.
    start
        Its first bytes; fewer than `START_BYTES` only where the file ends.
    """
    convert = f"`sonar-graph convert rosbag {path} -o {path.with_suffix('.mcap').name}` makes one"
    if start.startswith(b"#ROSBAG"):
        return f"a ROS 1 bag; {convert}"
    if start.startswith(b"SQLite format 3"):
        return f"a ROS 2 bag of the sqlite3 kind; {convert}"
    return _neither(start, "logs are .mcap files, and ROS bags become one by `sonar-graph convert rosbag`")


def why_no_bag(path: Path, start: bytes) -> str | None:
    """What completes "`path` is ..." where a file is no bag by its first bytes; None where it may be one."""
    if start.startswith(BAG_MAGIC):
        return None
    if start.startswith(MCAP0_MAGIC):
        return f"already an MCAP file: read it directly, `sonar-graph inspect {path}`"
    return f"no bag but {_neither(start, 'give a ROS 1 .bag, or the folder of a ROS 2 bag')}"


def _neither(start: bytes, advice: str) -> str:
    if not start.strip(b"\0"):
        kind = "zeros" if start else "empty"
        return f"{kind}: copy it again, or see whether the recorder wrote anything"
    if _is_text(start):
        first_line = start.decode("utf-8", "replace").strip().partition("\n")[0]
        return f"a text that begins with {first_line[:40]!r}; {advice}"
    return f"something else; {advice}"


def _is_text(start: bytes) -> bool:
    """Whether these are printable characters, the last of which may be cut."""
    text = start.decode("utf-8", "replace").rstrip("\ufffd")
    return bool(text) and all(character.isprintable() or character.isspace() for character in text)
