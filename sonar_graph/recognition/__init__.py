"""Recognition."""

# fmt: off
from sonar_graph.recognition.calibrate import calibrate
from sonar_graph.recognition.recognition_record import (
    SURE, DrawnFrame, Recognition, read_recognition, write_recognition,
)
from sonar_graph.recognition.session import LandmarkRecogniser, recognise, with_detections

__all__ = [
    "DrawnFrame", "LandmarkRecogniser", "Recognition", "SURE", "calibrate", "read_recognition", "recognise",
    "with_detections", "write_recognition",
]
