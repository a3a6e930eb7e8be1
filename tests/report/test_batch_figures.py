from __future__ import annotations

import pytest

from sonar_graph.report.batch_figures import WIDTH_IN, folded, log_panels, spread_out
from sonar_graph.report.figure_style import colour
from tests.recorded_batches import drawn_batch


@pytest.mark.parametrize(("logs", "shape"), [(1, (1, 1)), (2, (2, 1)), (3, (2, 2)), (4, (2, 3)), (9, (3, 3))])
def test_many_logs_stand_beside_each_other(logs, shape):
    names = tuple(f"log {index}" for index in range(logs))
    figure, panels = log_panels(drawn_batch(1, logs=names), list(names), "error (m)")
    assert [panel.get_title(loc="left") for panel in panels] == list(names)
    assert len(figure.axes) == logs
    grid = panels[0].get_subplotspec().get_gridspec()
    assert (grid.nrows, grid.ncols) == shape
    assert figure.get_figwidth() == WIDTH_IN


def test_names_stand_at_the_left_of_every_row_only():
    names = tuple(f"log {index}" for index in range(5))
    batch = drawn_batch(1, logs=names)
    _, panels = log_panels(batch, list(names), "")
    shown = [[label.get_text() for label in panel.get_yticklabels()] for panel in panels]
    assert shown[0] == shown[3] == batch.contestants
    assert set(shown[1] + shown[2] + shown[4]) == {""}


@pytest.mark.parametrize("name", ["isam2/identity.policy=max-mixture", "a, b=1, c=2", "plain", "/=,", "x" * 40])
def test_folding_loses_no_letter(name):
    lines = folded(name, 18).split("\n")
    assert "".join(lines).replace(" ", "") == name.replace(" ", "")
    assert all(len(line) <= 18 or not any(sign in line[:-1] for sign in "/=,") for line in lines)


def test_the_first_contestant_is_on_top_and_each_has_its_colour():
    batch = drawn_batch(1)
    _, panels = log_panels(batch, batch.logs, "")
    bottom, top = panels[0].get_ylim()
    assert top < 0 < len(batch.contestants) - 1 < bottom
    colours = [label.get_color() for label in panels[0].get_yticklabels()]
    assert colours == [colour(place) for place in range(len(batch.contestants))]
    assert len(set(colours)) == len(colours)


def test_headings_are_folded_over_small_panels_alone():
    names = tuple(f"tracks, wrong_id_rate=0.0{index}" for index in range(3))
    batch = drawn_batch(1, logs=names)
    for logs in (names[:2], names):
        _, panels = log_panels(batch, list(logs), "")
        assert ["\n" in panel.get_title(loc="left") for panel in panels] == [len(logs) > 2] * len(logs)


def test_a_spread_out_scale_has_numbers_at_one_two_and_five():
    _, (panel, *_) = log_panels(drawn_batch(1), ["basin"], "")
    spread_out(panel)
    panel.set_xlim(0.9, 11)
    shown = [place for place in panel.xaxis.get_majorticklocs() if 0.9 < place < 11]
    assert shown == pytest.approx([1, 2, 5, 10])
