"""Unknown objects by name: natural ones, and ones that look like landmarks.

Sizes are those of landmarks (0.1 to 0.4 m), levels and heights what such things might have, not measured ones.
"""

from collections.abc import Callable, Sequence
from typing import Literal, get_args

import numpy as np

from sonar_graph.measurements import Floats
from sonar_graph.simulation.sonar_image.scene import (
    SeabedObject,
    Shape,
    block,
    material,
    place,
    ragged_outline,
    stone,
)

Natural = Literal["stone", "weed", "stick"]
LookAlike = Literal["lid", "tile", "hexagon", "pan-lid", "box", "round-stone"]
StrangerName = Literal[Natural, LookAlike, "natural", "look-alikes"]
GROUPS: dict[str, tuple[str, ...]] = {
    "natural": get_args(Natural),
    "look-alikes": get_args(LookAlike),
}


Drawn = tuple[Shape, float]
"""One object of a kind: its shape, and the radius of the disc that its material covers."""


def polygon(radius_m: float, corners: int, height_m: float, level_db: float) -> Shape:
    """A regular plate; the radius is that of its corners."""
    apothem_m = radius_m * np.cos(np.pi / corners)
    step = 2 * np.pi / corners

    def shape(x_m: Floats, y_m: Floats) -> tuple[Floats, Floats]:
        # angle from the middle of the nearest side
        from_side = np.arctan2(y_m, x_m) % step - step / 2
        inside = np.hypot(x_m, y_m) * np.cos(from_side) < apothem_m
        return material(inside, level_db, height_m)

    return shape


def _pan_lid(rng: np.random.Generator) -> Drawn:
    """A round lid: 2 dB under the floor where it is smooth, 9 dB over it on rim and knob; it rises to a dome."""
    radius_m = rng.uniform(0.11, 0.15)
    dome_m = rng.uniform(0.015, 0.03)

    def shape(x_m: Floats, y_m: Floats) -> tuple[Floats, Floats]:
        away = np.hypot(x_m, y_m)
        is_knob = away < 0.02
        is_rough = ((away > radius_m - 0.012) & (away < radius_m)) | is_knob
        top = (
            0.01
            + dome_m * np.clip(1 - (away / radius_m) ** 2, 0, 1)
            + np.where(is_knob, 0.02, 0.0)
        )
        return material(away < radius_m, np.where(is_rough, 9.0, -2.0), top)

    return shape, radius_m


def _boulder(rng: np.random.Generator) -> Drawn:
    """A stone of random outline and lumpy top: half an ellipsoid whose radius varies with direction."""
    radius_m = rng.uniform(0.08, 0.17)
    height_m = rng.uniform(0.03, 0.09)
    level_db = rng.uniform(4, 11)
    outline = ragged_outline(radius_m, (0.5, 1.4), 4, 0.16, rng)
    # stones are longer than wide, and not smooth on top
    flattened = rng.uniform(0.6, 1.0)
    lumps = rng.uniform(0, 2 * np.pi, 2)
    lump_m = 0.5 * radius_m

    def shape(x_m: Floats, y_m: Floats) -> tuple[Floats, Floats]:
        from_top = (np.hypot(x_m, y_m / flattened) / outline(x_m, y_m)) ** 2
        lumpy = 1 + 0.2 * np.sin(x_m / lump_m * np.pi + lumps[0]) * np.sin(
            y_m / lump_m * np.pi + lumps[1]
        )
        return np.where(from_top < 1, level_db, np.nan), height_m * lumpy * np.sqrt(
            np.clip(1 - from_top, 0, None)
        )

    return shape, 1.4 * radius_m


