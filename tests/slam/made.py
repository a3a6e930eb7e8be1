"""Settings, estimators, smoothers, values, graphs and detections in few words."""

from collections.abc import Iterable
from collections.abc import Sequence as Row
from typing import Any

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, L, X
from numpy.typing import ArrayLike

from sonar_graph.measurements import Floats, LandmarkDetections
from sonar_graph.navigation import Odometry, PreintegratedMotion
from sonar_graph.sequence import Sequence
from sonar_graph.settings import nested
from sonar_graph.slam import (
    BoundedHistory,
    Isam2,
    Isam2Params,
    SmootherParams,
    WholeHistory,
)
from sonar_graph.slam.prediction import PoseHistory
from sonar_graph.slam.smoother import Smoother
from sonar_graph.states import Estimate

POSES = {
    "random": gtsam.Pose3(
        gtsam.Rot3.RzRyRx(0.4, -0.6, 2.2), np.array([3.0, -2.0, 1.0])
    ),
    "near identity": gtsam.Pose3(
        gtsam.Rot3.RzRyRx(1e-9, -1e-9, 1e-9), np.array([1e-9, 0.0, 0.0])
    ),
    "yaw near pi": gtsam.Pose3(
        gtsam.Rot3.RzRyRx(0.05, 0.02, np.pi - 1e-8), np.array([-1.0, 5.0, 0.3])
    ),
    "yaw beyond -pi": gtsam.Pose3(
        gtsam.Rot3.RzRyRx(0.0, 0.0, -np.pi + 1e-8), np.array([-1.0, 5.0, 0.3])
    ),
}


def isam2_params(**given: Any) -> Isam2Params:
    """By dotted names, with two underscores for a dot: ``smoother__lag_s``."""
    return Isam2Params(
        **nested({name.replace("__", "."): value for name, value in given.items()})
    )


def ran(
    sequence: Sequence, rate_hz: float = 2.0, **params: Any
) -> tuple[Isam2, list[Estimate]]:
    """The estimator after a run, and its causal estimates."""
    estimator = Isam2(
        sequence.calibration, Odometry(sequence.calibration), isam2_params(**params)
    )
    return estimator, estimates_of(estimator, sequence, rate_hz)


def estimates_of(
    estimator: Isam2, sequence: Sequence, rate_hz: float = 2.0
) -> list[Estimate]:
    answers = [
        estimator.process(step) for step in sequence.replay(sequence.instants(rate_hz))
    ]
    return [answer for answer in answers if answer is not None]


def smoother_with(
    lag_s: float = 1e9,
    relinearize_threshold: float = 1e-6,
    stale_shift_m: float = 1e9,
    waiting_gain: float = 0.0,
    *,
    is_bounded: bool = False,
) -> Smoother:
    """One that keeps all poses, never restarts and lets nothing wait, unless set so."""
    params = SmootherParams(
        lag_s=lag_s,
        relinearize_threshold=relinearize_threshold,
        relinearize_interval_s=0.0,
        stale_shift_m=stale_shift_m,
        waiting_gain=waiting_gain,
    )
    return Smoother(
        params, BoundedHistory() if is_bounded else WholeHistory(), PoseHistory()
    )


def values_of(**named: Any) -> gtsam.Values:
    """Values by name: X0, L3, B1."""
    values = gtsam.Values()
    symbols = {"X": X, "L": L, "B": B}
    for name, value in named.items():
        values.insert(symbols[name[0]](int(name[1:])), value)
    return values


def scattered(
    values: gtsam.Values, rng: np.random.Generator, sigmas: dict[str, float]
) -> gtsam.Values:
    """Every variable moved, by sigmas of its kind: x, l, b."""
    off = values.zeroVectors()
    for key in list(values.keys()):
        moved = gtsam.VectorValues()
        moved.insert(
            key,
            sigmas[chr(gtsam.Symbol(key).chr())]
            * rng.standard_normal(len(off.at(key))),
        )
        off.update(moved)
    return values.retract(off)


def graph_of(factors: Iterable[gtsam.NonlinearFactor]) -> gtsam.NonlinearFactorGraph:
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        graph.push_back(factor)
    return graph


