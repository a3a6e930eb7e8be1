"""Sections of settings of which one of several kinds is chosen, and settings that exclude each other."""

from typing import Any

from pydantic import BaseModel, BeforeValidator, Field, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import InitErrorDetails, PydanticCustomError

from sonar_graph.errors import MISFIT


def tagged(tag: str, default: str) -> tuple[FieldInfo, BeforeValidator]:
    """Metadata of a union of sections that one of their fields tells apart; it has a default.

    ``tag``: that field, with a literal text in each section; ``default``: its value where it is not given.
    """

    def with_tag(value: Any) -> Any:
        if isinstance(value, str):
            raise ValueError(f'expected a section with {tag} = "{value}"')
        return {tag: default, **value} if isinstance(value, dict) else value

    return Field(discriminator=tag), BeforeValidator(with_tag)


def misfits(model: type[BaseModel], reasons: dict[str, str]) -> ValidationError:
    """Error for a model's validator to raise where fields exclude each other.

    ``reasons``: message for each field, so that the line in a file can be named.
    """
    found = [
        InitErrorDetails(type=PydanticCustomError(MISFIT, "{reason}", {"reason": reason}), loc=(name,), input=None)
        for name, reason in reasons.items()
    ]
    return ValidationError.from_exception_data(model.__name__, found)