def _tuft(rng: np.random.Generator) -> Drawn:
    """Weed: narrow fronds from one root, which lie over the floor and between which it shows."""
    radius_m = rng.uniform(0.12, 0.2)
    height_m = rng.uniform(0.03, 0.08)
    level_db = rng.uniform(4, 9)
    fronds = int(rng.integers(10, 24))
    # each frond is a parabola from the root
    angle = rng.uniform(-np.pi, np.pi, fronds)
    length_m = radius_m * rng.uniform(0.4, 1.0, fronds)
    bend = rng.normal(0, 2.5, fronds)
    width_m = rng.uniform(0.004, 0.010, fronds)

    def shape(x_m: Floats, y_m: Floats) -> tuple[Floats, Floats]:
        level = np.full(np.shape(x_m), np.nan)
        top = np.zeros(np.shape(x_m))
        for turn, reach_m, curve, wide_m in zip(
            angle, length_m, bend, width_m, strict=True
        ):
            along = np.cos(turn) * x_m + np.sin(turn) * y_m
            aside = np.cos(turn) * y_m - np.sin(turn) * x_m
            covers = (
                (along > 0)
                & (along < reach_m)
                & (np.abs(aside - curve * along**2) < wide_m)
            )
            level[covers] = level_db
            top = np.maximum(
                top,
                np.where(
                    covers, height_m * np.sqrt(np.clip(1 - along / reach_m, 0, 1)), 0.0
                ),
            )
        return level, top

    return shape, 1.2 * radius_m


def _stick(rng: np.random.Generator) -> Drawn:
    length_m = rng.uniform(0.3, 0.5)
    width_m = rng.uniform(0.015, 0.04)
    return block(length_m, width_m, 0.8 * width_m, rng.uniform(4, 10)), length_m / 2


def _lid(rng: np.random.Generator) -> Drawn:
    radius_m = rng.uniform(0.11, 0.16)
    return polygon(radius_m, 48, 0.012, rng.uniform(8, 12)), radius_m


def _tile(rng: np.random.Generator) -> Drawn:
    side_m = rng.uniform(0.2, 0.3)
    return block(side_m, side_m, 0.01, rng.uniform(6, 12)), side_m / np.sqrt(2)


def _hexagon(rng: np.random.Generator) -> Drawn:
    radius_m = rng.uniform(0.13, 0.17)
    return polygon(radius_m, 6, 0.013, rng.uniform(8, 12)), radius_m


def _box(rng: np.random.Generator) -> Drawn:
    side_m = rng.uniform(0.2, 0.28)
    return block(side_m, side_m, 0.05, rng.uniform(4, 10)), side_m / np.sqrt(2)


def _round_stone(rng: np.random.Generator) -> Drawn:
    radius_m = rng.uniform(0.11, 0.15)
    return stone(radius_m, rng.uniform(0.03, 0.06), rng.uniform(6, 11)), radius_m


KINDS: dict[str, Callable[[np.random.Generator], Drawn]] = {
    "stone": _boulder,
    "weed": _tuft,
    "stick": _stick,
    "lid": _lid,
    "tile": _tile,
    "hexagon": _hexagon,
    "pan-lid": _pan_lid,
    "box": _box,
    "round-stone": _round_stone,
}
"""How each kind is drawn. lid: a flat rough disc; tile: a square one; box: 5 cm high; pan-lid: a dome with rim and
knob; round-stone: half an ellipsoid, stone: one of random outline."""


def strangers_at(
    spots_m: Floats,
    names: Sequence[StrangerName],
    first_id: int,
    rng: np.random.Generator,
) -> list[SeabedObject]:
    """Objects of these names at spots (n, 3), each name as often as the others, with identities downward.

    The names take turns in a random order. ``first_id`` is negative.
    """
    kinds = list(
        dict.fromkeys(kind for name in names for kind in GROUPS.get(name, (name,)))
    )
    if not kinds:
        return []
    # each kind once before any comes again
    order = np.concatenate(
        [rng.permutation(len(kinds)) for _ in range(-(-len(spots_m) // len(kinds)))]
    )
    objects = []
    for number, (spot, kind) in enumerate(
        zip(spots_m, (kinds[k] for k in order), strict=False)
    ):
        drawn = KINDS[kind](rng)
        yaw_rad = rng.uniform(-np.pi, np.pi)
        objects.append(place(first_id - number, kind, *drawn, spot, yaw_rad))
    return objects
