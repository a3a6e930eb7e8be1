"""Dives in a map of known landmarks: errors and NEES, landmarks that moved, wrong maps, unknown starts.

Four parts, each a share of the table in `benchmarks/results/known_map.md`:

* ``field``: 30 landmarks over 100 m x 100 m. The vehicle (`spline_vehicle`) and its sonar share no code with the library.
  A dive of 600 s maps the field by iSAM2 from a start that is known; a second one of 150 s, elsewhere, gets the map;
* ``basin``: the same with the library's simulator: a dive of 240 s past four landmarks maps, another one gets the map;
* ``starts``: dives in a surveyed field, their place and heading unknown: identities right, 10 % of them wrong, and
  all of them of another landmark (a map of another place); and identities right in a map with two landmarks moved;
* ``mrclam``: three robots of UTIAS MRCLAM data set 6: the map of the first half of a log given to the second half, and
  the map of one robot given to another; with the sigmas of the log, and with those that the warnings of the mapping run
  ask for, because errors of successive sightings are alike.

A second dive starts 1 m and 0.05 rad off (basin: 0.1 m and 0.01 rad), and the same without the map. Errors are horizontal,
without alignment. NEES are of the horizontal position and of the map's landmarks, over their degrees of freedom: averages
over runs and instants +- 1.96 standard errors between runs. Two landmarks that *moved* are those that the dive sees most,
each 1 m off in the map in a direction of its own; the start is known to 1 mm then, and the map is a survey of 0.05 m.
They are *named* where the estimator names both, and no others, as moved, or as those that contradict the map. *Located*
is a start once the estimator returns a pose; its number of landmarks is that of all frames before, and one of the last.
*Right sightings alone* are those before the first landmark beyond the target, without wrong identities. A start is *wrong*
where it is over 1 m or 0.1 rad off, and outside the 1e-6 ellipse of its covariance.

``--constants`` varies the constants of the library instead (`benchmarks/results/known_map_constants.md`).
"""

import json
import re
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

sys.path.append(str(Path(__file__).resolve().parents[1]))
sys.path.append(str(Path(__file__).resolve().parent))
from common import (
    conclude,
    in_parallel,
    make_parser,
    print_table,
    recording,
    write_results,
)
from spline_vehicle import BODY_P_DVL, BODY_P_IMU, BODY_R_DVL, Vehicle, make_vehicle

from sonar_graph import load_estimator
from sonar_graph.calibration import (
    Calibration,
    DvlCalibration,
    FloorPrior,
    ImuCalibration,
    KnownMap,
    Mounting,
    SonarCalibration,
    Start,
)
from sonar_graph.estimator import known_map_of, withheld_of
from sonar_graph.evaluation import compare
from sonar_graph.logs.convert import read_mrclam
from sonar_graph.measurements import Dvl, Imu, LandmarkDetections
from sonar_graph.models import known_map as moved_landmarks
from sonar_graph.navigation import make_estimator, map_start
from sonar_graph.report.sentences import alike_errors
from sonar_graph.sequence import Sequence
from sonar_graph.simulation import BasinOptions, simulate_basin
from sonar_graph.states import LandmarkMap, Trajectory

ESTIMATORS = ("ekf-slam", "invariant-ekf", "isam2")
MAPPING_S = 600.0
DURATION_S = 150.0
IMU_HZ = 50.0
DVL_HZ = 5.0
SONAR_HZ = 1.0
FIELD_M = 100.0
LANDMARKS = 30
DEPTH_M = -2.0
FLOOR_M = -4.0
FLOOR_SIGMA_M = 0.05
REACH_M = 20.0
HALF_APERTURE_RAD = 1.1
RANGE_SIGMA_M = 0.05
AZIMUTH_SIGMA_RAD = 0.01
VELOCITY_SIGMA_M_S = 0.01
GYRO_NOISE = 1e-4
ACCEL_NOISE = 1e-3
GYRO_BIAS_SIGMA = 1e-5
ACCEL_BIAS_SIGMA = 1e-2
SURVEY_SIGMA_M = 0.05
FIELD_START = (1.0, 0.05)
"""Sigmas of the start of a second dive, m and rad."""
BASIN_START = (0.1, 0.01)
"""The basin's landmarks are near and its sonar is accurate: 1 m is beyond what EKF-SLAM can linearise there."""
SURE = 1e-3
"""Sigma of a start that is known, m and rad."""
FAR_M = 1.0
FAR_RAD = 0.1
OUTSIDE = 38.3
"""Chi-square quantile of 1 - 1e-6, six degrees of freedom."""
BASIN = {"duration_s": 240.0, "laps": 1}
ROBOTS = (1, 2, 3)
RATE_HZ = 2.0
MOST_RATIO = 0.5
MOST_MOVED_RATIO = 1.2
MOST_LANDMARKS = 3
MOST_SIGHTINGS = 8
Figures = dict[str, float]


