"""A log whose driver spaced the beams of a lens equally."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sonar_graph.recognition.session import RecognitionSession, one_by_one
from sonar_graph.simulation.sonar_image.imaging_sonar import DIDSON


@pytest.mark.parametrize(("lens", "is_right"), [("didson", True), ("as-logged", False)])
def test_the_lens_of_the_calibration_puts_azimuths_right(lane, lens, is_right):
    sonar = lane.sequence.calibration.sonar.model_copy(update={"lens": lens})
    calibration = lane.sequence.calibration.model_copy(update={"sonar": sonar})
    told = replace(lane.frames, azimuths_rad=DIDSON.linear_azimuths_rad())
    session, errors = RecognitionSession(replace(lane.sequence, calibration=calibration), pictures=False), []
    for frame, truth in zip(one_by_one(told), lane.truth, strict=True):
        found = session.take(frame)
        for row, landmark in enumerate([] if found is None else found.most_probable()[0].tolist()):
            at = np.flatnonzero(truth.ids == landmark)
            errors += [found.azimuth_rad[row] - truth.azimuth_rad()[0, a] for a in at]
    assert len(errors) > 50
    assert (np.degrees(np.median(np.abs(errors))) < 0.1) == is_right
