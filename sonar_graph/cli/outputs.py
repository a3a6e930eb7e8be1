"""Output files, checked before any long work begins, and progress on stderr, silent unless it is a terminal.

Files that the user wrote are never overwritten.
"""

import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from sonar_graph.cli.arguments import echo, printable
from sonar_graph.errors import EvaluationError, LogError, SonarGraphError
from sonar_graph.files import COMPARISON, read_json, refused, result_folder

# line of every page of tracks
OWN_PAGE = '<p class="kicker">sonar_graph recognition</p>'


def writable_log(path: Path, *sources: Path | None, overwrite: bool = False) -> Path:
    """Check that a log can be written as `writable_file`, print whether it replaces another, and return ``path``."""
    from sonar_graph.logs.mcap import is_own_log

    writable_file(path, ".mcap", is_own_log, sources, overwrite=overwrite)
    if path.exists() and path.stat().st_size:
        echo(f"Replaces {path}", err=True)
    return path


def writable_file(
    path: Path,
    suffix: str,
    is_own: Callable[[Path], bool],
    sources: Iterable[Path | None] = (),
    *,
    overwrite: bool = False,
) -> Path:
    """Check that a file can be written, and return ``path``.

    A source, a file or folder, is never overwritten; a file that is not ``is_own``, only with ``overwrite``.

    Raises `LogError` when it is a folder, has another suffix, is a source or a part of it, is a file that this package
    did not write, or its folder cannot be written to.
    """
    # a wrong suffix would make a file that no other program opens
    if path.is_dir() or path.suffix != suffix:
        raise LogError(f"{path}: expected the name of a file that ends in {suffix}")
    if any(source is not None and _is_part_of(path, source) for source in sources):
        raise LogError(
            f"{path}: is what is read, and would be overwritten; choose another name with -o"
        )
    # an empty file, such as one that a script made for its name, holds nothing that could be lost
    is_free = not path.exists() or (path.is_file() and not path.stat().st_size)
    if not (overwrite or is_free or (path.is_file() and is_own(path))):
        raise LogError(
            f"{path}: exists, and sonar-graph did not write it; choose another name, or give --overwrite"
        )
    _require_writing_in(path.parent, path, LogError)
    return path


def is_json(is_own: Callable[[dict[str, Any]], bool]) -> Callable[[Path], bool]:
    """A check for `writable_file`: the file holds a JSON object that is ``is_own``."""

    def check(path: Path) -> bool:
        with suppress(EvaluationError):
            return is_own(read_json(path))
        return False

    return check


def is_own_page(path: Path) -> bool:
    """True for a page of tracks that this package wrote."""
    return OWN_PAGE in path.read_text("utf-8", errors="replace")


@contextmanager
def writable_folder(
    path: Path,
    names: Iterable[str],
    sources: Iterable[Path | None] = (),
    *,
    kind: str = COMPARISON,
    overwrite: bool = False,
) -> Iterator[Path]:
    """Make a folder for results of some names and keep other commands out of it while the block runs.

    Raises `EvaluationError` when it is a file, cannot be written to, holds one of the sources under one of the names,
    or files of these names that this package did not write, or another command writes there.
    """
    if path.exists() and not path.is_dir():
        raise EvaluationError(f"{path}: is a file; give a folder with -o")
    # through links too: the source may lie in the folder of the results
    for written in (path / name for name in names if (path / name).exists()):
        if any(source is not None and written.samefile(source) for source in sources):
            raise EvaluationError(
                f"{written}: is what is read, and would be overwritten; choose another folder with -o"
            )
    _require_writing_in(path, path, EvaluationError)
    # locked until the block ends: two commands would mix their files
    with result_folder(path, kind, overwrite=overwrite) as folder:
        folder.require(names)
        yield path


def _is_part_of(path: Path, source: Path) -> bool:
    """True if a file is the source, also through links, or lies in the folder that is the source."""
    if not path.exists():
        return False
    return path.samefile(source) or (
        source.is_dir() and path.resolve().is_relative_to(source.resolve())
    )


def _require_writing_in(
    folder: Path, path: Path, refusal: type[SonarGraphError]
) -> None:
    """Try to write to a folder, or where it would be made; an error names the path that was given.

    Nothing is made for that: another command may be about to write there.
    """
    existing = (one for one in (folder, *folder.parents) if os.path.lexists(one))
    # the only sure way to find out: rights, quotas and read-only mounts differ
    with (
        refused(path, refusal, "choose another place with -o"),
        TemporaryFile(dir=next(existing)),
    ):
        pass


# called with the name of the work, the number of steps done, their total (0: not known), and perhaps a remark
Report = Callable[..., None]


@contextmanager
def progress_bars() -> Iterator[Report]:
    """Progress bars, one for each name of work, while the context is open."""
    # stdout is for answers that another program may read
    console = Console(stderr=True)
    bars = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.fields[remark]}"),
        TimeRemainingColumn(elapsed_when_finished=True),
        console=console,
        disable=not console.is_terminal,
        transient=True,
    )
    tasks = {}

    def show(what: str, done: int, total: int, remark: str = "") -> None:
        what = printable(what)
        if what not in tasks:
            tasks[what] = bars.add_task(what, remark="")
        bars.update(tasks[what], completed=done, total=total or None, remark=remark)

    # transient: a finished bar leaves no line among the answers
    with bars:
        yield show


@contextmanager
def working(what: str) -> Iterator[None]:
    """Spinner beside ``what``, for work of unknown length."""
    console = Console(stderr=True)
    with console.status(what) if console.is_terminal else nullcontext():
        yield
