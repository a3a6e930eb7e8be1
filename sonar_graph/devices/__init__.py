"""Device data: beams of Doppler logs, lenses of sonars, designs of artificial landmarks."""

# fmt: off
from typing import TYPE_CHECKING

from sonar_graph import at_first_use

if TYPE_CHECKING:
    from sonar_graph.devices.dvl_beams import PARTIAL_M2_S2, UNMEASURED_M_S, is_partial, velocity_of_beams
    from sonar_graph.devices.landmark_designs import (
        DEFAULT_DESIGNS, LEAST_BRIGHT_DB, OWN_DESIGNS, LandmarkDesign, load_designs,
    )
    from sonar_graph.devices.sonar_lenses import DIDSON_BEAMS, aris_azimuths, didson_azimuths, even_azimuths
else:
    __getattr__, __dir__ = at_first_use(__name__)

__all__ = [
    "DEFAULT_DESIGNS", "DIDSON_BEAMS", "LEAST_BRIGHT_DB", "LandmarkDesign", "OWN_DESIGNS", "PARTIAL_M2_S2",
    "UNMEASURED_M_S", "aris_azimuths", "didson_azimuths", "even_azimuths", "is_partial", "load_designs",
    "velocity_of_beams",
]
