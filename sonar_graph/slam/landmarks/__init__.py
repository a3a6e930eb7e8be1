"""Identities of detections: what is believed, gated, taken back or chosen anew (docs/theory/doubtful_identities.md).

association.py       the recogniser's posterior, accepted above a least probability or weighed for the mixture
tracked.py           policies "robust" (default) and "gate": a wrong identity is taken back when its track is renamed
mixture_policy.py    policies "max-mixture" and "gnc" in the window; mixture_history.py: in the whole history
mixture.py           log densities of the mixture, and the choice that maximises it
unknown.py           detections that name no landmark, paired by joint_compatibility.py
sighting.py          a detection tied to a keyframe, and its factors; the kernel (models/factors.py) enters here
"""

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
