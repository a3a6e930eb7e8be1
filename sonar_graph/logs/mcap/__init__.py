"""MCAP containers: messages read by topic, also from damaged files, and written with CRCs."""

# fmt: off
from sonar_graph.logs.mcap.bag_folder import earlier_parts, log_parts
from sonar_graph.logs.mcap.foreign_files import ALREADY_MCAP, START_BYTES, foreign_kind, why_no_bag
from sonar_graph.logs.mcap.log_file import LARGEST_BYTES, LARGEST_RATIO, LogFile, parse, seal
from sonar_graph.logs.mcap.reader import ChunkPart, Passage, Progress, Recording
from sonar_graph.logs.mcap.record_walk import content_of
from sonar_graph.logs.mcap.scanning import scan, stream
from sonar_graph.logs.mcap.time_window import Instant, TimeWindow
from sonar_graph.logs.mcap.topic import STAMP_BYTES, Damage, Keep, Topic
from sonar_graph.logs.mcap.writer import (
    LIBRARY, ROSBAG2_METADATA, TRANSIENT_LOCAL, Attachment, Outgoing, RecordingWriter, is_own_log, recording,
    write_recording,
)

__all__ = [
    "ALREADY_MCAP", "Attachment", "ChunkPart", "Damage", "Instant", "Keep", "LARGEST_BYTES", "LARGEST_RATIO",
    "LIBRARY", "LogFile", "Outgoing", "Passage", "Progress", "ROSBAG2_METADATA", "Recording", "RecordingWriter",
    "STAMP_BYTES", "START_BYTES", "TRANSIENT_LOCAL", "TimeWindow", "Topic", "content_of", "earlier_parts",
    "foreign_kind", "is_own_log", "log_parts", "parse", "recording", "scan", "seal", "stream", "why_no_bag",
    "write_recording",
]
