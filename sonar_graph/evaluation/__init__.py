"""Running estimators on a sequence and scoring them; estimators are known only through their contract."""

# fmt: off
from sonar_graph.evaluation.comparison import LIBRARIES, compare, describe_environment, judge
from sonar_graph.evaluation.consistency import (GATED_SHARE, anees_interval, likeness, nis, normalised_squares,
    used_squares)
from sonar_graph.evaluation.digits import fixed, format_value
from sonar_graph.evaluation.metrics import landmark_errors, rmse, scored_map, yaw_rad
from sonar_graph.evaluation.aligned import aligned_to_truth
from sonar_graph.evaluation.results import MOST_ROWS_NAMED, Comparison, ErrorSeries, RunResult, Score, gathered
from sonar_graph.evaluation.run import check_request, one_line, run_estimator, run_here
from sonar_graph.evaluation.scored_instants import (DURATION_S, MAP_TIMES_S, map_instants, published_maps,
    repeats_published, rows_at)
from sonar_graph.evaluation.storage import read_comparison, write_comparison, write_viewer_files, result_names
from sonar_graph.evaluation.tables import (DIRECTIONS, ESTIMATES, FITTED, HEADLINES, HEIGHTS, RAW, SCORES, ScoreKind,
    compact_table, headline_metric, label, run_columns, score_keys, score_table, scores_across, unaligned)
__all__ = [
    "Comparison", "DIRECTIONS", "DURATION_S", "ESTIMATES", "ErrorSeries", "FITTED", "GATED_SHARE", "HEADLINES",
    "HEIGHTS", "LIBRARIES", "MAP_TIMES_S", "MOST_ROWS_NAMED", "RAW",
    "RunResult", "SCORES", "Score", "ScoreKind", "aligned_to_truth", "anees_interval",
    "check_request", "compact_table", "compare", "describe_environment", "fixed",
    "format_value", "gathered", "headline_metric", "judge", "label", "landmark_errors", "likeness", "map_instants", "nis",
    "normalised_squares", "one_line", "published_maps", "read_comparison",
    "repeats_published", "result_names", "rmse", "rows_at", "run_columns", "run_estimator", "run_here",
    "score_keys", "score_table", "scored_map", "scores_across", "unaligned", "used_squares", "write_comparison",
    "write_viewer_files", "yaw_rad",
]
