from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.patches import Ellipse
from scipy.stats import chi2

from sonar_graph.evaluation.results import Comparison, MapSoFar
from sonar_graph.evaluation.scored_instants import map_instants, published_maps
from sonar_graph.report.comparison_page import illustrations
from sonar_graph.report.maps import LARGEST_ELLIPSE, enlargement, growth_figure, map_view
from sonar_graph.states import LandmarkMap
from tests.synthetic import basin_comparison, with_failure


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
                MapSoFar(stamp, LandmarkMap(known.ids[r], known.positions[r], known.covariances[r]))
                for stamp, r in zip(stamps, rows, strict=True)
            ]
        runs.append(replace(run, maps=maps))
    return replace(comparison, runs=runs)


def test_each_panel_shows_what_was_known_then():
    comparison = grown()
    figure = growth_figure(comparison)
    assert figure is not None
    panels = np.array(figure.axes).reshape(2, 3)
    stamps = sorted({known.stamp_ns for run in comparison.runs for known in run.maps})
    for row, run in enumerate(comparison.runs[:2]):
        for column, (panel, stamp_ns) in enumerate(zip(panels[row], stamps, strict=True)):
            lines = {line.get_label(): line for line in panel.get_lines()}
            assert run.causal is not None
            until = run.causal.positions[run.causal.stamps_ns <= stamp_ns]
            path = np.column_stack(lines["causal estimate"].get_data())
            np.testing.assert_allclose(path, until[:, :2])
            assert len(lines["estimated landmarks"].get_xdata()) == 2 + column
            assert sum(isinstance(patch, Ellipse) for patch in panel.patches) == 2 + column


def test_ellipses_are_as_large_as_the_caption_says():
    comparison = grown(sigma_m=0.02)
    figure, factor = growth_figure(comparison), enlargement(comparison)
    assert figure is not None
    assert factor > 1
    ellipse = next(patch for patch in figure.axes[0].patches if isinstance(patch, Ellipse))
    assert ellipse.width == pytest.approx(2 * factor * 0.02 * np.sqrt(chi2.ppf(0.95, 2)))
    assert f"drawn {factor} times as large" in illustrations(comparison)["growth"].caption


@pytest.mark.parametrize("sigma_m", [1e-4, 0.01, 0.1, 3.0])
def test_ellipses_are_enlarged_only_as_far_as_there_is_room(sigma_m):
    comparison = grown(60, sigma_m)
    view, factor = map_view(comparison), enlargement(comparison)
    assert view is not None
    half_m = factor * sigma_m * np.sqrt(chi2.ppf(0.95, 2))
    assert factor == 1 or half_m <= LARGEST_ELLIPSE * float((view[1] - view[0]).max())


def test_without_maps_on_the_way_the_page_says_so_and_a_failed_run_has_no_row():
    comparison = basin_comparison(60)
    assert growth_figure(comparison) is None
    assert illustrations(comparison)["growth"].instead
    figure = growth_figure(with_failure(grown(60), "ekf-slam", "gave up"))
    assert figure is not None
    assert len(figure.axes) == 3


@pytest.mark.slow
def test_only_the_repeated_experiment_names_the_papers_figures():
    other = grown(60)
    same = replace(other, sequence=replace(other.sequence, true_landmarks=published_maps()[1]))
    for name, counterpart in (("growth", "Fig. 4"), ("yaw", "Fig. 5")):
        assert counterpart in illustrations(same)[name].caption
        assert "paper" not in illustrations(other)[name].caption
    assert "same fractions of this run as its 833.1, 1369.4 and 2039.0 s" in illustrations(same)["growth"].caption
