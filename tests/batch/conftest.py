"""Suites of seconds, and estimators that misbehave, installed for the processes of runs too."""

import os
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from sonar_graph.batch import plan_runs, read_suite
from sonar_graph.batch.plan import source_hash, versions_of
from sonar_graph.batch.store import PlannedRun

WriteSuite = Callable[..., Path]

HEADER = """name = "short"
reference = "dead-reckoning"
"""
BASIN = """
[[logs]]
name = "basin"
generator = "basin"
options = { duration_s = 120, laps = 1 }
"""
DEAD_RECKONING = """
[[estimators]]
name = "dead-reckoning"
"""


FORK = "if os.fork() == 0: time.sleep(1000)"
EAT = "self.eaten = bytearray(os.urandom(1)) * 700_000_000"
DIE = "os.kill(os.getpid(), signal.SIGKILL)"
MISBEHAVING = {
    "sleeps": ["time.sleep(1000)"],
    "prints": [
        "os.write(1, b'written by native code')",
        "raise RuntimeError('diverged')",
    ],
    "hungry": [EAT, "time.sleep(1000)"],
    "forks": [FORK, "time.sleep(1000)"],
    "dies-after-forking": [FORK, DIE],
    "hungry-child": ["if os.fork() == 0:", f"    {EAT}", "time.sleep(1000)"],
    "dies": [DIE],
    "dies-once": [
        "mark = Path(os.environ['SONAR_GRAPH_TEST_MARK'])",
        *("if not mark.exists():", "    mark.touch()", f"    {DIE}"),
        "return super().process(measurements)",
    ],
    "sums-over-a-set": [
        "raise RuntimeError('-'.join({f'mine {number}' for number in range(20)}))"
    ],
}
"""What an estimator does when it gets measurements, by its name."""


@pytest.fixture
def misbehaving(tmp_path, monkeypatch):
    """Estimators that fail in ways that cannot be caught, found here and in other processes."""
    folder = tmp_path / "site"
    about = folder / "misbehaving-1.0.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: misbehaving\nVersion: 1.0\n"
    )
    points = ["[sonar_graph.estimators]", "broken = not-there.module:Broken"]
    code = ["import os, signal, time"]
    code += [
        "from pathlib import Path",
        "from baselines.dead_reckoning import DeadReckoning",
    ]
    for name, lines in MISBEHAVING.items():
        class_name = name.title().replace("-", "")
        points.append(f"{name} = misbehaving:{class_name}")
        code += [
            f"class {class_name}(DeadReckoning):",
            "    def process(self, measurements):",
        ]
        code += [f"        {line}" for line in lines]
    (about / "entry_points.txt").write_text("\n".join([*points, ""]))
    (folder / "misbehaving.py").write_text("\n".join([*code, ""]))
    # the one of an earlier test's folder
    monkeypatch.delitem(sys.modules, "misbehaving", raising=False)
    source_hash.cache_clear()
    versions_of.cache_clear()
    monkeypatch.syspath_prepend(folder)
    path = os.pathsep.join([str(folder), os.environ.get("PYTHONPATH", "")])
    monkeypatch.setenv("PYTHONPATH", path.rstrip(os.pathsep))
    monkeypatch.setenv("SONAR_GRAPH_TEST_MARK", str(tmp_path / "died"))


@pytest.fixture
def planned(plan) -> Callable[..., PlannedRun]:
    """The one run of a suite with a named estimator."""

    def of(name="dead-reckoning"):
        header = HEADER.replace("dead-reckoning", name)
        (run,) = plan(header, BASIN, f'[[estimators]]\nname = "{name}"\n')
        return run

    return of


@pytest.fixture
def write_suite(tmp_path) -> WriteSuite:
    """Writes a suite from its parts and gives its path."""

    def write(*parts):
        path = tmp_path / "suite.toml"
        path.write_text("".join(parts) if parts else HEADER + BASIN + DEAD_RECKONING)
        return path

    return write


@pytest.fixture
def plan(write_suite) -> Callable[..., list[PlannedRun]]:
    """The runs of a suite, from its parts."""
    return lambda *parts: plan_runs(read_suite(write_suite(*parts)))
