"""MCAP containers: messages read by topic, also from damaged files, and written with CRCs."""

# fmt: off
from sonar_graph.logs.mcap.bag_folder import earlier_parts, log_parts
from sonar_graph.logs.mcap.chunks import Found
from sonar_graph.logs.mcap.foreign_files import ALREADY_MCAP, START_BYTES, foreign_kind, why_no_bag
from sonar_graph.logs.mcap.log_file import LARGEST_BYTES, LARGEST_RATIO, LogFile, parse
from sonar_graph.logs.mcap.reader import ChunkPart, Passage, Progress, Recording
from sonar_graph.logs.mcap.record_walk import Record, content_of
from sonar_graph.logs.mcap.scanning import scan, stream
from sonar_graph.logs.mcap.time_window import Instant, TimeWindow
from sonar_graph.logs.mcap.topic import STAMP_BYTES, Damage, Keep, Topic, keeping
from sonar_graph.logs.mcap.writer import (
    LogWriter, Outgoing, SchemaText, by_time, header_of, is_own_log, latched,
    own_schema, recording, write_recording,
)

__all__ = [
    "ALREADY_MCAP", "ChunkPart", "Damage", "Found", "Instant", "Keep", "LARGEST_BYTES", "LARGEST_RATIO",
    "LogFile", "LogWriter", "Outgoing", "Passage", "Progress", "Record", "Recording", "STAMP_BYTES", "START_BYTES",
    "SchemaText", "TimeWindow", "Topic", "by_time", "content_of", "earlier_parts", "foreign_kind", "header_of", "is_own_log",
    "keeping", "latched", "log_parts", "own_schema", "parse", "recording", "scan", "stream", "why_no_bag",
    "write_recording",
]
