"""Other people's messages as measurements, without code: an adapter a role says which fields hold what, and how.

`shipped` lists the adapters for common drivers, found by message type; `config` reads more of them, or changes to
them, from a TOML file. Both are the same classes.
"""

# fmt: off
from sonar_graph.logs.adapters.adapter import Adapter, body_to_ros, leaf_fields
from sonar_graph.logs.adapters.drivers import SHIPPED, Z_DOWN_TYPES, Shipped
from sonar_graph.logs.adapters.dvl_messages import DvlAdapter
from sonar_graph.logs.adapters.landmark_messages import (
    DetectionArrayAdapter, detection_warnings, read_detections, read_landmark_map,
)
from sonar_graph.logs.adapters.log_config import (
    LogConfig, changes_text, comment, plain_lines, read_log_config, shipped_like, table_text,
)
from sonar_graph.logs.adapters.sonar_messages import SAMPLE_TYPES, Refused, SonarAdapter
from sonar_graph.logs.adapters.vehicle_messages import DepthAdapter, ImuAdapter, TruthAdapter

__all__ = [
    "Adapter", "DepthAdapter", "DetectionArrayAdapter", "DvlAdapter", "ImuAdapter", "LogConfig", "Refused",
    "SAMPLE_TYPES", "SHIPPED", "Shipped", "SonarAdapter", "TruthAdapter", "Z_DOWN_TYPES", "body_to_ros",
    "changes_text", "comment", "detection_warnings", "leaf_fields", "plain_lines", "read_detections",
    "read_landmark_map", "read_log_config", "shipped_like", "table_text",
]
