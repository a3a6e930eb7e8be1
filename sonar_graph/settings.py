"""Sections of settings, and messages about wrong ones that name each field and those that exist."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from difflib import SequenceMatcher
from functools import partial
from types import UnionType
from typing import Any, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails, InitErrorDetails, PydanticCustomError

Place = tuple[int | str, ...]
_SHOWN_CHARACTERS = 60
_LEAST_SIMILARITY = 0.7
_MISFIT = "misfit"


def faults_in(error: ValidationError, model: type[BaseModel]) -> str:
    """Message naming every wrong field and the expected value, in one line.

    Parameters
    ----------
    error
        From validating plain values.
    model
        Model against which they were validated.
    """
    errors = error.errors()
    short = dict.fromkeys(_list_of(e) for e in errors if _is_short_list(e))
    texts = [_describe(e, model) for e in errors if not _is_short_list(e)]
    return "; ".join([*texts, *(_wrong_length(place, errors) for place in short)])


def misfits(model: type[BaseModel], reasons: dict[str, str]) -> ValidationError:
    """Error for a model's validator to raise where fields exclude each other.

    Parameters
    ----------
    reasons
        Message for each field, so that the line in a file can be named.
    """
    found = [
        InitErrorDetails(type=PydanticCustomError(_MISFIT, "{reason}", {"reason": reason}), loc=(name,), input=None)
        for name, reason in reasons.items()
    ]
    return ValidationError.from_exception_data(model.__name__, found)


def _describe(error: ErrorDetails, model: type[BaseModel]) -> str:
    place = error["loc"]
    if error["type"] == _MISFIT:
        return error["msg"]
    if error["type"] == "extra_forbidden":
        return unknown_field(place, model)
    if error["type"] == "missing":
        return f"{_path(place)}: is missing"
    if error["type"] in ("list_type", "tuple_type") and isinstance(error["input"], dict):
        return f"{_path(place)}: expected a list of tables, [[{_path(place)}]] in TOML, not one table"
    if error["type"] == "too_long" and not isinstance(error["input"], str):
        return f"{_path(place)}: expected {error['ctx']['max_length']} values, not {_shown(error['input'])}"
    message = error["msg"].removeprefix("Value error, ")
    return f"{_path(place)}: {message}, not {_shown(error['input'])}" if place else message


def unknown_field(place: Place, model: type[BaseModel]) -> str:
    """Message that a field does not exist, with the most similar one and those that exist."""
    section = section_at(model, place[:-1])
    names = list(section.model_fields) if section else []
    return f"{_path(place)}: there is no such field{choice(str(place[-1]), names, _path(place[:-1]) or 'it')}"


def choice(name: str, known: Iterable[str], owner: str = "") -> str:
    """Message after an unknown name: the most similar known name, and all that exist."""
    names = list(known)
    similar = max(names, key=partial(_similarity, name), default="")
    is_meant = _similarity(name, similar) >= _LEAST_SIMILARITY
    suggestion = f"; did you mean {similar}?" if is_meant else ";"
    return f"{suggestion} {f'{owner} has' if owner else 'there are'}: {', '.join(names) or 'none'}"


def _similarity(name: str, known: str) -> float:
    """Similarity from 0 to 1; the beginning of a name counts as well, since units at its end are forgotten."""
    return max(SequenceMatcher(None, name, text).ratio() for text in (known, known[: len(name)]))


def _is_short_list(error: ErrorDetails) -> bool:
    return error["type"] == "missing" and bool(error["loc"]) and isinstance(error["loc"][-1], int)


def _list_of(error: ErrorDetails) -> Place:
    return error["loc"][:-1]


def _wrong_length(place: Place, errors: list[ErrorDetails]) -> str:
    lacking = [e for e in errors if _is_short_list(e) and _list_of(e) == place]
    expected = max(int(e["loc"][-1]) for e in lacking) + 1
    return f"{_path(place)}: expected {expected} values, not {_shown(lacking[0]['input'])}"


def _shown(value: Any) -> str:
    text = repr(list(value) if isinstance(value, tuple) else value)
    return text if len(text) <= _SHOWN_CHARACTERS else f"{text[:_SHOWN_CHARACTERS]}..."


def _path(place: Place) -> str:
    """Dotted names, without what pydantic adds for the branch of a union."""
    return ".".join(str(part) for part in place if isinstance(part, int) or part.isidentifier())


def section_at(model: type[BaseModel], place: Place) -> type[BaseModel] | None:
    """Section at a place within a model, or None."""
    section: type[BaseModel] | None = model
    for name in place:
        if section is None:
            return None
        if isinstance(name, str) and name in section.model_fields:
            section = next(_sections(section.model_fields[name].annotation), None)
    return section


def _sections(annotation: Any) -> Iterator[type[BaseModel]]:
    if get_origin(annotation) in (Union, UnionType, tuple, list):
        for option in get_args(annotation):
            yield from _sections(option)
    elif isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
