"""Compile the loops that tests use, once and before the workers of pytest start: each would compile them for itself.

Three processes share the work. Where everything is compiled already, they take a few seconds.
"""

import os
import sys
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[variable] = "1"


def filters() -> str:
    """Both filters, over gaps of the Doppler log and holes of the IMU too."""
    from sonar_graph import compare
    from sonar_graph.testing import misnamed_world, small_world

    for world in (small_world(), misnamed_world()):
        compare(world, ["ekf-slam", "invariant-ekf"])
    return "filters"


def smoother() -> str:
    """Dead reckoning and iSAM2."""
    from sonar_graph import compare
    from sonar_graph.testing import small_world

    world = small_world()
    compare(world, ["isam2", "dead-reckoning"])
    return "smoother"


def images() -> str:
    """Simulated sonar images and the recogniser."""
    sys.path.insert(0, str(Path(__file__).parents[1]))
    from sonar_graph import recognise
    from tests.recognition.imaged_lane import lane_run

    lane = lane_run(1)
    recognise([lane.frames], lane.sequence)
    return "images and recognition"


if __name__ == "__main__":
    with ProcessPoolExecutor(3, mp_context=get_context("spawn")) as pool:
        for done in as_completed(
            [pool.submit(job) for job in (filters, images, smoother)]
        ):
            print(f"compiled: {done.result()}", file=sys.stderr, flush=True)
