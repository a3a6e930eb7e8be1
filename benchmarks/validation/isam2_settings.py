"""Effect of iSAM2's settings: keyframes, waiting, relinearisation, marginalising, kernel and gate.

* Effort: keyframes, updates of the window and CPU time in a basin of 600 s, by default, with a keyframe at every frame
  (``motion_noise_share`` 0), and with no sighting waiting (``waiting_gain`` 0).
* Waiting: causal error on missions of 600 s, aligned in yaw and translation, root mean square over the missions.
* Relinearisation: after 300 s with nothing marginalised and nothing waiting, what iSAM2 says by itself against
  Levenberg-Marquardt on the same factors: cost over the least cost, and the newest pose's distance, in mm and in
  standard deviations of the solution (root of the normalised square per dimension).
* Marginalising: the same distance by default, after 600 s.
* Kernel and gate: basins of 600 s without bias, where nothing is an outlier, and MRCLAM data set 6, where some are.

There is no target.
"""

import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X

sys.path.append(str(Path(__file__).resolve().parents[1]))
from common import in_parallel, make_parser, print_figures, print_table, recording

from sonar_graph.evaluation import compare
from sonar_graph.logs.convert import read_mrclam
from sonar_graph.navigation import Odometry
from sonar_graph.sequence import Sequence
from sonar_graph.simulation import (
    BasinOptions,
    MissionOptions,
    simulate_basin,
    simulate_mission,
)
from sonar_graph.slam import Isam2, Isam2Params
from sonar_graph.slam.smoother import Changed, Smoother, solve

RATE_HZ, LONG_S, SHORT_S = 2.0, 600.0, 300.0
ALONE = {"lag_s": 1e6, "waiting_gain": 0.0, "stale_shift_m": 1e3}
"""iSAM2 by itself: nothing leaves the window, nothing waits, no restart."""
THRESHOLDS = (0.01, 0.001, 0.0001)
GAINS = (0.0, 2.0, 5.0, 20.0)
EFFORTS: dict[str, dict[str, Any]] = {
    "default": {},
    "share 0": {"keyframes": {"motion_noise_share": 0.0}},
    "gain 0": {"smoother": {"waiting_gain": 0.0}},
}
KERNELS: dict[str, dict[str, Any]] = {
    "huber 2.0, gate 0.999": {
        "identity": {"policy": "gate"},
        "kernel": {"shape": "huber", "width": 2.0},
    },
    "cauchy 1.5, no gate": {},
    "cauchy 1.0, no gate": {"kernel": {"width": 1.0}},
    "no kernel, no gate": {"kernel": {"shape": "none"}},
}
Scores = dict[str, dict[str, float]]
"""By kernel and figure."""


def run(sequence: Sequence, settings: dict[str, Any]) -> tuple[Isam2, int, float]:
    """The estimator at the end, how often its window was updated, and CPU seconds."""
    updates, update = 0, Smoother.update

    def counted(smoother: Smoother, time_s: float) -> Changed:
        nonlocal updates
        updates += 1
        return update(smoother, time_s)

    estimator = Isam2(
        sequence.calibration, Odometry(sequence.calibration), Isam2Params(**settings)
    )
    pieces = list(sequence.replay(sequence.instants(RATE_HZ)))
    Smoother.update = counted  # type: ignore[method-assign]
    try:
        before = time.process_time()
        for piece in pieces:
            estimator.process(piece)
        return estimator, updates, time.process_time() - before
    finally:
        Smoother.update = update  # type: ignore[method-assign]


def keyframes_of(estimator: Isam2) -> int:
    return sum(
        gtsam.Symbol(key).chr() == ord("x") for key in list(estimator.values.keys())
    )


def from_least_cost(estimator: Isam2) -> tuple[float, float, float]:
    """Cost over that of Levenberg-Marquardt, and how far the newest pose is from its solution: mm and sigmas."""
    graph, own = estimator.graph, gtsam.Values(estimator.values)
    least = solve(graph, own)
    newest = X(keyframes_of(estimator) - 1)
    off = gtsam.Pose3.Logmap(least.atPose3(newest).between(own.atPose3(newest)))
    cov = gtsam.Marginals(graph.linearize(least), least).marginalCovariance(newest)
    sigmas = float(np.sqrt(off @ np.linalg.solve(cov, off) / 6))
    return (
        graph.error(own) / graph.error(least),
        1e3 * float(np.linalg.norm(off[3:])),
        sigmas,
    )


