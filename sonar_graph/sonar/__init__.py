"""From polar sonar images to recognised landmarks with identity probabilities."""

# fmt: off
from sonar_graph.sonar.appearance import SLANT_PLANE, ObjectSighting
from sonar_graph.sonar.bayes import IdentityParams
from sonar_graph.sonar.confusion import (
    SHIPPED, Accuracy, Confusion, confusion_for, mark_of, read_confusion, soft_scores,
)
from sonar_graph.sonar.evidence import EVIDENCE
from sonar_graph.sonar.geometry import Fan, FloorView, MadeOfWindow, with_lens
from sonar_graph.sonar.frame_check import FrameCheck, check_block
from sonar_graph.sonar.recogniser import (
    REPORTED, Fate, RecognisedFrame, Recogniser, RecogniserParams, TrackInFrame,
)
from sonar_graph.sonar.tracker import SonarStep

__all__ = [
    "Accuracy", "Confusion", "EVIDENCE", "Fan", "Fate", "FloorView", "FrameCheck", "IdentityParams", "MadeOfWindow",
    "ObjectSighting", "REPORTED", "RecognisedFrame", "Recogniser", "RecogniserParams", "SHIPPED", "SLANT_PLANE",
    "SonarStep", "TrackInFrame", "check_block", "confusion_for", "mark_of", "read_confusion",
    "soft_scores", "with_lens",
]
