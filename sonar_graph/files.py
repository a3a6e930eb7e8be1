"""Atomic writing of files, and JSON without NaN or infinity."""

import json
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

from sonar_graph.errors import EvaluationError, LogError


def as_path(value: object, call: str) -> Path:
    """An argument as a path; a TypeError that names the expected ``call`` where it is none."""
    if not isinstance(value, str | Path):
        raise TypeError(f"{call}: expected a path, a str or Path, not {type(value).__name__}")
    return Path(value)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Temporary path with the suffix of ``path``, which replaces ``path`` when the block ends without an error."""
    partial = path.with_name(f".partial-{path.name}")
    try:
        yield partial
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write JSON atomically; NaN and infinity become null."""
    with replacing(path) as partial:
        partial.write_text(strict_json(content) + "\n", "utf-8")


def strict_json(content: dict[str, Any]) -> str:
    """JSON text; NaN and infinity become null."""
    return json.dumps(_strict(content), indent=2, allow_nan=False, ensure_ascii=False)


def read_json(path: Path) -> dict[str, Any]:
    """JSON object in a file.

    Raises `EvaluationError` when the file is missing or is not a JSON object.
    """
    try:
        content = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise EvaluationError(f"{path}: cannot be read as JSON ({error}); write the comparison anew") from error
    if not isinstance(content, dict):
        raise EvaluationError(f"{path}: expected a JSON object, found {type(content).__name__}")
    return content


def _strict(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _strict(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [_strict(inner) for inner in value]
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    return value


@contextmanager
def written_whole(path: Path) -> Iterator[BinaryIO]:
    """Open a temporary file beside ``path``, which replaces ``path`` when the block ends without an error.

    Raises `LogError` when the file cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as partial, partial.open("wb") as stream:
            yield stream
    except OSError as error:
        raise LogError(f"{path} cannot be written: {error.strerror}") from error
