"""Settings of the two filters: robust kernel, and views of landmarks far from where they are predicted.

Kernel: `invariant-ekf` with a Cauchy kernel of width 1.5 and without, `ekf-slam` for comparison, at shares of wrong
identities. Each detection's identity is replaced with that probability by one drawn evenly from the others
(`mrclam_wrong_ids.falsified`). Worlds are MRCLAM 2, 4, 6 and 9 (robots real, landmarks known), the first 1000 s of DLR
(its reference is the map of iSAM2 with right identities) and A-KIT with far landmarks simulated along its reference.
Figures are the horizontal rms of the map and of the causal trajectory after the best SE(2) alignment, means over the
runs of a world. A run is lost where the map is more than `LOST_M` off, or it fails; ``warned`` counts runs with a
message of a lock-out.

Far views: short missions that lose bottom lock for 60 and 120 s, both filters with `far_views` and without; NEES of
position over 3 and error (m, rms) so many seconds after the gap.

    python benchmarks/validation/filter_settings.py --part kernel --data recordings
    python benchmarks/validation/filter_settings.py --part far
"""

import math
import sys
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

sys.path.append(str(Path(__file__).resolve().parents[1]))
sys.path.append(str(Path(__file__).resolve().parent))
from akit import realigned
from akit_landmarks import FAR, SIGMA_AGAINST_REFERENCE_M_S
from common import conclude, in_parallel, make_parser, print_table, recording
from mrclam_wrong_ids import falsified

from sonar_graph.evaluation import judge, run_estimator
from sonar_graph.logs.convert import read_akit, read_dlr, read_mrclam
from sonar_graph.measurements import NS_PER_S
from sonar_graph.navigation.alignment import match_dvl_to_imu, match_reference_to_imu
from sonar_graph.sequence import Sequence
from sonar_graph.simulation import MissionOptions, add_landmarks, simulate_mission

SHARES, RATE_HZ, SEED, LOST_M, DLR_S = (0.0, 0.1, 0.2), 2.0, 6, 1.0, 1000.0
KERNELS: dict[str, tuple[str, dict[str, Any]]] = {
    "invariant-ekf, kernel": ("invariant-ekf", {"kernel_width": 1.5}),
    "invariant-ekf, none": ("invariant-ekf", {"kernel_width": 0.0}),
    "ekf-slam, none": ("ekf-slam", {}),
}
MRCLAM = {2: (1, 2), 4: (1, 2), 6: (1, 2, 3, 4, 5), 9: (1, 2)}
ARCHIVES = {2: "mrclam_ds2_ds4", 4: "mrclam_ds2_ds4", 6: "mrclam_ds6", 9: "mrclam_ds9"}
TRAJECTORIES = (1, 2, 3, 4, 5, 6, 7)
GAPS_S, AFTER_S, BEFORE_S = (60.0, 120.0), (3.0, 10.0, 20.0), 25.0
Case = tuple[str, int, float, str]
"""World, run, share of wrong identities, name in `KERNELS`."""


def read(folders: dict[str, Path], world: str, number: int) -> Sequence:
    """One run of a world; that of DLR with the map of iSAM2 as true landmarks."""
    if world == "akit":
        recorded = read_akit(folders[world], number)
        assert recorded.truth is not None
        dvl_offset = match_dvl_to_imu(
            recorded.imu, recorded.dvl, recorded.calibration
        ).offset.value
        reference_offset = match_reference_to_imu(
            recorded.imu, recorded.truth, recorded.calibration
        ).offset.value
        sequence = add_landmarks(
            realigned(recorded, dvl_offset, reference_offset),
            FAR.model_copy(update={"wrong_id_rate": 0.0}),
        )
        dvl = sequence.calibration.dvl.model_copy(
            update={"velocity_sigma_m_s": SIGMA_AGAINST_REFERENCE_M_S}
        )
        return replace(
            sequence, calibration=sequence.calibration.model_copy(update={"dvl": dvl})
        )
    if world == "dlr":
        sequence = first_part(read_dlr(folders[world]), DLR_S)
        reference = run_estimator(
            sequence,
            "isam2",
            {},
            instants_ns=sequence.instants(RATE_HZ),
            interim_maps=False,
        )
        return replace(sequence, true_landmarks=reference.landmarks)
    return read_mrclam(folders[world], number)


def first_part(sequence: Sequence, seconds: float) -> Sequence:
    """The detections up to an instant, and no instants after it."""
    until_ns = sequence.start_ns + round(seconds * NS_PER_S)
    blocks = {
        name: block.between(sequence.start_ns - 1, until_ns)
        for name, block in sequence.blocks().items()
    }
    return replace(sequence, **blocks)


def run_world(
    folders: dict[str, Path], run: tuple[str, int]
) -> list[tuple[Case, dict[str, float]]]:
    """Scores of all estimators at all shares on one run."""
    world, number = run
    right = read(folders, world, number)
    instants = right.instants(RATE_HZ)
    found = []
    for share in SHARES:
        sequence = falsified(right, share, [SEED, number]) if share else right
        for label, (estimator, settings) in KERNELS.items():
            result = run_estimator(
                sequence, estimator, settings, instants_ns=instants, interim_maps=False
            )
            scores = {"map": math.nan, "causal": math.nan}
            if result.status != "failed":
                (values,) = judge(sequence, instants, [result]).scores.values()
                keys = {"map": "landmarks.se2_m", "causal": "causal.ate_se2_m"}
                scores = {
                    name: values[key].value if key in values else math.nan
                    for name, key in keys.items()
                }
            scores["warned"] = float(
                any("lie outside the 99.9" in line for line in result.withheld)
            )
            found.append(((world, number, share, label), scores))
    return found


