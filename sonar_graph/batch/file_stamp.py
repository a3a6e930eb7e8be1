"""Whether a file is still the one that was read, told without reading it again."""

from __future__ import annotations

import os
from pathlib import Path

Stamp = tuple[int, int, int, int]


def stamp_of(path: Path | os.DirEntry[str]) -> Stamp:
    """Inode, size, and the times in ns of the last change of content and of status; the last one cannot be set back."""
    state = path.stat()
    return state.st_ino, state.st_size, state.st_mtime_ns, state.st_ctime_ns
