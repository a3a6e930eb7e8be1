"""``recognise``, ``calibrate`` and ``compare`` on a log with images, and what they say to a user's mistakes."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from mcap.reader import make_reader

from sonar_graph.logs.mcap.writer import write_recording
from sonar_graph.logs.reading import read_log
from sonar_graph.logs.writing import sonar_image_messages, write_log
from sonar_graph.sonar import confusion
from sonar_graph.sonar.confusion import read_confusion

if TYPE_CHECKING:
    from tests.recognition.imaged_lane import Lane

Run = Callable[..., int]
QUICK = ("--estimators", "dead-reckoning")
DESIGNS = """
[[landmark]]
id = 4
name = "plate"
size_m = 0.3
shapes = [{ level_db = 12.0, circle_m = [0.0, 0.0, 0.15] }]
"""


@pytest.fixture(scope="module")
def recognised(lane_log: Path, run: Run, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The log with what was recognised in it."""
    out = tmp_path_factory.mktemp("recognised") / "out.mcap"
    assert run("recognise", lane_log, "-o", out) == 0
    return out


@pytest.fixture(scope="module")
def strange_designs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of a landmark that is not in the log."""
    path = tmp_path_factory.mktemp("strange") / "mine.toml"
    bar = "polygon_m = [[-0.3, -0.02], [0.3, -0.02], [0.3, 0.02], [-0.3, 0.02]]"
    text = DESIGNS.replace("size_m = 0.3", "size_m = 0.6").replace("circle_m = [0.0, 0.0, 0.15]", bar)
    path.write_text(text.replace("id = 4", "id = 9"))
    return path


def contents(path: Path) -> Counter[tuple[str, int, bytes]]:
    with path.open("rb") as stream:
        return Counter((channel.topic, m.log_time, m.data) for _, channel, m in make_reader(stream).iter_messages())


def test_recognise_adds_detections_and_leaves_the_rest_as_it_was(lane_log, recognised, lane_recognition):
    before, after = contents(lane_log), contents(recognised)
    assert before - after == Counter()
    added = after - before
    assert {topic for topic, _, _ in added} == {"/sonar/landmarks"}
    found, expected = read_log(recognised).detections, lane_recognition.detections
    assert found is not None
    np.testing.assert_array_equal(found.stamps_ns, expected.stamps_ns)
    np.testing.assert_allclose(found.range_m, expected.range_m, atol=1e-4)
    np.testing.assert_allclose(found.range_azimuth_cov, expected.range_azimuth_cov, rtol=1e-3, atol=1e-9)
    np.testing.assert_array_equal(found.most_probable()[0], expected.most_probable()[0])
    np.testing.assert_allclose(found.id_probability.sum(axis=1), expected.id_probability.sum(axis=1), atol=1e-3)


def test_recognise_says_what_became_of_everything(lane, lane_log, lane_recognition, run, tmp_path, capsys):
    assert run("recognise", lane_log, "-o", tmp_path / "out.mcap") == 0
    said = capsys.readouterr().out
    assert f"{len(lane.frames)} frames, {len(lane_recognition.detections)} detections" in said
    for outcome, count in lane_recognition.outcomes.items():
        assert re.search(rf"^ +{count}  {re.escape(outcome)}$", said, re.MULTILINE), outcome
    assert said.rstrip().endswith("out.mcap")
    ids, probability = lane_recognition.detections.most_probable()
    counts = [f"landmark {k}: {np.count_nonzero((ids == k) & (probability > 0.5))}" for k in (1, 2, 3, 4)]
    rest = np.count_nonzero(probability <= 0.5)
    assert f"Most probable: {', '.join(counts)}, none of them: {rest}\n" in said
    assert "Warning" not in said


def test_where_nothing_is_recognised_one_line_says_so_and_what_was_looked_for(
    lane_log, strange_designs, run, tmp_path, capsys
):
    for command, out in (("recognise", "out.mcap"), ("compare", "out")):
        more = QUICK if command == "compare" else ()
        assert run(command, lane_log, "-o", tmp_path / out, "--designs", strange_designs, *more) == 0
        said = capsys.readouterr().out
        assert "Warning: no landmark was recognised; looked for 9: plate; --designs gives others" in said


def test_a_design_that_is_never_a_candidate_is_refused_before_a_frame_is_read(lane_log, run, tmp_path, capsys):
    path = tmp_path / "large.toml"
    path.write_text(DESIGNS.replace("size_m = 0.3", "size_m = 2.0").replace("0.15]", "1.0]"))
    assert run("recognise", lane_log, "-o", tmp_path / "out.mcap", "--designs", path) == 2
    said = capsys.readouterr().err
    assert "plate (id 4) would never be found" in said
    assert "Traceback" not in said
    assert not (tmp_path / "out.mcap").exists()


def test_a_log_made_with_other_designs_says_so(lane, run, tmp_path, capsys):
    log = tmp_path / "mine.mcap"
    options = {"options": '{"image":{"designs":"mine.toml"}}'}
    made = replace(lane, sequence=replace(lane.sequence, notes=options))
    made.write(log, [lane.one(k) for k in range(3)])
    assert run("recognise", log, "-o", tmp_path / "out.mcap") == 0
    said = capsys.readouterr().out
    assert "Warning: the log was made with the designs of mine.toml; give them with --designs" in said


def test_recognising_again_replaces_what_was_there(recognised, run, tmp_path, capsys):
    assert run("recognise", recognised, "-o", tmp_path / "again.mcap", "--rule", "jeffrey") == 0
    assert "Replaced: " in capsys.readouterr().out
    one, other = read_log(recognised).detections, read_log(tmp_path / "again.mcap").detections
    assert one is not None
    assert other is not None
    assert len(one) == len(other)
    assert not np.allclose(one.id_probability, other.id_probability)


def test_compare_recognises_by_itself_and_gives_what_recognise_gives(lane_log, recognised, run, tmp_path, capsys):
    assert run("compare", lane_log, "-o", tmp_path / "images", *QUICK) == 0
    assert run("compare", recognised, "-o", tmp_path / "detections", *QUICK) == 0
    pages = [(tmp_path / name / "report.html").read_text() for name in ("images", "detections")]
    assert 'id="recognition"' in pages[0]
    assert 'id="recognition"' not in pages[1]
    said = [" ".join(text.split()) for text in capsys.readouterr().out.split("Report: ")]
    assert "Most probable: landmark 1: " in said[0]
    assert "those that recognise put into the log" in said[1]
    assert "--rule virtual-evidence" in said[1]
    assert run("compare", recognised, "-o", tmp_path / "anew", *QUICK, "--rule", "virtual-evidence") == 0
    assert 'id="recognition"' in (tmp_path / "anew" / "report.html").read_text()
    assert json.loads((tmp_path / "images" / "recognition.json").read_text())["frames"] > 100
    topics = {topic for topic, _, _ in contents(tmp_path / "images" / "result.mcap")}
    assert "/sonar/recognised" in topics


def test_a_model_that_calibrate_wrote_is_used(lane_log, run, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(confusion, "LEAST_FRAMES", 10**6)
    assert run("calibrate", lane_log, "-o", tmp_path / "model.json") == 2
    assert re.fullmatch(r"sonar-graph: too few labelled frames .*give longer or more logs\n", capsys.readouterr().err)
    monkeypatch.setattr(confusion, "LEAST_FRAMES", 8)
    assert run("calibrate", lane_log, "-o", tmp_path / "model.json") == 0
    said = capsys.readouterr().out
    assert re.search(r"^  landmark 1: \d+ frames, 1 tracks?$", said, re.MULTILINE)
    assert re.search(r"^Caution: fewer than 10 tracks of landmark 1, .*more logs", said, re.MULTILINE)
    model = read_confusion(tmp_path / "model.json")
    assert model.provenance["logs"] == "lane.mcap"
    assert run("recognise", lane_log, "-o", tmp_path / "out.mcap", "--model", tmp_path / "model.json") == 0
    found = read_log(tmp_path / "out.mcap").detections
    assert found is not None
    assert np.median(found.range_azimuth_cov[:, 0, 0]) < 0.05**2


def test_designs_of_ones_own_need_no_code(lane_log, run, tmp_path, capsys):
    (tmp_path / "mine.toml").write_text(DESIGNS)
    assert run("recognise", lane_log, "-o", tmp_path / "out.mcap", "--designs", tmp_path / "mine.toml") == 0
    assert "Warning: the log has landmarks 1, 2, 3, of which there is no design" in capsys.readouterr().out
    found = read_log(tmp_path / "out.mcap").detections
    assert found is not None
    assert np.unique(found.candidate_ids).tolist() == [4]


def images_alone(lane: Lane, path: Path) -> Path:
    """A log as one of a sonar's own file is."""
    write_recording(path, [sonar_image_messages("/sonar", lane.one(0), frequency_hz=1.8e6, sound_speed_m_s=1480)], {})
    return path


