"""Logs in and out: MCAP with ROS 2 messages, trajectory files, converters."""

# fmt: off
from typing import TYPE_CHECKING

from sonar_graph import at_first_use

if TYPE_CHECKING:
    from sonar_graph.logs.amending import Amended, write_amended
    from sonar_graph.logs.images_alone import ImagesAlone, lacking_navigation, no_images, read_images_alone
    from sonar_graph.logs.inspection import LogSummary, TopicSummary, inspect_log
    from sonar_graph.logs.reading import read_log, read_sonar_frames
    from sonar_graph.logs.result_log import write_result
    from sonar_graph.logs.roles import DETECTIONS
    from sonar_graph.logs.trajectory_files import write_landmarks_csv, write_tum
    from sonar_graph.logs.vehicle_setup import METADATA, PartialCalibration, with_notes
    from sonar_graph.logs.viewer_messages import PICTURES, Picture
    from sonar_graph.logs.writing import detection_messages, sonar_image_messages, write_log
else:
    __getattr__ = at_first_use(__name__)

__all__ = [
    "Amended", "DETECTIONS", "ImagesAlone", "LogSummary", "METADATA", "PICTURES", "PartialCalibration", "Picture",
    "TopicSummary", "detection_messages", "inspect_log", "lacking_navigation", "no_images", "read_images_alone",
    "read_log", "read_sonar_frames", "sonar_image_messages", "with_notes", "write_amended", "write_landmarks_csv",
    "write_log", "write_result", "write_tum",
]
