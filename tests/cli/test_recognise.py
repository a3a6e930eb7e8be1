"""``recognise`` and ``calibrate`` on a log with images, and ``compare`` on one without detections."""

import json
import re
from collections import Counter
from contextlib import redirect_stdout
from dataclasses import replace
from io import StringIO
from pathlib import Path

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


@pytest.fixture(scope="module")
def command(lane_log, run, tmp_path_factory) -> tuple[Path, str]:
    """The log with what was recognised in it, and what the command printed."""
    out = tmp_path_factory.mktemp("recognised") / "out.mcap"
    said = StringIO()
    with redirect_stdout(said):
        assert run("recognise", lane_log, "-o", out) == 0
    return out, said.getvalue()


@pytest.fixture(scope="module")
def recognised(command) -> Path:
    return command[0]


def topics_of(path: Path) -> set[str]:
    return {topic for topic, _, _ in contents(path)}


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
    _, said = command
    found = lane_recognition.detections
    assert f"{len(lane.frames)} frames, {len(found)} detections" in said
    for outcome, count in lane_recognition.outcomes.items():
        assert re.search(rf"^ +{count}  {re.escape(outcome)}$", said, re.MULTILINE)
    assert said.rstrip().endswith("out.mcap")
    ids, probability = found.most_probable()
    counts = Counter(ids[probability > 0.5].tolist())
    each = ", ".join(f"landmark {k}: {counts[k]}" for k in (1, 2, 3, 4))
    rest = len(ids) - counts.total()
    assert f"Most probable: {each}, none of them: {rest}\n" in said
    assert "Warning" not in said


def test_recognising_again_replaces_what_was_there(recognised, tmp_path, reply):
    again = tmp_path / "again.mcap"
    words = "recognise", recognised, "-o", again, "--rule", "jeffrey"
    assert "Replaced: " in reply(0, *words).out
    one, other = (read_log(path).detections for path in (recognised, again))
    assert set(one.track.tolist()) == set(other.track.tolist())
    assert not np.isin(one.id_probability, other.id_probability).all()


@pytest.mark.usefixtures("unrendered")
def test_compare_recognises_by_itself_and_gives_what_recognise_gives(
    lane_log, recognised, tmp_path, reply
):
    said = []
    for log, options, is_recognised in (
        (lane_log, (), True),
        (recognised, (), False),
        (recognised, ("--rule", "virtual-evidence"), True),
    ):
        out = tmp_path / str(len(said))
        told = reply(0, "compare", log, "-o", out, *QUICK, *options).out
        said.append(" ".join(told.split()))
        page = (out / "report.html").read_text()
        assert ('id="recognition"' in page) == is_recognised
    assert "Most probable: landmark 1: " in said[0]
    assert "those that recognise put into the log" in said[1]
    assert "--rule virtual-evidence" in said[1]
    first = tmp_path / "0"
    assert json.loads((first / "recognition.json").read_text())["frames"] > 100
    assert "/sonar/recognised" in topics_of(first / "result.mcap")


def test_a_model_that_calibrate_wrote_is_used(
    lane_log, run, tmp_path, monkeypatch, reply
):
    monkeypatch.setattr(confusion_fit, "LEAST_FRAMES", 8)
    path = tmp_path / "model.json"
    said = reply(0, "calibrate", lane_log, "-o", path).out
    model = read_confusion(path)
    sigmas = f"{1e3 * model.range_sigma_m:.1f} mm, across {1e3 * model.across_sigma_m:.1f} mm"
    for told in (
        r"^  landmark 1: \d+ frames, 1 track$",
        "^Caution: fewer than 10 tracks of landmark 1, .*more logs",
        f"^  range sigma {sigmas}, a track is reported every {model.report_interval_s:.1f} s$",
    ):
        assert re.search(told, said, re.MULTILINE)
    own = "model.json: exists, and sonar-graph did not write it; choose"
    assert own in reply(2, "label", lane_log, "-o", path).err
    assert model.provenance["logs"] == "lane.mcap"
    out = tmp_path / "out.mcap"
    assert run("recognise", lane_log, "-o", out, "--model", path) == 0
    found = read_log(out).detections
    assert np.median(found.range_azimuth_cov[:, 0, 0]) < 0.05**2


def test_label_ends_with_a_command_that_has_the_options_that_it_was_given(
    lane_log, tmp_path, monkeypatch, reply
):
    monkeypatch.setattr("sonar_graph.cli.label.serve", lambda *_, **__: None)
    designs = Path(devices.__file__).with_name("default_landmarks.toml")
    labels = tmp_path / "labels.json"
    words = lane_log, "-o", labels, "--designs", designs, "--no-browser"
    said = " ".join("".join(reply(0, "label", *words)).split())
    options = f"--labels {labels} --designs {designs} -o model.json"
    assert f"Next: sonar-graph calibrate {lane_log} {options}" in said


def test_designs_of_ones_own_and_settings_need_no_code(short_log, run, tmp_path, reply):
    designs = tmp_path / "mine.toml"
    designs.write_text(DESIGNS)
    out = tmp_path / "out.mcap"
    words = "recognise", short_log, "-o", out
    unknown = "Warning: the log has landmarks 1, 2, 3, of which there is no design"
    assert unknown in reply(0, *words, "--designs", designs).out
    assert np.unique(read_log(out).detections.candidate_ids).tolist() == [4]
    assert run(*words, "--set", "least_frames=10000") == 0
    assert read_log(out).detections is None


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
    given = tmp_path / "over.json"
    given.write_text(lane.sequence.calibration.model_dump_json(exclude_unset=True))
    plane = "landmarks are compared in the plane of the image"
    none = "Without navigation: motion none: the sonar is taken to be at rest"
    kept = "height and tilt are taken to stay those of the calibration's"
    for said, *more in (
        (f"Warning: height and tilt are not known: {plane}",),
        (none, "--motion", "fixed"),
        (f"Without navigation: {kept}", "--calibration", given),
    ):
        told = reply(0, *words, *more).out
        assert said in told
        assert "no estimator can run on the images alone; `sonar-graph join`" in told
    advice = f"sonar-graph recognise {log} -o recognised.mcap"
    assert advice in reply(3, "inspect", log).out
    assert topics_of(out) == {TOPIC, "/sonar/landmarks"}


def test_a_page_of_the_tracks_is_written_and_replaces_only_its_own(
    short_log, tmp_path, reply
):
    page = tmp_path / "page.html"
    page.write_text("mine")
    out = tmp_path / "out.mcap"
    words = "recognise", short_log, "-o", out, "--report", page
    refusal = "page.html: exists, and sonar-graph did not write it"
    assert refusal in reply(2, *words).err
    for more in (("--overwrite",), ()):
        assert f"Page: {page}" in reply(0, *words, *more).out
        assert 'id="track-0"' in page.read_text()
