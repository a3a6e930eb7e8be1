"""Inputs that end and fit into memory, TOML, and JSON without NaN or infinity."""

import errno
import json
import math
import re
import tomllib
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


def read_toml(path: Path, refusal: type[Exception]) -> dict[str, Any]:
    """Content of a TOML file; ``refusal`` names the file where it cannot be read, or is not TOML."""
    try:
        text = text_of(path)
    except OSError as error:
        raise refusal(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise refusal(f"{path}: not TOML: {error}") from error
    return parsed_toml(text, path, refusal)


def parsed_toml(text: str, path: Path, refusal: type[Exception]) -> dict[str, Any]:
    """Content of a text as TOML; ``refusal`` names the file that it comes from, and the way out."""
    try:
        return tomllib.loads(text)
    # the parser recurses into nested arrays
    except (ValueError, RecursionError) as error:
        raise refusal(f"{path}: not TOML: {error}{_twice(text, str(error))}") from error


def _twice(text: str, fault: str) -> str:
    """Advice about a table or key that stands twice, as a line of advice makes it that was pasted; else empty."""
    lines = text.splitlines()
    table = re.search(r"Cannot declare \('([^']+)'", fault)
    at_line = re.search(r"Cannot overwrite a value \(at (?:line (\d+)|end)", fault)
    if table is not None:
        name = re.escape(table[1])
        header = re.compile(rf"\s*(\[\s*{name}\s*\]|{name}\s*\.)")
        number = next((n for n, line in enumerate(lines, 1) if header.match(line)), 0)
        return f"; [{table[1]}] begins in line {number}: put its keys together there"
    if at_line is not None:
        number = int(at_line[1] or len(lines))
        key = lines[number - 1].partition("=")[0].strip()
        return (
            f"; `{key}` in line {number} is set above already: keep one of both lines"
        )
    return ""


def spelt(text: str) -> str:
    """The same text with bytes of file names that are not UTF-8 spelt out, so that it can be written."""
    return text.encode("utf-8", "backslashreplace").decode()


def strict_json(content: dict[str, Any]) -> str:
    """JSON text; NaN and infinity become null."""
    return json.dumps(_strict(content), indent=2, allow_nan=False, ensure_ascii=False)


def read_json(
    path: Path,
    refusal: type[Exception] = EvaluationError,
    remedy: str = "write the comparison again",
) -> dict[str, Any]:
    """JSON object in a file; ``refusal`` names the file, and the remedy, where it is missing or holds anything else."""
    try:
        content = json.loads(text_of(path))
    except OSError as error:
        raise refusal(f"{path}: cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise refusal(f"{path}: cannot be read as JSON ({error}); {remedy}") from error
    if not isinstance(content, dict):
        found = type(content).__name__
        raise refusal(f"{path}: expected a JSON object, found {found}; {remedy}")
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
