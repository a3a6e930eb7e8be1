"""Messages of a topic as measurements.

Each function returns a block with only the rows fit for use, in the order of their stamps, and how many rows were
left out, by reason; the block is None where none is left.
"""

from __future__ import annotations

import numpy as np

from sonar_graph.calibration import Calibration
from sonar_graph.errors import LogError
from sonar_graph.logs.cdr import Messages
from sonar_graph.logs.container import Topic
from sonar_graph.logs.message_definitions import short_name
from sonar_graph.logs.pose_covariance import ros_to_body
from sonar_graph.logs.roles import PRESSURE
from sonar_graph.logs.table import Table, fit_rows, header_stamps_ns
from sonar_graph.measurements import Depth, Dvl, Floats, Imu, Ints, LandmarkDetections
from sonar_graph.states import LandmarkMap, Trajectory

Dropped = dict[str, int]

ATMOSPHERE_PA = 101_325.0
WATER_DENSITY_KG_M3 = 1000.0
_BOTTOM_MODE = 1
_NOT_FINITE = "with values that are not finite"


def _not_finite(*columns: Floats) -> np.ndarray:
    return ~np.all([np.isfinite(c).reshape(len(c), -1).all(axis=1) for c in columns], axis=0)


def read_imu(table: Table) -> tuple[Imu | None, Dropped]:
    """``sensor_msgs/Imu``: a first covariance element of -1 says that the quantity is not measured."""
    rate, force = table.columns("angular_velocity", "xyz"), table.columns("linear_acceleration", "xyz")
    unmeasured = table.column("linear_acceleration_covariance")[:, 0] == -1
    force = np.where(unmeasured[:, None] | ~np.isfinite(force), np.nan, force)
    faults = {
        "without angular rate": table.column("angular_velocity_covariance")[:, 0] == -1,
        _NOT_FINITE: _not_finite(rate),
    }
    rows, dropped = fit_rows(table.stamps_ns, faults, unique=True)
    return (Imu(table.stamps_ns[rows], rate[rows], force[rows]) if rows.size else None), dropped


def read_dvl(table: Table) -> tuple[Dvl | None, Dropped]:
    """``marine_acoustic_msgs/Dvl``: only velocities over the bottom; a covariance of -1 or all zeros is unknown.

    Where no message of a topic counts any good beam, the driver does not fill that field, and it is not used.
    """
    velocity = table.columns("velocity", "xyz")
    covariance = table.column("velocity_covar").reshape(-1, 3, 3)
    unknown = (covariance[:, 0, 0] < 0) | ~covariance.any(axis=(1, 2)) | _not_finite(covariance)
    beams = table.column("num_good_beams")
    faults = {
        "not over the bottom": table.column("velocity_mode") != _BOTTOM_MODE,
        "without a good beam": (beams == 0) & beams.any(),
        _NOT_FINITE: _not_finite(velocity),
    }
    rows, dropped = fit_rows(table.stamps_ns, faults, unique=True)
    covariance = np.where(unknown[:, None, None], np.nan, covariance)
    return (Dvl(table.stamps_ns[rows], velocity[rows], covariance[rows]) if rows.size else None), dropped


def read_depth(table: Table, calibration: Calibration) -> tuple[Depth | None, Dropped]:
    """Height from pressure, ``z = -(p - 101325 Pa) / (rho g)``, or from a pose; a variance not above 0 is unknown."""
    if short_name(table.topic.type_name) == short_name(PRESSURE):
        pascals_per_metre = WATER_DENSITY_KG_M3 * calibration.gravity_m_s2
        z_m = (ATMOSPHERE_PA - table.column("fluid_pressure")) / pascals_per_metre
        variance_m2 = table.column("variance") / pascals_per_metre**2
    else:
        z_m, variance_m2 = _depth_of_poses(table)
    variance_m2 = np.where(np.isfinite(variance_m2) & (variance_m2 > 0), variance_m2, np.nan)
    rows, dropped = fit_rows(table.stamps_ns, {_NOT_FINITE: _not_finite(z_m)}, unique=True)
    return (Depth(table.stamps_ns[rows], z_m[rows], variance_m2[rows]) if rows.size else None), dropped


def _depth_of_poses(table: Table) -> tuple[Floats, Floats]:
    if "pose.pose.position.z" in table.groups[0].layout.columns:
        return table.column("pose.pose.position.z"), table.column("pose.covariance")[:, 14]
    return table.column("pose.position.z"), np.full(len(table), np.nan)


