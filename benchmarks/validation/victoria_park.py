"""Does the smoother find the map that a batch solution of GTSAM finds on the same file? Victoria Park.

The batch solution is planar and made here from the file's lines, without a line of the library: between factors from
the odometry edges, bearing-range factors from the sightings, Levenberg-Marquardt. From dead reckoning it ends in a
local minimum far away (printed); it therefore starts from the estimates of GTSAM's own iSAM2, and once more from
ours: both must end at the same cost.

Odometry noise can be read in two ways. The file gives a covariance of each edge (x, y, heading) at its end. A log of
sensors has noise all along the edge, so that a heading error early in it also moves its end sideways. The batch problem
is solved under both readings: under the sensors' it is the problem that our smoother solves and the maps must be
equal; how far the file's is from that is what the conversion to a log costs.

Our smoother gets the log that the converter made. Like for like: a keyframe at every pose, no robust kernel, no
gate. As users run it: the defaults, with fewer keyframes and a robust kernel, against a batch solution with that
kernel. Such a cost has many minima that hardly differ, so the batch solver starts both from the solution without kernel
and from ours, and the lower result counts; both costs are printed. The costs of poses between keyframes are not
compared, since those are not solved for but carried on.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L, X

sys.path.append(str(Path(__file__).resolve().parents[1]))
from common import conclude, in_parallel, make_parser, note, print_table

from sonar_graph.evaluation import RunResult, run_estimator
from sonar_graph.evaluation.metrics import align_yaw
from sonar_graph.logs.convert import read_victoria_park
from sonar_graph.states import Outcome

LIKE_FOR_LIKE: dict[str, Any] = {
    "kernel": {"shape": "none"},
    "identity": {"minimum_probability": 0.0},
    "keyframes": {"motion_noise_share": 0.0, "max_interval_s": 0.5},
    "smoother": {"waiting_gain": 0.0},
}
KERNEL_WIDTH = 1.5
"""Of the default kernel (Cauchy), in standard deviations."""
SETTINGS: dict[str, dict[str, Any]] = {"like for like": LIKE_FOR_LIKE, "defaults": {}}
QUICK_LINES = 1500
PRIOR_SIGMA = 1e-3
COST_AGREEMENT = 5e-3
"""Solutions whose costs differ by less than this share are at the same minimum."""
RMS_AGREEMENT_M = 0.05
SIGMAS_AGREEMENT = 0.1
"""Rms over all landmarks, and any single one in its own standard deviations, for maps to agree."""
SLICES = 20
"""Of an edge, for adding up noise along it."""
Reading = Callable[[gtsam.Pose2, np.ndarray], np.ndarray]
"""Covariance of an edge (3, 3) from its motion and what the file says."""
Sighter = Callable[[int, int, np.ndarray, np.ndarray], list[gtsam.NonlinearFactor]]
"""Factors of a sighting from keys of pose and landmark, the point in the body frame and its covariance."""


@dataclass(frozen=True)
class Step:
    """Row of the file: the edge that leads to a pose, and the sightings from it."""

    edge: tuple[gtsam.Pose2, np.ndarray] | None
    """The motion from the pose before with its covariance (3, 3); None at the first pose."""
    points: list[tuple[int, np.ndarray, np.ndarray]]
    """Landmark, point in the body frame (2,), covariance (2, 2)."""

    def factors(
        self, index: int, reading: Reading, sighter: Sighter
    ) -> gtsam.NonlinearFactorGraph:
        """Key of the ``index``-th pose."""
        graph = gtsam.NonlinearFactorGraph()
        if self.edge is None:
            graph.push_back(
                gtsam.PriorFactorPose2(
                    X(0),
                    gtsam.Pose2(),
                    gtsam.noiseModel.Isotropic.Sigma(3, PRIOR_SIGMA),
                )
            )
        else:
            step, cov = self.edge
            noise = gtsam.noiseModel.Gaussian.Covariance(reading(step, cov), False)
            graph.push_back(
                gtsam.BetweenFactorPose2(X(index - 1), X(index), step, noise)
            )
        for landmark, point, cov in self.points:
            for factor in sighter(X(index), L(landmark), point, cov):
                graph.push_back(factor)
        return graph

    def first_values(
        self, index: int, before: gtsam.Pose2, known: set[int]
    ) -> tuple[gtsam.Pose2, gtsam.Values]:
        """The pose, and values of what is new at it, carried on from the pose before; ``known`` gains new landmarks."""
        pose = before if self.edge is None else before.compose(self.edge[0])
        values = gtsam.Values()
        values.insert(X(index), pose)
        for landmark, point, _ in self.points:
            if landmark not in known:
                known.add(landmark)
                values.insert(L(landmark), pose.transformFrom(point))
        return pose, values


def read_steps(lines: list[str]) -> list[Step]:
    """``ODOMETRY i j dx dy dtheta cxx cxy cxt cyy cyt ctt`` and ``LANDMARK i l x y cxx cxy cyy``, in driving order."""
    steps = [Step(None, [])]
    for line in lines:
        kind, *words = line.split()
        numbers = [float(word) for word in words]
        if kind == "ODOMETRY":
            steps.append(
                Step((gtsam.Pose2(*numbers[2:5]), upper_to_full(numbers[5:], 3)), [])
            )
        else:
            steps[-1].points.append(
                (int(numbers[1]), np.array(numbers[2:4]), upper_to_full(numbers[4:], 2))
            )
    return steps


def at_its_end(_: gtsam.Pose2, cov: np.ndarray) -> np.ndarray:
    """The file's covariance as it stands."""
    return cov


