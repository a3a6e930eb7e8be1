"""The first compilation of a fresh clone is announced; with anything cached it is not."""

import os
import subprocess
import sys
from pathlib import Path

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
