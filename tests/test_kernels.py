"""Compiled code: a user who waits gets a message, and its cache follows what it was compiled from."""

import importlib
import os
import pty
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from numba.core import event

from sonar_graph.numerics import compiling
from sonar_graph.numerics.matrices import COMPILED_IN
from sonar_graph.sonar.cfar import interpolated

KERNELS = """
from sonar_graph.numerics import compiled, matrices

matrices.COMPILED_IN.clear()

@compiled
def twice(x):
    return 2 * x

@compiled
def thrice(x):
    return 3 * x
"""
CALLS = "import loops; assert loops.twice(2) == 4; assert loops.thrice(2) == 6; assert loops.twice(1.5) == 3.0"
ERASED = "\r\x1b[2K"


def told(
    folder: Path,
    program: str = CALLS,
    stderr: int = subprocess.PIPE,
    **environment: str,
) -> str:
    path = os.pathsep.join([str(folder), str(Path(__file__).parents[1])])
    env = {**os.environ, "PYTHONPATH": path, **environment}
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", program],
        stderr=stderr,
        text=True,
        check=True,
        env=env,
    )
    return done.stderr or ""


@pytest.fixture
def loops(tmp_path: Path) -> Path:
    (tmp_path / "loops.py").write_text(KERNELS)
    return tmp_path


def test_numba_has_the_private_names_that_the_cache_uses():
    """pyproject.toml bounds numba's version for these names; look here before the bound is raised."""
    cache_file = interpolated._cache._cache_file
    assert isinstance(cache_file._source_stamp, str)
    assert isinstance(cache_file._load_index(), dict)


def test_the_first_compilation_is_told_once_and_later_ones_are_not(loops):
    assert told(loops) == f"{compiling.NOTICE}\n"
    assert told(loops) == ""
    # compiled, but not the first time
    assert told(loops, "import loops; assert loops.thrice(1.5) == 4.5") == ""


def test_a_long_wait_is_told_with_what_is_compiled_and_how_far_it_is(loops):
    program = f"from sonar_graph.numerics import compiling; compiling.TELL_EVERY_S = 0.0; {CALLS}"
    lines = ("twice (1 of about 2)", "thrice (2 of about 2)", "twice (3 of about 3)")
    assert told(loops, program) == "\n".join(
        [
            compiling.NOTICE,
            *(f"compiling for the first use: {line}" for line in lines),
            "",
        ]
    )


def test_a_terminal_shows_what_is_compiled_in_place_and_nothing_stays(loops):
    reader, terminal = pty.openpty()
    told(loops, stderr=terminal)
    shown = os.read(reader, 10_000).decode()
    told(loops, stderr=terminal)
    os.write(terminal, b"end")
    assert os.read(reader, 10_000) == b"end"  # from the cache: nothing
    head, *lines = shown.split(ERASED)
    assert head == f"{compiling.NOTICE}\r\n"
    assert lines[0] == "compiling for the first use: twice (1 of about 2)"
    assert lines[-1] == ""


def test_the_cache_goes_where_numba_is_told_and_needs_no_compiler(loops):
    told(loops, NUMBA_CACHE_DIR=str(loops / "elsewhere"))
    assert list((loops / "elsewhere").rglob("*.nbi"))
    assert told(loops, NUMBA_DISABLE_JIT="1") == ""
    assert not list(loops.glob("__pycache__/*.nbi"))


CALLER = """
from callee import inner
from limits import LIMIT
from sonar_graph.numerics.matrices import compiled

@compiled
def outer(x):
    return 10.0 * inner(x) + LIMIT
"""
CALLEE = """
from sonar_graph.numerics.matrices import {kind}

@{kind}
def inner(x):
    return x + {offset}
"""
Ask = Callable[..., tuple[float, int]]


@pytest.fixture
def ask(monkeypatch) -> Ask:
    """Answer of a function that calls one in another file, imported as by a new interpreter, and functions compiled."""
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    names = ("limits", "callee", "caller")

    def ask(
        folder: Path,
        offset: float = 1.0,
        limit: float = 0.0,
        kind: str = "compiled",
    ) -> tuple[float, int]:
        texts = (
            f"LIMIT = {limit}\n",
            CALLEE.format(kind=kind, offset=offset),
            CALLER,
        )
        for name, text in zip(names, texts, strict=True):
            sys.modules.pop(name, None)
            COMPILED_IN.pop(name, None)
            folder.mkdir(exist_ok=True)
            if (
                not (folder / f"{name}.py").exists()
                or (folder / f"{name}.py").read_text() != text
            ):
                (folder / f"{name}.py").write_text(text)
        monkeypatch.syspath_prepend(folder)
        importlib.invalidate_caches()
        with event.install_recorder("numba:compile") as recorder:
            answer = importlib.import_module("caller").outer(1.0)
        return answer, sum(found.is_start for _, found in recorder.buffer)

    yield ask
    for name in names:
        sys.modules.pop(name, None)


def test_cached_code_is_used_until_what_it_was_compiled_from_changes(ask, tmp_path):
    here = tmp_path / "here"
    there = tmp_path / "there"
    assert ask(here) == (20.0, 2)
    assert ask(here) == (20.0, 0)
    for path in here.glob("*.py"):
        os.utime(path, ns=(2_000_000_000 * 10**9,) * 2)
    assert ask(here) == (20.0, 0)
    # times of sources are those of the copy, as of an installed package
    shutil.copytree(here, there)
    shutil.rmtree(here)
    assert ask(there) == (20.0, 0)
    assert ask(there, offset=2.5) == (35.0, 2)
    # a number of a file without compiled functions
    assert ask(there, offset=2.5, limit=4.0) == (
        39.0,
        1,
    )


@pytest.mark.parametrize("kind", ["inlined", "compilable"])
def test_cached_code_sees_changes_of_what_python_runs_elsewhere(ask, tmp_path, kind):
    assert ask(tmp_path / "it", kind=kind)[0] == 20.0
    assert ask(tmp_path / "it", kind=kind) == (20.0, 0)
    assert ask(tmp_path / "it", kind=kind, offset=2.5)[0] == 35.0