def all_along(step: gtsam.Pose2, cov: np.ndarray) -> np.ndarray:
    """Noise of speed and turn rate that is white along the edge and adds up to the file's variances.

    A slice's error ``e`` in the body then is ``Ad(remaining^-1) e`` at the end. Speed noise is scaled such that without
    turn noise the displacement has the file's covariance.
    """
    twist = gtsam.Pose2.Logmap(step)
    remaining = [
        gtsam.Pose2.Expmap(twist * (1 - (k + 0.5) / SLICES)).inverse().AdjointMap()
        for k in range(SLICES)
    ]
    V = np.mean(
        [
            gtsam.Pose2.Expmap(twist * (k + 0.5) / SLICES).rotation().matrix()
            for k in range(SLICES)
        ],
        axis=0,
    )
    density = np.zeros((3, 3))
    density[:2, :2] = np.linalg.solve(V, np.linalg.solve(V, cov[:2, :2]).T)
    density[2, 2] = cov[2, 2]
    return np.asarray(sum(A @ density @ A.T for A in remaining) / SLICES)


def upper_to_full(entries: list[float], size: int) -> np.ndarray:
    """A covariance from its upper triangle by rows."""
    full = np.zeros((size, size))
    full[np.triu_indices(size)] = entries
    return full + np.triu(full, 1).T


def plain_sighting(
    pose: int, landmark: int, point: np.ndarray, cov: np.ndarray
) -> list[gtsam.NonlinearFactor]:
    """Bearing and range, with the covariance that follows from the point's to first order."""
    bearing, distance, noise = bearing_and_range(point, cov)
    return [
        gtsam.BearingRangeFactor2D(
            pose,
            landmark,
            bearing,
            distance,
            gtsam.noiseModel.Gaussian.Covariance(noise, False),
        )
    ]


def robust_sighting(
    pose: int, landmark: int, point: np.ndarray, cov: np.ndarray
) -> list[gtsam.NonlinearFactor]:
    """The same with a kernel on each of the two, which the file's covariances leave uncorrelated."""
    bearing, distance, noise = bearing_and_range(point, cov)
    kernel = gtsam.noiseModel.mEstimator.Cauchy.Create(KERNEL_WIDTH)
    across, along = (
        gtsam.noiseModel.Robust.Create(
            kernel, gtsam.noiseModel.Isotropic.Variance(1, variance)
        )
        for variance in np.diag(noise).tolist()
    )
    return [
        gtsam.BearingFactor2D(pose, landmark, bearing, across),
        gtsam.RangeFactor2D(pose, landmark, distance, along),
    ]


def bearing_and_range(
    point: np.ndarray, cov: np.ndarray
) -> tuple[gtsam.Rot2, float, np.ndarray]:
    """Bearing and range of a point in the body frame, and their covariance (2, 2)."""
    distance = float(np.hypot(*point))
    J = np.array(
        [
            [-point[1] / distance**2, point[0] / distance**2],
            [point[0] / distance, point[1] / distance],
        ]
    )
    return (
        gtsam.Rot2.fromAngle(float(np.arctan2(point[1], point[0]))),
        distance,
        J @ cov @ J.T,
    )


def solve(graph: gtsam.NonlinearFactorGraph, start: gtsam.Values) -> gtsam.Values:
    """Levenberg-Marquardt to the end."""
    params = gtsam.LevenbergMarquardtParams()
    params.setMaxIterations(500)
    params.setRelativeErrorTol(1e-10)
    params.setAbsoluteErrorTol(1e-10)
    return gtsam.LevenbergMarquardtOptimizer(graph, start, params).optimize()


