"""Helpers of the benchmark scripts: arguments, recordings, workers, tables, and the last line of figures."""

import argparse
import json
import multiprocessing
import os
import platform
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")

DATA_VARIABLE = "SONAR_GRAPH_DATA"
THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMBA_NUM_THREADS",
)


def make_parser(
    description: str | None, *, data: bool = False, workers: bool = False
) -> argparse.ArgumentParser:
    """The arguments that scripts share; each adds its own."""
    parser = argparse.ArgumentParser(description=(description or "").partition("\n")[0])
    parser.add_argument(
        "--quick", action="store_true", help="a short version, to see that it runs"
    )
    if data:
        parser.add_argument(
            "--data",
            type=Path,
            default=os.environ.get(DATA_VARIABLE),
            help=f"folder with the recordings, packed or unpacked (default: the variable {DATA_VARIABLE})",
        )
    if workers:
        parser.add_argument(
            "--workers",
            type=int,
            default=os.cpu_count() or 1,
            help="processes (default: all cores)",
        )
    return parser


def refuse(message: str) -> NoReturn:
    """End with one line on stderr and exit code 2."""
    print(message, file=sys.stderr)
    raise SystemExit(2)


def note(message: str) -> None:
    """A line of progress."""
    print(message, file=sys.stderr, flush=True)


@contextmanager
def recording(data: Path | str | None, archive: str, folder: str) -> Iterator[Path]:
    """The folder of a data set, unpacked for the time being where only its archive is there.

    Parameters
    ----------
    data
        Folder with the recordings.
    archive
        Name of the packed data set in it.
    folder
        Name of the unpacked one, in ``data`` or in the archive.
    """
    if data is None:
        refuse(
            f"no recordings: give their folder with --data, or in the environment variable {DATA_VARIABLE}"
        )
    root = Path(data)
    packed = root / archive
    if (root / folder).is_dir():
        yield root / folder
    elif packed.is_file():
        with tempfile.TemporaryDirectory() as scratch:
            with tarfile.open(packed) as content:
                content.extractall(scratch, filter="data")
            yield Path(scratch) / folder
    else:
        refuse(
            f"{root} holds neither {archive} nor {folder}/; give the folder that does with --data"
        )


def in_parallel(
    function: Callable[[Item], Result], items: Sequence[Item], workers: int, what: str
) -> list[Result]:
    """``function`` of every item, in the order of the items, by one-thread processes; one worker: in this one."""
    for variable in THREAD_VARIABLES:
        os.environ[variable] = "1"
    results: dict[int, Result] = {}
    for place, result in (
        _one_by_one(function, items)
        if workers <= 1
        else _by_processes(function, items, workers)
    ):
        results[place] = result
        note(f"{what} {items[place]}: {len(results)} of {len(items)}")
    return [results[place] for place in range(len(items))]


def _one_by_one(
    function: Callable[[Item], Result], items: Sequence[Item]
) -> Iterator[tuple[int, Result]]:
    for place, item in enumerate(items):
        yield place, function(item)


def _by_processes(
    function: Callable[[Item], Result], items: Sequence[Item], workers: int
) -> Iterator[tuple[int, Result]]:
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(workers, len(items)), mp_context=context) as pool:
        jobs = {pool.submit(function, item): place for place, item in enumerate(items)}
        for job in as_completed(jobs):
            yield jobs[job], job.result()


def print_table(headers: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Columns aligned, numbers to three decimals."""
    cells = [list(headers), *([_cell(value) for value in row] for row in rows)]
    widths = [max(len(row[column]) for row in cells) for column in range(len(headers))]
    for row in cells:
        print(
            "  ".join(
                [
                    row[0].ljust(widths[0]),
                    *(c.rjust(w) for c, w in zip(row[1:], widths[1:], strict=True)),
                ]
            )
        )
    print()


def _cell(value: object) -> str:
    return f"{value:.3f}" if isinstance(value, float) else str(value)


def write_results(
    name: str, title: str, headers: Sequence[str], rows: Iterable[Sequence[object]]
) -> None:
    """Write a table to ``benchmarks/results``, with the commit, the machine and the command that measured it."""
    root = Path(__file__).resolve().parent
    described = subprocess.run(
        ["git", "describe", "--always", "--dirty"],
        cwd=root,
        capture_output=True,
        text=True,
    )
    command = " ".join(
        [
            "python",
            Path(sys.argv[0]).resolve().relative_to(root.parent).as_posix(),
            # nobody else has the files and folders of this machine
            *(
                Path(word).name if word.startswith("/") else word
                for word in sys.argv[1:]
            ),
        ]
    )
    lines = [
        f"# {title}",
        "",
        f"Measured by `{command}` at {described.stdout.strip() or 'an unknown commit'} on {os.cpu_count()} cores,"
        f" {platform.machine()}, Python {platform.python_version()}.",
        "",
        "| " + " | ".join(headers) + " |",
        "|---" * len(headers) + "|",
        *("| " + " | ".join(map(_cell, row)) + " |" for row in rows),
    ]
    path = root / "results" / name
    path.parent.mkdir(exist_ok=True)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    note(f"wrote {path}")


def print_figures(figures: dict[str, Any]) -> None:
    """The last line: one JSON object."""
    print(json.dumps(figures, allow_nan=False))


def conclude(figures: dict[str, Any], *, is_quick: bool) -> None:
    """The last line; a full run that misses a target ends with exit code 1."""
    print_figures(figures)
    if not is_quick and not figures["passed"]:
        raise SystemExit(1)
