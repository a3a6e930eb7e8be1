"""Pages of the reference: one a package, with the names that `docs/reference/names.toml` lists."""

import inspect
import tomllib
from importlib import import_module
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

LISTED = Path(__file__).parents[1] / "reference" / "names.toml"
FRONT_DOOR = "sonar_graph"


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add a page for each package that is listed, and one with the conventions of all."""
    front = inspect.getdoc(import_module(FRONT_DOOR)) or ""
    conventions = (
        f"# Conventions\n\nThe text of `help(sonar_graph)`.\n\n```text\n{front}\n```\n"
    )
    files.append(
        File.generated(config, "reference/conventions.md", content=conventions)
    )
    for package, names in tomllib.loads(LISTED.read_text("utf-8")).items():
        module = import_module(package)
        about = (inspect.getdoc(module) or "").partition("\n\n")[0]
        parts = [f"# {package}", about]
        parts += [
            _entry(f"{getattr(module, name).__module__}.{name}", name) for name in names
        ]
        files.append(
            File.generated(
                config, f"reference/{package}.md", content="\n\n".join(parts) + "\n"
            )
        )
    return files


def _entry(defined: str, name: str) -> str:
    return (
        f"::: {defined}\n    options:\n      heading: {name}\n      toc_label: {name}\n"
    )
