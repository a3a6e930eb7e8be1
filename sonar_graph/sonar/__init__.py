"""From polar sonar images to recognised landmarks with identity probabilities."""

# fmt: off
from sonar_graph.sonar.actag import AcTagRecogniser, AcTagSettings
from sonar_graph.sonar.appearance import SLANT_PLANE, ObjectSighting
from sonar_graph.sonar.bayes import IdentityParams
from sonar_graph.sonar.confusion import (
    SHIPPED, Confusion, confusion_for, mark_of, posterior_mean_rows, read_confusion, soft_scores,
)
from sonar_graph.sonar.evidence import EVIDENCE
from sonar_graph.sonar.geometry import Fan, FloorView, with_lens
from sonar_graph.sonar.recogniser import REPORTED, Fate, Recogniser, RecogniserParams
from sonar_graph.sonar.tracker import SonarStep

__all__ = [
    "AcTagRecogniser", "AcTagSettings", "Confusion", "EVIDENCE", "Fan", "Fate", "FloorView", "IdentityParams",
    "ObjectSighting", "REPORTED", "Recogniser", "RecogniserParams", "SHIPPED", "SLANT_PLANE", "SonarStep",
    "confusion_for", "mark_of", "posterior_mean_rows", "read_confusion", "soft_scores", "with_lens",
]
