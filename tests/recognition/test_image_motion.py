"""Motion from the images alone, against the true motion of the lane, and what is recognised with it."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from sonar_graph.logs import (
    ImagesAlone,
)
from sonar_graph.measurements import Floats
from sonar_graph.recognition import ImageMotions, one_by_one, recognise_images
from tests.recognition.imaged_lane import Lane

SURE = 0.9
RANGE_M = 1.9
"""RANGE_M: the middle of the images, where motion across the line of sight is seen best."""


def in_plane(steps: list[gtsam.Pose3], level_R_sonar: Floats) -> Floats:
    """Yaw, x, y of each step in level axes."""
    level_T_sonar = gtsam.Pose3(gtsam.Rot3(level_R_sonar), np.zeros(3))
    turned = [level_T_sonar * step * level_T_sonar.inverse() for step in steps]
    return np.array([[step.rotation().yaw(), step.x(), step.y()] for step in turned])


def look_at_all(lane: Lane, motions: ImageMotions, rows: range) -> list:
    return [step for row in rows if (step := motions.add(lane.one(row))) is not None]


@pytest.mark.parametrize("is_floor_known", [True, False])
def test_steps_are_the_true_ones_within_their_covariance(lane, is_floor_known):
    calibration = lane.sequence.calibration
    if not is_floor_known:
        calibration = calibration.model_copy(update={"floor": None})
    motions = ImageMotions(calibration)
    steps = look_at_all(lane, motions, range(60))
    assert (motions.view is not None) == is_floor_known
    assert motions.measured == motions.steps == 59
    level_R_sonar = motions.view.level_R_sonar if is_floor_known else np.eye(3)
    true = in_plane(lane.true_steps(slice(60)), level_R_sonar)
    errors = np.array([step.motion for step in steps]) - true
    across = errors[:, 2] + RANGE_M * errors[:, 0]
    off, size = (np.sqrt(np.mean(one[:, 1] ** 2)) for one in (errors, true))
    assert off < 0.2 * size
    assert np.sqrt(np.mean(across**2)) < 0.004
    covariances = np.array([step.covariance for step in steps])
    weighed = np.linalg.solve(covariances, errors[..., None])[..., 0]
    assert 0.3 < np.vecdot(errors, weighed).mean() / 3 < 3.0


def test_a_frame_of_another_scene_is_not_laid_upon_the_one_before(lane):
    motions = ImageMotions(lane.sequence.calibration)
    look_at_all(lane, motions, range(3))
    other = lane.one(3)
    noise = np.random.default_rng(1).rayleigh(40.0, other.intensity.shape)
    step = motions.add(replace(other, intensity=noise.astype(np.uint8)))
    assert not step.is_measured
    assert step.covariance[1, 1] > (0.05) ** 2 * step.duration_s
    said = motions.notes()["detections.motion"]
    assert said == "from the images: 2 of 3 steps measured"


def test_a_fixed_sonar_does_not_move_whatever_its_images_show(lane):
    motions = ImageMotions(lane.sequence.calibration, is_fixed=True)
    assert look_at_all(lane, motions, range(4)) == []
    step, _ = motions.at(int(lane.frames.stamps_ns[3]))
    assert step.previous_T_sonar.equals(gtsam.Pose3(), 0)
    assert not step.covariance.any()


def test_landmarks_are_recognised_by_images_alone(lane, lane_recognition):
    calibration = lane.sequence.calibration
    alone = ImagesAlone("lane", calibration, int(lane.frames.stamps_ns[0]), {})
    counts = []
    found = recognise_images(one_by_one(lane.frames), alone, progress=counts.append)
    assert counts == list(range(1, len(lane.frames) + 1))
    assert found.notes["detections.motion"].startswith("from the images")
    sure, expected = (
        one.detections.rows(one.detections.most_probable()[1] > SURE)
        for one in (found, lane_recognition)
    )
    assert set(sure.most_probable()[0].tolist()) == {1, 2, 3, 4}
    is_common = np.isin(np.unique(expected.stamps_ns), sure.stamps_ns)
    assert is_common.mean() > 0.5
