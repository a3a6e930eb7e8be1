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
    with pytest.raises(SystemExit):
        main(
            [
                "simulate",
                "basin",
                "-o",
                str(path),
                "--images",
                "--set",
                "laps=1",
                "--set",
                "duration_s=150",
            ]
        )
    return path


@pytest.mark.slow
@pytest.mark.parametrize("knows_floor", [False, True])
def test_who_recognises_live_without_a_height_over_the_floor_is_told(
    tmp_path, log, knows_floor
):
    given = (
        PartialCalibration.parse({"floor": {"z_m": 0.0, "sigma_m": 0.02}}, "a test")
        if knows_floor
        else None
    )
    messages = messages_of(log, np.random.default_rng(0), 0.0)
    said = []
    options = LiveOptions("dead-reckoning", calibration=given)
    with (
        LiveRecord(tmp_path / "record.mcap") as record,
        LiveRun(record, definition_of, options, [], said.append) as run,
    ):
        for message in messages:
            if message.arrival_ns > messages[0].arrival_ns + 4 * 10**9:
                break
            if message.topic != "/sonar/landmarks":
                run.accept(message)
                run.turn(0.0)
    assert sum("floor" in line and "plane of the image" in line for line in said) == (
        not knows_floor
    )


@pytest.mark.slow
def test_live_detections_are_those_of_the_log_and_the_record_has_them(tmp_path, log):
    """Each image is waited for; the images of the first two seconds, before the recogniser begins, are missing."""
    whole = recognise(log)
    # messages do not contain it
    given = PartialCalibration.parse(read_log(log).calibration.model_dump(), "its log")
    messages = messages_of(log, np.random.default_rng(0), 0.0)
    last_ns = messages[0].arrival_ns + int(LOG_S * 1e9)
    with LiveRecord(tmp_path / "record.mcap") as record:
        options = LiveOptions("dead-reckoning", lateness_s=5.0, calibration=given)
        with LiveRun(record, definition_of, options, [], lambda _: None) as run:
            for message in messages:
                if message.arrival_ns > last_ns:
                    break
                if message.topic == "/sonar/landmarks":
                    continue
                run.accept(message)
                run.turn(0.0)
                until_s = time.monotonic() + 60
                while run.images_waiting and time.monotonic() < until_s:
                    run.turn(0.001)
            outcome = run.finish()
    assert len(outcome.causal) > 100
    recorded = read_log(tmp_path / "record.mcap")
    assert recorded.detections is not None
    mine = recorded.detections
    theirs = whole.detections.between(0, int(recorded.detections.stamps_ns[-1]))
    first = np.searchsorted(theirs.stamps_ns, mine.stamps_ns[0])
    assert len(mine) >= 5
    assert abs(len(mine) - (len(theirs) - first)) <= 2
    # beliefs begin later live, so it may report others too
    common = np.intersect1d(mine.stamps_ns, theirs.stamps_ns)
    assert len(common) >= 0.8 * len(np.unique(theirs.stamps_ns[first:]))
