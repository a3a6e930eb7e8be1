"""Running estimators on a sequence and scoring them; estimators are known only through their contract."""

# fmt: off
from sonar_graph.evaluation.comparison import LIBRARIES, compare, describe_environment, expense, judge
from sonar_graph.evaluation.consistency import (GATED_SHARE, NONE, UNJUDGED, Reliability, anees_interval, confidences,
    nis, normalised_squares, reliability_of, true_identities)
from sonar_graph.evaluation.digits import between, fixed, format_value, quantile_text, supported, with_error
from sonar_graph.evaluation.metrics import landmark_errors, rmse, scored_map, yaw_rad
from sonar_graph.evaluation.aligned import aligned_to_truth, own_map_errors
from sonar_graph.evaluation.results import (MOST_ROWS_NAMED, Comparison, ErrorSeries, RefusedRows, RunResult, Score,
    gathered)
from sonar_graph.evaluation.run import check_request, one_line, run_estimator
from sonar_graph.evaluation.scored_instants import (DURATION_S, MAP_TIMES_S, RETURN_M, map_instants, published_maps,
    repeats_published)
from sonar_graph.evaluation.scores import ESTIMATES
from sonar_graph.evaluation.storage import read_comparison, write_comparison, write_viewer_files, result_names
from sonar_graph.evaluation.tables import (FITTED, HEADLINES, HEIGHTS, LABELS, RAW, SCORES, compact_table, headline_metric,
    label, run_columns, score_keys, score_table, unaligned)
__all__ = [
    "Comparison", "DURATION_S", "ESTIMATES", "ErrorSeries", "FITTED", "GATED_SHARE", "HEADLINES",
    "HEIGHTS", "LABELS", "LIBRARIES", "MAP_TIMES_S", "MOST_ROWS_NAMED", "NONE", "RAW", "RETURN_M", "RefusedRows",
    "Reliability", "RunResult", "SCORES", "Score", "UNJUDGED", "aligned_to_truth", "anees_interval", "between",
    "check_request", "compact_table", "compare", "confidences", "describe_environment", "expense", "fixed",
    "format_value", "gathered", "headline_metric", "judge", "label", "landmark_errors", "map_instants", "nis",
    "normalised_squares", "one_line", "own_map_errors", "published_maps", "quantile_text", "read_comparison",
    "reliability_of", "repeats_published", "result_names", "rmse", "run_columns", "run_estimator",
    "score_keys", "score_table", "scored_map", "supported", "true_identities", "unaligned", "with_error",
    "write_comparison", "write_viewer_files", "yaw_rad",
]
