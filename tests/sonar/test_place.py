"""Laws of the place of a landmark: least squares of its figure with the side and the shadow of its relief."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from sonar_graph.devices import DEFAULT_DESIGNS
from sonar_graph.errors import CalibrationError
from sonar_graph.images import SonarFrames
from sonar_graph.measurements import Floats
from sonar_graph.simulation.sonar_image import (
    FrameSimulator,
    ImageOptions,
    place_landmark,
)
from sonar_graph.sonar import FloorView, confusion_for
from sonar_graph.sonar.appearance import (
    Appearance,
    AppearanceParams,
    CandidateFit,
    DesignFit,
)
from sonar_graph.sonar.place import Grid, Lit, Relief, fit_place
from sonar_graph.sonar.templates import Patch, check_headings

from .polar_images import candidates_at, design_of

CELL_M = 0.015
SIDE = 37
BLUR_M = (0.008, 0.01)
SIDE_M = 0.007
SHADE_STEPS = 3
LONGER = 0.6
"""The shadow is 3.6 steps of half a cell long."""
ROWS_COLUMNS = tuple(np.indices((SIDE, SIDE)).reshape(2, -1))
RELIEF = Relief.of(DEFAULT_DESIGNS[2], 0.3, Grid(SIDE, CELL_M, BLUR_M), SHADE_STEPS)


def columns(relief: Relief = RELIEF) -> list[Floats]:
    """B with its side, D where no shadow lies on it, and S, written out."""
    shade = relief.shorter * (1 - LONGER) + relief.longer * LONGER
    return [relief.figure + SIDE_M * relief.side, relief.dark * (1 - shade), shade]


def patch_with(
    levels: tuple[float, float, float, float],
    at: tuple[int, int],
    noise_db: float,
    seed: int,
) -> Floats:
    """Levels (floor, beta, delta, gamma) of the figure at a cell of a patch of 47 by 47, with white noise."""
    floor, *others = levels
    patch = floor + np.random.default_rng(seed).normal(0, noise_db, (47, 47))
    x, y = at
    patch[x : x + SIDE, y : y + SIDE] += np.tensordot(others, columns(), 1)
    return patch.astype(np.float32)


def test_place_and_bound_are_those_of_least_squares_over_the_cells_in_view():
    """By `scipy.optimize.least_squares` on the same tangents."""
    x = 5
    y = 6
    patch = patch_with((40, 0.7, 0.5, -9.0), (x, y), 3.0, 2)
    seen = np.ones((47, 47), np.float32)
    seen[:, 33:] = 0
    start = np.array([x, y], float)
    of = Patch.of(patch, seen, np.zeros(2)), ROWS_COLUMNS, start
    place, bound = fit_place(RELIEF, *of, Lit(SIDE_M, LONGER))
    inside = np.s_[x : x + SIDE, y : y + SIDE]
    held = seen[inside] > 0
    z = patch[inside][held].astype(float)
    parts = np.array(columns())
    slopes = np.gradient(parts, axis=(1, 2))

    def residuals(q: Floats) -> Floats:
        shifted = parts - q[4] * slopes[0] - q[5] * slopes[1]
        return z - q[0] - np.tensordot(q[1:4], shifted, 1)[held]

    found = least_squares(residuals, [40, 1, 0.3, -5, 0, 0])
    np.testing.assert_allclose(place - start, found.x[4:], atol=0.02)
    covariance = np.mean(found.fun**2) * np.linalg.inv(found.jac.T @ found.jac)
    np.testing.assert_allclose(bound, np.sqrt(np.diag(covariance)[4:]), rtol=0.03)


AN_L = (0.0, -0.12, 0.17, 0.05), (-0.12, 0.05, 0.05, 0.12)


def test_a_landmark_is_where_the_middle_of_its_square_is():
    """In frames of the simulator, at several headings; the candidate lies where the figure does."""
    middle_m = (0.15, -0.1)
    design = design_of(*AN_L, size_m=0.7, middle_m=middle_m)
    sonar_m = np.array([0, 0, 0.95])
    tilt = Rotation.from_euler("Y", 0.52)
    model = confusion_for([design]).model_copy(update={"height_bias_m": 0.0})
    look = CandidateFit([design], AppearanceParams(), model, np.radians(14))
    view = FloorView(tilt.as_matrix(), 0.95 - design.height_m)
    errors = []
    figure = np.array(design.figure_m)
    np.testing.assert_allclose(figure - middle_m, (-0.0497, -0.0497), atol=2e-3)
    near_m = np.array([1.75, 0.02, design.height_m])
    for seed, heading in enumerate((0.4, 2.1, 4.4)):
        turn = Rotation.from_euler("Z", heading)
        centre_m = near_m - turn.apply([*figure, 0.0])
        placed = place_landmark(design, centre_m, heading, 0.0)
        simulator = FrameSimulator(ImageOptions(), [placed], 0.0, seed)
        level_db = simulator.level_db(sonar_m, tilt, 0, 1.75)
        axes = simulator.ranges_m(), simulator.azimuths_rad()
        frame = SonarFrames(np.array([1]), level_db[None], *axes)
        places = tilt.inv().apply(np.array([centre_m, near_m]) - sonar_m)
        r, near_r = np.linalg.norm(places, axis=1)
        a, near_a = np.arctan2(places[:, 1], places[:, 0])
        candidates = candidates_at([near_r], [near_a])
        (seen,) = look.at(level_db, frame, view, candidates, np.array([0]))
        assert seen.moved_m.max() > 0.001  # an error of the heading
        off = np.array([seen.range_m - r, seen.azimuth_rad - a])
        errors.append(off / np.sqrt(np.diag(seen.covariance)))
    assert np.mean(np.square(errors)) < 2
    assert np.abs(errors).max() < 4


def test_a_figure_beside_the_middle_that_looks_the_same_turned_is_refused():
    aside = {"size_m": 0.7, "middle_m": (0.15, 0.0)}
    box = (0.0, 0.0, 0.08, 0.08)
    check_headings([design_of(box), design_of(*AN_L, **aside), *DEFAULT_DESIGNS])
    with pytest.raises(
        CalibrationError,
        match=r"own \(id 7\): its figure lies 15 cm .* looks the same .* in the middle",
    ):
        check_headings([design_of(box, **aside)])


@pytest.mark.parametrize("slope", [0.15, 0.6, 1.2])
@pytest.mark.parametrize("design", [0, 2])
def test_side_and_shadow_of_a_place_are_those_of_the_slope(slope, design):
    """``t h / d`` of the face and ``t (d / h + h / d)`` behind it of 12 mm of foam: nothing is left, the bound is 0.

    In the same appearance after each other, so that what was drawn for one slope is not taken for another.
    """
    relief_m = 0.012
    tall = replace(DEFAULT_DESIGNS[design], relief_m=relief_m)
    appearance = Appearance([tall], BLUR_M)
    row = len(appearance.templates.heading_rad) // 3
    heading_rad = float(appearance.templates.heading_rad[row])
    side = appearance.templates.side
    grid = Grid(side, CELL_M, BLUR_M)
    centre_m = np.array([2.0, 0.1])
    moved = np.array([1, -2])
    at = centre_m + CELL_M * moved
    fit = DesignFit(
        np.zeros((1, 11)),
        1.0,
        np.array([heading_rad]),
        at[None] + 0.004,
        np.array([row]),
        np.array([-1]),
    )
    for other in (0.9, slope):
        length = relief_m * (other + 1 / other) / (CELL_M / 2)
        steps = int(length)
        drawn = Relief.of(tall, heading_rad, grid, steps)
        shade = drawn.shorter + (length - steps) * (drawn.longer - drawn.shorter)
        face = drawn.figure + relief_m * other * drawn.side
        level = np.full((appearance.patch_side, appearance.patch_side), 40.0)
        inset = (appearance.patch_side - side) // 2 + moved
        inside = tuple(slice(first, first + side) for first in inset)
        level[inside] += 0.7 * face + 0.5 * drawn.dark * (1 - shade) - 9.0 * shade
        level = level.astype(np.float32)
        seen = np.ones_like(level)
        patch = Patch(level, seen, level, seen, centre_m)
        place_m, bound_m, _ = appearance.place(patch, fit, 0, other)
        np.testing.assert_allclose(place_m, at, atol=2e-5)
        assert (bound_m < 2e-5).all()
