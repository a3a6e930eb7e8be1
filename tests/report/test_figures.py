"""Figures of a comparison: quantities with units, truth from the numbers, and maps as they grew."""

import re
from dataclasses import replace
from itertools import combinations
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.patches import Ellipse
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from sonar_graph.evaluation import Comparison, map_instants, published_maps
from sonar_graph.evaluation.results import MapSoFar
from sonar_graph.report import figures
from sonar_graph.report.figure_style import (
    arrange,
    blank_panels,
    evenly,
    inline_svg,
    logarithmic,
    sized,
)
from sonar_graph.report.figures import (
    drawings,
    growth_figure,
    illustrations,
    map_figure,
)
from sonar_graph.report.figures.error_figures import errors_cut_off, shares_in_band
from sonar_graph.report.figures.maps import (
    enlargement,
)
from sonar_graph.states import FIRST_ANONYMOUS_ID, LandmarkMap
from tests.synthetic import basin_comparison, only, with_failure, with_run

TIME = "time since start (s)"
DISTANCE = "distance travelled (m)"
FIGURES = {
    map_figure: ({"world x (m)"}, {"world y (m)"}),
    figures.error_figure: ({TIME, DISTANCE}, {"position error (m)", "yaw error (°)"}),
    figures.bounds_figure: (
        {TIME},
        {"error in x (m)", "error in y (m)", "yaw error (°)"},
    ),
    figures.yaw_figure: ({TIME}, {"yaw (°)"}),
    figures.nees_figure: ({TIME}, {"position NEES / dof", "yaw NEES / dof"}),
    figures.innovation_figure: ({TIME}, {"range (m)", "azimuth (°)"}),
}
"""Every figure, with the labels of its axes."""


def drawing_of(comparison: Comparison, name: str) -> Any:
    """A figure with its caption, not drawn."""
    return drawings(comparison)[name][1]


@pytest.mark.parametrize("draw", FIGURES)
def test_a_figure_is_a_well_formed_svg_with_units(comparison, draw):
    figure, (x, y) = draw(comparison), FIGURES[draw]
    assert {panel.get_xlabel() for panel in figure.axes} - {""} == x
    assert {panel.get_ylabel() for panel in figure.axes} - {""} == y
    svg = inline_svg(figure, "figure", 'says "<x>" & more')
    root = ElementTree.fromstring(svg)
    assert root.attrib["aria-label"] == 'says "<x>" & more'
    assert "var(--ink)" in svg
    assert not re.search(r"#[0-9a-f]{6}\b", svg), "would not follow dark and light"
    assert "http" not in svg
    blind = replace(comparison.sequence, truth=None, true_landmarks=None)
    assert draw(replace(only(comparison), sequence=blind)) is None


def test_names_of_crowded_landmarks_neither_overlap_nor_cover_a_mark():
    """Landmarks without a name are u0, u1, ...; a name without room is left out."""
    comparison = only(basin_comparison(60, truth=False), "isam2")
    rng = np.random.default_rng(5)
    ids = FIRST_ANONYMOUS_ID + np.arange(40)
    for spread_m in (0.05, 1.0, 4.0):
        points = rng.normal(3.0, spread_m, (40, 3))
        crowd = LandmarkMap(ids, points, np.tile(1e-4 * np.eye(3), (40, 1, 1)))
        shown = with_run(comparison, replace(comparison.runs[0], landmarks=crowd))
        with sized():
            figure = map_figure(shown)
        FigureCanvasAgg(figure).draw()
        (panel,) = figure.axes
        names = [text for text in panel.texts if text.get_text()]
        assert names or spread_m < 1
        assert {text.get_text() for text in names} <= {f"u{k}" for k in range(40)}
        boxes = [text.get_window_extent() for text in names]
        assert not any(one.overlaps(other) for one, other in combinations(boxes, 2))
        marks = panel.transData.transform(points[:, :2])
        assert not any(box.contains(*mark) for box in boxes for mark in marks)


