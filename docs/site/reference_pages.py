"""Pages of the reference: one a package, and one list of all names, commands, settings and calibration fields.

`docs/reference/names.toml` lists the names. The list replaces a marked paragraph of `docs/reference/README.md`.
"""

import inspect
import re
import tomllib
from collections.abc import Iterable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any, get_args

import typer.main
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

from sonar_graph.calibration import Calibration, Section
from sonar_graph.cli.main import app
from sonar_graph.estimator import installed_estimators, load_estimator
from sonar_graph.settings import Setting, settings_of

LISTED = Path(__file__).parents[1] / "reference" / "names.toml"
FRONT_DOOR = "sonar_graph"
INDEX = "reference/README.md"
MARKED = re.compile(r"<!-- list -->.*<!-- end -->", re.DOTALL)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add a page for each package that is listed, one with the conventions of all, and the list of everything."""
    front = inspect.getdoc(import_module(FRONT_DOOR)) or ""
    conventions = (
        f"# Conventions\n\nThe text of `help(sonar_graph)`.\n\n```text\n{front}\n```\n"
    )
    files.append(
        File.generated(config, "reference/conventions.md", content=conventions)
    )
    packages = tomllib.loads(LISTED.read_text("utf-8"))
    for package, names in packages.items():
        module = import_module(package)
        about = (inspect.getdoc(module) or "").partition("\n\n")[0]
        parts = [f"# {package}", about]
        parts += [_entry(_place(module, name), name) for name in names]
        files.append(
            File.generated(
                config,
                f"reference/{package}.md",
                content="\n\n".join(parts) + "\n",
            )
        )
    index = files.get_file_from_path(INDEX)
    if index is not None:
        text = index.content_string
        content = MARKED.sub(lambda _: "\n\n".join(_list(packages)), text)
        files.remove(index)
        files.append(File.generated(config, INDEX, content=content))
    return files


def _list(packages: dict[str, list[str]]) -> Iterator[str]:
    """Sections of the list, each a heading and a table."""
    yield "## Commands"
    commands = typer.main.get_command(app).commands  # type: ignore[attr-defined]
    yield _table(
        ("command", "purpose"),
        (
            (f"`sonar-graph {name}`", _first_line(command.help or ""))
            for name, command in commands.items()
        ),
    )
    yield "## Settings of the estimators"
    for name in installed_estimators():
        yield f"### {name}"
        yield _settings(settings_of(load_estimator(name).Params), f"{name}.")
    yield "## Fields of the calibration"
    yield _settings(_calibration_fields(), "")
    yield "## Public names"
    for package, names in packages.items():
        module = import_module(package)
        yield f"### {package}"
        yield _table(
            ("name", "what it is"),
            (
                (
                    f"[{name}][{_place(module, name)}]",
                    _first_line(inspect.getdoc(getattr(module, name)) or ""),
                )
                for name in names
            ),
        )


def _calibration_fields() -> Iterator[Setting]:
    """All fields, also those of sections that are absent by default."""
    for setting in settings_of(Calibration):
        yield setting
        *path, last = setting.name.split(".")
        model: Any = Calibration()
        for part in path:
            model = getattr(model, part)
        kinds = get_args(type(model).model_fields[last].annotation)
        sections = [
            kind
            for kind in kinds
            if isinstance(kind, type) and issubclass(kind, Section)
        ]
        if setting.default is None:
            for section in sections:
                yield from settings_of(section, None, f"{setting.name}.")


def _settings(settings: Iterable[Setting], prefix: str) -> str:
    return _table(
        ("name", "default", "meaning"),
        (
            (
                f"`{prefix}{one.name}`",
                "required"
                if repr(one.default) == "PydanticUndefined"
                else f"`{one.default}`",
                one.meaning,
            )
            for one in settings
        ),
    )


def _table(headers: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> str:
    """A Markdown table; bars inside cells are escaped."""
    lines = ["| " + " | ".join(headers) + " |", "|---" * len(headers) + "|"]
    lines += [
        "| " + " | ".join(cell.replace("|", r"\|") for cell in row) + " |"
        for row in rows
    ]
    return "\n".join(lines)


def _first_line(text: str) -> str:
    """The first paragraph as one line."""
    return " ".join(text.partition("\n\n")[0].split())


def _place(module: Any, name: str) -> str:
    """Where a name is defined, which is its anchor on the page of its package."""
    return f"{getattr(module, name).__module__}.{name}"


def _entry(defined: str, name: str) -> str:
    return (
        f"::: {defined}\n    options:\n      heading: {name}\n      toc_label: {name}\n"
    )
