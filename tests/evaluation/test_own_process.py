"""Estimators of other packages run in processes of their own, and what they do stays there."""

import contextlib
import os
import re
import signal
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from sonar_graph.errors import EstimatorError
from sonar_graph.estimator import is_foreign
from sonar_graph.evaluation import check_request, compare, run_estimator
from sonar_graph.files import KilledError, OwnProcess
from sonar_graph.simulation import MissionOptions, simulate_mission

PLUGIN = """
import locale, os, sys
import numpy as np
from baselines.dead_reckoning import DeadReckoning

def meddle():
    np.sqrt = lambda value: 2.0 * value
    np.linalg.norm = np.abs
    np.seterr(all="raise")
    np.random.seed(3)
    sys.setrecursionlimit(60 + len(__import__("inspect").stack()))
    os.chdir("/")
    os.environ["OMP_NUM_THREADS"] = "7"
    os.environ["TZ"] = "Asia/Tokyo"
    locale.setlocale(locale.LC_ALL, "C")

if "SONAR_GRAPH_MEDDLES" in os.environ:
    sys.exit(7)

class Meddling(DeadReckoning):
    def process(self, measurements):
        estimate = super().process(measurements)
        meddle()
        return estimate

class Word(str):
    pass

class Wording(DeadReckoning):
    def withheld(self):
        return [Word("mine")]

class Exits(DeadReckoning):
    def process(self, measurements):
        sys.exit(3)

class Aborts(DeadReckoning):
    def process(self, measurements):
        os.abort()

class Interrupts(DeadReckoning):
    def process(self, measurements):
        raise KeyboardInterrupt("of its own")
"""


@pytest.fixture
def plugin(tmp_path, monkeypatch) -> None:
    """Estimators of another package, called ``their-NAME``."""
    about = tmp_path / "theirs-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: theirs\nVersion: 1.0\n"
    )
    names = re.findall(r"class (\w+)\(DeadReckoning", PLUGIN)
    points = [f"their-{name.lower()} = theirs:{name}" for name in names]
    text = "\n".join(["[sonar_graph.estimators]", *points, ""])
    (about / "entry_points.txt").write_text(text)
    (tmp_path / "theirs.py").write_text(PLUGIN)
    monkeypatch.syspath_prepend(tmp_path)


@pytest.fixture(scope="module")
def mission():
    return simulate_mission(MissionOptions(duration_s=10.0))


def state() -> tuple[object, ...]:
    """What `meddle` would change."""
    of_numpy = np.sqrt, np.linalg.norm, np.geterr()
    return *of_numpy, sys.getrecursionlimit(), Path.cwd(), dict(os.environ)


def test_an_estimator_cannot_change_another_s_process(plugin, mission):
    first = "dead-reckoning"
    second = "ekf-slam"
    alone = compare(mission, [first, second])
    before = state()
    together = compare(mission, [first, "their-meddling", second])
    assert state() == before
    assert "theirs" not in sys.modules
    own, meddling, other = together.runs
    assert meddling.status == "ok"
    for run, again in zip(alone.runs, (own, other), strict=True):
        for path in ("causal", "smoothed"):
            paths = [getattr(one, path) for one in (run, again)]
            for name in ("stamps_ns", "positions", "quaternions_xyzw", "covariances"):
                one, two = (getattr(path, name).tobytes() for path in paths)
                assert one == two


def test_a_process_of_its_own_gives_the_same_numbers(plugin, mission, monkeypatch):
    def ran():
        steps = []
        told = {"progress": lambda *step: steps.append(step)}
        run = run_estimator(mission, "dead-reckoning", **told)
        return run.causal.positions.tobytes(), steps

    here = ran()
    monkeypatch.setattr(
        "sonar_graph.estimator.DISTRIBUTION", "another name of this package"
    )
    assert is_foreign("dead-reckoning")
    assert ran() == here
    told = r"settings of dead-reckoning: \w+.* no such"
    with pytest.raises(EstimatorError, match=told):
        check_request("dead-reckoning", {"wrong": 1})


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("exits", r"s after the start .*: it called sys\.exit\(3\)"),
        ("aborts", "its process was ended by SIGABRT"),
        ("interrupts", "KeyboardInterrupt: of its own"),
        (
            "wording",
            r"its answer cannot be read: it has a theirs\.Word; expected a class of sonar_graph",
        ),
    ],
)
def test_the_end_of_a_process_is_the_failure_of_its_run(plugin, mission, name, reason):
    run = run_estimator(mission, f"their-{name}")
    assert run.status == "failed"
    assert re.search(reason, run.reason)
    assert "theirs" not in sys.modules


def test_a_process_that_ends_by_itself_is_named_with_its_code():
    process = OwnProcess(("-c", "raise SystemExit(4)"))
    with pytest.raises(KilledError, match="its process ended with code 4"):
        process.answer()
    process.end()


@pytest.mark.parametrize("failure", [RuntimeError, None])
def test_an_interrupt_is_no_failure_of_the_estimator(mission, monkeypatch, failure):
    def swallow(*_):
        with contextlib.suppress(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(1)
        if failure:
            raise failure("from compiled code")

    monkeypatch.setattr("baselines.dead_reckoning.DeadReckoning.process", swallow)
    with pytest.raises(KeyboardInterrupt):
        compare(mission, ["dead-reckoning"])
