"""Real data at sea: A-KIT trajectories 1 to 7, fibre-optic IMU at 100 Hz, Doppler log and reference at 1 Hz.

The reference is computed from the same sensors: agreement with it shows consistent conventions, not accuracy.

* Dead reckoning from one initial attitude, once with the stamps as converted and once with the time offsets that
  are found without a reference for the Doppler log (against the accelerometers) and against the gyros for the
  reference. The error is that of the last position, over the distance travelled.
* The same with 30 s of the Doppler log removed at each of nine places: the share in which what is lost against dead
  reckoning with all data lies in the 99 % ellipse of a run that knows its start; and, literally, in which the error
  against the reference lies in the one reported with the start's uncertainty, beside the same without a gap. With the
  IMU where the accelerations of the six other runs say that it is (`akit_imu_place`); where the calibration has it,
  which is what all seven say; and at the reference's point, as a control. How wide the ellipse is, and how wide it
  would be with accelerometers known to have no bias, which nobody knows: what the calibration's sigma for it makes.
* Landmarks simulated along the reference: iSAM2, EKF-SLAM and dead reckoning with their NEES (`akit_landmarks`, which
  says what can be expected).
"""

import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

sys.path.append(str(Path(__file__).resolve().parents[1]))
from akit_imu_place import PlaceFit, fit_place, place_of
from akit_landmarks import reference_wander, sightings, slam
from akit_report import report
from common import in_parallel, make_parser, print_figures, print_table, recording

from sonar_graph.calibration import Mounting
from sonar_graph.evaluation import run_estimator
from sonar_graph.evaluation.consistency import world_position_covs
from sonar_graph.logs.convert import read_akit
from sonar_graph.measurements import Dvl, Floats
from sonar_graph.navigation.alignment import match_dvl_to_imu, match_reference_to_imu
from sonar_graph.sequence import Sequence
from sonar_graph.states import Trajectory

RUNS = (1, 2, 3, 4, 5, 6, 7)
GAP_S = 30.0
CONFIRMED_NS = 4_000_000_000
"""After a gap: at 2 m/s three velocities, one a second, have confirmed each other by then."""
GAP_STARTS_S = tuple(20.0 + 40.0 * k for k in range(9))
Figures = dict[str, Any]


def imu_place(folder: Path, number: int) -> PlaceFit:
    """Estimate of the IMU's place from one trajectory."""
    recorded = read_akit(folder, number)
    offset = match_dvl_to_imu(
        recorded.imu, recorded.dvl, recorded.calibration
    ).offset.value
    return fit_place(replace(recorded, dvl=shifted(recorded.dvl, offset)))


def run(folder: Path, places: dict[int, Floats], number: int) -> Figures:
    """All figures of one trajectory.

    Parameters
    ----------
    places
        Of the IMU on the body by all other trajectories, by number.
    """
    recorded = read_akit(folder, number)
    assert recorded.truth is not None
    dvl = match_dvl_to_imu(recorded.imu, recorded.dvl, recorded.calibration)
    reference = match_reference_to_imu(
        recorded.imu, recorded.truth, recorded.calibration
    )
    aligned = realigned(recorded, dvl.offset.value, reference.offset.value)
    whole, placed, unplaced = (
        reckoned(aligned),
        with_imu_at(aligned, places[number]),
        with_imu_at(aligned, np.zeros(3)),
    )
    return {
        "dvl_offset": (dvl.offset.value, dvl.offset.sigma),
        "reference_offset": (reference.offset.value, reference.offset.sigma),
        "start_heading_rad": start_heading(recorded, aligned),
        "as_converted": final_error(recorded, reckoned(recorded)),
        "aligned": final_error(aligned, whole),
        "gaps": [gap_error(placed, whole, begin) for begin in GAP_STARTS_S],
        "gaps_as_converted": [
            gap_error(aligned, whole, begin) for begin in GAP_STARTS_S
        ],
        "gaps_unbiased": [
            gap_error(without_accel_bias(placed), whole, begin)
            for begin in GAP_STARTS_S
        ],
        "gaps_unplaced": [gap_error(unplaced, whole, begin) for begin in GAP_STARTS_S],
        "reference_wander_m": reference_wander(
            folder, number, recorded.truth.positions
        ),
        "sightings": sightings(aligned),
        "slam": slam(aligned, number),
    }


def realigned(
    recorded: Sequence, dvl_offset_s: float, reference_offset_s: float
) -> Sequence:
    """Stamps of Doppler log and reference on the IMU's clock, and the start taken there."""
    assert recorded.truth is not None
    dvl, truth = recorded.dvl, recorded.truth
    dvl = shifted(dvl, dvl_offset_s)
    truth = replace(truth, stamps_ns=truth.stamps_ns + round(reference_offset_s * 1e9))
    first_ns = max(int(dvl.stamps_ns[0]), int(truth.stamps_ns[0]))
    dvl = dvl.rows(dvl.stamps_ns >= first_ns)
    pose = truth.at(dvl.stamps_ns[:1])
    x, y, z = pose.positions[0].tolist()
    yaw, pitch, roll = pose.rotations().as_euler("ZYX")[0].tolist()
    moved = replace(recorded, dvl=dvl, truth=truth)
    return with_start(moved, position_m=(x, y, z), rpy_rad=(roll, pitch, yaw))


def shifted(dvl: Dvl, offset_s: float) -> Dvl:
    """Stamps put right."""
    return replace(dvl, stamps_ns=dvl.stamps_ns + round(offset_s * 1e9))


def with_imu_at(sequence: Sequence, body_p_imu: Floats) -> Sequence:
    """The IMU at another place of the body."""
    x, y, z = body_p_imu.tolist()
    imu = sequence.calibration.imu.model_copy(
        update={"mounting": Mounting(translation_m=(x, y, z))}
    )
    return replace(
        sequence, calibration=sequence.calibration.model_copy(update={"imu": imu})
    )


