"""Tutorials that are programs, as pages: run from top to bottom while the site is built, output below each step.

A comment at the margin that begins a paragraph is prose, what follows is the code of that step. Pictures and pages
that a step writes are shown below it. A tutorial that fails ends the build.
"""

import ast
import io
import os
import re
import tempfile
from collections.abc import Iterator
from contextlib import chdir, redirect_stdout
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files

TUTORIALS = Path(__file__).parents[1] / "tutorials"
SHOWN = (".png", ".svg", ".html")
HEADING = re.compile(r"(?P<number>\d+)\. (?P<title>[^.:]+)[.:] ")


def page_of_script(path: Path) -> str | None:
    """The page of a tutorial that is a program or a notebook; None of other files."""
    programs = {*TUTORIALS.glob("[0-9]*.py"), *TUTORIALS.glob("[0-9]*.ipynb")}
    return f"tutorials/{path.stem}.md" if path in programs else None


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add a page for each program among the tutorials, and what it wrote."""
    for script in sorted(TUTORIALS.glob("[0-9]*.py")):
        with tempfile.TemporaryDirectory() as folder:
            try:
                text, written = run_tutorial(script, Path(folder))
            except Exception as error:
                raise PluginError(
                    f"{script.name} ended with {type(error).__name__}: {error}"
                ) from error
            files.append(
                File.generated(config, f"tutorials/{script.stem}.md", content=text)
            )
            for path in written:
                uri = f"tutorials/{script.stem}/{path.relative_to(folder).as_posix()}"
                files.append(File.generated(config, uri, content=path.read_bytes()))
    return files


def run_tutorial(script: Path, folder: Path) -> tuple[str, list[Path]]:
    """Run a tutorial in a folder; its page as Markdown, and the files that the page shows."""
    source = script.read_text("utf-8")
    title, _, about = (ast.get_docstring(ast.parse(source)) or script.stem).partition(
        "\n\n"
    )
    parts = [
        f"# {title.rstrip('.').partition(':')[0]}",
        title,
        re.sub(r"::(?=\n)", ":", about),
    ]
    parts.append(
        f"The program is `docs/tutorials/{script.name}`; this page shows it with its output."
    )
    shown: dict[Path, bytes] = {}
    names = {"__name__": "__main__", "__file__": str(script)}
    for line, prose, code in cells(source):
        if prose:
            parts.append(
                HEADING.sub(lambda found: f"## {found['title']}\n\n", prose, count=1)
            )
        if not code.strip():
            continue
        parts.append(f"```python\n{code.strip()}\n```")
        said = io.StringIO()
        with chdir(folder), redirect_stdout(said):
            exec(compile("\n" * line + code, script, "exec"), names)
        if said.getvalue().strip():
            parts.append(f'```text title="Output"\n{said.getvalue().strip()}\n```')
        now = {
            path: path.read_bytes()
            for path in sorted(folder.rglob("*"))
            if path.suffix in SHOWN
        }
        parts += [
            _shown(path, folder, script.stem)
            for path, content in now.items()
            if shown.get(path) != content
        ]
        shown = now
    return "\n\n".join(parts) + "\n", list(shown)


def cells(source: str) -> Iterator[tuple[int, str, str]]:
    """Steps of a program after its docstring: number of lines before the code, prose, code."""
    lines = source.splitlines()
    inside = {
        number
        for node in ast.parse(source).body
        for number in range(node.lineno, (node.end_lineno or node.lineno) + 1)
    }
    docstring = ast.parse(source).body[0].end_lineno or 0
    prose: list[str] = []
    code: list[str] = []
    for number, line in enumerate(lines[docstring:], docstring + 1):
        comment = line.startswith("#") and number not in inside
        if comment and not prose_continues(lines, number) and (prose or code):
            yield number - 1 - len(code), " ".join(prose), "\n".join(code)
            prose, code = [], []
        if comment and not any(code):
            prose.append(line.lstrip("# "))
        else:
            code.append(line)
    yield len(lines) - len(code), " ".join(prose), "\n".join(code)


def prose_continues(lines: list[str], number: int) -> bool:
    """True of a comment, by its number from 1, that goes on from the line before or stands among code."""
    return number > 1 and bool(lines[number - 2].strip())


def _shown(path: Path, folder: Path, name: str) -> str:
    place = f"{name}/{path.relative_to(folder).as_posix()}"
    if path.suffix == ".html":
        frame = f'<iframe class="written" src="{place}" title="{path.name}" loading="lazy"></iframe>'
        return f'{frame}\n\n<a href="{place}">Open {os.fspath(path.relative_to(folder))} by itself</a>'
    return f"![What the step drew: {path.stem}]({place})"
