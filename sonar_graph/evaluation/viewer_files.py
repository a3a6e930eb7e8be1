"""A comparison for viewers: ``result.mcap`` and the layouts beside it, in the folder that has the comparison.

What stands in the folder as JSON travels in the file too: settings and versions as metadata, ``comparison.json`` and
each ``runs/NAME/result.json`` as attachments, so that the file alone says how it came about.
"""

from __future__ import annotations

import json
from pathlib import Path

from sonar_graph.evaluation.results import Comparison
from sonar_graph.evaluation.storage import INDEX, RESULT, RUNS
from sonar_graph.logs.pictures import Picture
from sonar_graph.logs.recorder import Attachment
from sonar_graph.logs.result_log import write_result
from sonar_graph.sequence import Sequence

RESULT_LOG = "result.mcap"


def write_viewer_files(comparison: Comparison, sequence: Sequence, folder: Path) -> None:
    """Write ``result.mcap``, ``result.foxglove.json`` and ``result.rviz`` beside what `write_comparison` wrote.

    Raises
    ------
    LogError
        When a file cannot be written, or a stamp does not fit into a ROS 2 message.
    """
    estimates = {
        run.estimator: (run.causal, run.smoothed, run.landmarks)
        for run in comparison.runs
        if run.causal is not None and run.smoothed is not None and run.landmarks is not None
    }
    settings = {
        f"settings of {run.estimator}": json.dumps(run.params, default=str, ensure_ascii=False)
        for run in comparison.runs
    }
    names = [INDEX, *(f"{RUNS}/{run.estimator}/{RESULT}" for run in comparison.runs)]
    attachments = [Attachment(name, "application/json", (folder / name).read_bytes()) for name in names]
    drawn = comparison.recognition.pictures if comparison.recognition else []
    pictures = [Picture(picture.stamp_ns, picture.jpeg) for picture in drawn]
    about = comparison.environment | settings
    write_result(folder / RESULT_LOG, sequence, estimates, about, attachments, pictures)
