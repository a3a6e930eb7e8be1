"""Output files, checked before any long work begins, and progress on stderr, silent unless it is a terminal.

Files that the user wrote are never overwritten.
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from sonar_graph.cli.arguments import echo, printable
from sonar_graph.errors import EvaluationError, LogError, SonarGraphError
from sonar_graph.files import COMPARISON, read_json, result_folder

OWN_PAGE = '<p class="kicker">sonar_graph recognition</p>'
"""Line of every page of tracks."""


def writable_log(path: Path, *sources: Path | None, overwrite: bool = False) -> Path:
    """Check that a log can be written, say whether it replaces another, and return ``path``.

    A source, a file or folder, is never overwritten; a file that this package did not write, only if asked for.

    Raises `LogError` when it is a folder, is not called ``*.mcap``, is a source or a part of it, is a file that this
    package did not write, or its folder cannot be written to.
    """
    if path.is_dir():
        raise LogError(
            f"{path}: is a folder; give the name of a file such as {path / 'log.mcap'}"
        )
    if path.suffix != ".mcap":
        raise LogError(f"{path}: logs are MCAP files; give a name that ends in .mcap")
    if any(source is not None and _is_part_of(path, source) for source in sources):
        raise LogError(
            f"{path}: is what is read, and would be overwritten; choose another name with -o"
        )
    if not (overwrite or _is_replaceable(path)):
        raise LogError(
            f"{path}: exists, and sonar-graph did not write it; choose another name, or give --overwrite"
        )
    _require_writing_in(path.parent, path, LogError)
    if path.exists() and path.stat().st_size:
        echo(f"Replaces {path}", err=True)
    return path


def writable_json(
    path: Path,
    what: str,
    sources: Iterable[Path],
    is_own: Callable[[dict[str, Any]], bool],
    *,
    overwrite: bool = False,
) -> Path:
    """Check that a JSON file of ``what`` can be written, and return ``path``.

    Raises `EvaluationError` when it is one of the sources, cannot be written, or has a content that is not ``is_own``.
    """
    if path.is_dir() or path.suffix != ".json":
        raise EvaluationError(f"{path}: expected the name of a file that ends in .json")
    if any(_is_part_of(path, source) for source in sources):
        raise EvaluationError(
            f"{path}: is what is read, and would be overwritten; choose another name with -o"
        )
    if not overwrite and path.exists() and (not path.is_file() or path.stat().st_size):
        content: dict[str, Any] = {}
        with suppress(EvaluationError):
            content = read_json(path)
        if not is_own(content):
            raise EvaluationError(
                f"{path}: exists, and holds something else than {what}; choose another name, or give --overwrite"
            )
    _require_writing_in(path.parent, path, EvaluationError)
    return path


def writable_page(path: Path, *, overwrite: bool = False) -> Path:
    """Check that a page can be written, and return ``path``.

    Raises `EvaluationError` when it is a folder, is not called ``*.html``, cannot be written, or is a file that this
    package did not write.
    """
    if path.is_dir() or path.suffix != ".html":
        raise EvaluationError(f"{path}: expected the name of a file that ends in .html")
    if (
        not overwrite
        and path.exists()
        and OWN_PAGE not in path.read_text("utf-8", errors="replace")
    ):
        raise EvaluationError(
            f"{path}: exists, and sonar-graph did not write it; choose another name, or give --overwrite"
        )
    _require_writing_in(path.parent, path, EvaluationError)
    return path


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
    for written in (path / name for name in names if (path / name).exists()):
        if any(source is not None and written.samefile(source) for source in sources):
            raise EvaluationError(
                f"{written}: is what is read, and would be overwritten; choose another folder with -o"
            )
    _require_writing_in(path, path, EvaluationError)
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


def _is_replaceable(path: Path) -> bool:
    """True if there is no file, an empty one, or a log that this package wrote."""
    from sonar_graph.logs.mcap import is_own_log

    return not path.exists() or (
        path.is_file() and (path.stat().st_size == 0 or is_own_log(path))
    )


def _require_writing_in(
    folder: Path, path: Path, refusal: type[SonarGraphError]
) -> None:
    """Try to write to a folder, or where it would be made; an error names the path that was asked for.

    Nothing is made for that: another command may be about to write there.
    """
    try:
        with TemporaryFile(
            dir=next(
                one
                for one in (folder, *folder.parents)
                if one.exists() or one.is_symlink()
            )
        ):
            pass
    except OSError as error:
        raise refusal(
            f"{path}: cannot be written: {error.strerror}; choose another place with -o"
        ) from error


Report = Callable[..., None]
"""Called with the name of the work, the number of steps done, their total (0: not known), and perhaps a remark."""


@contextmanager
def progress_bars() -> Iterator[Report]:
    """Progress bars, one for each name of work, while the context is open."""
    console = Console(stderr=True)
    bar = (
        BarColumn(),
        TextColumn("{task.fields[remark]}"),
        TimeRemainingColumn(elapsed_when_finished=True),
    )
    columns = (TextColumn("{task.description}"), *bar)
    bars = Progress(
        *columns, console=console, disable=not console.is_terminal, transient=True
    )
    tasks = {}

    def show(what: str, done: int, total: int, remark: str = "") -> None:
        what = printable(what)
        if what not in tasks:
            tasks[what] = bars.add_task(what, remark="")
        bars.update(tasks[what], completed=done, total=total or None, remark=remark)

    with bars:
        yield show


@contextmanager
def working(what: str) -> Iterator[None]:
    """Spinner beside ``what``, for work of unknown length."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield
        return
    with console.status(what):
        yield
