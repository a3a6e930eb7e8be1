"""AcTags as landmark designs, for simulating them: drawn from the bits of AcTag's own families."""

from __future__ import annotations

from importlib import import_module

import numpy as np

from sonar_graph.errors import CalibrationError
from sonar_graph.landmark_designs import LandmarkDesign
from sonar_graph.sonar.actag_recogniser import BITS_OF_INNER_SQUARE, INSTALL

BITS_ACROSS, PIXELS_A_BIT = 7, 20
FOAM_DB, PLATE_DB = 12.0, -8.0
"""Over the floor: as of the landmarks that ship."""
RING = (
    *((0, column) for column in range(7)),
    *((row, 6) for row in range(1, 7)),
    *((6, column) for column in range(5, -1, -1)),
    *((row, 0) for row in range(5, 0, -1)),
)
"""Row and column of each of 24 bits, clockwise from the upper left corner of the tag's picture."""


def tag_design(family: str, tag: int, tag_size_m: float) -> LandmarkDesign:
    """A tag of foam and metal: 24 bits about a dark ring about a square of foam.

    Parameters
    ----------
    family
        Such as AcTag24h10.
    tag
        Its number in the family, and the landmark's identity.
    tag_size_m
        Side of the inner square.

    Raises
    ------
    CalibrationError
        When AcTag is not installed.
    """
    try:
        parameters = import_module("actag.tag_parameters")
    except ImportError as error:
        raise CalibrationError(f"drawing AcTags needs the package actag: {INSTALL} ({error})") from error
    levels = np.full((BITS_ACROSS, BITS_ACROSS), PLATE_DB)
    for bit, place in zip(parameters.AcTagParams(family, tag_size_m).tags_in_family[tag], RING, strict=True):
        levels[place] = FOAM_DB if bit else PLATE_DB
    levels[2:5, 2:5] = FOAM_DB
    mask = np.kron(levels, np.ones((PIXELS_A_BIT, PIXELS_A_BIT)))
    return LandmarkDesign(tag, f"{family} {tag}", tag_size_m * BITS_ACROSS / BITS_OF_INNER_SQUARE, mask)
