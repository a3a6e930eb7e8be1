"""Shipped adapters: message types of common drivers, with the conventions by which these fill them.

For one log, a few lines of TOML describe a type (docs/tutorials/04_your_own_log.md). For everybody the same lines are
added to ``drivers.toml`` (docs/design/0004-logs.md).
"""

import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

from sonar_graph.logs.adapters.adapter import Adapter
from sonar_graph.logs.adapters.aiding_messages import HeadingAdapter, PositionAdapter
from sonar_graph.logs.adapters.dvl_messages import DvlAdapter
from sonar_graph.logs.adapters.landmark_messages import (
    DetectionArrayAdapter,
    DetectionListsAdapter,
    LandmarkMapAdapter,
)
from sonar_graph.logs.adapters.sonar_messages import SonarAdapter
from sonar_graph.logs.adapters.vehicle_messages import (
    DepthAdapter,
    ImuAdapter,
    TruthAdapter,
)

TRUTH_WORDS = ("truth",)
Z_DOWN_TYPES = frozenset({"marine_acoustic_msgs/msg/Dvl", "dvl_msgs/msg/DVL"})
"""Types whose definition or instrument has z downwards, which not all drivers follow."""
ADAPTERS: dict[str, type[Adapter]] = {
    "imu": ImuAdapter,
    "dvl": DvlAdapter,
    "depth": DepthAdapter,
    "heading": HeadingAdapter,
    "positions": PositionAdapter,
    "detections": DetectionArrayAdapter,
    "truth": TruthAdapter,
    "true_landmarks": LandmarkMapAdapter,
    "sonar": SonarAdapter,
}
"""Adapter of each role, for types that are not shipped."""
_OWN_DETECTIONS = "sonar_graph_msgs/msg/LandmarkDetections"


@dataclass(frozen=True)
class Shipped:
    """An adapter, and the topics for which it is taken by default."""

    adapter: Adapter
    words: tuple[str, ...] = ()
    """The topic's name must contain one of these words; none: any name fits."""
    is_general: bool = False
    """The type hardly shows the sensor: the adapter counts only where no topic of a more specific type fits."""


def _shipped(role: str, entry: dict[str, Any]) -> Iterator[Shipped]:
    """Adapters of an entry of ``drivers.toml``, one for each of its types."""
    words = tuple(entry.pop("words", ()))
    is_general = entry.pop("is_general", False)
    types = entry.pop("type")
    for type_name in [types] if isinstance(types, str) else types:
        # flat lists of detections have no fields that a table could name
        kind = DetectionListsAdapter if type_name == _OWN_DETECTIONS else ADAPTERS[role]
        adapter = kind.model_construct(type=type_name).changed(entry)
        yield Shipped(adapter, words, is_general)


_ENTRIES = tomllib.loads(
    files("sonar_graph.logs.adapters").joinpath("drivers.toml").read_text("utf-8")
)
SHIPPED: dict[str, tuple[Shipped, ...]] = {
    role: tuple(one for entry in entries for one in _shipped(role, entry))
    for role, entries in _ENTRIES.items()
}
"""Adapters by role; of several for one type the first is taken whose fields the messages have."""