@pytest.mark.parametrize(
    "limits", [(0.9, 1.1), (1.0, 9.0), (2.0, 3.0), (0.3, 40.0), (1e-3, 1e6)]
)
def test_a_logarithmic_axis_has_several_ticks(limits):
    _, axes = blank_panels(1, 1, (4.0, 3.0))
    panel = axes[0, 0]
    logarithmic(panel, "y")
    panel.set_ylim(*limits)
    low, high = limits
    shown = [tick for tick in panel.yaxis.get_majorticklocs() if low <= tick <= high]
    assert 3 <= len(shown) <= 12


@pytest.fixture(scope="module")
def comparison() -> Comparison:
    return basin_comparison()


def test_errors_and_their_band_are_drawn_in_their_units(comparison):
    first, _, yaw = figures.bounds_figure(only(comparison, "ekf-slam")).axes
    errors = comparison.errors["ekf-slam"]["causal"]
    x_line = first.lines[-1]
    np.testing.assert_allclose(x_line.get_ydata(), errors.position_m[:, 0])
    degrees = np.degrees(errors.yaw_rad)
    np.testing.assert_allclose(yaw.lines[-1].get_ydata(), degrees)
    seconds = (errors.stamps_ns - errors.stamps_ns[0]) * 1e-9 + 0.5
    np.testing.assert_allclose(x_line.get_xdata(), seconds)
    corners = first.collections[0].get_datalim(first.transData)
    largest_m = errors.position_sigma_m[:, 0].max()
    assert corners.y1 == pytest.approx(chi2.ppf(0.95, 1) ** 0.5 * largest_m)


def test_the_share_in_the_band_is_that_of_a_chi_square(comparison):
    """Written beside the figure: 95 % of a chi-square with three and with one degree of freedom, none of a wrong sigma."""
    alone = only(comparison, "isam2")
    series = comparison.errors["isam2"]["causal"]
    n = 20_000
    rng = np.random.default_rng(3)
    squares = rng.chisquare(series.position_dof, n)
    yaw = rng.chisquare(1, n)
    for nees, share in ((squares, "95 %"), (100.0 * squares + 100.0, "0 %")):
        drawn = {"stamps_ns": np.arange(n), "nees_position": nees, "nees_yaw": yaw}
        errors = {"isam2": {"causal": replace(series, **drawn)}}
        told = shares_in_band(replace(alone, errors=errors))
        assert told == f" In the band (position, yaw): isam2 {share}, 95 %."
    caption = drawing_of(alone, "nees").caption
    assert " In the band (position, yaw): isam2 " in caption


def test_a_run_that_is_far_worse_leaves_the_picture_and_is_named(comparison):
    assert errors_cut_off(only(comparison, "isam2", "ekf-slam")) == []
    errors = comparison.errors["dead-reckoning"]["causal"]
    lost = replace(errors, position_m=np.add(errors.position_m, [100.0, 0, 0]))
    series = comparison.errors | {"dead-reckoning": {"causal": lost}}
    far = replace(comparison, errors=series)
    assert errors_cut_off(far) == ["dead-reckoning"]
    best = np.hypot(*comparison.errors["isam2"]["causal"].position_m[:, :2].T).max()
    assert best < figures.error_figure(far).axes[0].get_ylim()[1] < 20 * best
    caption = drawing_of(far, "errors-raw").caption
    assert "Leaves the picture: dead-reckoning." in caption


@pytest.mark.parametrize("draw", FIGURES)
def test_nothing_overlaps_and_nothing_leaves_the_figure(comparison, draw):
    """Labels stand beside the numbers, panels beside each other, all within the paper."""
    with sized():
        figure = draw(comparison)
        arrange(figure)
        FigureCanvasAgg(figure).draw()
    width, height = figure.get_size_inches() * figure.dpi
    boxes = [panel.get_tightbbox() for panel in figure.axes]
    for panel, box in zip(figure.axes, boxes, strict=True):
        assert -1 <= box.x0 < box.x1 <= width + 1
        assert -1 <= box.y0 < box.y1 <= height + 1
        if not panel.get_subplotspec().is_first_col():
            continue
        texts = [text for text in panel.get_yticklabels() if text.get_text()]
        numbers = [text.get_window_extent() for text in texts]
        low = panel.bbox.y0
        high = panel.bbox.y1
        numbers = [one for one in numbers if low <= (one.y0 + one.y1) / 2 <= high]
        assert numbers
        label = panel.yaxis.label
        right = label.get_window_extent().x1
        assert not label.get_text() or all(right <= one.x0 + 1 for one in numbers)
    assert not any(one.overlaps(other) for one, other in combinations(boxes, 2))
    for legend in figure.legends:
        extent = legend.get_window_extent()
        assert extent.x1 <= width + 1
        assert all(extent.y0 >= box.y1 - 1 for box in boxes)