def kernel_rows(found: list[tuple[Case, dict[str, float]]]) -> list[dict[str, Any]]:
    """A row for each world, share and estimator."""
    rows = []
    for world, share, label in dict.fromkeys((w, s, e) for (w, _, s, e), _ in found):
        runs = [
            scores
            for (w, _, s, e), scores in found
            if (w, s, e) == (world, share, label)
        ]
        maps = np.array([scores["map"] for scores in runs])
        causal_m = float(np.mean([scores["causal"] for scores in runs]))
        rows.append(
            {
                "world": world,
                "wrong": share,
                "filter": label,
                "map_m": float(np.mean(maps)),
                "worst_m": float(np.max(maps)),
                "causal_m": causal_m if math.isfinite(causal_m) else None,
                "lost": int(np.sum(~(maps <= LOST_M))),
                "warned": int(sum(scores["warned"] for scores in runs)),
                "runs": len(runs),
            }
        )
    return rows


def far_case(case: tuple[float, str, bool, int]) -> list[tuple[float, float]]:
    """NEES of position over 3 and error, at each of `AFTER_S` after a gap."""
    gap_s, estimator, far_views, seed = case
    options = MissionOptions(
        seed=seed,
        duration_s=BEFORE_S + gap_s + 22.0,
        frame_rate_hz=0.5,
        false_detections_per_frame=0,
    )
    mission = simulate_mission(options)
    assert mission.truth is not None
    seconds = (mission.dvl.stamps_ns - mission.start_ns) / NS_PER_S
    lost = mission.dvl.rows((seconds <= BEFORE_S) | (seconds >= BEFORE_S + gap_s))
    first_after = np.searchsorted(
        lost.stamps_ns, mission.start_ns + (BEFORE_S + gap_s) * NS_PER_S
    )
    # the second row confirms the first
    closed_ns = int(lost.stamps_ns[first_after + 1])
    instants = closed_ns + np.round(np.array(AFTER_S) * NS_PER_S).astype(np.int64)
    sequence = replace(mission, dvl=lost, depth=None)
    result = run_estimator(
        sequence, estimator, {"far_views": far_views}, instants_ns=instants
    )
    assert result.causal is not None
    found = []
    for row, stamp_ns in enumerate(instants.tolist()):
        pose = result.causal.rows(slice(row, row + 1))
        error = pose.positions[0] - mission.truth.at(np.array([stamp_ns])).positions[0]
        in_body = pose.matrices[0].T @ error
        nees = in_body @ np.linalg.solve(pose.covariances[0, 3:, 3:], in_body)
        found.append((float(nees) / 3.0, float(np.linalg.norm(error))))
    return found


def main() -> None:
    parser = make_parser(__doc__, data=True, workers=True)
    parser.add_argument(
        "--part",
        choices=("kernel", "far"),
        required=True,
        help="which of the two tables",
    )
    parser.add_argument(
        "--worlds",
        help="kernel: some of mrclam2, mrclam4, mrclam6, mrclam9, dlr, akit (default: all)",
    )
    parser.add_argument(
        "--seeds", type=int, default=20, help="missions of each gap (default: 20)"
    )
    arguments = parser.parse_args()
    if arguments.part == "far":
        seeds = range(2 if arguments.quick else arguments.seeds)
        kinds = [
            (gap_s, name, far)
            for gap_s in GAPS_S
            for name in ("ekf-slam", "invariant-ekf")
            for far in (False, True)
        ]
        cases = [(*kind, seed) for kind in kinds for seed in seeds]
        found = np.array(
            in_parallel(far_case, cases, arguments.workers, "run")
        ).reshape(len(kinds), len(seeds), -1, 2)
        rows = []
        for (gap_s, name, far), runs in zip(kinds, found, strict=True):
            errors = np.sqrt(np.mean(runs[..., 1] ** 2, axis=0))
            rows.append(
                (
                    f"{gap_s:g} s, {name}, {'on' if far else 'off'}",
                    *np.mean(runs[..., 0], axis=0),
                    *errors,
                )
            )
        headers = (
            "",
            *(f"NEES/3 {s:g} s" for s in AFTER_S),
            *(f"m {s:g} s" for s in AFTER_S),
        )
        print_table(headers, rows)
        conclude({"rows": rows, "passed": True}, is_quick=arguments.quick)
        return
    with ExitStack() as unpacked:
        folders = {
            f"mrclam{n}": unpacked.enter_context(
                recording(arguments.data, f"{ARCHIVES[n]}.tar.xz", f"MRCLAM_Dataset{n}")
            )
            for n in MRCLAM
        }
        folders["dlr"] = unpacked.enter_context(
            recording(arguments.data, "dlr.tar.xz", "dlr")
        )
        folders["akit"] = unpacked.enter_context(
            recording(arguments.data, "akit_1-7.tar.xz", "akit")
        )
        runs = [
            (f"mrclam{n}", robot) for n, robots in MRCLAM.items() for robot in robots
        ]
        runs += [("dlr", 1), *(("akit", n) for n in TRAJECTORIES)]
        if arguments.worlds:
            runs = [run for run in runs if run[0] in arguments.worlds.split(",")]
        runs = runs[:2] if arguments.quick else runs
        found = [
            one
            for run in in_parallel(
                partial(run_world, folders), runs, arguments.workers, "run"
            )
            for one in run
        ]
    kernels = kernel_rows(found)
    print_table(
        tuple(kernels[0]),
        [
            tuple("-" if value is None else value for value in row.values())
            for row in kernels
        ],
    )
    conclude({"rows": kernels, "passed": True}, is_quick=arguments.quick)


if __name__ == "__main__":
    main()
