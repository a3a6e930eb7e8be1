"""Landmarks."""

# fmt: off
from sonar_graph.slam.landmarks.association import (
    Identities, IdentityPosterior, RecogniserErrors, gate_threshold, identify,
)
from sonar_graph.slam.landmarks.mixture import Mixture
from sonar_graph.slam.landmarks.mixture_policy import DoubtfulIdentities, IdentityParams, MixtureIdentity
from sonar_graph.slam.landmarks.sighting import LandmarkSightings, Sighting, SightingFactors
from sonar_graph.slam.landmarks.tracked import (
    DeferredIdentities, GatedIdentity, RobustIdentity, decide, of_no_landmark, once_a_track,
)
from sonar_graph.slam.landmarks.unknown import (
    AnonymousLandmarks, AssociatedUnknown, IgnoredUnknown, refuse_taken_ids, unnamed,
)

__all__ = [
    "AnonymousLandmarks", "AssociatedUnknown", "DeferredIdentities", "DoubtfulIdentities", "GatedIdentity",
    "Identities", "IdentityParams", "IdentityPosterior", "IgnoredUnknown", "LandmarkSightings", "Mixture",
    "MixtureIdentity", "RecogniserErrors", "RobustIdentity", "Sighting", "SightingFactors", "decide",
    "gate_threshold", "identify", "of_no_landmark", "once_a_track", "refuse_taken_ids", "unnamed",
]
