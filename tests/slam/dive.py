"""A straight dive past objects, taken in up to the sightings."""

import gtsam
import numpy as np

from sonar_graph.calibration import (
    Calibration,
    FloorPrior,
    ImuCalibration,
    Mounting,
    SonarCalibration,
    Start,
)
from sonar_graph.measurements import Dvl, Floats, Imu
from sonar_graph.navigation import Odometry
from sonar_graph.slam import (
    GatedIdentity,
    GaussianKernel,
    KeyframeParams,
    MixtureIdentity,
    RobustKernel,
)
from sonar_graph.slam.frontend import Frontend
from sonar_graph.slam.keyframes import Keyframes
from sonar_graph.slam.landmarks.tracked import TrackedIdentity
from sonar_graph.slam.smoother import Smoother
from sonar_graph.states import Outcome

from .made import detected, polar, smoother_with

NS = 1_000_000_000
T0_NS = 1_500_000_000 * NS
START_NS = T0_NS - 1
POLICY = KeyframeParams(
    max_interval_s=5.0, motion_noise_share=1e9, bias_interval_s=60.0
)
TRUSTING = GatedIdentity(gate_probability=0.99)
UNGATED = GatedIdentity(gate_probability=1.0)
SONAR = SonarCalibration(
    mounting=Mounting(translation_m=(0.3, 0.1, -0.1), rpy_rad=(0.0, 0.4, 0.2)),
    range_sigma_m=0.02,
    azimuth_sigma_rad=0.01,
)
FLOOR = FloorPrior(z_m=-1.0, sigma_m=0.01)
CALIBRATION = Calibration(
    imu=ImuCalibration(gyro_bias_sigma=0.0),
    sonar=SONAR,
    start=Start(position_sigma_m=(0.05, 0.02, 0.01), rpy_sigma_rad=(0.01, 0.01, 0.03)),
    use_gravity=False,
)


class Dive:
    """Everything up to the sightings, driving straight on at 0.5 m/s for 10 s."""

    def __init__(
        self,
        calibration: Calibration = CALIBRATION,
        identity: TrackedIdentity | MixtureIdentity = TRUSTING,
        kernel: GaussianKernel | RobustKernel = GaussianKernel(),  # noqa: B008
        lag_s: float = 1e9,
        smoother: Smoother | None = None,
    ) -> None:
        self.smoother = smoother or smoother_with(lag_s, 1e-6, 1e9)
        self.keyframes = Keyframes(
            calibration, Odometry(calibration), POLICY, self.smoother
        )
        self.sightings = Frontend(identity, kernel, self.keyframes)
        stamps = T0_NS + np.arange(-1, 101) * NS // 10
        doppler = np.r_[START_NS, stamps[1:]]  # the second row confirms the first
        n = len(stamps)
        velocity = np.tile([0.5, 0.0, 0.0], (n, 1))
        self.keyframes.add(
            Imu(stamps, np.zeros((n, 3)), np.full((n, 3), np.nan)),
            Dvl(doppler, velocity, np.full((n, 3, 3), np.nan)),
            None,
        )

    def see(
        self,
        after_s: float,
        *rows: tuple[int, float, float],
        probability: float = 0.9,
        cov: Floats | None = None,
    ) -> None:
        stamp = T0_NS + round(after_s * NS)
        self.show(
            stamp,
            [row[1:] for row in rows],
            [[row[0]] for row in rows],
            [probability],
            cov=cov,
        )

    def show(self, stamp_ns: int, *rows, **more) -> None:
        """A frame as of `detected`."""
        self.keyframes.advance(stamp_ns)
        self.sightings.add(detected(stamp_ns, *rows, **more))

    @property
    def outcomes(self) -> list[Outcome]:
        return self.sightings.journal.log().outcomes


def spherical(x: float, p: Floats) -> Floats:
    """Range and azimuth of a point from the mounted sonar of a level vehicle at (x, 0, 0)."""
    return polar(
        gtsam.Pose3(gtsam.Rot3(), np.array([x, 0.0, 0.0])).compose(
            SONAR.mounting.pose()
        ),
        p,
    )
