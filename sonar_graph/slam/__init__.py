"""Landmark SLAM by incremental smoothing: models, factors, the iSAM2 estimator."""

# fmt: off
from sonar_graph.slam.isam2 import Isam2, Isam2Params
from sonar_graph.slam.keyframes import KeyframeParams
from sonar_graph.slam.landmarks import AssociatedUnknown, GatedIdentity, MixtureIdentity, RobustIdentity
from sonar_graph.models import (GaussianKernel, RobustKernel)
from sonar_graph.slam.smoother import BoundedHistory, SmootherParams, WholeHistory

__all__ = [
    "AssociatedUnknown", "BoundedHistory", "GatedIdentity", "GaussianKernel",
    "Isam2", "Isam2Params", "KeyframeParams", "MixtureIdentity", "RobustIdentity", "RobustKernel",
    "SmootherParams", "WholeHistory",
]