@pytest.fixture
def files(lane: Lane, lane_log: Path, strange_designs: Path, tmp_path: Path) -> dict[str, object]:
    """What a user may give by mistake."""
    bare, blind = tmp_path / "bare.mcap", tmp_path / "blind.mcap"
    write_log(bare, lane.sequence)
    short = replace(lane, sequence=replace(lane.sequence, truth=None))
    short.write(blind, [lane.one(k) for k in range(3)])
    (tmp_path / "words.json").write_text("{ no")
    (tmp_path / "list.json").write_text("[]")
    (tmp_path / "designs.toml").write_text(DESIGNS)
    (tmp_path / "broken.toml").write_text('[[landmark]]\nid = 1\nname = "x"\nsize_m = -1\n')
    (tmp_path / "empty").mkdir()
    names = ("words.json", "list.json", "designs.toml", "broken.toml", "empty")
    return {
        "lane": lane_log,
        "bare": bare,
        "blind": blind,
        "images": images_alone(lane, tmp_path / "images.mcap"),
        "strange": strange_designs,
        "new": tmp_path / "new.mcap",
        "model": tmp_path / "m.json",
    } | {name: tmp_path / name for name in names}


MISTAKES = {
    "recognise bare -o new": r"bare\.mcap: has no sonar images; `sonar-graph inspect .*` lists what it has",
    "recognise lane -o new --rule bayes": r"rule.*virtual-evidence.*jeffrey",
    "recognise lane -o new --model words.json": r"words\.json is not JSON",
    "recognise lane -o new --model list.json": r"list\.json: .*calibrate",
    "recognise lane -o new --designs broken.toml": r"broken\.toml.*size_m",
    "recognise lane -o new --designs empty": r"empty: no landmark designs",
    "recognise lane -o lane --overwrite": r"is what is read",
    "recognise lane -o new --topic sonar=/none": r"/none was chosen but is not in the log",
    "compare lane -o new --topic sonar=/none": r"/none was chosen but is not in the log",
    "recognise words.json -o new": r"words\.json",
    "recognise missing.mcap -o new": r"missing\.mcap",
    "calibrate bare -o new": r"ends in \.json",
    "calibrate blind -o model": r"blind\.mcap: without true trajectory and true landmarks",
    "calibrate bare -o model": r"bare\.mcap: has no sonar images",
    "calibrate lane lane -o model": r"lane\.mcap: is named twice.*name each log once",
    "calibrate lane -o model --designs strange": r"true landmarks are 1, 2, 3, 4, the designs are 9: .*--designs",
    "calibrate lane -o model --set identity.tempre=1": r"settings of the recogniser: identity\.tempre: .*temper",
    "calibrate lane -o model --calibration words.json": r"words\.json: not JSON",
    "compare bare -o new --rule jeffrey": r"bare\.mcap: has no sonar images.*--rule",
    "compare lane -o new --rule bayes": r"settings of the recogniser: identity\.rule: .*virtual-evidence.*jeffrey",
    "compare lane -o new --model list.json": r"list\.json: .*calibrate",
    "compare lane -o new --designs broken.toml": r"broken\.toml.*size_m",
    "recognise lane -o new --rule jeffrey --set identity.rule=jeffrey": r"--rule jeffrey and --set .*give one of them",
    "recognise images -o new": r"images\.mcap: nothing for imu.*IMU and Doppler log must both be in the log",
    "calibrate lane -o model --designs broken.toml": r"broken\.toml.*size_m",
    "compare words.json -o new": r"words\.json",
}


@pytest.mark.parametrize("command", MISTAKES)
def test_a_mistake_is_answered_in_a_line(command: str, files, run, capsys):
    arguments = [files.get(word, word) for word in command.split()]
    before = {path: path.read_bytes() for path in files.values() if path.is_file()}
    assert run(*arguments) == 2
    said = capsys.readouterr().err
    assert "Traceback" not in said
    assert re.search(MISTAKES[command], " ".join(re.sub(r"[│╭╮╰╯─]", " ", said).split())), said
    if said.startswith("sonar-graph: "):
        assert said.count("\n") == 1
    else:
        assert said.startswith("Usage: ")
    assert {path: path.read_bytes() for path in before} == before
    assert not files["new"].is_file()
    assert not files["model"].exists()
