"""Files of labels, and the model measured by a few of them against that by the whole truth."""

import re
from pathlib import Path

import numpy as np
import pytest

from sonar_graph.errors import CalibrationError
from sonar_graph.recognition import (
    LabelledLog,
    Labels,
    calibrate_by_labels,
    confusion_fit,
    read_labels,
)
from sonar_graph.recognition.confusion_fit import true_objects

CLICK_PIXELS_M = 0.005


@pytest.fixture(scope="module")
def clicks(lane, lane_log, lane_recognition) -> Labels:
    """Landmarks clicked in every sixth frame, and what was tracked and is no landmark, where it was reported."""
    given = []
    rng = np.random.default_rng(2)
    run = lane.sequence
    stamps = lane.frames.stamps_ns[::6]
    for stamp_ns in stamps[stamps <= run.truth.stamps_ns[-1]].tolist():
        rows = zip(*true_objects(run, stamp_ns), strict=True)
        for landmark, range_m, azimuth_rad in rows:
            if 1.5 < range_m < 2.3 and abs(azimuth_rad) < 0.17:
                along, across = CLICK_PIXELS_M * rng.standard_normal(2)
                place = range_m + along, azimuth_rad + across / range_m
                given.append((stamp_ns, *place, int(landmark)))
    found = lane_recognition.detections
    none = found.rows(1 - found.id_probability.sum(axis=1) > 0.5)
    places = zip(none.stamps_ns.tolist(), none.range_m, none.azimuth_rad, strict=True)
    for stamp_ns, range_m, azimuth_rad in places:
        _, ranges_m, azimuths_rad = true_objects(run, stamp_ns)
        across_m = ranges_m * (azimuths_rad - azimuth_rad)
        if np.hypot(ranges_m - range_m, across_m).min() > 0.5:
            given.append((stamp_ns, range_m, azimuth_rad, None))
    names = ("stamp_ns", "range_m", "azimuth_rad", "id")
    rows = [dict(zip(names, row, strict=True)) for row in given]
    return Labels.model_validate({"log": lane_log.name, "labels": rows})


def test_a_few_labels_measure_what_the_whole_truth_does(
    lane, lane_log, clicks, measured, monkeypatch
):
    monkeypatch.setattr(confusion_fit, "LEAST_FRAMES", 8)
    ranges_m = lane.frames.ranges_m
    vain = [
        clicks.labels[0].model_copy(update=change)
        for change in (
            {"range_m": 9.0},
            {"stamp_ns": 5},
            {"azimuth_rad": 1.5},
            {"range_m": float(ranges_m[3])},
            {"range_m": float(ranges_m[-1]) + 0.3},
        )
    ]
    given = Labels(log=clicks.log, labels=(*vain, *clicks.labels))
    log = LabelledLog(lane_log, lane.sequence, given, Path("out.csv"))
    by_labels = calibrate_by_labels([log])
    assert by_labels.ids == measured.ids
    np.testing.assert_allclose(by_labels.matrix, measured.matrix, atol=0.1)
    for name in (
        "frames of landmark 1",
        "frames of landmark 3",
        "tracks of landmark 2",
    ):
        assert int(by_labels.provenance[name]) >= 0.8 * int(measured.provenance[name])
    assert by_labels.range_sigma_m < 0.02
    said = by_labels.provenance["labels 1"]
    for words in (
        rf"^out\.csv: \d+ of {len(given.labels)} labels met a track",
        "; rows 1, 5: outside of the image;",
        "; row 3: outside of the image, but not if the azimuth is in degrees; expected radians",
        "; row 2: no such frame",
        "; rows? 4[^;]*: no track there",
    ):
        assert re.search(words, said)


def test_labels_of_other_frames_designs_or_too_few_are_refused(lane, lane_log, clicks):
    first = clicks.labels[0]
    other, far, unnamed = (
        first.model_copy(update=change)
        for change in ({"stamp_ns": 5}, {"range_m": 9.0}, {"id": None})
    )
    for given, words in (
        ([other], ["no frame of lane.mcap has the stamp of any label"]),
        (
            [far, first, unnamed],
            [
                "2 of 3 labels met a track of the recogniser; row 1: outside of the",
                "; rows 2, 3: contradicts other labels of its track, so left out",
                "label more with `sonar-graph label`",
            ],
        ),
    ):
        labels = Labels(log="lane.mcap", labels=given)
        own = LabelledLog(lane_log, lane.sequence, labels, Path("out.csv"), "images")
        with pytest.raises(CalibrationError) as refused:
            calibrate_by_labels([own])
        assert str(refused.value).startswith("out.csv: ")
        assert all(each in str(refused.value) for each in words)


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("a.csv", "stamp_ns,range_m\n1,2", "no column azimuth_rad, id"),
        (
            "a.json",
            '{"log": "other.mcap", "labels": []}',
            "its labels are of other.mcap, not of lane.mcap",
        ),
        (
            "a.csv",
            "stamp_ns,range_m,azimuth_rad,id\n1,two,0,1",
            "range_m: expected a number",
        ),
    ],
)
def test_a_wrong_file_is_named_with_what_was_expected(
    name, text, said, lane_log, tmp_path
):
    (tmp_path / name).write_text(text)
    with pytest.raises(CalibrationError) as refused:
        read_labels(tmp_path / name, lane_log)
    assert str(tmp_path / name) in str(refused.value)
    assert said in str(refused.value)
