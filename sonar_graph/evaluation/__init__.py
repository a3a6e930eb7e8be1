"""Running estimators, judging them, and reporting: knows them only through their contract."""

# fmt: off
from sonar_graph.evaluation.comparison import LIBRARIES, compare, describe_environment, judge
from sonar_graph.evaluation.consistency import (
    GATED_SHARE, NONE, UNJUDGED, Reliability, anees_interval, confidences, nis, normalised_squares, reliability_of,
    true_identities,
)
from sonar_graph.evaluation.metrics import anonymous_named, landmark_errors, rmse, yaw_rad
from sonar_graph.evaluation.results import (
    ABSENT, LABELS, MOST_ROWS_NAMED, Comparison, ErrorSeries, MapSoFar, RefusedRows, RunResult, Score, format_value,
    gathered,
)
from sonar_graph.evaluation.run import one_line, run_estimator
from sonar_graph.evaluation.scored_instants import DURATION_S, MAP_TIMES_S, RETURN_M, published_maps, repeats_published
from sonar_graph.evaluation.scores import ESTIMATES
from sonar_graph.evaluation.storage import read_comparison, write_comparison, write_viewer_files

__all__ = [
    "ABSENT",
    "DURATION_S",
    "ESTIMATES",
    "GATED_SHARE",
    "LABELS",
    "LIBRARIES",
    "MAP_TIMES_S",
    "MOST_ROWS_NAMED",
    "NONE",
    "RETURN_M",
    "UNJUDGED",
    "Comparison",
    "ErrorSeries",
    "MapSoFar",
    "RefusedRows",
    "Reliability",
    "RunResult",
    "Score",
    "anees_interval",
    "anonymous_named",
    "compare",
    "confidences",
    "describe_environment",
    "format_value",
    "gathered",
    "judge",
    "landmark_errors",
    "nis",
    "normalised_squares",
    "one_line",
    "published_maps",
    "read_comparison",
    "reliability_of",
    "repeats_published",
    "rmse",
    "run_estimator",
    "true_identities",
    "write_comparison",
    "write_viewer_files",
    "yaw_rad",
]
