"""Motion and its covariance from gyros and Doppler log; mountings, tilt and biases: `sonar_graph.navigation.alignment`.

For use in any GTSAM program: docs/tutorials/05_preintegration.py.
"""

# fmt: off
from sonar_graph.motion import Motions, MotionSource, PreintegratedMotion
from sonar_graph.navigation.map_check import MapFit, first_start, map_fit
from sonar_graph.navigation.map_start import NO_MAP, FoundStart, make_estimator
from sonar_graph.navigation.odometry import Odometry

__all__ = [
    "FoundStart", "MapFit", "MotionSource", "Motions", "NO_MAP", "Odometry", "PreintegratedMotion", "first_start",
    "make_estimator", "map_fit",
]
