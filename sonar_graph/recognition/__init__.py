"""Landmark detections from the sonar images of a log, their record, and the measuring of the recognition model."""

# fmt: off
from sonar_graph.recognition.clock_offset import ClockOffset, estimate_offset
from sonar_graph.recognition.confusion_fit import calibrate
from sonar_graph.recognition.image_motion import ImageMotions, MotionFrom, PlanarStep
from sonar_graph.recognition.label_server import LabelDesk, LabelServer, shown_frames
from sonar_graph.recognition.labels import LabelledLog, Labels, calibrate_by_labels, read_labels
from sonar_graph.recognition.recognition_record import (
    NO_FLOOR, PICTURE_FOLDER, RECOGNITION, SEE_TRACKS, SURE, DrawnFrame, Recognition, read_recognition,
    write_recognition,
)
from sonar_graph.recognition.session import (
    RECOGNISERS, LandmarkRecogniser, RecognitionSession, one_by_one, recognise, recognise_images, with_detections,
)
from sonar_graph.recognition.track_stories import TrackStories, TrackStory

__all__ = [
    "ClockOffset", "DrawnFrame", "ImageMotions", "LabelDesk", "LabelServer", "LabelledLog", "Labels",
    "LandmarkRecogniser", "MotionFrom", "NO_FLOOR", "PICTURE_FOLDER", "PlanarStep", "RECOGNISERS", "RECOGNITION",
    "Recognition", "RecognitionSession", "SEE_TRACKS", "SURE", "TrackStories", "TrackStory", "calibrate",
    "calibrate_by_labels", "estimate_offset", "one_by_one", "read_labels", "read_recognition", "recognise",
    "recognise_images", "shown_frames", "with_detections", "write_recognition",
]