def field(seed: int) -> np.ndarray:
    """Landmarks on the floor, shape (m, 3)."""
    rng = np.random.default_rng(1000 + seed)
    level = rng.uniform(0.0, FIELD_M, (LANDMARKS, 2))
    heights = FLOOR_M + FLOOR_SIGMA_M * rng.standard_normal(LANDMARKS)
    return np.column_stack([level, heights])


def dive(
    seed: int, places: np.ndarray, wrong: float = 0.0, duration_s: float = DURATION_S
) -> Sequence:
    """A dive from a random place and heading; ``wrong``: share of wrong identities.

    Biases and the stated start are drawn by the sigmas that the calibration states.
    """
    rng = np.random.default_rng(seed)
    drawn = np.random.default_rng((seed, 9))
    vehicle = make_vehicle(seed, duration_s)
    imu_s = np.arange(0.0, duration_s, 1.0 / IMU_HZ)
    dvl_s = np.arange(0.0, duration_s, 1.0 / DVL_HZ)
    frame_s = np.arange(0.5, duration_s - 0.5, 1.0 / SONAR_HZ)
    path = vehicle.position(imu_s)
    middle = 0.5 * (path.min(axis=0) + path.max(axis=0))
    to_field = np.array([*rng.uniform(0.35, 0.65, 2) * FIELD_M, DEPTH_M]) - [
        *middle[:2],
        path[0, 2],
    ]
    rate = vehicle.rate(imu_s)
    rate += GYRO_NOISE * np.sqrt(IMU_HZ) * rng.standard_normal(rate.shape)
    rate += GYRO_BIAS_SIGMA * drawn.standard_normal(3)
    force = vehicle.specific_force(imu_s)
    force += ACCEL_NOISE * np.sqrt(IMU_HZ) * rng.standard_normal(force.shape)
    force += ACCEL_BIAS_SIGMA * drawn.standard_normal(3)
    velocity = vehicle.doppler(dvl_s)
    velocity += VELOCITY_SIGMA_M_S * rng.standard_normal(velocity.shape)
    yaw, pitch, roll = vehicle.attitude(np.zeros(1))[0].as_euler("ZYX").tolist()
    calibration = Calibration(
        imu=ImuCalibration(
            mounting=Mounting(translation_m=tuple(BODY_P_IMU.tolist())),
            gyro_noise_density=GYRO_NOISE,
            gyro_bias_sigma=GYRO_BIAS_SIGMA,
            gyro_bias_walk_density=0.0,
            accel_noise_density=ACCEL_NOISE,
            accel_bias_sigma=ACCEL_BIAS_SIGMA,
            accel_bias_walk_density=0.0,
        ),
        dvl=DvlCalibration(
            mounting=Mounting(
                translation_m=tuple(BODY_P_DVL.tolist()),
                rpy_rad=tuple(BODY_R_DVL.as_euler("xyz").tolist()),
            ),
            velocity_sigma_m_s=(VELOCITY_SIGMA_M_S,) * 3,
        ),
        sonar=SonarCalibration(
            range_sigma_m=RANGE_SIGMA_M,
            azimuth_sigma_rad=AZIMUTH_SIGMA_RAD,
            elevation_aperture_rad=1.2,
        ),
        floor=FloorPrior(z_m=FLOOR_M, sigma_m=FLOOR_SIGMA_M),
        start=Start(
            position_m=tuple(
                (path[0] + to_field + SURE * drawn.standard_normal(3)).tolist()
            ),
            rpy_rad=tuple(
                ([roll, pitch, yaw] + SURE * drawn.standard_normal(3)).tolist()
            ),
            position_sigma_m=(SURE, SURE, SURE),
            rpy_sigma_rad=(SURE, SURE, SURE),
        ),
    )
    stamps_ns = np.rint(imu_s * 1e9).astype(np.int64)
    return Sequence(
        name=f"dive {seed}",
        calibration=calibration,
        imu=Imu(stamps_ns, rate, force),
        dvl=Dvl(
            np.rint(dvl_s * 1e9).astype(np.int64),
            velocity,
            np.full((len(dvl_s), 3, 3), np.nan),
        ),
        detections=detections(vehicle, frame_s, places - to_field, wrong, rng),
        truth=Trajectory.without_covariances(
            stamps_ns, path + to_field, vehicle.attitude(imu_s).as_quat()
        ),
        true_landmarks=LandmarkMap(
            np.arange(LANDMARKS), places, np.zeros((LANDMARKS, 3, 3))
        ),
    )


