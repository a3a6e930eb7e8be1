"""Sonar images of a live run are recognised as those of a log are, and the record has what was recognised."""

import time

import numpy as np
import pytest

from sonar_graph import read_log, recognise
from sonar_graph.cli import main
from sonar_graph.live import LiveOptions, LiveRun, definition_of
from sonar_graph.logs import LiveRecord, PartialCalibration
from tests.live.traffic import messages_of

LOG_S = 40.0


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    path = tmp_path_factory.mktemp("images") / "basin.mcap"
    words = ["--images", "--set", "laps=1", "--set", "duration_s=150"]
    with pytest.raises(SystemExit):
        main(["simulate", "basin", "-o", str(path), *words])
    return path


@pytest.mark.slow
@pytest.mark.parametrize("knows_floor", [False, True])
def test_who_recognises_live_without_a_height_over_the_floor_is_told(
    tmp_path, log, knows_floor
):
    floor = {"floor": {"z_m": 0.0, "sigma_m": 0.02}} if knows_floor else {}
    given = PartialCalibration.parse(floor, "a test")
    said, _ = lived(tmp_path, log, 4.0, calibration=given)
    told = [line for line in said if "floor" in line and "plane of the image" in line]
    assert len(told) == (not knows_floor)


def lived(folder, log, until_s, **options):
    """What a live run on the first seconds of a log said, and its outcome; each image is waited for."""
    messages = messages_of(log, np.random.default_rng(0), 0.0)
    end_ns = messages[0].arrival_ns + until_s * 1e9
    said = []
    made = LiveOptions("dead-reckoning", **options)
    with (
        LiveRecord(folder / "record.mcap") as record,
        LiveRun(record, definition_of, made, [], said.append) as run,
    ):
        for message in messages:
            if message.arrival_ns <= end_ns and message.topic != "/sonar/landmarks":
                run.accept(message)
                run.turn(0.0)
                last_s = time.monotonic() + 60
                while run.images_waiting and time.monotonic() < last_s:
                    run.turn(0.001)
        return said, run.finish()


@pytest.mark.slow
def test_live_detections_are_those_of_the_log_and_the_record_has_them(tmp_path, log):
    """The images of the first two seconds, before the recogniser begins, are missing."""
    whole = recognise(log)
    # messages do not contain it
    given = PartialCalibration.parse(read_log(log).calibration.model_dump(), "its log")
    _, outcome = lived(tmp_path, log, LOG_S, lateness_s=5.0, calibration=given)
    assert len(outcome.causal) > 100
    mine = read_log(tmp_path / "record.mcap").detections
    assert mine is not None
    first_ns, *_, last_ns = mine.stamps_ns.tolist()
    theirs = whole.detections.between(first_ns - 1, last_ns)
    assert len(mine) >= 5
    assert abs(len(mine) - len(theirs)) <= 2
    # beliefs begin later live, so it may report others too
    common = np.intersect1d(mine.stamps_ns, theirs.stamps_ns)
    assert len(common) >= 0.8 * len(np.unique(theirs.stamps_ns))
