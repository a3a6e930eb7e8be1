"""CDR payloads of ROS 2 messages as columns, by the message definition in the log."""

# fmt: off
from sonar_graph.logs.cdr.definitions import DEFINITIONS, Struct, definition, parse_definition, short_name
from sonar_graph.logs.cdr.driver_definitions import DRIVER_DEFINITIONS
from sonar_graph.logs.cdr.layout import Bytes
from sonar_graph.logs.cdr.messages import Decoder, Messages, Value, decode, encode

__all__ = [
    "Bytes", "DEFINITIONS", "DRIVER_DEFINITIONS", "Decoder", "Messages", "Struct", "Value", "decode",
    "definition", "encode", "parse_definition", "short_name",
]
