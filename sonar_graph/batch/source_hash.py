"""What code a package is, told by its content: a version number says nothing of a checkout that was changed."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path

from sonar_graph.batch.file_stamp import Stamp, files_below, stamp_of

DIGITS = 16
BYTECODE = "__pycache__"
StampedFile = tuple[str, str, Stamp]
"""Its name within the package, path, and stamp."""


@lru_cache
def source_hash(package: str) -> str:
    """SHA-256 over names and content of the files of a top-level package or module, cut to `DIGITS`.

    Data in the package counts like code; bytecode, hidden files and the place where it is installed do not. Taken once
    in a process, before the first code of it decides a number; `source_hash_now` tells whether it still holds. The
    package is not imported.

    Returns
    -------
    Hexadecimal digits; empty where there is no such package.
    """
    return source_hash_now(package)


def source_hash_now(package: str) -> str:
    """`source_hash` of what is on the disk at this moment; files are read again only where their stamps changed."""
    files = tuple(sorted(_stamped_files(package)))
    return _digest(files) if files else ""


@lru_cache(maxsize=8)
def _digest(files: tuple[StampedFile, ...]) -> str:
    digest = hashlib.sha256()
    for name, path, _ in files:
        _add(digest, name, Path(path))
    return digest.hexdigest()[:DIGITS]


def _stamped_files(package: str) -> Iterator[StampedFile]:
    spec = find_spec(package)
    if spec is None:
        return
    folders = list(spec.submodule_search_locations or ())
    for folder in folders:
        for entry in files_below(folder, _is_no_source):
            yield entry.path[len(folder) + 1 :].replace(os.sep, "/"), entry.path, stamp_of(entry)
    if not folders and spec.origin is not None and (module := Path(spec.origin)).is_file():
        yield module.name, spec.origin, stamp_of(module)


def _is_no_source(name: str) -> bool:
    return name == BYTECODE or name.startswith(".")


def _add(digest: hashlib._Hash, name: str, path: Path) -> None:
    """With lengths, so that no two sets of files give the same bytes."""
    content = path.read_bytes()
    digest.update(f"{len(name.encode())} {name} {len(content)} ".encode())
    digest.update(content)
