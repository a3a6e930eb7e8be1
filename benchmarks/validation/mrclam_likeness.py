"""Errors of MRCLAM's detections that last from one sighting to the next, and what they make of covariances.

Three robots of UTIAS MRCLAM data set 6. The second half of each log is run by EKF-SLAM in the map of the true landmarks,
from a start that is drawn 1 m and 0.05 rad about the true one. NEES and error are those of the horizontal position:

* ``as it is``: the sigmas of the converter, which fit single errors;
* ``advised``: the sigmas by which `sonar_graph.evaluation.likeness` of the first half enlarges them;
* ``shuffled``: the errors of all sightings exchanged at random. Each sighting keeps a real error, none lasts.
"""

import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

sys.path.append(str(Path(__file__).resolve().parents[1]))
sys.path.append(str(Path(__file__).resolve().parent))
from common import conclude, make_parser, print_table, recording, write_results
from known_map import (
    FIELD_START,
    ROBOTS,
    between,
    resumed,
    run,
    started,
    with_calibration,
)

from sonar_graph import run_estimator
from sonar_graph.calibration import KnownMap
from sonar_graph.evaluation import likeness
from sonar_graph.logs.convert import read_mrclam
from sonar_graph.models import wrap_angle
from sonar_graph.sequence import Sequence

SURVEY_SIGMA_M = 0.005


def shuffled(sequence: Sequence, seed: int) -> Sequence:
    """The sequence with the errors of its sightings exchanged at random, where the truth gives them."""
    detections = sequence.detections
    truth = sequence.truth
    true = sequence.true_landmarks
    ids = detections.most_probable()[0]
    stamps_ns, of_stamp = np.unique(detections.stamps_ns, return_inverse=True)
    first_ns = truth.stamps_ns[0]
    last_ns = truth.stamps_ns[-1]
    is_inside = (detections.stamps_ns >= first_ns) & (detections.stamps_ns <= last_ns)
    has_truth = is_inside & np.isin(ids, true.ids)
    poses = truth.at(stamps_ns[(stamps_ns >= first_ns) & (stamps_ns <= last_ns)])
    pose = of_stamp[has_truth] - np.count_nonzero(stamps_ns < first_ns)
    landmark = np.searchsorted(true.ids, ids[has_truth])
    sight = true.positions[landmark] - poses.positions[pose]  # (n, 3)
    R = poses.rotations().as_matrix()[pose]  # (n, 3, 3)
    x, y, _ = np.einsum("nij,ni->jn", R, sight)
    true_range_m = np.hypot(x, y)
    true_azimuth_rad = np.arctan2(y, x)
    range_errors = detections.range_m[has_truth] - true_range_m
    azimuth_errors = wrap_angle(detections.azimuth_rad[has_truth] - true_azimuth_rad)
    order = np.random.default_rng(seed).permutation(len(x))
    range_m = detections.range_m.copy()
    azimuth_rad = detections.azimuth_rad.copy()
    range_m[has_truth] = true_range_m + range_errors[order]
    azimuth_rad[has_truth] = true_azimuth_rad + azimuth_errors[order]
    exchanged = replace(detections, range_m=range_m, azimuth_rad=azimuth_rad)
    return replace(sequence, detections=exchanged)


def robot_figures(folder: Path, robot: int) -> dict[str, Any]:
    """Likeness in the first half, and error and NEES of the second."""
    log = read_mrclam(folder, robot)
    middle_ns = (log.start_ns + log.end_ns) // 2
    first = between(log, log.start_ns - 1, middle_ns)
    found_alike = likeness(run_estimator(first, "ekf-slam").detections)
    factors = found_alike.sigma_factors()
    true = log.true_landmarks
    known = KnownMap.of(true.ids, true.positions, sigma_m=SURVEY_SIGMA_M)
    second = between(log, middle_ns, log.end_ns)
    sonar = log.calibration.sonar
    wider = sonar.model_copy(
        update={
            "range_sigma_m": sonar.range_sigma_m * float(factors[0]),
            "azimuth_sigma_rad": sonar.azimuth_sigma_rad * float(factors[1]),
        }
    )
    runs = {
        "as it is": second,
        "advised": with_calibration(second, sonar=wider),
        "shuffled": between(shuffled(log, robot), middle_ns, log.end_ns),
    }
    found: dict[str, Any] = {
        "likeness": found_alike.correlation.tolist(),
        "factors": factors.tolist(),
    }
    for label, sequence in runs.items():
        unsure = started(sequence, *FIELD_START, robot + 10 * robot)
        one = run("ekf-slam", unsure, known)
        found[label] = {"rms_m": one.rms_m, "nees": float(one.nees.mean())}
    return found


def main() -> None:
    parser = make_parser(__doc__, data=True)
    parser.add_argument("--resume", type=Path, help="file of results, read first")
    arguments = parser.parse_args()
    chosen = ROBOTS[: 1 if arguments.quick else None]
    with recording(arguments.data, "mrclam_ds6.tar.xz", "MRCLAM_Dataset6") as folder:
        figures = partial(robot_figures, folder)
        found = resumed(arguments.resume, 1, figures, chosen, "robot")
    rows = []
    for robot, one in zip(chosen, found, strict=True):
        cells = [f"{value:.2f}" for value in one["likeness"] + one["factors"]]
        for label in ("as it is", "advised", "shuffled"):
            cells += [f"{one[label]['rms_m']:.3f}", f"{one[label]['nees']:.2f}"]
        rows.append((robot, *cells))
    heads = ["robot", "likeness of range", "of azimuth", "sigma times", "azimuth"]
    for label in ("as it is", "advised", "shuffled"):
        heads += [f"{label}: error, m", "NEES"]
    print_table(heads, rows)
    if not arguments.quick:
        title = "Errors of detections that last, MRCLAM set 6, in the true map"
        write_results("mrclam_likeness.md", title, heads, rows)
    advised = [one["advised"]["nees"] < one["as it is"]["nees"] for one in found]
    conclude({"passed": all(advised)}, is_quick=arguments.quick)


if __name__ == "__main__":
    main()