def detections(
    vehicle: Vehicle,
    frame_s: np.ndarray,
    places: np.ndarray,
    wrong: float,
    rng: np.random.Generator,
) -> LandmarkDetections:
    """Range and azimuth of the landmarks in view, in the body's axes; a share of identities is wrong."""
    rows = []
    for t in frame_s:
        at = vehicle.position(np.array([t]))[0]
        seen = vehicle.attitude(np.array([t]))[0].inv().apply(places - at)
        range_m = np.linalg.norm(seen, axis=1)
        azimuth = np.arctan2(seen[:, 1], seen[:, 0])
        in_view = (range_m < REACH_M) & (np.abs(azimuth) < HALF_APERTURE_RAD)
        elevation = np.arcsin(seen[:, 2] / range_m)
        for i in np.flatnonzero(in_view & (np.abs(elevation) < 0.6)).tolist():
            named = int(rng.integers(LANDMARKS)) if rng.random() < wrong else i
            z = range_m[i] + RANGE_SIGMA_M * rng.standard_normal()
            a = azimuth[i] + AZIMUTH_SIGMA_RAD * rng.standard_normal()
            rows.append((round(t * 1e9), named, z, a))
    stamps_ns, ids, ranges, azimuths = (
        np.array(column) for column in zip(*rows, strict=True)
    )
    n = len(rows)
    return LandmarkDetections(
        stamps_ns=stamps_ns.astype(np.int64),
        range_m=ranges,
        azimuth_rad=azimuths,
        range_azimuth_cov=np.full((n, 2, 2), np.nan),
        candidate_ids=ids.astype(np.int64)[:, None],
        id_probability=np.ones((n, 1)),
    )


def started(
    sequence: Sequence, sigma_m: float, sigma_rad: float, seed: int
) -> Sequence:
    """The sequence with a start that is drawn about the one it has."""
    rng = np.random.default_rng((seed, 7))
    start = sequence.calibration.start
    position_m = start.position_m + sigma_m * rng.standard_normal(3) * [1, 1, 0]
    roll, pitch, yaw = start.rpy_rad
    drawn = start.model_copy(
        update={
            "position_m": tuple(position_m.tolist()),
            "rpy_rad": (roll, pitch, yaw + sigma_rad * rng.standard_normal()),
            "position_sigma_m": (sigma_m, sigma_m, SURE),
            "rpy_sigma_rad": (SURE, SURE, sigma_rad),
        }
    )
    return with_calibration(sequence, start=drawn)


def lost(sequence: Sequence) -> Sequence:
    """The sequence with a start whose place and heading are to be found; depth and tilt are known to `SURE`."""
    start = sequence.calibration.start
    roll, pitch, _ = start.rpy_rad
    unknown = start.model_copy(
        update={
            "position_m": (-400.0, 700.0, start.position_m[2]),
            "rpy_rad": (roll, pitch, 0.0),
            "position_sigma_m": (SURE, SURE, SURE),
            "rpy_sigma_rad": (SURE, SURE, SURE),
            "source": "map",
        }
    )
    return with_calibration(sequence, start=unknown)


def with_calibration(sequence: Sequence, **changes: object) -> Sequence:
    calibration = sequence.calibration.model_copy(update=changes)
    return replace(sequence, calibration=calibration)


def surveyed(places: np.ndarray, ids: Any, rng: np.random.Generator) -> KnownMap:
    """Map of a survey."""
    errors = SURVEY_SIGMA_M * rng.standard_normal(places.shape)
    return KnownMap.of(list(map(int, ids)), places + errors, sigma_m=SURVEY_SIGMA_M)


class Run(NamedTuple):
    """Causal estimates of one dive beside its truth."""

    error_m: np.ndarray
    """Horizontal, shape (n, 2)."""
    nees: np.ndarray
    """Of the horizontal position over 2, shape (n,)."""
    turn_rad: np.ndarray
    """Error of the attitude, shape (n,)."""
    pose_squared: np.ndarray
    """Squared Mahalanobis distance of the pose, shape (n,)."""
    stamps_ns: np.ndarray
    messages: list[str]
    known: KnownMap | None

    @property
    def rms_m(self) -> float:
        return float(np.sqrt(np.mean(np.sum(self.error_m**2, axis=1))))


def run(
    name: str, sequence: Sequence, known: KnownMap | None, only_first: bool = False
) -> Run:
    """Estimates at two instants a second, where there is truth; ``only_first``: until the first of them."""
    sequence = with_calibration(sequence, map=known)
    estimator = make_estimator(load_estimator(name), sequence.calibration)
    found = []
    for window in sequence.replay(sequence.instants(RATE_HZ)):
        estimate = estimator.process(window)
        if estimate is not None:
            found.append(estimate)
            if only_first:
                break
    true = sequence.truth
    last_ns = true.stamps_ns[-1]
    found = [e for e in found if true.stamps_ns[0] <= e.stamp_ns <= last_ns]
    stamps_ns = np.array([e.stamp_ns for e in found], dtype=np.int64)
    if not found:
        none = np.empty(0)
        return Run(none, none, none, none, stamps_ns, withheld_of(estimator), None)
    truth = true.at(stamps_ns)
    rows = []
    for k, estimate in enumerate(found):
        R = estimate.world_T_body.rotation().matrix()
        P = estimate.covariance
        e = truth.positions[k] - estimate.world_T_body.translation()
        turn = (Rotation.from_matrix(R).inv() * truth.rotations()[k]).as_rotvec()
        pose = np.concatenate([turn, R.T @ e])
        P_level = (R @ P[3:, 3:] @ R.T)[:2, :2]
        nees = e[:2] @ np.linalg.solve(P_level, e[:2]) / 2.0
        squared = pose @ np.linalg.solve(P, pose)
        rows.append((*e[:2], nees, np.linalg.norm(turn), squared))
    columns = np.array(rows)
    return Run(
        columns[:, :2],
        columns[:, 2],
        columns[:, 3],
        columns[:, 4],
        stamps_ns,
        withheld_of(estimator),
        known_map_of(estimator),
    )


