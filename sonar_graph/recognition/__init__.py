"""Landmark detections from the sonar images of a log, their record, and the measuring of the recognition model."""

# fmt: off
from sonar_graph.recognition.confusion_fit import calibrate
from sonar_graph.recognition.image_motion import ImageMotions, MotionFrom
from sonar_graph.recognition.recognition_record import (
    PICTURE_FOLDER, RECOGNITION, SURE, DrawnFrame, Recognition, read_recognition, write_recognition,
)
from sonar_graph.recognition.session import (
    NO_FLOOR, LandmarkRecogniser, recognise, recognise_images, with_detections,
)

__all__ = [
    "DrawnFrame", "ImageMotions", "LandmarkRecogniser", "MotionFrom", "NO_FLOOR", "PICTURE_FOLDER", "RECOGNITION",
    "Recognition", "SURE", "calibrate", "read_recognition", "recognise", "recognise_images", "with_detections",
    "write_recognition",
]
