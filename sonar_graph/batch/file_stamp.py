"""Whether a file is still the one that was read, told without reading it again."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path

Stamp = tuple[int, int, int, int]


def stamp_of(path: Path | os.DirEntry[str]) -> Stamp:
    """Inode, size, and the times in ns of the last change of content and of status; the last one cannot be set back."""
    state = path.stat()
    return state.st_ino, state.st_size, state.st_mtime_ns, state.st_ctime_ns


def files_below(
    folder: str, is_passed_over: Callable[[str], bool] = lambda _name: False, around: tuple[str, ...] = ()
) -> Iterator[os.DirEntry[str]]:
    """Files in a folder and in those within, linked ones too, since readers and imports follow links.

    Entries rather than paths: runs wait for this list. A link to a folder around it is passed over.
    """
    here = os.path.realpath(folder)
    if here in around:
        return
    with os.scandir(folder) as entries:
        for entry in entries:
            if is_passed_over(entry.name):
                continue
            if entry.is_dir():
                yield from files_below(entry.path, is_passed_over, (*around, here))
            elif entry.is_file():
                yield entry