def map_nees(known: KnownMap, true: LandmarkMap) -> float:
    """Mean NEES of the landmarks of a map over 2, horizontal."""
    P = known.joint()
    squares = []
    for k, landmark_id in enumerate(known.ids):
        row = int(np.searchsorted(true.ids, landmark_id))
        e = true.positions[row, :2] - known.positions_m[k][:2]
        block = P[3 * k : 3 * k + 2, 3 * k : 3 * k + 2]
        squares.append(e @ np.linalg.solve(block, e) / 2.0)
    return float(np.mean(squares))


def in_map(name: str, second: Sequence, known: KnownMap) -> Figures:
    """A dive without the map, and with it, refined and held."""
    without = run(name, second, None)
    refined = run(name, second, known)
    held = run(name, second, known.model_copy(update={"is_fixed": True}))
    true = second.true_landmarks
    return {
        "without_m": without.rms_m,
        "with_m": refined.rms_m,
        "nees": float(refined.nees.mean()),
        "held_m": held.rms_m,
        "held_nees": float(held.nees.mean()),
        "map_nees": map_nees(known_of(refined, known), true),
        "held_map_nees": map_nees(known, true),
    }


def known_of(one: Run, known: KnownMap) -> KnownMap:
    """The map after a run, without the landmarks that it added."""
    assert one.known is not None
    return part(one.known, [i for i in one.known.ids if i in known.ids])


def part(known: KnownMap, ids: list[int]) -> KnownMap:
    """Some landmarks of a map."""
    rows = np.array([known.ids.index(i) for i in ids])
    coordinates = np.add.outer(3 * rows, np.arange(3)).ravel()
    return KnownMap.of(
        ids,
        np.array(known.positions_m)[rows],
        covariance_m2=known.joint()[np.ix_(coordinates, coordinates)],
    )


def with_moved(name: str, sure: Sequence, known: KnownMap, seed: int) -> Figures:
    """A dive in a map that has two landmarks 1 m off, and in a map without them."""
    ids, counts = np.unique(sure.detections.candidate_ids, return_counts=True)
    count = dict(zip(ids.tolist(), counts.tolist(), strict=True))
    by_count = sorted(known.ids, key=lambda i: -count.get(i, 0))
    moved = sorted(by_count[:2])
    places = np.array(known.positions_m)
    for i, angle in zip(
        moved, np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, 2), strict=True
    ):
        places[known.ids.index(i), :2] += [np.cos(angle), np.sin(angle)]
    wrong = KnownMap.of(known.ids, places, covariance_m2=known.joint())
    of_wrong = run(name, sure, wrong)
    of_rest = run(name, sure, part(known, [i for i in known.ids if i not in moved]))
    is_located = len(of_wrong.stamps_ns) > 0 and len(of_rest.stamps_ns) > 0
    return {
        "located": float(is_located),
        "moved_m": of_wrong.rms_m if is_located else 0.0,
        "rest_m": of_rest.rms_m if is_located else 0.0,
        "named": float(named_landmarks(of_wrong.messages) == set(moved)),
        "shared": float(len(set(known.ids) & set(count))),
    }


def named_landmarks(messages: list[str]) -> set[int]:
    """Landmarks that messages name as moved, or as those that contradict the map."""
    named = set()
    for line in messages:
        listed = re.search(r"landmarks? ([0-9., ]+): (mapped|sightings)", line)
        for part in listed[1].split(", ") if listed else ():
            first, *rest = part.split("..")
            named |= set(range(int(first), int(rest[0] if rest else first) + 1))
    return named


def start_with_moved(seed: int) -> Figures:
    """A dive from an unknown start in a map with two landmarks moved."""
    places = field(seed)
    known = surveyed(places, range(LANDMARKS), np.random.default_rng((seed, 9)))
    return with_moved("isam2", lost(dive(2 * seed + 1, places)), known, seed)


def field_pair(seed: int) -> dict[str, Figures]:
    """A dive that maps the field, and one in its map."""
    places = field(seed)
    mapping = dive(2 * seed, places, duration_s=MAPPING_S)
    return pair(mapping, dive(2 * seed + 1, places), FIELD_START, seed)


