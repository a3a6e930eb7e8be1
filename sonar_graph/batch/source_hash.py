"""What code a package is, told by its content: a version number says nothing of a checkout that was changed."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path

from sonar_graph.batch.file_stamp import Stamp, stamp_of

DIGITS = 16
BYTECODE = "__pycache__"


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
    files = tuple((name, path, stamp_of(path)) for name, path in _named_files(package) if path.is_file())
    return _digest(files) if files else ""


@lru_cache(maxsize=8)
def _digest(files: tuple[tuple[str, Path, Stamp], ...]) -> str:
    digest = hashlib.sha256()
    for name, path, _ in files:
        _add(digest, name, path)
    return digest.hexdigest()[:DIGITS]


def _named_files(package: str) -> Iterator[tuple[str, Path]]:
    """Names within the package, in their order, and paths."""
    spec = find_spec(package)
    if spec is None:
        return
    folders = [Path(folder) for folder in spec.submodule_search_locations or ()]
    for folder in folders:
        for parts in _files(folder):
            yield "/".join(parts), folder.joinpath(*parts)
    if not folders and spec.origin is not None and Path(spec.origin).is_file():
        yield Path(spec.origin).name, Path(spec.origin)


def _files(folder: Path) -> list[tuple[str, ...]]:
    """Parts of their paths below the folder; without a `Path` for each, since runs wait for this list."""
    found: list[tuple[str, ...]] = []
    for place, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if name != BYTECODE and not name.startswith(".")]
        within = Path(place).relative_to(folder).parts
        found += [(*within, name) for name in names if not name.startswith(".")]
    return sorted(found)


def _add(digest: hashlib._Hash, name: str, path: Path) -> None:
    """With lengths, so that no two sets of files give the same bytes."""
    content = path.read_bytes()
    digest.update(f"{len(name.encode())} {name} {len(content)} ".encode())
    digest.update(content)