def without_accel_bias(sequence: Sequence) -> Sequence:
    """With accelerometers that are known to have no bias."""
    imu = sequence.calibration.imu.model_copy(update={"accel_bias_sigma": 0.0})
    return replace(
        sequence, calibration=sequence.calibration.model_copy(update={"imu": imu})
    )


def reckoned(sequence: Sequence) -> Trajectory:
    """Dead reckoning once a second for as long as there is a reference."""
    assert sequence.truth is not None
    instants = sequence.instants(1.0)
    result = run_estimator(
        sequence,
        "dead-reckoning",
        instants_ns=instants[instants <= sequence.truth.stamps_ns[-1]],
    )
    if result.causal is None:
        raise RuntimeError(f"{sequence.name}: {result.reason}")
    return result.causal


def final_error(sequence: Sequence, estimate: Trajectory) -> dict[str, float]:
    """Error of the last position, and the distance travelled."""
    assert sequence.truth is not None
    truth = sequence.truth.at(estimate.stamps_ns)
    distance_m = float(np.linalg.norm(np.diff(truth.positions, axis=0), axis=1).sum())
    error_m = float(np.linalg.norm(estimate.positions[-1] - truth.positions[-1]))
    return {"error_m": error_m, "distance_m": distance_m, "share": error_m / distance_m}


def start_heading(recorded: Sequence, aligned: Sequence) -> float:
    """Error of the converted start heading: gyro-carried heading minus that of the aligned reference."""
    assert aligned.truth is not None
    estimate = reckoned(recorded)
    inside = estimate.stamps_ns <= aligned.truth.stamps_ns[-1]
    truth = aligned.truth.at(estimate.stamps_ns[inside])
    turned = (
        estimate.rotations()[np.flatnonzero(inside)] * truth.rotations().inv()
    ).as_rotvec()
    return float(np.median(turned[:, 2]))


def gap_error(aligned: Sequence, whole: Trajectory, begin_s: float) -> dict[str, float]:
    """Position lost in a gap, its square by the covariance without that of the start, and the literal squares.

    The literal ones are of the error against the reference by the whole reported covariance, which the start's heading
    sigma of 0.03 rad makes wide; one of them where nothing was removed.
    """
    assert aligned.truth is not None
    begin_ns = aligned.start_ns + round(begin_s * 1e9)
    end_ns = begin_ns + round(GAP_S * 1e9)
    stamps = aligned.dvl.stamps_ns
    bridged = replace(
        aligned, dvl=aligned.dvl.rows((stamps <= begin_ns) | (stamps >= end_ns))
    )
    after, sure = (
        reckoned(bridged),
        reckoned(with_start(bridged, rpy_sigma_rad=(1e-5,) * 3)),
    )
    row = int(np.searchsorted(after.stamps_ns, end_ns + CONFIRMED_NS))
    other = int(np.flatnonzero(whole.stamps_ns == after.stamps_ns[row])[0])
    lost = after.positions[row] - whole.positions[other]
    truth = aligned.truth.at(after.stamps_ns[row : row + 1]).positions[0]
    own = world_position_covs(sure)[row]
    return {
        "lost_m": float(np.linalg.norm(lost)),
        "sigma_m": float(np.sqrt(own.trace())),
        "square": square(lost, own),
        "literal_square": square(
            after.positions[row] - truth, world_position_covs(after)[row]
        ),
        "without_gap_square": square(
            whole.positions[other] - truth, world_position_covs(whole)[other]
        ),
    }


def square(error: Floats, cov: Floats) -> float:
    """Squared Mahalanobis distance."""
    return float(error @ np.linalg.solve(cov, error))


def with_start(sequence: Sequence, **changes: Any) -> Sequence:
    """Another start."""
    start = sequence.calibration.start.model_copy(update=changes)
    return replace(
        sequence, calibration=sequence.calibration.model_copy(update={"start": start})
    )


def main() -> None:
    parser = make_parser(__doc__, data=True, workers=True)
    arguments = parser.parse_args()
    numbers = RUNS[:1] if arguments.quick else RUNS
    with recording(arguments.data, "akit_1-7.tar.xz", "akit") as folder:
        fits = in_parallel(
            partial(imu_place, folder),
            RUNS,
            arguments.workers,
            "IMU's place by trajectory",
        )
        places = {
            n: place_of([fit for m, fit in zip(RUNS, fits, strict=True) if m != n])
            for n in RUNS
        }
        runs = in_parallel(
            partial(run, folder, places), numbers, arguments.workers, "trajectory"
        )
    print_places(fits)
    figures = report(numbers, runs) | {
        "imu_place_m": [fit.body_p_imu.tolist() for fit in fits],
        "imu_place_of_all_m": place_of(fits).tolist(),
        "accel_bias_m_s2": [fit.accel_bias.tolist() for fit in fits],
    }
    print_figures(figures)


def print_places(fits: list[PlaceFit]) -> None:
    """IMU's place on the body by trajectory, with standard deviations, and the noise of the Doppler log."""
    print_table(
        (
            "IMU's place",
            *(f"{axis} m" for axis in "xyz"),
            "±",
            "±",
            "±",
            "accel bias x mm/s²",
            "y",
            "DVL noise m/s",
        ),
        [
            (
                f"trajectory {n}",
                *fit.body_p_imu.tolist(),
                *np.sqrt(np.diag(np.linalg.inv(fit.information))).tolist(),
                *(1e3 * fit.accel_bias[:2]).tolist(),
                fit.noise_m_s,
            )
            for n, fit in zip(RUNS, fits, strict=True)
        ],
    )


if __name__ == "__main__":
    main()