def basin_pair(seed: int) -> dict[str, Figures]:
    """A dive that maps the basin, and one in its map."""
    first = simulate_basin(BasinOptions(seed=2 * seed, **BASIN))
    second = simulate_basin(BasinOptions(seed=2 * seed + 1, **BASIN))
    pose = second.truth.at(np.array([second.start_ns]))
    true_start = second.calibration.start.model_copy(
        update={
            "position_m": tuple(pose.positions[0].tolist()),
            "rpy_rad": tuple(pose.rotations().as_euler("ZYX")[0, ::-1].tolist()),
        }
    )
    second = with_calibration(second, start=true_start)
    return pair(first, second, BASIN_START, seed)


def pair(
    mapping: Sequence, second: Sequence, sigmas: tuple[float, float], seed: int
) -> dict[str, Figures]:
    """Figures by estimator."""
    known = run("isam2", mapping, None).known
    assert known is not None
    unsure = started(second, *sigmas, seed)
    sure = started(second, SURE, SURE, seed)
    true = second.true_landmarks
    survey = surveyed(true.positions, true.ids, np.random.default_rng((seed, 9)))
    return {
        name: in_map(name, unsure, known) | with_moved(name, sure, survey, seed)
        for name in ESTIMATORS
    }


def start_in_map(case: tuple[int, float, bool]) -> Figures:
    """A dive from an unknown start: when it is located, and how well."""
    seed, wrong, is_other = case
    places = field(seed)
    sequence = dive(50_000 + seed, places, wrong)
    rng = np.random.default_rng(seed)
    # a shift leaves none of the identities in its place
    ids = np.roll(np.arange(LANDMARKS), 1 + seed % (LANDMARKS - 1) if is_other else 0)
    known = surveyed(places, ids, rng)
    located = run("ekf-slam", lost(sequence), known, only_first=True)
    if not len(located.stamps_ns):
        return {"located": 0.0}
    stamps_ns = sequence.detections.stamps_ns
    rows = stamps_ns <= located.stamps_ns[0]
    before = stamps_ns < stamps_ns[rows][-1]
    ids = sequence.detections.candidate_ids
    # a frame may bring several landmarks at once
    landmarks = min(len(np.unique(ids[before])) + 1, len(np.unique(ids[rows])))
    is_late = wrong > 0.0 and landmarks > MOST_SIGHTINGS
    error_m = float(np.linalg.norm(located.error_m[0]))
    is_far = error_m > FAR_M or located.turn_rad[0] > FAR_RAD
    squared = float(located.pose_squared[0])
    return {
        "located": 1.0,
        "sightings": float(rows.sum()),
        "landmarks": float(landmarks),
        "error_m": error_m,
        "far": float(is_far),
        "wrong": float(is_far and squared > OUTSIDE),
        "nees": squared / 6.0,
        "possible": float(not is_late or is_located_by_right(sequence, known)),
    }


def is_located_by_right(sequence: Sequence, known: KnownMap) -> bool:
    """True where right identities alone locate a dive before it shows one landmark more than the target has."""
    detections = sequence.detections
    ids = detections.candidate_ids[:, 0]
    _, first_rows = np.unique(ids, return_index=True)
    until = np.sort(first_rows)[MOST_SIGHTINGS]
    frames_ns, frame = np.unique(detections.stamps_ns, return_inverse=True)
    truth = sequence.truth.at(frames_ns)
    world_p = sequence.true_landmarks.positions[ids] - truth.positions[frame]
    seen = truth.rotations()[frame].inv().apply(world_p)
    range_m = np.linalg.norm(seen, axis=1)
    azimuth_rad = np.arctan2(seen[:, 1], seen[:, 0])
    is_right = np.abs(range_m - detections.range_m) < 6.0 * RANGE_SIGMA_M
    is_right &= np.abs(azimuth_rad - detections.azimuth_rad) < 6.0 * AZIMUTH_SIGMA_RAD
    rows = np.flatnonzero(is_right[:until])
    right = replace(sequence, detections=detections.rows(rows))
    return len(run("ekf-slam", lost(right), known, only_first=True).stamps_ns) > 0


def advised(first: Sequence) -> dict[str, float]:
    """Sigmas of the sonar, by their keys, that the warnings of a mapping run ask for."""
    asked = {}
    for line in alike_errors(compare(first, ["isam2"])):
        for key, value in re.findall(r"`(\w+) = (\S+)`", line):
            asked[key] = float(value)
    return asked


def robots(folder: Path, case: tuple[int, int, bool]) -> dict[str, Figures]:
    """A robot in the map of another; in that of the first half of its own log where both are the same.

    ``case``: the robot, the other one, and whether both dives have the sigmas that the mapping run asks for.
    """
    robot, other, is_advised = case
    second = read_mrclam(folder, robot)
    first = read_mrclam(folder, other)
    if robot == other:
        middle_ns = (second.start_ns + second.end_ns) // 2
        first = between(first, first.start_ns - 1, middle_ns)
        second = between(second, middle_ns, second.end_ns)
    if is_advised:
        asked = advised(first)
        print(f"robot {other} asks for {asked}", file=sys.stderr)
        sonar = first.calibration.sonar.model_copy(update=asked)
        first = with_calibration(first, sonar=sonar)
        second = with_calibration(second, sonar=sonar)
    known = run("isam2", first, None).known
    assert known is not None
    unsure = started(second, *FIELD_START, robot + 10 * other)
    found = {}
    for name in ESTIMATORS:
        found[name] = in_map(name, unsure, known)
        # how far the recording's own noise is from the stated one
        found[name]["own_nees"] = float(run(name, second, None).nees.mean())
        located = run(name, lost(second), known)
        found[name]["lost_m"] = located.rms_m
        waited_ns = located.stamps_ns[0] - second.start_ns
        found[name]["waited_s"] = float(waited_ns * 1e-9)
    return found