def dead_reckoning(steps: list[Step]) -> gtsam.Values:
    """Edges composed; landmarks where they were first seen from there."""
    pose, known, values = gtsam.Pose2(), set(), gtsam.Values()
    for index, step in enumerate(steps):
        pose, new = step.first_values(index, pose, known)
        values.insert(new)
    return values


def incremental(steps: list[Step]) -> gtsam.Values:
    """Estimates of GTSAM's own iSAM2: a start in which loops were closed as they came."""
    params = gtsam.ISAM2Params()
    params.relinearizeSkip = 1
    isam, pose, known = gtsam.ISAM2(params), gtsam.Pose2(), set()
    for index, step in enumerate(steps):
        _, new = step.first_values(index, pose, known)
        isam.update(step.factors(index, at_its_end, plain_sighting), new)
        pose = isam.calculateEstimatePose2(X(index))
        if index % 2000 == 0:
            note(f"GTSAM's iSAM2: {index} of {len(steps)} poses")
    return isam.calculateBestEstimate()


def joined(
    steps: list[Step], reading: Reading, sighter: Sighter = plain_sighting
) -> gtsam.NonlinearFactorGraph:
    """All factors."""
    graph = gtsam.NonlinearFactorGraph()
    for index, step in enumerate(steps):
        graph.push_back(step.factors(index, reading, sighter))
    return graph


def run_ours(path: Path, name: str) -> RunResult:
    """Our smoother over the converter's log; asked at each pose of the file but the first."""
    return run_estimator(read_victoria_park(path), "isam2", SETTINGS[name], rate_hz=1.0)


def in_the_plane(run: RunResult) -> gtsam.Values:
    """Our smoothed solution as values of the planar graph."""
    values = gtsam.Values()
    values.insert(X(0), gtsam.Pose2())
    assert run.smoothed is not None
    assert run.landmarks is not None
    yaw = run.smoothed.rotations().as_euler("ZYX")[:, 0]
    for index, (position, heading) in enumerate(
        zip(run.smoothed.positions, yaw.tolist(), strict=True), start=1
    ):
        values.insert(X(index), gtsam.Pose2(position[0], position[1], heading))
    for landmark, position in zip(
        run.landmarks.ids.tolist(), run.landmarks.positions, strict=True
    ):
        values.insert(L(landmark), position[:2])
    return values


def map_differences(
    ours: gtsam.Values, batch: gtsam.Values, ids: list[int]
) -> dict[str, float]:
    """Distances between the same landmarks: as they are (both begin at the first pose), and after SE(2) alignment."""
    a, b = (
        np.array([[*values.atPoint2(L(i)), 0.0] for i in ids])
        for values in (ours, batch)
    )
    raw = np.linalg.norm(a - b, axis=1)
    aligned = np.linalg.norm(align_yaw(a, b).apply(a) - b, axis=1)
    return {
        "rms_difference_m": float(np.sqrt(np.mean(raw**2))),
        "max_difference_m": float(raw.max()),
        "aligned_rms_difference_m": float(np.sqrt(np.mean(aligned**2))),
        "aligned_max_difference_m": float(aligned.max()),
    }


@dataclass(frozen=True)
class Batch:
    """A batch solution under one reading of the odometry noise."""

    graph: gtsam.NonlinearFactorGraph
    solution: gtsam.Values

    @classmethod
    def solved(cls, graph: gtsam.NonlinearFactorGraph, start: gtsam.Values) -> Batch:
        """By Levenberg-Marquardt from a start."""
        return cls(graph, solve(graph, start))

    @property
    def cost(self) -> float:
        return float(self.graph.error(self.solution))

    def against(self, run: RunResult) -> dict[str, float]:
        """Our run beside this solution; where it leads as a start must be no lower."""
        assert run.landmarks is not None
        ours = in_the_plane(run)
        return {
            "cost_ratio": self.graph.error(ours) / self.cost,
            "restarted_cost_ratio": self.graph.error(solve(self.graph, ours))
            / self.cost,
            **map_differences(ours, self.solution, run.landmarks.ids.tolist()),
            "max_difference_sigmas": self._sigmas(ours, run.landmarks.ids.tolist()),
        }

    def _sigmas(self, ours: gtsam.Values, ids: list[int]) -> float:
        """Largest difference of a landmark in standard deviations of this solution (Mahalanobis)."""
        marginals = gtsam.Marginals(self.graph, self.solution)
        squares = []
        for key in map(L, ids):
            difference = ours.atPoint2(key) - self.solution.atPoint2(key)
            squares.append(
                difference
                @ np.linalg.solve(marginals.marginalCovariance(key), difference)
            )
        return float(np.sqrt(max(squares)))


