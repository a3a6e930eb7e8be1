"""Images of a simulated imaging sonar, with the truth about each."""

# fmt: off
from sonar_graph.simulation.sonar_image.frames import FrameSimulator, ImagedFrames, image_along
from sonar_graph.simulation.sonar_image.imaging_sonar import SONARS, SOUND_SPEED_M_S, ImageOptions
from sonar_graph.simulation.sonar_image.scene import SeabedObject, place_landmark, scattered_objects

__all__ = [
    "FrameSimulator", "ImageOptions", "ImagedFrames", "SONARS", "SOUND_SPEED_M_S", "SeabedObject", "image_along",
    "place_landmark", "scattered_objects",
]