def between(sequence: Sequence, after_ns: int, until_ns: int) -> Sequence:
    """A part of a log that starts at its true pose."""
    cut = {
        name: block.between(after_ns, until_ns)
        for name, block in sequence.blocks().items()
    }
    cut_sequence = replace(sequence, **cut)
    pose = sequence.truth.at(np.array([cut_sequence.start_ns]))
    yaw = float(pose.rotations().as_euler("ZYX")[0, 0])
    start = sequence.calibration.start.model_copy(
        update={
            "position_m": tuple(pose.positions[0].tolist()),
            "rpy_rad": (0.0, 0.0, yaw),
        }
    )
    return with_calibration(cut_sequence, start=start)


class Claim(NamedTuple):
    """A row of the table."""

    what: str
    measured: str
    target: str
    is_met: bool


def ratio_of(rows: list[Figures], above: str, below: str) -> float:
    """Ratio of two errors, rms over runs."""
    squares = [np.mean([one[key] ** 2 for one in rows]) for key in (above, below)]
    return float(np.sqrt(squares[0] / squares[1]))


WIDEST = 0.5
"""Half of the 95 % interval of a mean NEES, up to which it says something."""


def nees_claim(what: str, rows: list[Figures], key: str) -> Claim:
    values = np.array([one[key] for one in rows])
    mean = float(values.mean())
    half = float(1.96 * values.std(ddof=1) / np.sqrt(len(values)))
    # a wide interval holds anything
    is_met = abs(mean - 1.0) <= half <= WIDEST
    return Claim(what, f"{mean:.2f} ± {half:.2f}", f"1, known to {WIDEST:g}", is_met)


def dive_claims(place: str, found: list[dict[str, Figures]]) -> list[Claim]:
    """Claims about pairs of dives."""
    claims = []
    for name in ESTIMATORS:
        rows = [one[name] for one in found]
        head = f"{place}, {name}"
        refined = ratio_of(rows, "with_m", "without_m")
        held = ratio_of(rows, "held_m", "without_m")
        claims += [
            Claim(
                f"{head}: error over that without the map; the same, held",
                f"{refined:.2f}; {held:.2f}",
                f"at most {MOST_RATIO}",
                max(refined, held) <= MOST_RATIO,
            ),
            nees_claim(f"{head}, NEES of position", rows, "nees"),
            nees_claim(f"{head}, NEES of position, held map", rows, "held_nees"),
            nees_claim(f"{head}, NEES of the refined map", rows, "map_nees"),
        ]
        if "own_nees" in rows[0]:
            own = nees_claim(
                f"{head}, NEES of position without a map, from the true start",
                rows,
                "own_nees",
            )
            claims.append(own._replace(target="", is_met=True))
        if "moved_m" in rows[0]:
            ratio = ratio_of(rows, "moved_m", "rest_m")
            named = sum(one["named"] for one in rows)
            claims += [
                Claim(
                    f"{head}, two landmarks moved: error over that without them",
                    f"{ratio:.2f}",
                    f"at most {MOST_MOVED_RATIO}",
                    ratio <= MOST_MOVED_RATIO,
                ),
                Claim(
                    f"{head}, two landmarks moved: both named, and no others",
                    f"{named:.0f} of {len(rows)}",
                    "all",
                    named == len(rows),
                ),
            ]
        if "lost_m" in rows[0]:
            ratio = ratio_of(rows, "lost_m", "without_m")
            waited_s = np.median([one["waited_s"] for one in rows])
            claims.append(
                Claim(
                    f"{head}, start found in the map: error over that without it, from 1 m; median wait",
                    f"{ratio:.2f}; {waited_s:.0f} s",
                    f"at most {MOST_RATIO}",
                    ratio <= MOST_RATIO,
                )
            )
    if "held_map_nees" in found[0][name]:
        claims.append(
            nees_claim(f"{place}, NEES of the map that is given", rows, "held_map_nees")
        )
    return claims