def read_truth(table: Table) -> tuple[Trajectory | None, Dropped]:
    """``nav_msgs/Odometry`` as reference poses of the body; the twist is not used."""
    positions = table.columns("pose.pose.position", "xyz")
    quaternions = table.columns("pose.pose.orientation", "xyzw")
    lengths = np.linalg.norm(quaternions, axis=1)
    faults = {_NOT_FINITE: _not_finite(positions, quaternions), "without an orientation": lengths < 0.5}
    rows, dropped = fit_rows(table.stamps_ns, faults, unique=True)
    if not rows.size:
        return None, dropped
    scale = np.where(np.abs(lengths - 1) > 1e-6, lengths, 1.0)  # what is of unit length stays as it is to the bit
    truth = Trajectory.without_covariances(table.stamps_ns[rows], positions[rows], (quaternions / scale[:, None])[rows])
    covariances = table.column("pose.covariance").reshape(-1, 6, 6)[rows]
    covariances = ros_to_body(covariances, truth.rotations().as_matrix())
    return Trajectory(truth.stamps_ns, truth.positions, truth.quaternions_xyzw, covariances), dropped


def read_detections(topic: Topic) -> tuple[LandmarkDetections | None, Dropped]:
    """``sonar_graph_msgs/LandmarkDetections``; where messages differ in candidates, -1 with probability 0 fills.

    Raises
    ------
    LogError
        When the lists of a message do not belong together.
    """
    log_times_ns = topic.log_times_ns
    groups = [group for group in topic.messages() if group["range_m"].shape[1]]
    if not groups:
        return None, {}
    parts = [_detection_columns(topic, group, log_times_ns) for group in groups]
    places = max(1, *(ids.shape[1] for *_, ids, _ in parts))
    order, stamps, ranges, azimuths, covariances = (np.concatenate([p[i] for p in parts]) for i in range(5))
    ids = np.concatenate([_widen(p[5], places, -1) for p in parts])
    probabilities = np.concatenate([_widen(p[6], places, 0) for p in parts])
    faults = {_NOT_FINITE: _not_finite(ranges, azimuths, probabilities)}
    first = np.argsort(order, kind="stable")
    rows, dropped = fit_rows(stamps[first], {k: v[first] for k, v in faults.items()}, unique=False)
    columns = (stamps, ranges, azimuths, covariances, ids, probabilities)
    return (LandmarkDetections(*(c[first[rows]] for c in columns)) if rows.size else None), dropped


def _detection_columns(topic: Topic, group: Messages, log_times_ns: Ints) -> tuple[np.ndarray, ...]:
    """Message number, stamp, range, azimuth, covariance, identities and probabilities, one row a detection."""
    frames, count = group["range_m"].shape
    ids, probabilities = group["candidate_ids"], group["id_probability"]
    sizes = (group["azimuth_rad"].shape[1], group["covariance"].shape[1], ids.shape[1] % count, probabilities.shape[1])
    if sizes != (count, 4 * count, 0, ids.shape[1]):
        raise LogError(
            f"{topic.file}: topic {topic.name}: message {group.rows[0]} has {count} ranges, {sizes[0]} azimuths, "
            f"{sizes[1]} covariance elements, {ids.shape[1]} identities, {sizes[3]} probabilities; "
            f"expected n, n, 4n, kn and kn"
        )
    total, places = frames * count, ids.shape[1] // count
    return (
        np.repeat(group.rows, count),
        np.repeat(header_stamps_ns(group, log_times_ns), count),
        group["range_m"].reshape(total),
        group["azimuth_rad"].reshape(total),
        group["covariance"].reshape(total, 2, 2),
        ids.reshape(total, places),
        probabilities.reshape(total, places),
    )


def _widen(columns: np.ndarray, places: int, filling: int) -> np.ndarray:
    return np.pad(columns, ((0, 0), (0, places - columns.shape[1])), constant_values=filling)


def read_landmark_map(topic: Topic) -> LandmarkMap:
    """The last ``sonar_graph_msgs/LandmarkMap`` of a topic.

    Raises
    ------
    LogError
        When its lists do not belong together or an identity comes twice.
    """
    last = next(group for group in topic.messages() if group.rows[-1] == len(topic) - 1)
    ids, position, covariance = (last[name][-1] for name in ("ids", "position", "covariance"))
    count = len(ids)
    sizes = (len(np.unique(ids)), len(position), len(covariance))
    if sizes != (count, 3 * count, 9 * count):
        raise LogError(
            f"{topic.file}: topic {topic.name}: {count} ids ({sizes[0]} different), {sizes[1]} position and "
            f"{sizes[2]} covariance elements; expected n different, 3n and 9n"
        )
    order = np.argsort(ids)
    return LandmarkMap(ids[order].astype(np.int64), position.reshape(-1, 3)[order], covariance.reshape(-1, 3, 3)[order])
