"""JSON that every reader accepts: no NaN, no infinity."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from sonar_graph.errors import EvaluationError
from sonar_graph.evaluation.atomic import replacing


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write whole or not at all; what is not a finite number becomes null."""
    with replacing(path) as partial:
        partial.write_text(strict_json(content) + "\n", "utf-8")


def strict_json(content: dict[str, Any]) -> str:
    """The text; what is not a finite number becomes null."""
    return json.dumps(_strict(content), indent=2, allow_nan=False, ensure_ascii=False)


def read_json(path: Path) -> dict[str, Any]:
    """The object in a file.

    Raises
    ------
    EvaluationError
        When the file is missing or is not a JSON object.
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