def start_claims(label: str, found: list[Figures], most: int) -> list[Claim]:
    """Claims about unknown starts in the right map."""
    located = [one for one in found if one["located"]]
    column = {key: np.array([one[key] for one in located]) for key in located[0]}
    is_within = column["landmarks"] <= most
    others = column["possible"][~is_within]
    share = f"{100.0 * is_within.mean():.1f} %"
    wrong = int(column["wrong"].sum())
    head = f"unknown start, {label}"
    sightings = np.percentile(column["sightings"], [50, 95])
    error_m = np.percentile(column["error_m"], [50, 95])
    return [
        Claim(
            f"{head}: located",
            f"{len(located)} of {len(found)}, after {sightings[0]:.0f} sightings (median; 95 %: {sightings[1]:.0f})",
            "all",
            len(located) == len(found),
        ),
        Claim(
            f"{head}: located after at most {most} landmarks",
            f"{share}; right sightings alone would locate {others.sum():.0f} of {len(others)} others",
            "all that right sightings alone locate",
            not others.any(),
        ),
        Claim(
            f"{head}: wrong starts",
            f"{wrong}; {column['far'].sum():.0f} over 1 m or 0.1 rad",
            "1 in 1,000",
            wrong <= len(found) / 1000.0,
        ),
        Claim(
            f"{head}: error where located",
            f"{error_m[0]:.2f} m (median; 95 %: {error_m[1]:.2f} m)",
            "",
            True,
        ),
        nees_claim(f"{head}: NEES of the first pose", located, "nees"),
    ]


def other_claim(found: list[Figures]) -> Claim:
    count = sum(one["located"] for one in found)
    return Claim(
        "unknown start, map of another place: poses claimed",
        f"{count:.0f} of {len(found)}",
        "0",
        count == 0,
    )


def start_moved_claims(found: list[Figures]) -> list[Claim]:
    """Claims about unknown starts in a map with two landmarks moved."""
    head = "unknown start, two landmarks moved"
    located = [one for one in found if one["located"]]
    ratio = ratio_of(located, "moved_m", "rest_m")
    named = sum(one["named"] for one in located)
    return [
        Claim(
            f"{head}: error over that without them",
            f"{ratio:.2f}",
            f"at most {MOST_MOVED_RATIO}",
            ratio <= MOST_MOVED_RATIO,
        ),
        Claim(
            f"{head}: both named, and no others",
            f"{named:.0f} of {len(located)} located",
            "all",
            named == len(located),
        ),
    ]


CONSTANTS = {
    "WRONG": (map_start, (0.01, 0.1, 0.3)),
    "ODDS": (map_start, (1e2, 1e3, 1e4, 1e6)),
    "MOST_OF_LANDMARK": (map_start, (1, 4, 16)),
    "LINEAR_SIGMAS": (map_start, (0.0, 3.0, 10.0)),
    "CONTRADICTS": (moved_landmarks, (9.2, 13.8, 27.6, 41.4, 100.0)),
    "FEWEST": (moved_landmarks, (1, 2, 3, 6)),
}
"""Module and values of each constant that is varied; the others stay at their own."""


def start_constant(name: str, value: float, seed: int) -> dict[str, Figures]:
    """Unknown starts with a constant changed."""
    setattr(CONSTANTS[name][0], name, value)
    return {
        "right": start_in_map((seed, 0.0, False)),
        "wrong": start_in_map((seed, 0.1, False)),
        "other": start_in_map((seed, 0.0, True)),
    }


def moved_constants(seed: int) -> dict[str, Figures]:
    """A dive with 10 % wrong identities in a map with two landmarks moved, by constant and value."""
    places = field(seed)
    known = surveyed(places, range(LANDMARKS), np.random.default_rng((seed, 9)))
    second = started(dive(2 * seed + 1, places, 0.1), SURE, SURE, seed)
    found = {}
    for name, (module, values) in CONSTANTS.items():
        if module is not moved_landmarks:
            continue
        kept = getattr(module, name)
        for value in values:
            setattr(module, name, value)
            found[f"{name} {value}"] = with_moved("ekf-slam", second, known, seed)
        setattr(module, name, kept)
    return found


