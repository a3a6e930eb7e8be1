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
    assert re.findall(r"#[0-9a-f]{6}\b", svg) == [], (
        "a fixed colour would not follow dark and light"
    )
    assert "http" not in svg
    empty = replace(
        only(comparison),
        sequence=replace(comparison.sequence, truth=None, true_landmarks=None),
    )
    assert draw(empty) is None


def test_names_of_crowded_landmarks_neither_overlap_nor_cover_a_mark():
    """Landmarks without a name are u0, u1, ...; a name without room is left out."""
    comparison = only(basin_comparison(60, truth=False), "isam2")
    rng = np.random.default_rng(5)
    for spread_m in (0.05, 1.0, 4.0):
        points = np.column_stack([rng.normal(3.0, spread_m, (40, 2)), np.zeros(40)])
        ids = FIRST_ANONYMOUS_ID + np.arange(40)
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
    figure, axes = blank_panels(1, 1, (4.0, 3.0))
    panel = axes[0, 0]
    logarithmic(panel, "y")
    panel.set_ylim(*limits)
    ticks = panel.yaxis.get_majorticklocs()
    assert 3 <= np.count_nonzero((ticks >= limits[0]) & (ticks <= limits[1])) <= 12
    assert figure.axes == [panel]


@pytest.fixture(scope="module")
def comparison() -> Comparison:
    return basin_comparison()


def test_errors_and_their_band_are_drawn_in_their_units(comparison):
    name = "ekf-slam"
    figure = figures.bounds_figure(only(comparison, name))
    errors = comparison.errors[name]["causal"]
    x_line = figure.axes[0].lines[-1]
    yaw_line = figure.axes[2].lines[-1]
    np.testing.assert_allclose(x_line.get_ydata(), errors.position_m[:, 0])
    np.testing.assert_allclose(yaw_line.get_ydata(), np.degrees(errors.yaw_rad))
    seconds = (errors.stamps_ns - errors.stamps_ns[0]) * 1e-9 + 0.5
    np.testing.assert_allclose(x_line.get_xdata(), seconds)
    corners = figure.axes[0].collections[0].get_datalim(figure.axes[0].transData)
    assert corners.y1 == pytest.approx(
        chi2.ppf(0.95, 1) ** 0.5 * errors.position_sigma_m[:, 0].max()
    )


def test_the_share_in_the_band_is_that_of_a_chi_square(comparison):
    """Written beside the figure: 95 % of a chi-square with three and with one degree of freedom, none of a wrong sigma."""
    series = comparison.errors["isam2"]["causal"]
    n = 20_000
    rng = np.random.default_rng(3)
    drawn = replace(
        series,
        stamps_ns=np.arange(n),
        nees_position=rng.chisquare(series.position_dof, n),
        nees_yaw=rng.chisquare(1, n),
    )
    far = replace(drawn, nees_position=100.0 * drawn.nees_position + 100.0)
    for shown, share in ((drawn, "95 %"), (far, "0 %")):
        one = replace(only(comparison, "isam2"), errors={"isam2": {"causal": shown}})
        assert (
            shares_in_band(one) == f" In the band (position, yaw): isam2 {share}, 95 %."
        )
    caption = drawing_of(only(comparison, "isam2"), "nees").caption
    assert " In the band (position, yaw): isam2 " in caption


def test_a_run_that_is_far_worse_leaves_the_picture_and_is_named(comparison):
    assert errors_cut_off(only(comparison, "isam2", "ekf-slam")) == []
    lost = replace(
        (errors := comparison.errors["dead-reckoning"]["causal"]),
        position_m=errors.position_m + np.array([100.0, 0, 0]),
    )
    far = replace(
        comparison, errors={**comparison.errors, "dead-reckoning": {"causal": lost}}
    )
    assert errors_cut_off(far) == ["dead-reckoning"]
    best = np.hypot(*comparison.errors["isam2"]["causal"].position_m[:, :2].T).max()
    assert best < figures.error_figure(far).axes[0].get_ylim()[1] < 20 * best
    shown = drawing_of(far, "errors-raw")
    assert "Leaves the picture: dead-reckoning." in shown.caption


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
        written = [
            text.get_window_extent()
            for text in panel.get_yticklabels()
            if text.get_text()
        ]
        numbers = [
            one
            for one in written
            if panel.bbox.y0 <= (one.y0 + one.y1) / 2 <= panel.bbox.y1
        ]
        assert numbers or not panel.get_subplotspec().is_first_col()
        label = panel.yaxis.label
        if label.get_text() and panel.get_subplotspec().is_first_col():
            assert all(
                label.get_window_extent().x1 <= number.x0 + 1 for number in numbers
            )
    for one, other in combinations(boxes, 2):
        assert not one.overlaps(other)
    for legend in figure.legends:
        assert legend.get_window_extent().x1 <= width + 1
        assert all(legend.get_window_extent().y0 >= box.y1 - 1 for box in boxes)


def test_yaw_is_never_joined_across_the_wrap(comparison):
    for line in figures.yaw_figure(comparison).axes[0].lines:
        steps = np.abs(np.diff(np.asarray(line.get_ydata(), dtype=float)))
        assert np.nanmax(steps) <= 180
        assert np.isnan(steps).any(), "three laps pass ±180° and must leave gaps"


def test_landmark_ellipses_hold_95_percent_of_draws(comparison):
    run = comparison.runs[0]
    panel = map_figure(only(comparison, "isam2")).axes[0]
    ellipses = [patch for patch in panel.patches if isinstance(patch, Ellipse)]
    assert len(ellipses) == len(run.landmarks)
    rng = np.random.default_rng(3)
    for ellipse, mean, cov in zip(
        ellipses, run.landmarks.positions, run.landmarks.covariances, strict=True
    ):
        draws = rng.multivariate_normal(mean[:2], cov[:2, :2], 20_000)
        turn = np.radians(ellipse.angle)
        along = (draws - ellipse.center) @ np.array(
            [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
        )
        inside = np.sum((2 * along / [ellipse.width, ellipse.height]) ** 2, axis=1) <= 1
        assert inside.mean() == pytest.approx(0.95, abs=0.01)


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
    runs = []
    for run in comparison.runs:
        maps = []
        if run.landmarks is not None:
            covariances = np.tile(sigma_m**2 * np.eye(3), (4, 1, 1))
            known = replace(run.landmarks, covariances=covariances)
            rows = [slice(0, 2), slice(0, 3), slice(0, 4)]
            maps = [
                MapSoFar(
                    stamp,
                    LandmarkMap(known.ids[r], known.positions[r], known.covariances[r]),
                )
                for stamp, r in zip(stamps, rows, strict=True)
            ]
        runs.append(replace(run, maps=maps))
    return replace(comparison, runs=runs)


def test_ellipses_are_as_large_as_the_caption_says():
    comparison = grown(sigma_m=0.02)
    figure = growth_figure(comparison)
    factor = enlargement(comparison)
    assert factor > 1
    ellipse = next(
        patch for patch in figure.axes[0].patches if isinstance(patch, Ellipse)
    )
    assert ellipse.width == pytest.approx(
        2 * factor * 0.02 * np.sqrt(chi2.ppf(0.95, 2))
    )
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
    same = replace(
        other, sequence=replace(other.sequence, true_landmarks=published_maps()[1])
    )
    for name, counterpart in (("growth", "Fig. 4"), ("yaw", "Fig. 5")):
        assert counterpart in drawing_of(same, name).caption
        assert "paper" not in drawing_of(other, name).caption
    assert (
        "same fractions of this run as its 833.1, 1369.4 and 2039.0 s"
        in drawing_of(same, "growth").caption
    )