def laps(seconds: float) -> int:
    """Two in 600 s; one takes two minutes at least."""
    return max(1, int(seconds // 300))


def basin(seconds: float, seed: int = 0) -> Sequence:
    return simulate_basin(
        BasinOptions(seed=seed, duration_s=seconds, laps=laps(seconds))
    )


def mission(seconds: float, seed: int = 0) -> Sequence:
    return simulate_mission(MissionOptions(seed=seed, duration_s=seconds))


WORLDS = {"basin": basin, "mission": mission}


def effort(seconds: float, case: str) -> tuple[int, int, int, float]:
    """Frames, keyframes, updates and CPU seconds."""
    sequence = basin(seconds)
    assert sequence.detections is not None
    run(basin(150.0), EFFORTS[case])  # compiles
    estimator, updates, cpu_s = run(sequence, EFFORTS[case])
    return (
        len(list(sequence.detections.frames())),
        keyframes_of(estimator),
        updates,
        cpu_s,
    )


def waiting(seconds: float, seed: int) -> list[float]:
    """Causal aligned error by gain, m."""
    sequence, found = mission(seconds, seed), []
    for gain in GAINS:
        compared = compare(
            sequence,
            ["isam2"],
            {"isam2": {"smoother": {"waiting_gain": gain}}},
            rate_hz=RATE_HZ,
        )
        found.append(compared.scores["isam2"]["causal.ate_yaw_m"].value)
    return found


def relinearised(seconds: float, case: tuple[str, float]) -> tuple[float, float, float]:
    """Scores of iSAM2 alone."""
    world, threshold = case
    return from_least_cost(
        run(
            WORLDS[world](seconds),
            {"smoother": {**ALONE, "relinearize_threshold": threshold}},
        )[0]
    )


def marginalised(seconds: float, world: str) -> tuple[float, float, float]:
    """By default."""
    return from_least_cost(run(WORLDS[world](seconds), {})[0])


def kernels_in_basin(seconds: float, seed: int) -> Scores:
    """Errors and NEES where no detection is an outlier."""
    options = BasinOptions(
        seed=seed,
        duration_s=seconds,
        laps=laps(seconds),
        gyro_bias_scale=0,
        accel_bias_scale=0,
    )
    return with_kernels(
        simulate_basin(options),
        1.0,
        ("causal.ate_raw_m", "smoothed.ate_raw_m", "causal.nees_position"),
    )


def kernels_on_robot(folder: Path, robot: int) -> Scores:
    """Errors on real detections."""
    return with_kernels(
        read_mrclam(folder, robot), RATE_HZ, ("smoothed.ate_se2_m", "landmarks.se2_m")
    )


def with_kernels(sequence: Sequence, rate_hz: float, keys: tuple[str, ...]) -> Scores:
    found = {}
    for name, settings in KERNELS.items():
        compared = compare(sequence, ["isam2"], {"isam2": settings}, rate_hz=rate_hz)
        found[name] = {key: compared.scores["isam2"][key].value for key in keys}
    return found


def print_kernels(title: str, found: list[Scores]) -> dict[str, Any]:
    """Averages over runs, and the largest."""
    keys = list(next(iter(found[0].values())))
    rows = [
        (
            name,
            *(
                f(values)
                for key in keys
                for values in [[of[name][key] for of in found]]
                for f in (np.mean, np.max)
            ),
        )
        for name in KERNELS
    ]
    rows = [(name, *(float(value) for value in values)) for name, *values in rows]
    print_table(
        (title, *(f"{key}{which}" for key in keys for which in (" (mean)", " (most)"))),
        rows,
    )
    return {f"{title}, {name}": values for name, *values in rows}


def main() -> None:
    parser = make_parser(__doc__, data=True, workers=True)
    arguments = parser.parse_args()
    scale, missions, seeds, robots = (
        (0.5, 2, 2, (1,)) if arguments.quick else (1.0, 6, 24, (1, 2, 3, 4, 5))
    )
    spread = partial(in_parallel, workers=arguments.workers)
    figures: dict[str, Any] = {}
    with recording(arguments.data, "mrclam_ds6.tar.xz", "MRCLAM_Dataset6") as folder:
        done = spread(partial(effort, scale * LONG_S), list(EFFORTS), what="effort")
        print_table(
            ("basin", "frames", "keyframes", "updates", "CPU s"),
            [(name, *row) for name, row in zip(EFFORTS, done, strict=True)],
        )
        errors = np.array(
            spread(partial(waiting, scale * LONG_S), range(missions), what="mission")
        )
        by_gain = (1e3 * np.sqrt(np.mean(errors**2, axis=0))).tolist()
        print_table(
            ("waiting gain", "causal rms, mm"),
            list(zip(map(str, GAINS), by_gain, strict=True)),
        )
        cases = [(world, threshold) for world in WORLDS for threshold in THRESHOLDS]
        off = spread(partial(relinearised, scale * SHORT_S), cases, what="threshold")
        named = [
            (f"{world}, relinearised at {threshold:g}", *row)
            for (world, threshold), row in zip(cases, off, strict=True)
        ]
        off = spread(partial(marginalised, scale * LONG_S), list(WORLDS), what="world")
        named += [
            (f"{world}, by default", *row)
            for world, row in zip(WORLDS, off, strict=True)
        ]
        print_table(("against the least cost", "cost ratio", "mm", "sigmas"), named)
        figures |= print_kernels(
            "basin",
            spread(
                partial(kernels_in_basin, scale * LONG_S), range(seeds), what="seed"
            ),
        )
        figures |= print_kernels(
            "MRCLAM", spread(partial(kernels_on_robot, folder), robots, what="robot")
        )
    figures |= {
        "effort": done,
        "waiting_rms_mm": by_gain,
        **{name: row for name, *row in named},
        "passed": True,
    }
    print_figures(figures)


if __name__ == "__main__":
    main()
