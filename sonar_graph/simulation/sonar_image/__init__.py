"""Images of a simulated imaging sonar, with the truth about each."""

# fmt: off
from sonar_graph.simulation.sonar_image.conditions import SCENES, SceneConditions, true_mounting
from sonar_graph.simulation.sonar_image.frames import FrameSimulator, ImagedFrames, image_along
from sonar_graph.simulation.sonar_image.imaging_sonar import SONARS, SOUND_SPEED_M_S, ImageOptions
from sonar_graph.simulation.sonar_image.scene import SeabedObject, place_landmark, scattered_objects
from sonar_graph.simulation.sonar_image.strangers import strangers_at
from sonar_graph.simulation.sonar_image.weathering import weathered

__all__ = [
    "FrameSimulator", "ImageOptions", "ImagedFrames", "SCENES", "SONARS", "SOUND_SPEED_M_S", "SceneConditions",
    "SeabedObject", "image_along", "place_landmark", "scattered_objects", "strangers_at", "true_mounting", "weathered",
]