def vary_constants(finished: Callable[..., list[Any]], count: int) -> None:
    """Print and write the table of constants."""
    rows: list[tuple[object, ...]] = []
    for name, (module, values) in CONSTANTS.items():
        if module is not map_start:
            continue
        kept = getattr(module, name)
        for value in values:
            vary = partial(start_constant, name, value)
            found = finished(vary, range(count), f"{name} {value}")
            setattr(module, name, kept)
            shown = []
            for kind in ("right", "wrong"):
                located = [one[kind] for one in found if one[kind]["located"]]
                landmarks = [one["landmarks"] for one in located]
                shown += [
                    float(np.mean(landmarks)),
                    int(sum(one["wrong"] for one in located)),
                    float(np.mean([one["nees"] for one in located])),
                ]
            others = int(sum(one["other"]["located"] for one in found))
            rows.append((name, f"{value:g}", *shown, others, "", ""))
    pairs = finished(moved_constants, range(max(count // 10, 2)), "constants")
    for key in pairs[0]:
        of = [one[key] for one in pairs]
        named = f"{sum(one['named'] for one in of):.0f} of {len(of)}"
        ratio = ratio_of(of, "moved_m", "rest_m")
        rows.append((*key.split(), *[""] * 7, named, ratio))
    heads = (
        "constant",
        "value",
        "landmarks until located",
        "wrong starts",
        "NEES",
        "the same with 10 % wrong identities",
        "wrong starts",
        "NEES",
        "poses in a map of another place",
        "moved landmarks named",
        "error over that without them",
    )
    print_table(heads, rows)
    title = (
        f"Constants of a known map, {count} starts and {len(pairs)} pairs of dives each"
    )
    write_results("known_map_constants.md", title, heads, rows)


def resumed(
    path: Path | None,
    workers: int,
    function: Callable[[Any], Any],
    items: Any,
    what: str,
) -> list[Any]:
    """Results of all items; those that ``path`` has are not computed again, and others are appended to it."""
    known = {}
    if path is not None and path.exists():
        for line in path.read_text(encoding="utf-8").splitlines():
            known |= json.loads(line)
    left = [item for item in items if f"{what} {item}" not in known]
    for first in range(0, len(left), CHUNK):
        chunk = left[first : first + CHUNK]
        for item, result in zip(
            chunk, in_parallel(function, chunk, workers, what), strict=True
        ):
            known[f"{what} {item}"] = result
            if path is not None:
                with path.open("a", encoding="utf-8") as file:
                    file.write(json.dumps({f"{what} {item}": result}) + "\n")
    return [known[f"{what} {item}"] for item in items]


CHUNK = 20
"""Number of items between two additions to the file."""


def robot_claims(
    finished: Callable[..., list[Any]], data: Path | None, chosen: tuple[int, ...]
) -> list[Claim]:
    """Claims about robots in a map of their own and in that of another."""
    with recording(data, "mrclam_ds6.tar.xz", "MRCLAM_Dataset6") as folder:
        function = partial(robots, folder)
        claims = []
        for is_advised in (False, True):
            sigmas = "sigmas that the mapping run asks for" * is_advised
            halves = [(r, r, is_advised) for r in chosen]
            others = [(r, r % 3 + 1, is_advised) for r in chosen]
            for place, cases in (
                ("MRCLAM, second half in the map of the first", halves),
                ("MRCLAM, map of another robot", others),
            ):
                head = f"{place}, {sigmas or 'sigmas of the log'}"
                claims += dive_claims(head, finished(function, cases, "robot"))
    return claims


def main() -> None:
    parser = make_parser(__doc__, data=True, workers=True)
    parser.add_argument("--pairs", type=int, default=20)
    parser.add_argument(
        "--basin-pairs", type=int, help="pairs in the basin (default: as in the field)"
    )
    parser.add_argument("--starts", type=int, default=1000)
    parser.add_argument(
        "--robots", type=int, default=3, help="of MRCLAM; 0 leaves it out"
    )
    parser.add_argument(
        "--constants", action="store_true", help="vary the constants of the library"
    )
    parser.add_argument(
        "--resume", type=Path, help="file of results, read first and appended to"
    )
    arguments = parser.parse_args()
    finished = partial(resumed, arguments.resume, arguments.workers)
    pairs = 2 if arguments.quick else arguments.pairs
    starts = 6 if arguments.quick else arguments.starts
    if arguments.constants:
        vary_constants(finished, min(starts, 200))
        return
    claims = dive_claims("field", finished(field_pair, range(pairs), "field"))
    of_basin = min(arguments.basin_pairs or pairs, pairs)
    claims += dive_claims("basin", finished(basin_pair, range(of_basin), "basin"))
    kinds = (
        ("identities right", 0.0, MOST_LANDMARKS),
        ("10 % of identities wrong", 0.1, MOST_SIGHTINGS),
    )
    for label, wrong, most in kinds:
        cases = [(seed, wrong, False) for seed in range(starts)]
        found = finished(start_in_map, cases, f"start, {label}")
        claims += start_claims(label, found, most)
    cases = [(seed, 0.0, True) for seed in range(max(starts // 5, 2))]
    claims.append(other_claim(finished(start_in_map, cases, "other place")))
    found = finished(start_with_moved, range(max(starts // 10, 2)), "start, moved")
    claims += start_moved_claims(found)
    chosen = ROBOTS[: 2 if arguments.quick else arguments.robots]
    if chosen:
        claims += robot_claims(finished, arguments.data, chosen)
    rows = [(c.what, c.measured, c.target, "yes" if c.is_met else "NO") for c in claims]
    heads = ("", "measured", "target", "met")
    print_table(heads, rows)
    if not arguments.quick:
        title = f"Dives in a known map, {pairs} pairs in the field, {of_basin} in the basin, 2 x {starts} starts"
        write_results("known_map.md", title, heads, rows)
    passed = all(claim.is_met for claim in claims)
    figures = {claim.what: claim.measured for claim in claims}
    conclude(figures | {"passed": passed}, is_quick=arguments.quick)


if __name__ == "__main__":
    main()
