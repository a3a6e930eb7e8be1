"""Identities of detections: what is believed, gated, taken back or chosen anew (docs/theory/doubtful_identities.md).

sighting.py          a frame's detections tied to a keyframe, and their factors
landmark_graph.py    the life of a detection, and its one writer: which sightings are of which landmark
tracked.py           policies "robust" (default) and "gate": a wrong identity is taken back when its track is renamed
unknown.py           detections that name no landmark, paired by joint_compatibility.py
mixture_policy.py    policy "max-mixture", of the log densities and votes in mixture.py
"""

# fmt: off
from sonar_graph.slam.landmarks.landmark_graph import AmendableJournal, IdentityPolicy, LandmarkGraph
from sonar_graph.slam.landmarks.mixture_policy import IdentityParams, MixtureIdentities, MixtureIdentity
from sonar_graph.slam.landmarks.sighting import Screened, SeenFrame, SightingFactors
from sonar_graph.slam.landmarks.tracked import GatedIdentity, RobustIdentity, TrackedIdentities
from sonar_graph.slam.landmarks.unknown import AssociatedUnknown, NamelessLandmarks

__all__ = [
    "AmendableJournal", "AssociatedUnknown", "GatedIdentity", "IdentityParams", "IdentityPolicy",
    "LandmarkGraph", "MixtureIdentities", "MixtureIdentity", "NamelessLandmarks",
    "RobustIdentity", "Screened", "SeenFrame", "SightingFactors", "TrackedIdentities",
]
