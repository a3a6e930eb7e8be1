"""Conditions under which landmarks lie on a floor, with presets from easy to hard.

Each is a departure from the basin that the other options describe: contrast, texture, ripples, sediment, fouling,
relief, strangers, and what the log does not know of the sonar's pose. Which of them are physics and which are models of
ours: docs/theory/sonar_image.md.
"""

from typing import Any, Literal

import numpy as np
from pydantic import Field, model_validator

from sonar_graph.calibration import Mounting, Section
from sonar_graph.simulation.sonar_image.strangers import StrangerName

SceneName = Literal["easy", "murky", "worn", "hard"]
SCENES: dict[SceneName, dict[str, Any]] = {
    "easy": {},
    "murky": {"contrast_db": -3.0, "texture_shape": 2.0, "noise_db": 22.0},
    "worn": {
        "contrast_db": -3.0,
        "plate_db": -4.0,
        "sediment": 0.15,
        "fouling": 0.2,
        "texture_shape": 3.0,
    },
    "hard": {
        "contrast_db": -4.5,
        "plate_db": 0.0,
        "sediment": 0.25,
        "fouling": 0.25,
        "texture_shape": 1.5,
        "texture_length_m": 0.05,
        "noise_db": 20.0,
        "ripple_length_m": 0.12,
        "ripple_height_m": 0.012,
        "attitude_error_deg": 0.5,
        "altitude_error_m": 0.02,
        "strangers": ("natural", "look-alikes"),
    },
}
"""Options that each preset changes."""


class SceneConditions(Section):
    """Wear of the landmarks, roughness of the floor, strangers, and errors of the vehicle's pose."""

    scene: SceneName = "easy"
    """Preset of all options that are not given: easy, murky, worn or hard. easy changes none of their defaults."""
    contrast_db: float = Field(0.0, ge=-30, le=10)
    """Added to the level of landmarks' bright parts: -6 leaves 6 dB over the floor of foam of 12 dB."""
    plate_db: float | None = Field(None, ge=-30, le=30)
    """Level of landmarks' dark parts over the floor; 0: as bright as the floor; None: that of their designs."""
    foam_height_m: float | None = Field(None, ge=0, le=0.1)
    """Height of bright parts over dark ones, at most that of the landmark; 0: one height for all of its material; None:
    that of their designs."""
    sediment: float = Field(0.0, ge=0, le=1)
    """Share of each landmark's area that drowned, in patches: they look like the floor."""
    fouling: float = Field(0.0, ge=0, le=1)
    """Share of each landmark's area on which something grows, in patches: 3 dB over the floor and up to 8 mm high."""
    texture_shape: float | None = Field(5.0, gt=0)
    """Shape of the floor's K-distribution: its strength is Gamma(shape) over patches of ``texture_length_m``; None:
    even floor."""
    texture_length_m: float = Field(0.03, ge=0.005, le=0.5)
    """Distance over which the correlation of the floor's strength falls to 1/e."""
    ripple_height_m: float = Field(0.0, ge=0, le=0.1)
    """From trough to crest of sand ripples; 0: none. Landmarks lie on the crests."""
    ripple_length_m: float = Field(0.12, ge=0.03, le=1)
    """From crest to crest."""
    noise_db: float | None = 15.0
    """Level of the noise of receiver and water at 2 m, in the scale of ``floor_db``; None: none."""
    strangers: tuple[StrangerName, ...] = ()
    """Unknown objects beside the landmarks, in turn: stone, weed and stick, or "natural" for all three; lid, tile,
    hexagon, pan-lid, box and round-stone, or "look-alikes" for all six."""
    attitude_error_deg: float = Field(0.0, ge=0, le=10)
    """Sigma about each axis of the sonar's rotation against the one in the log, drawn once a run; estimators do not
    know it."""
    altitude_error_m: float = Field(0.0, ge=0, le=0.3)
    """Sigma of the sonar's height against the one in the log, drawn once a run; estimators do not know it."""

    @model_validator(mode="before")
    @classmethod
    def _with_preset(cls, values: Any) -> Any:
        """What is not given, from the preset."""
        preset = (
            SCENES.get(values.get("scene", "easy"))
            if isinstance(values, dict)
            else None
        )
        return values if preset is None else preset | values


def true_mounting(
    mounting: Mounting, conditions: SceneConditions, seed: int
) -> Mounting:
    """Mounting with which the sonar sees, beside the one in the log: higher or lower, and turned.

    Angles of the mounting err by independent normal errors, and so does its height.
    """
    # a stream of its own: other options leave the errors as they were
    rng = np.random.default_rng([seed, 3])
    turned_rad = np.radians(conditions.attitude_error_deg) * rng.standard_normal(3)
    x, y, z = mounting.translation_m
    higher_m = conditions.altitude_error_m * rng.standard_normal()
    rpy_rad = tuple((np.array(mounting.rpy_rad) + turned_rad).tolist())
    return mounting.model_copy(
        update={"translation_m": (x, y, z + higher_m), "rpy_rad": rpy_rad}
    )