def plain(noise: gtsam.noiseModel.Base) -> gtsam.noiseModel.Base:
    """No kernel."""
    return noise


def huber(noise: gtsam.noiseModel.Base) -> gtsam.noiseModel.Base:
    return gtsam.noiseModel.Robust.Create(
        gtsam.noiseModel.mEstimator.Huber.Create(1.0), noise
    )


def cauchy(noise: gtsam.noiseModel.Base) -> gtsam.noiseModel.Base:
    return gtsam.noiseModel.Robust.Create(
        gtsam.noiseModel.mEstimator.Cauchy.Create(2.0), noise
    )


def isotropic(size: int, sigma: float) -> gtsam.noiseModel.Base:
    return gtsam.noiseModel.Isotropic.Sigma(size, sigma)


def pose_prior(key: int, pose: gtsam.Pose3, sigma: float) -> gtsam.NonlinearFactor:
    return gtsam.PriorFactorPose3(key, pose, isotropic(6, sigma))


def point_prior(
    key: int, point: ArrayLike, sigma: float = 0.1
) -> gtsam.NonlinearFactor:
    return gtsam.PriorFactorPoint3(key, np.asarray(point, float), isotropic(3, sigma))


def polar(world_T_sonar: gtsam.Pose3, point: Floats) -> Floats:
    """Range and azimuth of a point, by plain trigonometry."""
    x, y, z = world_T_sonar.transformTo(point)
    return np.array([np.sqrt(x * x + y * y + z * z), np.arctan2(y, x)])


def random_covariance(n: int, sigma: float, seed: int = 0) -> Floats:
    root = np.random.default_rng(seed).standard_normal((n, n))
    return sigma**2 * (root @ root.T / n + 0.1 * np.eye(n))


def motion_of(
    i_T_j: gtsam.Pose3,
    cov: Floats,
    D_bias: Floats | None = None,
    bias: Floats | None = None,
) -> PreintegratedMotion:
    """Motion of one second."""
    D_bias = np.zeros((6, 11)) if D_bias is None else D_bias
    bias = np.zeros(11) if bias is None else bias
    return PreintegratedMotion(i_T_j, cov, D_bias, bias, 1.0, np.zeros(3))


def some_motion(seed: int = 0, sigma: float = 0.01) -> PreintegratedMotion:
    rng = np.random.default_rng(seed)
    i_T_j = gtsam.Pose3.Expmap(
        np.concatenate([0.3 * rng.standard_normal(3), 0.5 * rng.standard_normal(3)])
    )
    D_bias = rng.standard_normal((6, 11))
    bias = 0.01 * rng.standard_normal(11)
    return motion_of(i_T_j, random_covariance(6, sigma, seed + 1), D_bias, bias)


def counted(monkeypatch: pytest.MonkeyPatch, owner: Any, name: str) -> list[tuple]:
    """Arguments of each call of a function or method from now on."""
    calls: list[tuple] = []
    original = getattr(owner, name)
    monkeypatch.setattr(
        owner, name, lambda *given: calls.append(given) or original(*given)
    )
    return calls


def detected(
    stamps_ns: ArrayLike,
    z: ArrayLike,
    ids: Row[Any],
    probabilities: ArrayLike,
    tracks: ArrayLike | None = None,
    cov: Floats | None = None,
) -> LandmarkDetections:
    """Rows z (range, azimuth), shape (n, 2); stamps and candidates are one for all rows or one for each."""
    z = np.asarray(z, float)
    probabilities = np.asarray(probabilities, float)
    n = len(z)
    width = probabilities.shape[-1]
    return LandmarkDetections(
        np.broadcast_to(np.asarray(stamps_ns, np.int64), n).copy(),
        z[:, 0],
        z[:, 1],
        np.tile(np.full((2, 2), np.nan) if cov is None else cov, (n, 1, 1)),
        np.broadcast_to(np.asarray(ids, np.int64), (n, width)).copy(),
        np.broadcast_to(probabilities, (n, width)).copy(),
        *([] if tracks is None else [np.asarray(tracks)]),
    )
