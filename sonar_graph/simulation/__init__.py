"""Simulated truth and sensor readings, sharing no code with the models that they judge."""

# fmt: off
from sonar_graph.simulation.basin import (
    LANDMARKS_XY_M, BasinOptions, cruise_speed, designs_laid, simulate_basin, simulate_basin_frames,
)
from sonar_graph.simulation.landmarks_on_log import LandmarkOptions, add_landmarks
from sonar_graph.simulation.mission import MissionOptions, simulate_mission

__all__ = [
    "BasinOptions", "LANDMARKS_XY_M", "LandmarkOptions", "MissionOptions", "add_landmarks", "cruise_speed",
    "designs_laid", "simulate_basin", "simulate_basin_frames", "simulate_mission",
]
