"""Logs in and out: MCAP with ROS 2 messages, trajectory files, converters."""

# fmt: off
from typing import TYPE_CHECKING
from sonar_graph import at_first_use

if TYPE_CHECKING:
    from sonar_graph.logs.amending import write_amended
    from sonar_graph.logs.checks import DRIFTING, FELT_ALONG, OTHER_WAYS, STEPPED_BACK, axis_doubts, gravity_warning, is_without_gravity, stuck_quantities  # noqa: E501
    from sonar_graph.logs.inspection import LogSummary, inspect_log
    from sonar_graph.logs.live_record import DROPPED_TOPIC, LATENESS, LIVE_RATE, LiveRecord, dropped_in, pinned
    from sonar_graph.logs.reading import Assembly, read_log, row_notes
    from sonar_graph.logs.result_log import write_result
    from sonar_graph.logs.roles import DETECTIONS, ROLES, Choice, Window, choose_each, choose_topics, wanted_types
    from sonar_graph.logs.sonar_images import ImagesAlone, joined_calibration, lacking_navigation, no_images, read_images_alone, read_sonar_frames, sonar_frame  # noqa: E501
    from sonar_graph.logs.trajectory_files import write_landmarks_csv, write_tum
    from sonar_graph.logs.vehicle_setup import METADATA, TAKEN_AS_ZERO, PartialCalibration, with_notes
    from sonar_graph.logs.viewer_messages import PICTURES, Picture, landmark_markers
    from sonar_graph.logs.writing import detection_messages, landmark_map_message, sonar_image_messages, write_log
else:
    __getattr__, __dir__ = at_first_use(__name__)
__all__ = [
    "Assembly", "Choice", "DETECTIONS", "DRIFTING", "DROPPED_TOPIC", "FELT_ALONG", "ImagesAlone",
    "LATENESS", "LIVE_RATE", "LiveRecord", "LogSummary", "METADATA", "OTHER_WAYS", "PICTURES", "PartialCalibration",
    "Picture", "ROLES", "STEPPED_BACK", "TAKEN_AS_ZERO", "Window", "axis_doubts", "choose_each",
    "choose_topics", "detection_messages", "dropped_in", "gravity_warning", "inspect_log", "is_without_gravity",
    "joined_calibration", "lacking_navigation", "landmark_map_message", "landmark_markers", "no_images", "pinned",
    "read_images_alone", "read_log", "read_sonar_frames", "row_notes", "sonar_frame",
    "sonar_image_messages", "stuck_quantities", "wanted_types", "with_notes", "write_amended",
    "write_landmarks_csv", "write_log", "write_result", "write_tum"]
