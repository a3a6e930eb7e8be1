"""``sonar-graph figures``: what a paper takes of a result."""

import pytest

from sonar_graph.report import write_report
from tests.synthetic import basin_comparison


@pytest.mark.usefixtures("unrendered")
def test_figures_go_into_a_folder_beside_the_result_or_elsewhere(run, tmp_path, capsys):
    result = write_report(basin_comparison(60), tmp_path / "result").parent
    assert run("figures", result) == 0
    assert (
        capsys.readouterr().out
        == f"Figures and tables: {result / 'paper' / 'protocol.txt'}\n"
    )
    assert (result / "paper" / "figures" / "map.pdf").is_file()
    assert run("figures", tmp_path) == 2
    assert "no comparison.json in it" in capsys.readouterr().err
    assert run("figures", result, "-o", result) == 2
    assert "holds a comparison, and would become a paper" in capsys.readouterr().err
