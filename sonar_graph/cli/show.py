"""``sonar-graph figures`` and ``view``: a result for a paper, and in the viewer that is there."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import webbrowser
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from sonar_graph.cli.arguments import Overwrite, echo
from sonar_graph.cli.outputs import working, writable_folder
from sonar_graph.errors import EvaluationError
from sonar_graph.files import PAPER

RESULT_LOG = "result.mcap"
LAYOUT = "result.foxglove.json"
PAGE = "report.html"
RESULT = "Folder that compare, run or bench wrote"


@dataclass(frozen=True)
class Viewer:
    """A program that shows MCAP files."""

    commands: tuple[str, ...]
    """Names under which it is installed."""
    application: str
    """Name of the application on macOS."""
    takes_layout: bool
    install: str


# in the order in which they are tried
VIEWERS = {
    "lichtblick": Viewer(
        ("lichtblick", "Lichtblick"),
        "Lichtblick",
        True,
        "https://github.com/lichtblick-suite/lichtblick",
    ),
    "foxglove": Viewer(
        ("foxglove", "foxglove-studio"),
        "Foxglove",
        True,
        "https://foxglove.dev/download",
    ),
    "rerun": Viewer(("rerun",), "Rerun", False, "pip install rerun-sdk"),
}


def figures(
    folder: Annotated[
        Path,
        typer.Argument(metavar="DIR", exists=True, file_okay=False, help=f"{RESULT}."),
    ],
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="DIR",
            help="Folder to write to. Default: DIR/paper.",
        ),
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Write every figure as SVG and PDF and every table as LaTeX and CSV, in the widths and type of journals.

    Beside them protocol.txt, how each number was got, and paper.tex, which shows all of them and compiles.
    """
    from sonar_graph.batch import is_batch, read_batch
    from sonar_graph.evaluation import read_comparison
    from sonar_graph.report import write_paper

    target = folder / "paper" if output is None else output
    with (
        working("drawing"),
        writable_folder(target, [], kind=PAPER, overwrite=overwrite),
    ):
        document = write_paper(
            read_batch(folder) if is_batch(folder) else read_comparison(folder),
            target,
            overwrite=overwrite,
        )
    echo(f"Figures and tables: {document}")


def view(
    result: Annotated[
        Path,
        typer.Argument(
            metavar="RESULT", exists=True, help=f"{RESULT}, or its result.mcap."
        ),
    ],
    viewer: Annotated[
        str | None,
        typer.Option(
            "--viewer",
            metavar="NAME",
            help=f"{', '.join(VIEWERS)} or browser. Default: the first found.",
        ),
    ] = None,
) -> None:
    """Open a result in Lichtblick, Foxglove or rerun, whichever is there; else its report in the browser."""
    log, page = files_of(result)
    if viewer not in (None, "browser", *VIEWERS):
        raise EvaluationError(
            f"--viewer {viewer}: expected {', '.join(VIEWERS)} or browser"
        )
    # an installed viewer is worth more than advice on another
    found = {
        name: command for name, one in VIEWERS.items() if (command := command_of(one))
    }
    chosen = viewer or next(iter(found if log else ()), "browser")
    if chosen == "browser":
        if viewer is None and not found:
            advice = "; ".join(
                f"{name}: {one.install}" for name, one in VIEWERS.items()
            )
            echo(f"No viewer for {RESULT_LOG} is installed ({advice})", err=True)
        show_page(result, page)
        return
    if chosen not in found:
        raise EvaluationError(
            f"--viewer {chosen}: is not installed: {VIEWERS[chosen].install}"
        )
    if log is None:
        raise EvaluationError(
            f"{result}: has no {RESULT_LOG} for {chosen}; compare and run write one"
        )
    if not has_screen():
        instead = f", or {page} in a browser" if page else ""
        echo(f"No screen here; open {log} with {chosen}{instead}")
        return
    # the viewer goes on when the command has ended
    subprocess.Popen(
        [*found[chosen], str(log.absolute())],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    layout = log.parent / LAYOUT
    has_layout = VIEWERS[chosen].takes_layout and layout.is_file()
    told = f"; import {layout} as its layout" if has_layout else ""
    echo(f"Opened {log} with {chosen}{told}")


def show_page(result: Path, page: Path | None) -> None:
    """Open the page of a result in the browser, or name it where there is no screen."""
    if page is None and result.is_file() and result.name != RESULT_LOG:
        raise EvaluationError(
            f"{result}: is a log, with no {PAGE} beside it; a viewer shows it ({', '.join(VIEWERS)}), and "
            f"`sonar-graph compare {result} -o DIR` makes a result of it"
        )
    if page is None:
        folder = result if result.is_dir() else result.parent
        raise EvaluationError(
            f"{result}: has no {PAGE}; sonar-graph report {folder} writes it"
        )
    is_open = has_screen() and webbrowser.open(page.absolute().as_uri())
    echo(f"{'Opened' if is_open else 'No screen here; open'} {page}")


def files_of(result: Path) -> tuple[Path | None, Path | None]:
    """The log for viewers and the page of a result, as far as they are there.

    Raises `EvaluationError` where neither is.
    """
    folder = result if result.is_dir() else result.parent
    if result.is_file() and result.suffix != ".mcap":
        raise EvaluationError(
            f"{result}: expected the folder of a result, or its {RESULT_LOG}"
        )
    log = folder / RESULT_LOG if result.is_dir() else result
    page = folder / PAGE
    if not log.is_file() and not page.is_file():
        raise EvaluationError(
            f"{result}: holds neither {RESULT_LOG} nor {PAGE}; give the folder that compare wrote"
        )
    return (log if log.is_file() else None), (page if page.is_file() else None)


def command_of(viewer: Viewer) -> list[str]:
    """The command that opens a file in a viewer; empty where it is not installed."""
    for name in viewer.commands:
        if path := shutil.which(name):
            return [path]
    if (
        sys.platform == "darwin"
        and Path(f"/Applications/{viewer.application}.app").is_dir()
    ):
        return ["open", "-a", viewer.application]
    return []


def has_screen() -> bool:
    """True where windows can be shown."""
    return sys.platform in ("darwin", "win32") or any(
        os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY")
    )
