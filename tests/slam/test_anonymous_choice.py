"""When geometry is believed: the density of what may not be in the map, and how surely a candidate is placed."""

import math

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L, X
from scipy.stats import multivariate_normal

from sonar_graph.calibration import SonarCalibration
from sonar_graph.slam.landmarks.sighting import LandmarkSightings, Sighting, SightingFactors
from sonar_graph.slam.landmarks.tracked import STILL
from sonar_graph.slam.landmarks.unknown import ODDS, AnonymousLandmarks, AssociatedUnknown, PairedDetection
from sonar_graph.slam.models.prediction import PredictedView
from sonar_graph.slam.smoother.batch_solution import Sightline
from sonar_graph.slam.smoother.incremental import Smoother
from sonar_graph.states import DetectionJournal, Outcome

from .made import smoother_with

NOISE = np.diag([4e-4, 1e-4])


def anonymous(
    range_m: float, density_m2: float, least_sightings: int = 1, aperture_rad: float = 0.3
) -> tuple[AnonymousLandmarks, Smoother]:
    """A known pose, and a landmark straight ahead."""
    smoother = smoother_with(1e9, 0.1, 1e9)
    maker = SightingFactors(SonarCalibration(elevation_aperture_rad=aperture_rad), lambda noise: noise)
    landmarks = LandmarkSightings(smoother, maker)
    smoother.add_pose(X(0), gtsam.Pose3(), 0.0)
    smoother.add([gtsam.PriorFactorPose3(X(0), gtsam.Pose3(), gtsam.noiseModel.Isotropic.Sigma(6, 1e-4))])
    smoother.update(0.0)
    sighting = Sighting(0, 0, Sightline(X(0), gtsam.Pose3(), np.array([range_m, 0.0])), NOISE, None)
    landmarks.exchange([], [(sighting, 7)], 0.0)
    policy = AssociatedUnknown(
        gate_probability=0.99, density_m2=density_m2, sightings=least_sightings, longest_wait_s=60.0
    )
    return AnonymousLandmarks(landmarks, DetectionJournal(), policy), smoother


@pytest.mark.parametrize("range_m", [0.5, 2.0, 8.0])
@pytest.mark.parametrize("share", [0.99, 1.01])
def test_a_landmark_has_to_be_denser_than_what_is_not_in_the_map(range_m: float, share: float) -> None:
    """So many a square metre are ``range`` times as many a metre of range and radian of azimuth."""
    z = np.array([range_m + 0.02, 0.01])
    _, smoother = anonymous(range_m, 1.0)
    view = PredictedView(X(0), None, gtsam.Pose3(), STILL, gtsam.Pose3(), smoother.joint_covariance([X(0), L(7)]))
    expected, cov = view.expect([L(7)], smoother.values.atPoint3(L(7))[None])
    density = multivariate_normal.pdf(z, expected[0], cov[0] + NOISE)
    policied, _ = anonymous(range_m, share * density / (ODDS * z[0]))
    (paired,) = policied.pair(view, z[None], NOISE[None], set())
    assert paired.landmark_id == (7 if share < 1.0 else None)


@pytest.mark.parametrize("range_m", [0.5, 2.0, 8.0])
@pytest.mark.parametrize("share", [0.98, 1.02])
def test_a_candidate_begins_a_landmark_when_it_is_known_to_a_tenth_of_its_range(range_m: float, share: float) -> None:
    """One sighting in an aperture whose standard deviation is about 0.1 rad."""
    made, _ = anonymous(range_m, 1e-3, aperture_rad=share * 0.1 * math.sqrt(12.0))
    sighting = Sighting(1, 1, Sightline(X(0), gtsam.Pose3(), np.array([range_m, 0.4])), NOISE, None)
    made.use([sighting], [PairedDetection(None, None)], 0.0)
    assert sighting.outcome is (Outcome.NEW if share < 1.0 else Outcome.WAITING)
