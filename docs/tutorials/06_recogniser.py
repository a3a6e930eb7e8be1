"""Landmarks in sonar frames, in your own program: arrays and poses go in, range, azimuth and identities come out.

Nothing here reads a log or runs an estimator. Frames and poses come from your own source: here from the simulator, a
sonar that moves past landmark 3 for six seconds. For a whole log, or frames with the other sensors of a vehicle, see
`sonar_graph.recognition.recognise`.
Run it in any folder: ``python 06_recogniser.py``. It takes a few seconds, half a minute the first time.
"""

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import Calibration
from sonar_graph.devices import DEFAULT_DESIGNS
from sonar_graph.images import SonarFrames
from sonar_graph.simulation.sonar_image import (
    FrameSimulator,
    ImageOptions,
    place_landmark,
)
from sonar_graph.sonar import FloorView, Recogniser, SonarStep

# 1. What you bring for each frame: samples, and the pose of the sonar in a world with z up (x along its axis, y left).
FLOOR_Z_M, PERIOD_NS = -2.0, 200_000_000
landmark = np.array([1.55, 0.05, FLOOR_Z_M])
design = DEFAULT_DESIGNS[2]
simulator = FrameSimulator(
    ImageOptions(), [place_landmark(design, landmark, 0.4, FLOOR_Z_M)], FLOOR_Z_M
)


def pose(k):
    """A metre above the floor, looking down by 30°, moving ahead and swaying."""
    orientation = gtsam.Rot3.RzRyRx(
        0.0, np.radians(30.0), np.radians(2.0) * np.sin(k / 4)
    )
    return gtsam.Pose3(
        orientation, np.array([0.02 * k - 0.6, 0.05 * np.sin(k / 5), FLOOR_Z_M + 1.0])
    )


def samples(k):
    """The image, shape (beams, bins): beams in the order of the azimuths, near bins first."""
    return simulator.frame(
        pose(k).translation(), Rotation.from_matrix(pose(k).rotation().matrix()), k
    )


# 2. Which landmarks may be there, and what your samples mean. Defaults: those that ship, and decibels in bytes.
calibration = Calibration()
recogniser = Recogniser(calibration, DEFAULT_DESIGNS)

# 3. Frame by frame, in order. The motion and the floor may be unknown (None): then less is recognised, and less surely.
# rotation first, in the axes of the newer frame
step_sigma = np.array([1e-3, 1e-3, 1e-3, 2e-3, 2e-3, 2e-3])
for k in range(30):
    frame = SonarFrames(
        stamps_ns=np.array([k * PERIOD_NS]),
        intensity=samples(k)[None],  # one frame: shape (1, beams, bins)
        ranges_m=simulator.ranges_m(),
        azimuths_rad=simulator.azimuths_rad(),  # positive to the left
    )
    step = (
        SonarStep(pose(k - 1).between(pose(k)), np.diag(step_sigma**2)) if k else None
    )
    result = recogniser.process(frame, step, FloorView.from_pose(pose(k), FLOOR_Z_M))
    found = result.detections

    # 4. What came out: a row for each thing seen and trusted, as often as errors are independent, and why no more.
    if k % 6 == 5:
        print(
            f"frame {k}: " + "; ".join(sorted({fate.outcome for fate in result.fates}))
        )
    if found is not None:
        ids, probability = found.most_probable()
        for row, (identity, p) in enumerate(zip(ids, probability, strict=True)):
            sigma_mm = 1e3 * np.sqrt(found.range_azimuth_cov[row, 0, 0])
            print(
                f"frame {k}: landmark {identity} ({p:.2f}) at {found.range_m[row]:.3f} ± {sigma_mm:.1f} mm",
                end="",
            )
            print(f", {np.degrees(found.azimuth_rad[row]):.2f}° to the left")
        true = pose(k).transformTo(landmark)

azimuth_deg = np.degrees(np.arctan2(true[1], true[0]))
print(
    f"true, of the last: landmark {design.id} at {np.linalg.norm(true):.3f} m, {azimuth_deg:.2f}°"
)
