"""A recording gives estimators the true size of its errors, and nothing else changes when one thing does."""

import gtsam
import numpy as np
import pytest
from scipy import stats

from sonar_graph.measurements import Floats
from sonar_graph.sequence import Sequence
from sonar_graph.simulation import BasinOptions, simulate_basin
from sonar_graph.simulation.options import IMU_PRESETS


def short(**options: object) -> Sequence:
    return simulate_basin(
        BasinOptions.model_validate({"duration_s": 130, "laps": 1, **options})
    )


def columns(sequence: Sequence) -> list[Floats]:
    imu = sequence.imu
    found = sequence.detections
    return [
        imu.angular_velocity, imu.specific_force, sequence.dvl.velocity, sequence.depth.z_m,
        found.range_m, found.id_probability,
    ]  # fmt: skip


def test_the_seed_decides_every_bit():
    for first, second, other in zip(
        *(columns(short(seed=seed)) for seed in (4, 4, 5)), strict=True
    ):
        np.testing.assert_array_equal(first, second)
        assert not np.array_equal(first, other)


def test_changing_the_sonar_leaves_all_other_noise_alone():
    """Also where it makes images."""
    slow = columns(short(frame_rate_hz=2))[:4]
    imaged = short(image={})
    assert imaged.detections is None
    imu = imaged.imu
    of_imaged = imu.angular_velocity, imu.specific_force, imaged.dvl.velocity
    fast = columns(short(frame_rate_hz=10, false_detections_per_frame=0.3))
    for others in (fast[:4], [*of_imaged, imaged.depth.z_m]):
        for first, second in zip(slow, others, strict=True):
            np.testing.assert_array_equal(first, second)


def test_presets_are_the_data_sheets_figures():
    """Each once more by hand: 1 °/h is 360° in 15 days; 0.125 °/√h over one hour is 0.125°."""
    hg1700 = IMU_PRESETS["hg1700"]
    assert hg1700.gyro_bias_sigma * 15 * 86400 == pytest.approx(2 * np.pi)
    assert np.degrees(hg1700.gyro_noise_density * np.sqrt(3600)) == pytest.approx(0.125)
    assert hg1700.accel_noise_density == pytest.approx(3.30e-4, rel=2e-3)
    assert IMU_PRESETS["mti1"].gyro_noise_density == pytest.approx(1.2217e-4, rel=1e-4)


def test_start_is_drawn_about_the_truth_with_its_own_sigmas():
    normalised = []
    for seed in range(20):
        run = short(seed=seed, frame_rate_hz=0.1)
        attitude = gtsam.Rot3(run.truth.rotations()[0].as_matrix())
        start = run.calibration.start
        off = gtsam.Pose3(attitude, run.truth.positions[0]).between(start.pose())
        turned = gtsam.Rot3.Logmap(off.rotation()) / start.rpy_sigma_rad
        normalised.append([turned, off.translation() / start.position_sigma_m])
    low, high = stats.chi2.interval(0.9999, 60)
    squares = np.sum(np.square(normalised), axis=(0, 2))
    assert ((low < squares) & (squares < high)).all()


def test_notes_say_what_was_simulated_and_credit_the_paper():
    notes = short(seed=9).notes
    assert "basin" in notes["generator"]
    assert BasinOptions.model_validate_json(notes["options"]).seed == 9
    assert "laps: 1" in notes["ours"]
    assert "130 s in all" in notes["ours"]
    assert "laps" not in notes["from the paper"]
    published = simulate_basin().notes
    assert published["from the paper"].endswith(
        "window, 2039 s in all, laps: 3, 0.150 m/s while driving"
    )
    assert "laps" not in published["ours"]
