"""HTML pages from templates: everything that comes from a suite, a log or an estimator is escaped."""

from __future__ import annotations

import base64
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from markupsafe import Markup

from sonar_graph.evaluation import Table, as_html
from sonar_graph.report.table_files import as_csv, as_latex


def render(template: str, content: dict[str, Any]) -> str:
    """The page as text: a template in ``templates/``, filled with content by the names that it uses."""
    environment = Environment(
        loader=PackageLoader("sonar_graph.report", "templates"),
        autoescape=select_autoescape(["html"]),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"svg": Markup, "html": _html, "csv": as_csv, "latex": as_latex, "address": data_address}
    return environment.get_template(template).render(**content)


def data_address(text: str | bytes, kind: str) -> str:
    """Content as an address within the page itself: ``data:KIND;base64,...``."""
    content = text if isinstance(text, bytes) else text.encode()
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"


def _html(table: Table, is_sortable: bool = False) -> Markup:
    return Markup(as_html(table, is_sortable=is_sortable))
