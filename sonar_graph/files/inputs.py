"""Inputs that end and fit into memory, and JSON without NaN or infinity."""

import errno
import json
import math
from pathlib import Path
from typing import Any

from sonar_graph.errors import ArgumentError, EvaluationError

LARGEST_TEXT = 1 << 27
"""Bytes."""


def as_path(value: object, call: str) -> Path:
    """An argument as a path; an `ArgumentError` that names the expected ``call`` for anything else."""
    if not isinstance(value, str | Path):
        raise ArgumentError(
            f"{call}: expected a path, a str or Path, not {type(value).__name__}"
        )
    return Path(value)


def regular(path: Path) -> Path:
    """The same path; an OSError where it is a pipe, a socket or a device, from which reading may never return."""
    if path.exists() and not path.is_file() and not path.is_dir():
        reason = "it is a pipe, a socket or a device, and reading it may never end: copy what it gives into a file"
        raise OSError(errno.EINVAL, reason, str(path))
    return path


def text_of(path: Path, encoding: str = "utf-8") -> str:
    """Content of a text file; an OSError as of `regular`, and where it has more than `LARGEST_TEXT` bytes."""
    # a log given as a text would fill the memory before it is refused
    if regular(path).stat().st_size > LARGEST_TEXT:
        reason = f"it has {path.stat().st_size} bytes, and at most {LARGEST_TEXT} are read as a text: give a part of it"
        raise OSError(errno.EFBIG, reason, str(path))
    return path.read_text(encoding)


def spelt(text: str) -> str:
    """The same text with bytes of file names that are not UTF-8 spelt out, so that it can be written."""
    return text.encode("utf-8", "backslashreplace").decode()


def strict_json(content: dict[str, Any]) -> str:
    """JSON text; NaN and infinity become null."""
    return json.dumps(_strict(content), indent=2, allow_nan=False, ensure_ascii=False)


def read_json(path: Path) -> dict[str, Any]:
    """JSON object in a file.

    Raises `EvaluationError` when the file is missing or is not a JSON object.
    """
    try:
        content = json.loads(text_of(path))
    except (OSError, ValueError, RecursionError) as error:
        raise EvaluationError(
            f"{path}: cannot be read as JSON ({error}); write the comparison again"
        ) from error
    if not isinstance(content, dict):
        raise EvaluationError(
            f"{path}: expected a JSON object, found {type(content).__name__}"
        )
    return content


def _strict(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _strict(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [_strict(inner) for inner in value]
    # JSON has neither NaN nor infinity
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    return value
