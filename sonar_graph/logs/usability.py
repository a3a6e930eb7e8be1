"""Whether what was read of a log is enough for an estimator, and where the calibration must stand in for it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sonar_graph.errors import LogError
from sonar_graph.logs.gaps import is_partial
from sonar_graph.measurements import Block, Depth, Dvl, Floats, Imu, LandmarkDetections


def require_use(file: str, imu: Imu, dvl: Dvl) -> None:
    """Refuse measurements with which no estimator could begin.

    Raises
    ------
    LogError
        When IMU and Doppler log have no time in common, or too few beams make a velocity in every row.
    """
    if max(imu.stamps_ns[0], dvl.stamps_ns[0]) > min(imu.stamps_ns[-1], dvl.stamps_ns[-1]):
        raise LogError(
            f"{file}: IMU {_span(imu)}, DVL {_span(dvl)}: no common time; of another clock or unit? "
            f"See stamp, stamp_unit_s and stamp_offset_s of the log configuration"
        )
    if is_partial(dvl).all():
        raise LogError(
            f"{file}: DVL: too few valid beams in all {len(dvl)} rows; at least one row needs three, for a velocity in "
            f"all directions"
        )


def unsaid_noise(dvl: Dvl, depth: Depth | None, detections: LandmarkDetections | None) -> Iterator[str]:
    """Whose noise is the calibration's, because rows do not say it or say zero, less or no number."""
    yield from _unsaid("dvl", dvl, dvl.velocity_cov, "dvl.velocity_sigma_m_s")
    if depth is not None:
        yield from _unsaid("depth", depth, depth.variance_m2, "depth.sigma_m")
    if detections is not None:
        fields = "sonar.range_sigma_m and azimuth_sigma_rad"
        yield from _unsaid("detections", detections, detections.range_azimuth_cov, fields)


def _unsaid(role: str, rows: Block, covariances: Floats, fields: str) -> Iterator[str]:
    count = np.count_nonzero(np.isnan(covariances.reshape(len(rows), -1)).any(axis=1))
    if count:
        yield f"{role}: {count} of {len(rows)} rows say no covariance, {fields} of the calibration count"


def _span(rows: Block) -> str:
    first_s, last_s = rows.stamps_ns[0] * 1e-9, rows.stamps_ns[-1] * 1e-9
    return f"from {first_s:.3f} to {last_s:.3f} s"
