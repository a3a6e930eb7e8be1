"""Sections of settings, and messages about wrong ones that name each field and those that exist."""

import ast
import inspect
import json
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from copy import deepcopy
from difflib import SequenceMatcher
from functools import lru_cache, partial
from itertools import pairwise
from types import UnionType
from typing import Any, NamedTuple, TypeVar, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from sonar_graph.errors import MISFIT, CalibrationError, expectation

Place = tuple[int | str, ...]
_SHOWN_CHARACTERS = 60
_LEAST_SIMILARITY = 0.7
M = TypeVar("M", bound=BaseModel)


def nested(
    values: dict[str, Any], start: dict[str, Any] | None = None
) -> dict[str, Any]:
    """Settings in sections, from values by dotted names such as ``image.noise_db``, added to those of a start."""
    tree = deepcopy(start or {})
    for name, value in sorted(
        values.items(), key=lambda named: named[0].count(".")
    ):  # sections before their settings
        # the sections are made on the way, where they are missing
        *sections, last = name.split(".")
        place = tree
        for section in sections:
            if not isinstance(place.get(section), dict):
                place[section] = {}
            place = place[section]
        place[last] = deepcopy(value)
    return tree


def flattened(tree: dict[str, Any], section: str = "") -> dict[str, Any]:
    """Values by dotted names, the inverse of `nested`."""
    flat: dict[str, Any] = {}
    for name, value in tree.items():
        flat |= (
            flattened(value, f"{section}{name}.")
            if isinstance(value, dict)
            else {f"{section}{name}": value}
        )
    return flat


class Setting(NamedTuple):
    """One setting of a model, for a listing."""

    name: str
    """With the sections that it is in, dotted."""
    default: Any
    meaning: str


def settings_of(
    model: type[BaseModel], default: BaseModel | None = None, section: str = ""
) -> list[Setting]:
    """All settings of a model, section after section.

    Of a tagged union first its tag, with what each value means, then the settings of all its sections.
    """
    found: dict[str, Setting] = {}
    for name, field in model.model_fields.items():
        value = field.get_default(call_default_factory=True)
        if default is not None:
            value = getattr(default, name)
        elif field.is_required():
            # a field without a default shows what it may hold
            value = field.examples[0] if field.examples else 0.1
        path = f"{section}{name}"
        options = list(_sections(field.annotation))
        tag = field.discriminator
        if isinstance(tag, str):
            meanings = (
                f"{' or '.join(_tags(option, tag))}: {_sentence(option.__doc__)}"
                for option in options
            )
            found[f"{path}.{tag}"] = Setting(
                f"{path}.{tag}", getattr(value, tag), " ".join(meanings)
            )
            for option in options:
                for setting in settings_of(
                    option, value if isinstance(value, option) else None, f"{path}."
                ):
                    # other options may have a setting of this name too
                    top = setting.name[len(path) + 1 :].split(".")[0]
                    with_it = [each for each in options if top in each.model_fields]
                    names = " or ".join(
                        f'"{name}"' for having in with_it for name in _tags(having, tag)
                    )
                    limit = (
                        ""
                        if len(with_it) == len(options)
                        else f" Only with {tag} = {names}."
                    )
                    found.setdefault(
                        setting.name, setting._replace(meaning=setting.meaning + limit)
                    )
        elif isinstance(value, BaseModel):
            found |= {
                setting.name: setting
                for setting in settings_of(type(value), value, f"{path}.")
            }
        else:
            found[path] = Setting(
                path, value, " ".join(meanings_of(model).get(name, "").split())
            )
    return list(found.values())


@lru_cache
def meanings_of(model: type[BaseModel]) -> dict[str, str]:
    """The text below each field of a class and of its bases, from their source.

    Pydantic's own reader (`use_attribute_docstrings`) works at every import, which takes a third of a second when a
    comparison begins; settings are listed seldom.
    """
    found: dict[str, str] = {}
    for kind in reversed(model.__mro__):
        try:
            (made,) = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
        except (OSError, TypeError, SyntaxError, ValueError):  # made without a file
            continue
        for field, below in pairwise(getattr(made, "body", [])):
            match field, below:
                case ast.AnnAssign(target=ast.Name(name)), ast.Expr(
                    ast.Constant(str(text))
                ):
                    found[name] = inspect.cleandoc(text)
    return {name: text for name, text in found.items() if name in model.model_fields}


def parse(
    model: type[M],
    values: object,
    source: str,
    refusal: type[Exception] = CalibrationError,
) -> M:
    """Plain values, such as from TOML or JSON, as their model.

    Parameters
    ----------
    source
        Origin of the values, with which the message begins.
    refusal
        Error for wrong values: it names each wrong field, what was expected, and the fields that exist.

    Examples
    --------
    >>> from sonar_graph import Calibration
    >>> parse(Calibration, {"imu": {"gyro_bias": 1e-4}}, "vehicle.toml")
    Traceback (most recent call last):
        ...
    sonar_graph.errors.CalibrationError: vehicle.toml: imu.gyro_bias: there is no such field; ...
    """
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise refusal(f"{source}: {faults_in(error, model)}") from error


