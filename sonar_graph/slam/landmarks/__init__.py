"""Identities of detections: accepted, gated, late or revised (docs/theory/doubtful_identities.md).

sighting.py             detections of a frame, sightings tied to a keyframe, and their factors
landmark_graph.py       states of a detection; decisions of a policy, and the one place that applies them
tracked.py              policies "robust" (default) and "gate": a wrong identity is retracted when its track is renamed
unknown.py              detections that name no landmark, paired jointly
mixture_policy.py       policy "max-mixture", with the log densities and votes of mixture.py
"""

# fmt: off
from sonar_graph.slam.landmarks.landmark_graph import (
    AmendableJournal, Decision, IdentityPolicy, LandmarkGraph, Solution,
)
from sonar_graph.slam.landmarks.mixture_policy import IdentityParams, MixtureIdentities, MixtureIdentity
from sonar_graph.slam.landmarks.sighting import Frame, SeenFrame, SightingFactors
from sonar_graph.slam.landmarks.tracked import GatedIdentity, RobustIdentity, TrackedIdentities
from sonar_graph.slam.landmarks.unknown import AssociatedUnknown, NamelessLandmarks, unnamed

__all__ = [
    "AmendableJournal", "AssociatedUnknown", "Decision", "Frame", "GatedIdentity", "IdentityParams", "IdentityPolicy",
    "LandmarkGraph", "MixtureIdentities", "MixtureIdentity", "NamelessLandmarks", "RobustIdentity", "SeenFrame",
    "SightingFactors", "Solution", "TrackedIdentities", "unnamed",
]