def test_landmark_ellipses_hold_95_percent(comparison):
    known = comparison.runs[0].landmarks
    panel = map_figure(only(comparison, "isam2")).axes[0]
    ellipses = [patch for patch in panel.patches if isinstance(patch, Ellipse)]
    for ellipse, mean, cov in zip(
        ellipses, known.positions, known.covariances, strict=True
    ):
        turn = Rotation.from_euler("z", ellipse.angle, degrees=True).as_matrix()
        axes = turn[:2, :2] * [ellipse.width / 2, ellipse.height / 2]
        expected = chi2.ppf(0.95, 2) * cov[:2, :2]
        np.testing.assert_allclose(axes @ axes.T, expected, rtol=1e-9)
        np.testing.assert_allclose(ellipse.center, mean[:2])


def test_yaw_is_never_joined_across_the_wrap(comparison):
    for line in figures.yaw_figure(comparison).axes[0].lines:
        steps = np.abs(np.diff(np.asarray(line.get_ydata(), dtype=float)))
        assert np.nanmax(steps) <= 180
        assert np.isnan(steps).any(), "three laps pass ±180° and must leave gaps"


@given(st.integers(0, 5000), st.integers(2, 900))
def test_even_choice_keeps_the_ends(n, points):
    rows = evenly(n, points)
    assert len(rows) == min(n, points)
    if n:
        assert rows[0] == 0
        assert rows[-1] == n - 1


def grown(instants: int = 240, sigma_m: float = 0.05) -> Comparison:
    """Runs that knew one landmark more at each of three times."""
    comparison = basin_comparison(instants)
    stamps = map_instants(comparison.instants_ns, comparison.sequence.start_ns).tolist()
    for run in comparison.runs[:2]:
        known = run.landmarks
        maps = []
        for n, stamp in zip((2, 3, 4), stamps, strict=True):
            covs = np.tile(sigma_m**2 * np.eye(3), (n, 1, 1))
            found = LandmarkMap(known.ids[:n], known.positions[:n], covs)
            maps.append(MapSoFar(stamp, found))
        comparison = with_run(comparison, replace(run, maps=maps))
    return comparison


def test_ellipses_are_as_large_as_the_caption_says():
    comparison = grown(sigma_m=0.02)
    factor = enlargement(comparison)
    assert factor > 1
    patches = growth_figure(comparison).axes[0].patches
    ellipse = next(patch for patch in patches if isinstance(patch, Ellipse))
    width_m = 2 * factor * 0.02 * np.sqrt(chi2.ppf(0.95, 2))
    assert ellipse.width == pytest.approx(width_m)
    caption = drawing_of(comparison, "growth").caption
    assert f"drawn {factor} times as large" in caption


@pytest.mark.usefixtures("unrendered")
def test_without_maps_on_the_way_the_page_says_so():
    comparison = basin_comparison(60)
    assert growth_figure(comparison) is None
    assert illustrations(only(comparison, "isam2"))["growth"].instead
    figure = growth_figure(with_failure(grown(60), "ekf-slam", "gave up"))
    assert len(figure.axes) == 3


def test_only_the_repeated_experiment_names_the_papers_figures():
    other = grown(60)
    sequence = replace(other.sequence, true_landmarks=published_maps()[1])
    same = replace(other, sequence=sequence)
    instants = "same fractions of this run as its 833.1, 1369.4 and 2039.0 s"
    for name, counterpart in (("growth", "Fig. 4"), ("yaw", "Fig. 5")):
        assert counterpart in drawing_of(same, name).caption
        assert "paper" not in drawing_of(other, name).caption
    assert instants in drawing_of(same, "growth").caption