def main() -> None:
    parser = make_parser(__doc__, workers=True)
    arguments = parser.parse_args()
    lines = (
        Path(gtsam.findExampleDataFile("victoria_park.txt")).read_text().splitlines()
    )
    lines = lines[:QUICK_LINES] if arguments.quick else lines
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "victoria_park.txt"
        path.write_text("\n".join(lines) + "\n")
        runs = dict(
            zip(
                SETTINGS,
                in_parallel(
                    partial(run_ours, path), list(SETTINGS), arguments.workers, "isam2"
                ),
                strict=True,
            )
        )
    steps = read_steps(lines)
    start = incremental(steps)
    plain = {
        "sensor noise": Batch.solved(joined(steps, all_along), start),
        "file noise": Batch.solved(joined(steps, at_its_end), start),
    }
    lost = solve(plain["file noise"].graph, dead_reckoning(steps))
    lost_cost = plain["file noise"].graph.error(lost)
    print(
        f"{len(steps)} poses; cost of the batch solution {plain['file noise'].cost:.3f}; "
        f"from dead reckoning {lost_cost:.3f}"
    )
    robust = joined(steps, all_along, robust_sighting)
    starts = [
        plain["sensor noise"].solution,
        *([in_the_plane(runs["defaults"])] if runs["defaults"].landmarks else []),
    ]
    solutions = [Batch.solved(robust, values) for values in starts]
    print(
        "with a kernel, from the solution without and from ours: "
        + ", ".join(f"{s.cost:.3f}" for s in solutions)
        + "\n"
    )
    batches = {
        "like for like": plain,
        "defaults": {
            "sensor noise and kernel": min(
                solutions, key=lambda solution: solution.cost
            )
        },
    }
    conclude(report(runs, batches), is_quick=arguments.quick)


def report(
    runs: dict[str, RunResult], batches: dict[str, dict[str, Batch]]
) -> dict[str, Any]:
    """Print the table; the figures by name."""
    rows, found = [], {}
    for name, run in runs.items():
        if run.status == "failed":
            print(f"isam2, {name}: failed {run.reason}\n")
            continue
        for noise, batch in batches[name].items():
            found[name, noise] = batch.against(run)
            rows.append(
                (f"isam2 {name}, batch with {noise}", *found[name, noise].values())
            )
    print_table(
        (
            "",
            "cost ratio",
            "restarted",
            "rms m",
            "max m",
            "aligned rms m",
            "aligned max m",
            "max sigmas",
        ),
        rows,
    )
    same, defaults = (
        found.get(("like for like", "sensor noise")),
        found.get(("defaults", "sensor noise and kernel")),
    )
    figures = _named("", same) | _named(
        "file_noise_", found.get(("like for like", "file noise"))
    )
    figures |= {
        key: value
        for key, value in _named("defaults_", defaults).items()
        if "cost" not in key
    }
    figures["gated"] = {
        name: refused(run) for name, run in runs.items() if run.status == "ok"
    }
    figures["failed"] = {
        name: run.reason for name, run in runs.items() if run.status == "failed"
    }
    figures["passed"] = (
        bool(same and defaults) and passed(same) and maps_agree(defaults)
    )
    return figures


def _named(prefix: str, figures: dict[str, float] | None) -> dict[str, Any]:
    landmark = "" if prefix else "landmark_"
    return {
        prefix + (landmark if "difference" in key else "") + key: value
        for key, value in (figures or {}).items()
    }


def refused(run: RunResult) -> int:
    """Detections outside the gate; in this file all are of the landmarks that it names."""
    return (
        sum(outcome is Outcome.GATED for outcome in run.detections.outcomes)
        if run.detections
        else 0
    )


def passed(same: dict[str, float]) -> bool:
    """Check that maps are equal, and that solutions started from ours stay there."""
    return (
        maps_agree(same)
        and abs(same["cost_ratio"] - 1) <= COST_AGREEMENT
        and abs(same["restarted_cost_ratio"] - 1) <= COST_AGREEMENT
    )


def maps_agree(differences: dict[str, float]) -> bool:
    """Check that landmarks are where the batch solution has them."""
    return (
        differences["rms_difference_m"] <= RMS_AGREEMENT_M
        and differences["max_difference_sigmas"] <= SIGMAS_AGREEMENT
    )


if __name__ == "__main__":
    main()
