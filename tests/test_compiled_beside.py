"""Loops of estimators that another process compiles are found by this one, and a failure there does no harm."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = """
import sys
from sonar_graph.estimator import load_estimator
from sonar_graph.evaluation import run_estimator
from sonar_graph.numerics import compiled_beside, needs_compiling
from sonar_graph.testing import small_world


def fail():
    raise ValueError("no sequence")


def run():
    run_estimator(small_world(), "ekf-slam")


if __name__ == "__main__":
    module = sys.modules[load_estimator("ekf-slam").__module__]
    before = needs_compiling(module)
    with compiled_beside(fail, [module]) as wait_until_compiled:
        wait_until_compiled()
    failed = needs_compiling(module)
    with compiled_beside(run, [module]) as wait_until_compiled:
        wait_until_compiled()
    print(before, failed, needs_compiling(module))
"""


@pytest.mark.slow
def test_loops_are_in_the_cache_once_the_other_process_is_done(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    done = subprocess.run(
        [sys.executable, script],
        env=os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache")},
        cwd=Path(__file__).parents[1],
        capture_output=True,
        text=True,
    )
    assert done.stdout.split() == ["True", "True", "False"], done.stderr
    assert done.stderr == "", "only this process writes to the terminal"
