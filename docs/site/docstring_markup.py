"""Docstrings as Markdown: an example announced by ``::`` ends in one colon."""

import re
from typing import Any

import griffe


class ExampleColons(griffe.Extension):
    """Turn the two colons of reStructuredText before an indented example into one."""

    def on_instance(self, *, obj: griffe.Object, **_: Any) -> None:
        """Change the docstring of one object."""
        if obj.docstring:
            obj.docstring.value = re.sub(r"::(?=\n)", ":", obj.docstring.value)
