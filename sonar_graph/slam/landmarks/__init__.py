"""Landmarks."""

# fmt: off
from sonar_graph.slam.landmarks.association import (
    Identities, IdentityPosterior, RecogniserErrors, gate_threshold, identify,
)
from sonar_graph.slam.landmarks.mixture import Kernel, Mixture
from sonar_graph.slam.landmarks.mixture_policy import DoubtfulIdentities
from sonar_graph.slam.landmarks.sighting import LandmarkSightings, Sighting, SightingFactors
from sonar_graph.slam.landmarks.tracked import DeferredIdentities, LateGate, decide, of_no_landmark, once_a_track
from sonar_graph.slam.landmarks.unknown import AnonymousLandmarks, AnonymousPolicy, refuse_taken_ids, unnamed

__all__ = [
    "AnonymousLandmarks", "AnonymousPolicy", "DeferredIdentities", "DoubtfulIdentities", "Identities",
    "IdentityPosterior", "Kernel", "LandmarkSightings", "LateGate", "Mixture", "RecogniserErrors", "Sighting",
    "SightingFactors", "decide", "gate_threshold", "identify", "of_no_landmark", "once_a_track", "refuse_taken_ids",
    "unnamed",
]
