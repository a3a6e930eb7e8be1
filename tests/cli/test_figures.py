"""``sonar-graph figures``: what a paper takes of a result."""

import pytest

from sonar_graph.report import write_report
from tests.synthetic import basin_comparison, only


@pytest.mark.usefixtures("unrendered")
def test_figures_go_into_a_folder_beside_the_result_or_elsewhere(tmp_path, reply):
    comparison = only(basin_comparison(60), "dead-reckoning")
    result = write_report(comparison, tmp_path / "result").parent
    assert (
        reply(0, "figures", result).out
        == f"Figures and tables: {result / 'paper' / 'protocol.txt'}\n"
    )
    assert (result / "paper" / "figures" / "map.pdf").is_file()
    assert "no comparison.json in it" in reply(2, "figures", tmp_path).err
    assert (
        "holds a comparison, and would become a paper"
        in reply(2, "figures", result, "-o", result).err
    )
