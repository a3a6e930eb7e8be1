"""Reports: pages, tables and terminal texts about comparisons and batches."""

# fmt: off
from typing import TYPE_CHECKING
from sonar_graph import at_first_use

if TYPE_CHECKING:
    from sonar_graph.report.batch_page import write_batch_report
    from sonar_graph.report.batch_summary import lost_told, missing_told, sensors_told, withheld_told
    from sonar_graph.report.comparison_page import write_page, write_report
    from sonar_graph.report.console import summary
    from sonar_graph.report.paper import write_paper
    from sonar_graph.report.rendering import render
    from sonar_graph.report.sentences import doubt_lines, doubtful_lines
    from sonar_graph.report.track_page import write_track_page
else:
    __getattr__, __dir__ = at_first_use(__name__)

__all__ = [
    "doubt_lines", "doubtful_lines", "lost_told", "missing_told", "render", "sensors_told", "summary",
    "withheld_told", "write_batch_report", "write_page", "write_paper", "write_report", "write_track_page",
]