def faults_in(error: ValidationError, model: type[BaseModel]) -> str:
    """Message naming every wrong field and the expected value, in one line.

    ``error``: from validating plain values; ``model``: model against which they were validated.
    """
    errors = error.errors()
    # pydantic reports each missing element of a list: one message for the list is enough; a dict keeps the
    # order
    short = dict.fromkeys(e["loc"][:-1] for e in errors if _is_short_list(e))
    texts = [_describe(e, model) for e in errors if not _is_short_list(e)]
    for place in short:
        lacking = [e for e in errors if _is_short_list(e) and e["loc"][:-1] == place]
        expected = max(int(e["loc"][-1]) for e in lacking) + 1
        texts.append(
            f"{_path(place)}: expected {expected} values, not {_shown(lacking[0]['input'])}"
        )
    return "; ".join(texts)


def _describe(error: ErrorDetails, model: type[BaseModel]) -> str:
    place = error["loc"]
    if error["type"] == MISFIT:
        return error["msg"]
    if error["type"] == "extra_forbidden":
        return unknown_field(place, model)
    # the message of pydantic lists classes; people know the tags
    if error["type"] == "union_tag_invalid":
        at = _walk(model, place)
        given = error["ctx"]["tag"]
        known = [name for option in at.options for name in _tags(option, at.tag)]
        return (
            f"{_path((*at.names, at.tag))}: there is no {given!r}{choice(given, known)}"
        )
    place = field_place(model, place)
    name = _path(place)
    if error["type"] == "missing":
        return f"{name}: is missing"
    if error["type"] in ("list_type", "tuple_type") and isinstance(
        error["input"], dict
    ):
        return f"{name}: expected a list of tables, [[{name}]] in TOML, not one table"
    if error["type"] == "too_long" and not isinstance(error["input"], str):
        return f"{name}: expected {error['ctx']['max_length']} values, not {_shown(error['input'])}"
    message = expectation(error["type"], error["msg"])
    if error["type"] == "model_type":
        like = (
            f"[{name}] in TOML"
            if place
            else "such as " + ", ".join(list(model.model_fields)[:3])
        )
        message = f"expected {'a section' if place else 'sections'}, {like}"
    return f"{name}: {message}, not {_shown(error['input'])}" if place else message


def unknown_field(place: Place, model: type[BaseModel]) -> str:
    """Message that a field does not exist, with the policy or section that has it, or the most similar one, and all."""
    name = str(place[-1])
    owner = _walk(model, place[:-1])
    fault = f"{_path((*owner.names, name))}: there is no such field"
    whose = _path(owner.names) or "it"
    if owner.value:
        others = [
            f'"{tag}"'
            for o in owner.options
            if name in o.model_fields
            for tag in _tags(o, owner.tag)
        ]
        if others:
            having = f"{_path((*owner.names, owner.tag))} = {' or '.join(others)}"
            return f'{fault} with {owner.tag} = "{owner.value}"; {having} has it'
        whose = f'{whose} with {owner.tag} = "{owner.value}"'
    if owner.section is None:
        return fault + choice(name, [], whose)
    fields = list(owner.section.model_fields)
    # the same name in a section below is what was probably meant
    # a line that was pasted below a table counts in that table
    if len(place) > 1 and _is_section(model, name):
        if place[0] == name:
            return f"{fault}; below [{name}] leave `{name}.` out"
        return f"{fault}; a line `{name}. … = …` goes above the first table of the file, or into the table [{name}]"
    inside = [setting.name for setting in settings_of(owner.section)]
    meant = [
        _path((*owner.names, *dotted.split(".")))
        for dotted in inside
        if dotted.endswith(f".{name}")
    ]
    hint = f"; did you mean {meant[0]}?" if meant else suggestion(name, fields)
    return f"{fault}{hint} {whose} has: {', '.join(fields) or 'none'}"


def _is_section(model: type[BaseModel], name: str) -> bool:
    """True of a field of the model that has fields of its own."""
    field = model.model_fields.get(name)
    return field is not None and any(True for _ in _sections(field.annotation))


def choice(name: str, known: Iterable[str], owner: str = "") -> str:
    """Message after an unknown name: the most similar known name, and all that exist."""
    names = list(known)
    return f"{suggestion(name, names)} {f'{owner} has' if owner else 'there are'}: {', '.join(names) or 'none'}"


def suggestion(name: str, known: Iterable[str]) -> str:
    """Question after an unknown name whether the most similar known name is meant; a semicolon if none is similar."""
    # one suggestion: the rest is in the list that follows
    similar = max(known, key=partial(_similarity, name), default="")
    return (
        f"; did you mean {similar}?"
        if _similarity(name, similar) >= _LEAST_SIMILARITY
        else ";"
    )


def _similarity(name: str, known: str) -> float:
    """Similarity from 0 to 1; the beginning of a name counts as well, since units at its end are forgotten."""
    return max(
        SequenceMatcher(None, name, text).ratio()
        for text in (known, known[: len(name)])
    )


