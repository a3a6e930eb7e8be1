"""Adapters: message types of any driver read as measurements, each described by field paths and conventions."""

# fmt: off
from sonar_graph.logs.adapters.adapter import (
    ANGLES, FORCES, LENGTHS, PRESSURES, RATES, SPEEDS, TIMES, Adapter, Setup, axes_matrix, did_you_mean, leaf_fields,
)
from sonar_graph.logs.adapters.aiding_messages import ENU_R_NED, GeodeticFields
from sonar_graph.logs.adapters.drivers import ADAPTERS, SHIPPED, TRUTH_WORDS, Z_DOWN_TYPES, Shipped
from sonar_graph.logs.adapters.dvl_messages import DvlAdapter
from sonar_graph.logs.adapters.geodesy import Origin, east_north_up
from sonar_graph.logs.adapters.landmark_messages import DetectionRowsAdapter, LandmarkRowsAdapter
from sonar_graph.logs.adapters.landmark_messages import detection_warnings, range_and_azimuth
from sonar_graph.logs.adapters.log_config import (
    LogConfig, as_log_config, changes_text, plain_lines, read_log_config, shipped_for, shipped_like, table_text,
)
from sonar_graph.logs.adapters.message_table import (
    LAST_S, Dropped, FieldTable, Mask, MessageTable, field_of,
)
from sonar_graph.logs.adapters.sonar_messages import SAMPLE_TYPES, Refused, SonarAdapter, samples_of_rows
from sonar_graph.logs.adapters.vehicle_messages import body_to_ros

__all__ = [
    "ADAPTERS", "ANGLES", "Adapter", "DetectionRowsAdapter", "Dropped", "DvlAdapter", "ENU_R_NED", "FORCES",
    "FieldTable", "GeodeticFields", "LAST_S", "LENGTHS", "LandmarkRowsAdapter", "LogConfig",
    "Mask", "MessageTable", "Origin", "PRESSURES", "RATES", "Refused", "SAMPLE_TYPES", "SHIPPED", "SPEEDS", "Setup",
    "Shipped", "SonarAdapter", "TIMES", "TRUTH_WORDS", "Z_DOWN_TYPES", "as_log_config", "axes_matrix", "body_to_ros",
    "changes_text", "detection_warnings", "did_you_mean", "east_north_up", "field_of", "leaf_fields", "plain_lines",
    "range_and_azimuth", "read_log_config", "samples_of_rows", "shipped_for", "shipped_like", "table_text",
]
