"""Definitions of messages of common drivers, for bags that have none.

The sqlite3 bags of ROS 2 Humble and before hold no definitions. A driver changed its messages over the years; the
definition counts with which the first messages have the right length. Definitions are in
``driver_definitions.ros2msg``, each after a line ``# TYPE`` with its type.
"""

import re
from importlib.resources import files

from sonar_graph.logs.cdr.definitions import DEFINITIONS, definition

# types whose definition has not changed are those of this package
DRIVER_DEFINITIONS = {
    name: [definition(name)]
    for name in (known.replace("/", "/msg/") for known in DEFINITIONS)
    if name.startswith(("marine_acoustic_msgs/", "sonar_graph_msgs/"))
}
"""Definitions by type; of several the first fits that a message follows."""
_FILE = files("sonar_graph.logs.cdr").joinpath("driver_definitions.ros2msg")
_, *_parts = re.split(r"(?m)^# TYPE (\S+)\n", _FILE.read_text("utf-8"))
for _name, _text in zip(_parts[::2], _parts[1::2], strict=True):
    DRIVER_DEFINITIONS.setdefault(_name, []).append(_text)
