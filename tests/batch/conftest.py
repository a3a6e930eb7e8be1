"""Suites of seconds, and estimators that misbehave, installed for the processes of runs too."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from sonar_graph.batch.plan import plan_runs, source_hash, versions_of
from sonar_graph.batch.store import PlannedRun
from sonar_graph.batch.suite import read_suite

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

MISBEHAVING = """
import os, signal, time
from pathlib import Path
from baselines.dead_reckoning import DeadReckoning


class Sleeps(DeadReckoning):
    def process(self, measurements):
        time.sleep(1000)


class Prints(DeadReckoning):
    def process(self, measurements):
        os.write(1, b"written by native code")
        raise RuntimeError("diverged")


class Hungry(DeadReckoning):
    def process(self, measurements):
        self.eaten = bytearray(os.urandom(1)) * 700_000_000
        time.sleep(1000)


class Forks(DeadReckoning):
    def process(self, measurements):
        if os.fork() == 0:
            time.sleep(1000)
        time.sleep(1000)


class DiesAfterForking(DeadReckoning):
    def process(self, measurements):
        if os.fork() == 0:
            time.sleep(1000)
        os.kill(os.getpid(), signal.SIGKILL)


class HungryChild(DeadReckoning):
    def process(self, measurements):
        if os.fork() == 0:
            self.eaten = bytearray(os.urandom(1)) * 700_000_000
            time.sleep(1000)
        time.sleep(1000)


class SumsOverASet(DeadReckoning):
    def process(self, measurements):
        raise RuntimeError("-".join({f"mine {number}" for number in range(20)}))


class Dies(DeadReckoning):
    def process(self, measurements):
        os.kill(os.getpid(), signal.SIGKILL)


class DiesOnce(DeadReckoning):
    def process(self, measurements):
        mark = Path(os.environ["SONAR_GRAPH_TEST_MARK"])
        if not mark.exists():
            mark.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return super().process(measurements)
"""
ENTRY_POINTS = """[sonar_graph.estimators]
sleeps = misbehaving:Sleeps
prints = misbehaving:Prints
hungry = misbehaving:Hungry
forks = misbehaving:Forks
dies-after-forking = misbehaving:DiesAfterForking
hungry-child = misbehaving:HungryChild
dies = misbehaving:Dies
sums-over-a-set = misbehaving:SumsOverASet
dies-once = misbehaving:DiesOnce
broken = not_there:Broken
"""


@pytest.fixture
def write_suite(tmp_path) -> WriteSuite:
    """Writes a suite from its parts and gives its path."""

    def write(*parts: str) -> Path:
        path = tmp_path / "suite.toml"
        path.write_text("".join(parts) if parts else HEADER + BASIN + DEAD_RECKONING)
        return path

    return write


@pytest.fixture
def misbehaving(tmp_path, monkeypatch):
    """Estimators that fail in ways that cannot be caught, found here and in other processes."""
    folder = tmp_path / "site"
    (folder / "misbehaving-1.0.dist-info").mkdir(parents=True)
    (folder / "misbehaving-1.0.dist-info" / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: misbehaving\nVersion: 1.0\n"
    )
    (folder / "misbehaving-1.0.dist-info" / "entry_points.txt").write_text(ENTRY_POINTS)
    (folder / "misbehaving.py").write_text(MISBEHAVING)
    monkeypatch.delitem(sys.modules, "misbehaving", raising=False)  # the one of an earlier test's folder
    source_hash.cache_clear()
    versions_of.cache_clear()
    monkeypatch.syspath_prepend(folder)
    monkeypatch.setenv(
        "PYTHONPATH", os.pathsep.join([str(folder), os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep)
    )
    monkeypatch.setenv("SONAR_GRAPH_TEST_MARK", str(tmp_path / "died"))


@pytest.fixture
def planned(write_suite) -> Callable[..., PlannedRun]:
    """The one run of a suite with a named estimator."""

    def plan(estimator: str = "dead-reckoning") -> PlannedRun:
        suite = write_suite(
            HEADER.replace("dead-reckoning", estimator), BASIN, f'[[estimators]]\nname = "{estimator}"\n'
        )
        (run,) = plan_runs(read_suite(suite))
        return run

    return plan
