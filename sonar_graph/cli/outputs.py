"""Places to write to, tried before any long work begins."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryFile

from sonar_graph.errors import EvaluationError, LogError


def writable_log(path: Path) -> Path:
    """``path``, with its folder made, once it is known that a log can be written there.

    Raises
    ------
    LogError
        When it is a folder, is not called ``*.mcap``, or its folder cannot be written to.
    """
    if path.is_dir():
        raise LogError(f"{path}: is a folder; give the name of a file such as {path / 'log.mcap'}")
    if path.suffix != ".mcap":
        raise LogError(f"{path}: logs are MCAP files; give a name that ends in .mcap")
    try:
        _try_writing_in(path.parent)
    except OSError as error:
        raise LogError(f"{path}: cannot be written: {error.strerror}; choose another place with -o") from error
    return path


def writable_folder(path: Path) -> Path:
    """``path``, made where it did not exist, once it is known that files can be written there.

    Raises
    ------
    EvaluationError
        When it is a file or cannot be written to.
    """
    if path.exists() and not path.is_dir():
        raise EvaluationError(f"{path}: is a file; give a folder with -o")
    try:
        _try_writing_in(path)
    except OSError as error:
        raise EvaluationError(f"{path}: cannot be written: {error.strerror}; choose another place with -o") from error
    return path


def _try_writing_in(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    with TemporaryFile(dir=folder):
        pass
