"""``recognise`` and ``calibrate`` on a log with images, and ``compare`` on one without detections."""

import json
import re
from collections import Counter
from contextlib import redirect_stdout
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from mcap.reader import make_reader

from sonar_graph import devices
from sonar_graph.logs import read_log, sonar_image_messages
from sonar_graph.logs.mcap import recording
from sonar_graph.recognition import confusion_fit
from sonar_graph.sonar import read_confusion
from tests.recognition.imaged_lane import TOPIC

QUICK = ("--estimators", "dead-reckoning")
DESIGNS = """
[[landmark]]
id = 4
name = "plate"
size_m = 0.3
shapes = [{ level_db = 12.0, circle_m = [0.0, 0.0, 0.15] }]
"""


class Recognised(NamedTuple):
    """The log with what was recognised in it, and what the command printed."""

    log: Path
    said: str


@pytest.fixture(scope="module")
def command(lane_log, run, tmp_path_factory) -> Recognised:
    out = tmp_path_factory.mktemp("recognised") / "out.mcap"
    said = StringIO()
    with redirect_stdout(said):
        assert run("recognise", lane_log, "-o", out) == 0
    return Recognised(out, said.getvalue())


@pytest.fixture(scope="module")
def recognised(command) -> Path:
    return command.log


@pytest.fixture(scope="module")
def short_log(lane, tmp_path_factory) -> Path:
    """The first landmarks of the lane."""
    log = tmp_path_factory.mktemp("short") / "short.mcap"
    return lane.write(log, map(lane.one, range(60)))


def contents(path: Path) -> Counter[tuple[str, int, bytes]]:
    with path.open("rb") as stream:
        return Counter(
            (channel.topic, m.log_time, m.data)
            for _, channel, m in make_reader(stream).iter_messages()
        )


def test_recognise_adds_detections_and_leaves_the_rest_as_it_was(
    lane_log, recognised, lane_recognition
):
    before = contents(lane_log)
    after = contents(recognised)
    assert not before - after
    assert {topic for topic, _, _ in after - before} == {"/sonar/landmarks"}
    found = read_log(recognised).detections
    expected = lane_recognition.detections
    np.testing.assert_array_equal(found.stamps_ns, expected.stamps_ns)
    np.testing.assert_allclose(found.range_m, expected.range_m, atol=1e-4)
    np.testing.assert_array_equal(found.most_probable()[0], expected.most_probable()[0])


def test_recognise_says_what_became_of_everything(lane, lane_recognition, command):
    said = command.said
    assert (
        f"{len(lane.frames)} frames, {len(lane_recognition.detections)} detections"
        in said
    )
    for outcome, count in lane_recognition.outcomes.items():
        assert re.search(rf"^ +{count}  {re.escape(outcome)}$", said, re.MULTILINE), (
            outcome
        )
    assert said.rstrip().endswith("out.mcap")
    ids, probability = lane_recognition.detections.most_probable()
    counts = [
        f"landmark {k}: {np.count_nonzero((ids == k) & (probability > 0.5))}"
        for k in (1, 2, 3, 4)
    ]
    rest = np.count_nonzero(probability <= 0.5)
    assert f"Most probable: {', '.join(counts)}, none of them: {rest}\n" in said
    assert "Warning" not in said


def test_recognising_again_replaces_what_was_there(recognised, tmp_path, reply):
    assert (
        "Replaced: "
        in reply(
            0,
            "recognise",
            recognised,
            "-o",
            tmp_path / "again.mcap",
            "--rule",
            "jeffrey",
        ).out
    )
    one = read_log(recognised).detections
    other = read_log(tmp_path / "again.mcap").detections
    assert set(one.track.tolist()) == set(other.track.tolist())
    assert not np.isin(one.id_probability, other.id_probability).all()


@pytest.mark.usefixtures("unrendered")
def test_compare_recognises_by_itself_and_gives_what_recognise_gives(
    lane_log, recognised, run, tmp_path, capsys
):
    assert run("compare", lane_log, "-o", tmp_path / "images", *QUICK) == 0
    assert run("compare", recognised, "-o", tmp_path / "detections", *QUICK) == 0
    pages = [
        (tmp_path / name / "report.html").read_text()
        for name in ("images", "detections")
    ]
    assert 'id="recognition"' in pages[0]
    assert 'id="recognition"' not in pages[1]
    said = [
        " ".join(text.split()) for text in capsys.readouterr().out.split("Report: ")
    ]
    assert "Most probable: landmark 1: " in said[0]
    assert "those that recognise put into the log" in said[1]
    assert "--rule virtual-evidence" in said[1]
    assert (
        run(
            "compare",
            recognised,
            "-o",
            tmp_path / "anew",
            *QUICK,
            "--rule",
            "virtual-evidence",
        )
        == 0
    )
    assert 'id="recognition"' in (tmp_path / "anew" / "report.html").read_text()
    assert (
        json.loads((tmp_path / "images" / "recognition.json").read_text())["frames"]
        > 100
    )
    topics = {topic for topic, _, _ in contents(tmp_path / "images" / "result.mcap")}
    assert "/sonar/recognised" in topics


