"""The lever arm from IMU to Doppler log and the gyro bias of a log, against what the calibration says of them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from sonar_graph.calibration import Calibration, ImuCalibration
from sonar_graph.evaluation.finding import NO_NEED, Finding, matters, said_once
from sonar_graph.measurements import Floats
from sonar_graph.navigation.dvl_against_imu import DvlMatch, Estimates3D
from sonar_graph.navigation.offset_search import Estimate1D

LEAST_LEVER_M = 0.05
"""A turn of 0.2 rad/s makes 0.01 m/s of it, the noise of a good Doppler log."""
LEAST_BIAS_RAD_S = 1e-4
"""The Earth's rotation, 7.3e-5 rad/s, may be in the bias."""
AXES = "xyz"
ARM, BIAS = "lever arm from IMU to DVL", "gyro bias"


def lever_findings(found: DvlMatch, calibration: Calibration) -> list[Finding]:
    """A row an axis; the arm is the difference of two places, and nothing here says which of them is wrong.

    One row in all where no axis can be told.
    """
    if not any(estimate.is_known for estimate in found.lever):
        return [Finding(ARM, found.lever[0], "m", "")]
    given = _given_arm(calibration)
    wrong = _wrong_by(found, given)
    imu, dvl = calibration.imu.mounting.translation_m, calibration.dvl.mounting.translation_m
    line = (
        f"`imu.mounting.translation_m = {_numbers(np.subtract(imu, wrong))}` in the calibration or, if that place is "
        f"sure, `dvl.mounting.translation_m = {_numbers(np.add(dvl, wrong))}`"
    )
    rows = []
    for axis, estimate, of_calibration, error in zip(AXES, found.lever, given, wrong, strict=True):
        advice = f"the calibration's {of_calibration:+.2f} m fits, {NO_NEED}"
        if error:
            advice = f"not the calibration's {of_calibration:+.2f} m: {line}"
        rows.append(Finding(f"{ARM}, {axis}", estimate, "m", advice, bool(error)))
    return said_once(rows)


def with_fitted(found: DvlMatch, calibration: Calibration) -> Calibration:
    """The calibration with the IMU's place and the bias' sigma changed as the findings advise."""
    imu = calibration.imu
    place = np.subtract(imu.mounting.translation_m, _wrong_by(found, _given_arm(calibration)))
    moved = imu.mounting.model_copy(update={"translation_m": tuple(place.tolist())})
    sigma = _largest(found.gyro_bias) if any(_is_beyond(e, imu) for e in found.gyro_bias) else imu.gyro_bias_sigma
    changed = imu.model_copy(update={"mounting": moved, "gyro_bias_sigma": sigma})
    return calibration.model_copy(update={"imu": changed})


def bias_findings(bias: Estimates3D, sources: tuple[str, str, str], imu: ImuCalibration) -> list[Finding]:
    """A row an axis, against what the calibration lets a bias be; one in all where no axis can be told.

    Parameters
    ----------
    bias
        Body axes, rad/s.
    sources
        From what each was told, such as "from 12 s of rest".
    """
    if not any(estimate.is_known for estimate in bias):
        return [Finding(BIAS, bias[0], "rad/s", "")]
    return said_once(list(_bias_rows(bias, sources, imu)))


def _bias_rows(bias: Estimates3D, sources: tuple[str, str, str], imu: ImuCalibration) -> Iterator[Finding]:
    allowed = imu.gyro_bias_sigma
    for axis, estimate, source in zip(AXES, bias, sources, strict=True):
        acts = _is_beyond(estimate, imu)
        advice = f"{source}; the calibration's sigma of {allowed:.2g} allows it, {NO_NEED}"
        if acts:
            advice = (
                f"{source}, beyond the calibration's sigma of {allowed:.2g}: "
                f"`imu.gyro_bias_sigma = {_largest(bias):.2g}` in the calibration, for estimators that find the bias"
            )
        yield Finding(f"{BIAS}, {axis}", estimate, "rad/s", advice, acts)


def _is_beyond(bias: Estimate1D, imu: ImuCalibration) -> bool:
    return matters(replace(bias, sigma=float(np.hypot(bias.sigma, imu.gyro_bias_sigma))), LEAST_BIAS_RAD_S)


def _largest(bias: Estimates3D) -> float:
    return max((abs(estimate.value) for estimate in bias if estimate.is_known), default=0.0)


def _given_arm(calibration: Calibration) -> Floats:
    return np.subtract(calibration.dvl.mounting.translation_m, calibration.imu.mounting.translation_m)


def _wrong_by(found: DvlMatch, given: Floats) -> Floats:
    """By how much the arm is longer than given, shape (3,), m; 0 along an axis on which nothing need be done."""
    errors = [replace(e, value=e.value - g) for e, g in zip(found.lever, given.tolist(), strict=True)]
    return np.array([error.value if matters(error, LEAST_LEVER_M) else 0.0 for error in errors])


def _numbers(place: Floats) -> str:
    return f"[{', '.join(f'{metres:.3f}' for metres in place)}]"
