"""Compiled code: its first compilation is announced, and it does not outlive its sources."""

import importlib
import os
import subprocess
import sys
from pathlib import Path

import pytest

from sonar_graph.numerics import jit
from sonar_graph.numerics.jit import NOTICE, nothing_is_cached

KERNELS = """
from sonar_graph.numerics import compiled, jit

jit._sources.clear()  # of a fresh clone: those of the package are compiled here

@compiled
def twice(x):
    return 2 * x

@compiled
def thrice(x):
    return 3 * x
"""
CALLS = "import loops; assert loops.twice(2) == 4; assert loops.thrice(2) == 6; assert loops.twice(1.5) == 3.0"


def told(folder: Path, program: str = CALLS) -> str:
    path = os.pathsep.join([str(folder), str(Path(__file__).parents[1])])
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", program],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "PYTHONPATH": path},
    )
    return done.stderr


def test_the_first_compilation_is_told_once_and_later_ones_are_not(tmp_path):
    (tmp_path / "loops.py").write_text(KERNELS)
    assert told(tmp_path) == f"{NOTICE}\n"
    assert told(tmp_path) == ""
    assert told(tmp_path, "import loops; assert loops.thrice(1.5) == 4.5") == ""  # compiled, but not the first time


def test_other_functions_of_numba_are_none_of_ours(tmp_path):
    program = "import numba, sonar_graph.numerics.jit; assert numba.njit(lambda x: 2 * x)(2) == 4"
    assert told(tmp_path, program) == ""


def test_code_of_any_function_counts_as_cached(tmp_path):
    (tmp_path / "__pycache__").mkdir()
    assert nothing_is_cached([tmp_path])
    (tmp_path / "__pycache__" / "loops.twice-3.py311.nbi").touch()
    assert not nothing_is_cached([tmp_path])


CALLEE = """
{imported}

{decorator}
def inner(x):
    return x + {offset}
"""
CALLER = """
from callee import inner

{imported}

{decorator}
def outer(x):
    return 10.0 * inner(x)
"""
CHECKED = {"imported": "from sonar_graph.numerics.jit import compiled", "decorator": "@compiled"}
UNCHECKED = {"imported": "import numba", "decorator": "@numba.njit(cache=True, error_model='numpy')"}


@pytest.fixture
def answer(tmp_path, monkeypatch):
    """A compiled function that calls another in another file, imported afresh as a new interpreter would."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)

    def ask(how: dict[str, str], offset: float) -> float:
        for name, text in (("callee.py", CALLEE.format(**how, offset=offset)), ("caller.py", CALLER.format(**how))):
            if not (tmp_path / name).exists() or (tmp_path / name).read_text() != text:
                (tmp_path / name).write_text(text)
        monkeypatch.setattr(jit, "_sources", set())
        for name in ("callee", "caller"):
            monkeypatch.delitem(sys.modules, name, raising=False)
        importlib.invalidate_caches()
        return importlib.import_module("caller").outer(1.0)

    yield ask
    for name in ("callee", "caller"):
        sys.modules.pop(name, None)


def test_cached_code_does_not_outlive_a_callee_in_another_file(answer, tmp_path):
    """Nor is it dropped while nothing changes: the index then keeps its time."""
    assert answer(CHECKED, 1.0) == 20.0
    (index,) = (tmp_path / "__pycache__").glob("caller.outer-*.nbi")
    made_ns = index.stat().st_mtime_ns
    assert answer(CHECKED, 1.0) == 20.0
    assert index.stat().st_mtime_ns == made_ns
    assert answer(CHECKED, 2.5) == 35.0
    assert index.stat().st_mtime_ns > made_ns


def test_without_the_check_the_old_answer_comes_from_the_cache(answer):
    """Negative control."""
    assert answer(UNCHECKED, 1.0) == answer(UNCHECKED, 2.5) == 20.0
