"""Small sequences whose truth is known by hand, and estimators that do exactly what they are set to."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
import pytest

from sonar_graph.calibration import Calibration, PlanarMotion, Section, Start
from sonar_graph.errors import UnknownEstimatorError
from sonar_graph.evaluation import run as run_module
from sonar_graph.measurements import Dvl, Imu, LandmarkDetections, Measurements
from sonar_graph.sequence import Sequence
from sonar_graph.states import DetectionLog, Estimate, LandmarkMap, Outcome, Trajectory

START_NS = 1_000_000_000
SPEED_M_S = 0.2


def straight_pose(stamp_ns: int) -> gtsam.Pose3:
    """Along world x at constant speed."""
    x_m = SPEED_M_S * (stamp_ns - START_NS) * 1e-9
    return gtsam.Pose3(gtsam.Rot3(), np.array([x_m, 0.0, 0.0]))


def straight_sequence(duration_s: float = 20.0, *, truth: bool = True) -> Sequence:
    n = round(duration_s * 10) + 1
    stamps = START_NS + np.arange(n, dtype=np.int64) * 100_000_000
    unknown = np.full((n, 6, 6), np.nan)
    sequence = Sequence(
        name="straight",
        calibration=Calibration(start=Start(), planar=PlanarMotion()),
        imu=Imu(stamps, np.zeros((n, 3)), np.tile([0.0, 0.0, 9.80665], (n, 1))),
        dvl=Dvl(stamps, np.tile([SPEED_M_S, 0.0, 0.0], (n, 1)), unknown[:, :3, :3]),
        detections=LandmarkDetections(
            stamps[5:7],
            np.ones(2),
            np.zeros(2),
            unknown[:2, :2, :2],
            np.full((2, 1), 7),
            np.ones((2, 1)),
        ),
        notes={"origin": "made by hand"},
    )
    if not truth:
        return sequence
    path = [Estimate(s, straight_pose(s), unknown[0]) for s in stamps.tolist()]
    places = np.array([[1.0, 1, 0], [2, -1, 0]])
    landmarks = LandmarkMap(np.array([7, 9]), places, unknown[:2, :3, :3])
    known = {"truth": Trajectory.from_estimates(path), "true_landmarks": landmarks}
    return replace(sequence, **known)


class Offset:
    """Its estimates are beside the truth by a fixed amount; smoothing halves it."""

    class Params(Section):
        offset_m: float = 0.3
        sigma_m: float = 0.3

    def __init__(
        self, _calibration: Calibration, _odometry: Any = None, params: Any = None
    ) -> None:
        self.params = params or self.Params()
        self.estimates: list[Estimate] = []

    def process(self, measurements: Measurements) -> Estimate | None:
        self.estimates.append(self.beside(measurements.end_ns, self.params.offset_m))
        return self.estimates[-1]

    def beside(self, stamp_ns: int, offset_m: float) -> Estimate:
        moved = straight_pose(stamp_ns) * gtsam.Pose3(
            gtsam.Rot3(), (0.0, offset_m, 0.0)
        )
        covariance = np.diag([1e-4] * 3 + [self.params.sigma_m**2] * 3)
        return Estimate(stamp_ns, moved, covariance)

    def trajectory(self) -> Trajectory:
        offset_m = self.params.offset_m / 2
        return Trajectory.from_estimates(
            [self.beside(e.stamp_ns, offset_m) for e in self.estimates]
        )

    def landmarks(self) -> LandmarkMap:
        places = np.array([[1.0, 1.1, 0.0], [2.0, -0.9, 0.0], [5.0, 5.0, 0.0]])
        covariances = np.tile(np.eye(3) * 0.01, (3, 1, 1))
        return LandmarkMap(np.array([7, 9, 20]), places, covariances)

    def detections(self) -> DetectionLog:
        covariances = np.tile(np.diag([1e-4, 1e-4]), (4, 1, 1))
        covariances[0] = np.nan
        return DetectionLog(
            np.arange(1, 5),
            np.array([7, 7, 7, 9]),
            np.array([[np.nan, np.nan], [0.02, 0.0], [5.0, 0.0], [0.0, 0.01]]),
            covariances,
            [Outcome.NEW, Outcome.USED, Outcome.GATED, Outcome.USED],
        )


class Broken(Offset):
    """Fails at once."""

    def process(self, _measurements: Measurements) -> Estimate | None:
        raise RuntimeError("diverged")


@pytest.fixture
def install(monkeypatch) -> Callable[..., None]:
    """Make classes known as estimators, beside ``offset`` and ``broken``: ``install(name=Class)``."""
    installed: dict[str, Any] = {"offset": Offset, "broken": Broken}

    def load(name):
        if name not in installed:
            raise UnknownEstimatorError(f"no estimator is called {name!r}")
        return installed[name]

    monkeypatch.setattr(run_module, "load_estimator", load)
    return installed.update
