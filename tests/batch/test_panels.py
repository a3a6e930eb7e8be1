from __future__ import annotations

import pytest

from sonar_graph.batch.panels import WIDTH_IN, folded, log_panels

from .recorded_batches import drawn_batch


@pytest.mark.parametrize(("logs", "shape"), [(1, (1, 1)), (2, (2, 1)), (3, (2, 2)), (4, (2, 3)), (9, (3, 3))])
def test_many_logs_stand_beside_each_other(logs: int, shape: tuple[int, int]) -> None:
    names = tuple(f"log {index}" for index in range(logs))
    figure, panels = log_panels(drawn_batch(1, logs=names), list(names), "error (m)")
    assert [panel.get_title(loc="left") for panel in panels] == list(names)
    assert len(figure.axes) == logs
    grid = panels[0].get_subplotspec().get_gridspec()
    assert (grid.nrows, grid.ncols) == shape
    assert figure.get_figwidth() == WIDTH_IN


def test_names_stand_at_the_left_of_every_row_only() -> None:
    names = tuple(f"log {index}" for index in range(5))
    batch = drawn_batch(1, logs=names)
    _, panels = log_panels(batch, list(names), "")
    shown = [[label.get_text() for label in panel.get_yticklabels()] for panel in panels]
    assert shown[0] == shown[3] == batch.contestants
    assert set(shown[1] + shown[2] + shown[4]) == {""}


@pytest.mark.parametrize("name", ["isam2/identity_policy=max-mixture", "a, b=1, c=2", "plain", "/=,", "x" * 40])
def test_folding_loses_no_letter(name: str) -> None:
    lines = folded(name, 18).split("\n")
    assert "".join(lines).replace(" ", "") == name.replace(" ", "")
    assert all(len(line) <= 18 or not any(sign in line[:-1] for sign in "/=,") for line in lines)
