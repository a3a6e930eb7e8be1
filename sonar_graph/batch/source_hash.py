"""What code a package is, told by its content: a version number says nothing of a checkout that was changed."""

from __future__ import annotations

import hashlib
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path

DIGITS = 16
BYTECODE = "__pycache__"


@lru_cache
def source_hash(package: str) -> str:
    """SHA-256 over names and content of the files of a top-level package or module, cut to `DIGITS`.

    Data in the package counts like code; bytecode, hidden files and the place where it is installed do not. Taken once
    in a process, whose code does not change any more either. The package is not imported.

    Returns
    -------
    Hexadecimal digits; empty where there is no such package.
    """
    spec = find_spec(package)
    if spec is None:
        return ""
    digest = hashlib.sha256()
    folders = [Path(folder) for folder in spec.submodule_search_locations or ()]
    for folder in folders:
        for path in _files(folder):
            _add(digest, path.relative_to(folder).as_posix(), path)
    if not folders and spec.origin is not None and Path(spec.origin).is_file():
        _add(digest, Path(spec.origin).name, Path(spec.origin))
    return digest.hexdigest()[:DIGITS]


def _files(folder: Path) -> list[Path]:
    """In the order of their names below the folder."""
    named = ((path.relative_to(folder).parts, path) for path in folder.rglob("*") if path.is_file())
    return [path for parts, path in sorted(named) if not any(part == BYTECODE or part[0] == "." for part in parts)]


def _add(digest: hashlib._Hash, name: str, path: Path) -> None:
    """With lengths, so that no two sets of files give the same bytes."""
    content = path.read_bytes()
    digest.update(f"{len(name.encode())} {name} {len(content)} ".encode())
    digest.update(content)