def _is_short_list(error: ErrorDetails) -> bool:
    return (
        error["type"] == "missing"
        and bool(error["loc"])
        and isinstance(error["loc"][-1], int)
    )


def _shown(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()  # as files have it
    text = repr(list(value) if isinstance(value, tuple) else value)
    return text if len(text) <= _SHOWN_CHARACTERS else f"{text[:_SHOWN_CHARACTERS]}..."


def _path(place: Place) -> str:
    """Dotted names, without what pydantic adds for the branch of a union."""
    return ".".join(
        str(part) for part in place if isinstance(part, int) or part.isidentifier()
    )


def field_place(model: type[BaseModel], place: Place) -> Place:
    """Place of an error as the user wrote it, without the tags that pydantic adds for tagged unions."""
    return _walk(model, place).names


class _Spot(NamedTuple):
    """A place in a model."""

    names: Place
    """Without the tags of unions."""
    section: type[BaseModel] | None
    tag: str
    """Name of the field that distinguishes the options; empty where it is no union."""
    value: str
    options: list[type[BaseModel]]


def _walk(model: type[BaseModel], place: Place) -> _Spot:
    spot = _Spot((), model, "", "", [model])
    for name in place:
        # the tag of a union is a step of the place, but no name in the file
        picked = (
            [option for option in spot.options if name in _tags(option, spot.tag)]
            if not spot.value
            else []
        )
        if picked:
            spot = spot._replace(section=picked[0], value=str(name))
            continue
        section = spot.section
        spot = spot._replace(names=(*spot.names, name))
        if (
            section is not None
            and isinstance(name, str)
            and name in section.model_fields
        ):
            field = section.model_fields[name]
            options = list(_sections(field.annotation))
            tag = field.discriminator if isinstance(field.discriminator, str) else ""
            spot = _Spot(spot.names, options[0] if options else None, tag, "", options)
    return spot


def _tags(section: type[BaseModel], tag: str) -> tuple[str, ...]:
    return get_args(section.model_fields[tag].annotation) if tag else ()


def _sections(annotation: Any) -> Iterator[type[BaseModel]]:
    if get_origin(annotation) in (Union, UnionType, tuple, list):
        for option in get_args(annotation):
            yield from _sections(option)
    elif isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation


def toml_value(value: Any) -> str:
    """A value as TOML, on one line."""
    if isinstance(value, BaseModel):
        return toml_value(value.model_dump(exclude_none=True))
    if isinstance(value, str):
        return _text(value)
    if isinstance(value, bool):
        return json.dumps(value)
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, Mapping):
        return (
            "{"
            + ", ".join(
                f"{toml_key(key)} = {toml_value(item)}" for key, item in value.items()
            )
            + "}"
        )
    if isinstance(value, Sequence):
        return "[" + ", ".join(map(toml_value, value)) + "]"
    raise TypeError(f"{type(value).__name__} has no TOML form")


def toml_key(name: str) -> str:
    """A key as TOML, in quotes where it needs them."""
    return (
        name
        if name.replace("_", "").replace("-", "").isalnum() and name.isascii()
        else _text(name)
    )


def _text(value: str) -> str:
    """A basic string: that of JSON, but for one character that TOML does not allow."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def toml_template(model: type[BaseModel], stated: BaseModel, remark: str) -> str:
    """Commented TOML of all settings of a model with their meaning: those of ``stated`` that differ from the defaults.

    The others are commented out, with the default; of a section that may be absent, its fields with an example. Read
    back as it is, it gives ``stated``. ``remark``: after each line that is stated.
    """
    default = model()
    top: list[str] = []
    sections: list[str] = []
    for name, field in model.model_fields.items():
        kind = next(_sections(field.annotation), None)
        usual = getattr(default, name)
        value = getattr(stated, name)
        if kind is None:
            setting = Setting(name, usual, meanings_of(model).get(name, ""))
            top.append(_template_line(setting, value, value != usual, remark))
            continue
        # a section that may be absent is commented out as a whole
        absent = "# " * (value is None)
        sections += ["", f"# {_sentence(kind.__doc__)}", f"{absent}[{name}]"]
        given = {setting.name: setting.default for setting in settings_of(kind, value)}
        for setting in settings_of(kind, usual):
            shown = given[setting.name]
            is_stated = value is not None and (
                usual is None or shown != setting.default
            )
            sections.append(_template_line(setting, shown, is_stated, remark))
    return "\n".join([*top, *sections]) + "\n"


def _template_line(setting: Setting, value: Any, is_stated: bool, remark: str) -> str:
    """Line of a template, commented out where the value is the default."""
    # TOML has no null
    line = f"{setting.name} = {toml_value(0.0 if value is None else value)}"
    notes = [_sentence(setting.meaning), f"({remark})" if is_stated else ""]
    note = " ".join(filter(None, notes))
    return ("" if is_stated else "# ") + line + (f"  # {note}" if note else "")


def _sentence(text: str | None) -> str:
    """Text on one line."""
    return " ".join((text or "").split("\n\n")[0].split())