def test_a_model_that_calibrate_wrote_is_used(
    lane_log, run, tmp_path, monkeypatch, reply
):
    monkeypatch.setattr(confusion_fit, "LEAST_FRAMES", 8)
    said = reply(0, "calibrate", lane_log, "-o", tmp_path / "model.json").out
    assert re.search(r"^  landmark 1: \d+ frames, 1 track$", said, re.MULTILINE)
    assert re.search(
        r"^Caution: fewer than 10 tracks of landmark 1, .*more logs", said, re.MULTILINE
    )
    model = read_confusion(tmp_path / "model.json")
    sigmas = f"  range sigma {1e3 * model.range_sigma_m:.1f} mm, across {1e3 * model.across_sigma_m:.1f} mm, "
    of_errors = f"a track is reported every {model.report_interval_s:.1f} s\n"
    assert f"{sigmas}{of_errors}" in said
    assert (
        "model.json: exists, and sonar-graph did not write it; choose"
        in reply(2, "label", lane_log, "-o", tmp_path / "model.json").err
    )
    assert model.provenance["logs"] == "lane.mcap"
    assert (
        run(
            "recognise",
            lane_log,
            "-o",
            tmp_path / "out.mcap",
            "--model",
            tmp_path / "model.json",
        )
        == 0
    )
    found = read_log(tmp_path / "out.mcap").detections
    assert np.median(found.range_azimuth_cov[:, 0, 0]) < 0.05**2


def test_label_ends_with_a_command_that_has_the_options_that_it_was_given(
    lane_log, tmp_path, monkeypatch, reply
):
    monkeypatch.setattr("sonar_graph.cli.label.serve", lambda *_, **__: None)
    designs = Path(devices.__file__).with_name("default_landmarks.toml")
    labels = tmp_path / "labels.json"
    said = " ".join(
        "".join(
            reply(
                0, "label", lane_log, "-o", labels, "--designs", designs, "--no-browser"
            )
        ).split()
    )
    assert (
        f"Next: sonar-graph calibrate {lane_log} --labels {labels} --designs {designs} -o model.json"
        in said
    )


def test_designs_of_ones_own_and_settings_need_no_code(short_log, run, tmp_path, reply):
    (tmp_path / "mine.toml").write_text(DESIGNS)
    words = "-o", tmp_path / "out.mcap", "--designs", tmp_path / "mine.toml"
    unknown = "Warning: the log has landmarks 1, 2, 3, of which there is no design"
    assert unknown in reply(0, "recognise", short_log, *words).out
    found = read_log(tmp_path / "out.mcap").detections
    assert np.unique(found.candidate_ids).tolist() == [4]
    assert (
        run(
            "recognise",
            short_log,
            "-o",
            tmp_path / "none.mcap",
            "--set",
            "least_frames=10000",
        )
        == 0
    )
    assert read_log(tmp_path / "none.mcap").detections is None


def test_images_alone_are_recognised_and_what_is_lost_is_said(
    lane, run, tmp_path, reply
):
    log = tmp_path / "sonar.mcap"
    out = tmp_path / "out.mcap"
    frames = lane.frames
    stamps_ns = frames.stamps_ns[:60]
    first = replace(frames, stamps_ns=stamps_ns, intensity=frames.intensity[:60])
    with recording(log, {}) as writer:
        writer.write([sonar_image_messages(TOPIC, first)])
    words = "recognise", log, "-o", out
    lacking = "no IMU and no DVL in the log; leave --motion out"
    assert lacking in reply(2, *words, "--motion", "navigation").err
    (tmp_path / "over.json").write_text(
        lane.sequence.calibration.model_dump_json(exclude_unset=True)
    )
    for more, said in (
        (
            (),
            "Warning: height and tilt are not known: landmarks are compared in the plane of the image",
        ),
        (
            ("--motion", "fixed"),
            "Without navigation: motion none: the sonar is taken to be at rest",
        ),
        (
            ("--calibration", tmp_path / "over.json"),
            "Without navigation: height and tilt are taken to stay those of the calibration's",
        ),
    ):
        lines = reply(0, *words, *more).out
        assert said in lines
        assert "no estimator can run on the images alone; `sonar-graph join`" in lines
    assert (
        f"sonar-graph recognise {log} -o recognised.mcap"
        in reply(3, "inspect", log).out
    )
    with out.open("rb") as stream:
        topics = {
            channel.topic for _, channel, _ in make_reader(stream).iter_messages()
        }
    assert topics == {TOPIC, "/sonar/landmarks"}


def test_a_page_of_the_tracks_is_written_and_replaces_only_its_own(
    short_log, tmp_path, reply
):
    page = tmp_path / "page.html"
    out = tmp_path / "out.mcap"
    page.write_text("mine")
    assert (
        "page.html: exists, and sonar-graph did not write it"
        in reply(2, "recognise", short_log, "-o", out, "--report", page).err
    )
    for more in (("--overwrite",), ()):
        assert (
            f"Page: {page}"
            in reply(0, "recognise", short_log, "-o", out, "--report", page, *more).out
        )
        assert 'id="track-0"' in page.read_text()
