"""Live operation: messages of a robot in, poses at the rate of the IMU out, and a record of everything that came."""

# fmt: off
from typing import TYPE_CHECKING

from sonar_graph import at_first_use

if TYPE_CHECKING:
    from sonar_graph.live.arrivals import Arrivals
    from sonar_graph.live.engine import Engine, LiveOptions
    from sonar_graph.live.live_messages import Message, play_messages, recorded_messages
    from sonar_graph.live.node import LiveRun
    from sonar_graph.live.outlets import open_link, open_outlets
    from sonar_graph.live.predictor import Prediction, Predictor
    from sonar_graph.live.zenoh_link import DEFAULT_ROUTER, Publisher, definition_of, open_session, subscribe
else:
    __getattr__, __dir__ = at_first_use(__name__)

__all__ = [
    "Arrivals", "DEFAULT_ROUTER", "Engine", "LiveOptions", "LiveRun", "Message", "Prediction", "Predictor", "Publisher",
    "definition_of", "open_link", "open_outlets", "open_session", "play_messages",
    "recorded_messages", "subscribe",
]
