"""AcTags as landmark designs, drawn from the bits of AcTag's own families."""

from __future__ import annotations

import numpy as np

from sonar_graph.landmark_designs import LandmarkDesign

FAMILY, BITS_ACROSS = "AcTag24h10", 7
FOAM_DB, PLATE_DB = 12.0, -8.0
RING = [
    *((0, column) for column in range(7)),
    *((row, 6) for row in range(1, 7)),
    *((6, column) for column in range(5, -1, -1)),
    *((row, 0) for row in range(5, 0, -1)),
]
"""Row and column of each bit, clockwise from the upper left corner of the tag's picture."""


def tag_design(tag: int, inner_square_m: float) -> LandmarkDesign:
    """A tag of foam and metal: 24 bits about a dark ring about a square of foam."""
    from actag.tag_parameters import AcTagParams

    levels = np.full((BITS_ACROSS, BITS_ACROSS), PLATE_DB)
    for bit, place in zip(AcTagParams(FAMILY, inner_square_m).tags_in_family[tag], RING, strict=True):
        levels[place] = FOAM_DB if bit else PLATE_DB
    levels[2:5, 2:5] = FOAM_DB
    return LandmarkDesign(tag, f"{FAMILY} {tag}", inner_square_m * BITS_ACROSS / 3, np.kron(levels, np.ones((20, 20))))
