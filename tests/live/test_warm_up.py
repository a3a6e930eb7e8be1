"""All that a live run needs is compiled before it listens: compiling in the middle of one takes seconds."""

import json
import subprocess
import sys

import pytest

PROGRAM = """
import gc, json, sys
from numba.core.dispatcher import Dispatcher
from sonar_graph import Odometry, load_estimator
from sonar_graph.live.node import WARM_UP
from sonar_graph.simulation import MissionOptions, simulate_mission

def run(options, rate_hz):
    world = simulate_mission(options)
    estimator = load_estimator(sys.argv[1])(world.calibration, Odometry(world.calibration))
    for step in world.replay(world.instants(rate_hz)):
        estimator.process(step)
    estimator.trajectory(), estimator.landmarks()

def compiled():
    dispatchers = [one for one in gc.get_objects() if isinstance(one, Dispatcher)]
    return {f"{one.py_func.__qualname__}{signature}" for one in dispatchers for signature in one.signatures}

run(WARM_UP.model_copy(update={"duration_s": float(sys.argv[2])}) if sys.argv[2:] else WARM_UP, 10.0)
before = compiled()
run(MissionOptions(duration_s=45.0, seed=4, frame_rate_hz=10.0, dvl_dropouts_per_hour=400, dvl_dropout_s=4), 10.0)
print(json.dumps([len(before), sorted(compiled() - before)]))
"""


def compiled_late(*arguments: str) -> list[str]:
    ran = subprocess.run(
        [sys.executable, "-c", PROGRAM, *arguments],
        capture_output=True,
        text=True,
        check=True,
    )
    count, late = json.loads(ran.stdout)
    assert count > 5
    return late


@pytest.mark.parametrize("estimator", ["isam2", "ekf-slam"])
def test_a_run_after_the_warm_up_compiles_nothing(estimator: str):
    assert compiled_late(estimator) == []
