"""The numbers that the 2014 paper publishes of its basin experiment, to stand beside what is estimated here.

Landmark positions are those of its Table I, times those of its Fig. 4. Errors of its map are computed from the table,
which gives centimetres; the paper itself states none. Its vehicle had no reference for its own path.

Source: "Experimental Results of Real-time Sonar-based Underwater Localization Using Landmarks", 2014.
"""

from __future__ import annotations

import numpy as np

from sonar_graph.evaluation.metrics import LandmarkErrors, landmark_errors
from sonar_graph.landmark_designs import OWN_DESIGNS
from sonar_graph.sequence import Sequence
from sonar_graph.states import LandmarkMap

IDS = np.array([1, 2, 3, 4])
TRUE_XY_M = np.array([[5.00, 0.00], [7.00, -5.00], [2.00, -7.00], [0.00, -2.00]])
ESTIMATED_XY_M = np.array([[4.81, -0.07], [6.74, -5.01], [1.85, -6.85], [-0.14, -1.82]])
RETURN_M = (-0.3013, -0.1758)
"""Last minus first estimated position, x and y: error of the estimate and of steering back by hand together."""
DURATION_S = 2039.0
MAP_TIMES_S = (833.1, 1369.4, 2039.0)
"""When Fig. 4 shows path and map."""

SAME_M = 1e-3
"""A true landmark this near to the published one in x and in y is that landmark."""


def published_maps() -> tuple[LandmarkMap, LandmarkMap]:
    """Table I as maps: estimated and true. Heights and covariances are not published: 0 and NaN."""
    unknown = np.full((len(IDS), 3, 3), np.nan)
    on_floor = np.zeros((len(IDS), 1))
    estimated, true = (LandmarkMap(IDS, np.hstack([xy, on_floor]), unknown) for xy in (ESTIMATED_XY_M, TRUE_XY_M))
    return estimated, true


def published_errors() -> LandmarkErrors:
    """The errors of the published map, raw and after SE(2) alignment."""
    return landmark_errors(*published_maps())


def repeats_published(sequence: Sequence) -> bool:
    """Whether a sequence's true landmarks are those of the paper, by identity and horizontal position.

    Landmarks of one's own design in their places are another experiment.
    """
    true = sequence.true_landmarks
    if true is None or OWN_DESIGNS in sequence.notes or not np.array_equal(true.ids, IDS):
        return False
    return bool(np.abs(true.positions[:, :2] - TRUE_XY_M).max() < SAME_M)
