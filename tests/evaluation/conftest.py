"""Small sequences whose truth is known by hand, and estimators that do exactly what they are set to."""

from collections.abc import Callable
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
    return gtsam.Pose3(
        gtsam.Rot3(), np.array([SPEED_M_S * (stamp_ns - START_NS) * 1e-9, 0.0, 0.0])
    )


def straight_sequence(
    duration_s: float = 20.0, *, planar: bool = True, truth: bool = True
) -> Sequence:
    stamps = (
        START_NS
        + np.arange(0, round(duration_s * 10) + 1, dtype=np.int64) * 100_000_000
    )
    n = len(stamps)
    poses = [straight_pose(stamp) for stamp in stamps.tolist()]
    return Sequence(
        name="straight",
        calibration=Calibration(
            start=Start(), planar=PlanarMotion() if planar else None
        ),
        imu=Imu(stamps, np.zeros((n, 3)), np.tile([0.0, 0.0, 9.80665], (n, 1))),
        dvl=Dvl(
            stamps, np.tile([SPEED_M_S, 0.0, 0.0], (n, 1)), np.full((n, 3, 3), np.nan)
        ),
        detections=LandmarkDetections(
            stamps[5:7],
            np.ones(2),
            np.zeros(2),
            np.full((2, 2, 2), np.nan),
            np.full((2, 1), 7),
            np.ones((2, 1)),
        ),
        truth=Trajectory.from_estimates(
            [
                Estimate(s, pose, np.full((6, 6), np.nan))
                for s, pose in zip(stamps.tolist(), poses, strict=True)
            ]
        )
        if truth
        else None,
        true_landmarks=LandmarkMap(
            np.array([7, 9]),
            np.array([[1.0, 1, 0], [2, -1, 0]]),
            np.full((2, 3, 3), np.nan),
        )
        if truth
        else None,
        notes={"origin": "made by hand"},
    )


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
        pose = straight_pose(stamp_ns)
        moved = gtsam.Pose3(
            pose.rotation(), pose.translation() + np.array([0.0, offset_m, 0.0])
        )
        covariance = np.diag([1e-4] * 3 + [self.params.sigma_m**2] * 3)
        return Estimate(stamp_ns, moved, covariance)

    def trajectory(self) -> Trajectory:
        return Trajectory.from_estimates(
            [self.beside(e.stamp_ns, self.params.offset_m / 2) for e in self.estimates]
        )

    def landmarks(self) -> LandmarkMap:
        positions = np.array([[1.0, 1.1, 0.0], [2.0, -0.9, 0.0], [5.0, 5.0, 0.0]])
        return LandmarkMap(
            np.array([7, 9, 20]), positions, np.tile(np.eye(3) * 0.01, (3, 1, 1))
        )

    def detections(self) -> DetectionLog:
        return DetectionLog(
            stamps_ns=np.array([1, 2, 3, 4]),
            landmark_ids=np.array([7, 7, 7, 9]),
            innovations=np.array(
                [[np.nan, np.nan], [0.02, 0.0], [5.0, 0.0], [0.0, 0.01]]
            ),
            innovation_covs=np.array(
                [np.full((2, 2), np.nan)] + [np.diag([1e-4, 1e-4])] * 3
            ),
            outcomes=[Outcome.NEW, Outcome.USED, Outcome.GATED, Outcome.USED],
        )


class Broken(Offset):
    """Fails at once."""

    def process(self, _measurements: Measurements) -> Estimate | None:
        raise RuntimeError("diverged")


@pytest.fixture
def install(monkeypatch) -> Callable[..., None]:
    """Make classes known as estimators, beside ``offset`` and ``broken``: ``install(name=Class)``."""
    installed: dict[str, Any] = {"offset": Offset, "broken": Broken}

    def load(name: str) -> Any:
        if name not in installed:
            raise UnknownEstimatorError(f"no estimator is called {name!r}")
        return installed[name]

    monkeypatch.setattr(run_module, "load_estimator", load)
    return installed.update
