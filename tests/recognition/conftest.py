"""The model of the lane by its truth, which several tests compare with."""

from pathlib import Path

import pytest

from sonar_graph.logs import read_log
from sonar_graph.recognition import confusion_fit
from sonar_graph.sonar import Confusion


@pytest.fixture(scope="session")
def measured(lane_log: Path) -> Confusion:
    """As measured with fewer frames than one would calibrate on: a lane is short."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sonar_graph.recognition.confusion_fit.LEAST_FRAMES", 8)
        return confusion_fit.calibrate([(lane_log, read_log(lane_log))])
