"""The page on which landmarks are labelled: who may use it, what it saves, and the clicks of a real browser.

Chromium comes from the system, as in tests/report/test_page_in_browser.py.
"""

import json
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from threading import Thread

import pytest

from sonar_graph.recognition import (
    LabelDesk,
    Labels,
    LabelServer,
    read_labels,
    shown_frames,
)
from sonar_graph.recognition.label_server import ShownFrame

IDS = [1, 2, 3, 4]


@pytest.fixture(scope="module")
def frames(lane) -> list[ShownFrame]:
    blocks = [lane.one(row) for row in range(20)]
    return shown_frames(
        blocks, lane.sequence.calibration.sonar, 500_000_000, lambda _: None
    )


@pytest.fixture
def server(frames, tmp_path) -> Iterator[LabelServer]:
    desk = LabelDesk(frames, Labels(log="lane.mcap"), tmp_path / "labels.json")
    with LabelServer(
        desk, lambda nonce: f"<script nonce={nonce}></script>", IDS
    ) as made:
        Thread(
            target=made.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True
        ).start()
        yield made
        made.shutdown()


def ask(
    server: LabelServer, path: str, content: object = None, **headers: str
) -> tuple[int, bytes]:
    """Status and body of an answer."""
    address = path if path.startswith("http") else server.address + path
    body = None if content is None else json.dumps(content).encode()
    kind = {} if content is None else {"Content-Type": "application/json"}
    request = urllib.request.Request(address, body, {**kind, **headers})
    try:
        with urllib.request.urlopen(request, timeout=10) as answer:
            return answer.status, answer.read()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read()


def test_only_who_knows_the_word_and_names_the_host_is_answered(server):
    other = f"http://{server.host}/"
    assert ask(server, "")[0] == 200
    assert ask(server, "frame/0")[1][:2] == b"\xff\xd8"
    for path in (
        other,
        f"{other}state",
        f"{other}{server.word}x/state",
        f"{other}{server.word}",
        server.address + "../x",
    ):
        assert ask(server, path)[0] == 404
    assert ask(server, "state", Host="evil.example")[0] == 404
    click = {"frame": 0, "column": 150, "row": 300, "id": 1}
    assert ask(server, f"{other}label", click)[0] == 404
    assert ask(server, "label", click, Origin="http://evil.example")[0] == 400
    assert ask(server, "label", click, **{"Content-Type": "text/plain"})[0] == 400
    assert server.desk.labels == ()
    assert server.server_address[0] == "127.0.0.1"


def test_requests_that_make_no_sense_are_refused(server):
    click = {"frame": 0, "column": 150, "row": 300, "id": 1}
    for changed in (
        {"frame": 99},
        {"frame": -1},
        {"frame": "x"},
        {"column": "a"},
        {"id": 9},
        {"id": [1]},
        {"row": None},
    ):
        assert ask(server, "label", click | changed)[0] == 400
    assert ask(server, "label", [1])[0] == 400
    assert ask(server, "label", {"frame": "1" * 20_000})[0] == 400
    assert (
        ask(server, "frame/99")[0]
        == ask(server, "frame/-1")[0]
        == ask(server, "labels", click)[0]
        == 404
    )
    assert server.desk.labels == ()


def test_each_click_is_saved_and_can_be_taken_back(server, tmp_path):
    click = {"frame": 1, "column": 300, "row": 300, "id": 2}
    assert json.loads(ask(server, "label", click)[1])["total"] == 1
    state = json.loads(ask(server, "label", click | {"id": None, "frame": 2})[1])
    assert [len(labels) for labels in state["frames"][:4]] == [0, 1, 1, 0]
    assert abs(state["frames"][1][0]["column"] - 300) <= 1
    saved = read_labels(tmp_path / "labels.json", Path("lane.mcap"))
    assert [label.id for label in saved.labels] == [2, None]
    assert saved.labels[0].stamp_ns == server.desk.frames[1].stamp_ns
    assert (
        json.loads(ask(server, "label", click | {"column": 0, "row": 600})[1])["fault"]
        == "outside of the image"
    )
    assert json.loads(ask(server, "take-back", {"frame": 2})[1])["total"] == 1
    assert (
        json.loads(ask(server, "take-back", {"frame": 2})[1])["fault"]
        == "no label in this frame"
    )
    assert [
        label.id
        for label in read_labels(tmp_path / "labels.json", Path("lane.mcap")).labels
    ] == [2]


def test_a_label_on_one_of_the_same_frame_takes_its_place(server):
    desk = server.desk
    for frame, landmark, range_m in (
        (1, 2, 1.5),
        (1, 3, 1.8),
        (2, 4, 1.5),
        (1, 1, 1.52),
    ):
        assert (
            desk.add(frame, *desk.frames[frame].fan.pixel(range_m, 0.0), landmark)
            is None
        )
    assert [label.id for label in desk.labels] == [3, 4, 1]


def test_what_cannot_be_saved_is_said_and_not_kept(server, monkeypatch):
    def full(*_: object) -> None:
        raise OSError("no space left")

    monkeypatch.setattr(Labels, "write", full)
    answer = json.loads(
        ask(server, "label", {"frame": 1, "column": 300, "row": 300, "id": 2})[1]
    )
    assert answer["fault"] == "not saved: no space left"
    assert answer["total"] == 0
