from __future__ import annotations

import json
from pathlib import Path

import pytest
from mcap.reader import make_reader

from sonar_graph.evaluation.comparison import compare
from sonar_graph.evaluation.storage import write_comparison, write_viewer_files
from sonar_graph.measurements import Measurements
from sonar_graph.states import Estimate

from .conftest import Offset, straight_sequence


@pytest.fixture
def folder(install, tmp_path) -> Path:
    class Broken(Offset):
        def process(self, _measurements: Measurements) -> Estimate | None:
            raise RuntimeError("diverged")

    install(broken=Broken)
    sequence = straight_sequence()
    comparison = compare(sequence, ["offset", "broken"], {"offset": {"offset_m": 0.4}})
    write_comparison(comparison, tmp_path)
    write_viewer_files(comparison, tmp_path)
    return tmp_path


def test_the_result_carries_the_json_files_beside_it(folder):
    with (folder / "result.mcap").open("rb") as stream:
        attached = {a.name: a.data for a in make_reader(stream, validate_crcs=True).iter_attachments()}
    assert set(attached) == {"comparison.json", "runs/offset/result.json", "runs/broken/result.json"}
    for name, content in attached.items():
        assert content == (folder / name).read_bytes()


def test_the_record_says_settings_versions_and_what_the_topics_are_of(folder):
    with (folder / "result.mcap").open("rb") as stream:
        record = {m.name: m.metadata for m in make_reader(stream).iter_metadata()}["sonar_graph_result"]
    environment = json.loads((folder / "comparison.json").read_text("utf-8"))["environment"]
    assert environment.items() <= record.items()
    assert {"gtsam", "numpy", "sonar_graph", "date", "command"} <= record.keys()
    assert json.loads(record["settings of offset"])["offset_m"] == 0.4
    assert (record["estimators"], record["topics"]) == ("offset", "offset")


def test_layouts_name_what_ran_and_not_what_failed(folder):
    layout = json.loads((folder / "result.foxglove.json").read_text("utf-8"))
    names = {topic.split("/")[1] for topic in layout["configById"]["3D!result"]["topics"]}
    assert names == {"offset", "ground_truth"}
    assert "/offset/path" in (folder / "result.rviz").read_text("utf-8")
