"""The page on which landmarks are labelled: who may use it, what it saves, and the clicks of a real browser.

Chromium comes from the system, as in tests/report/test_page_in_browser.py.
"""

import json
import re
import shutil
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from threading import Thread
from unittest.mock import Mock

import pytest

from sonar_graph.recognition import (
    LabelDesk,
    Labels,
    LabelServer,
    read_labels,
    shown_frames,
)
from sonar_graph.recognition.label_server import ShownFrame

BROWSER = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))),
    None,
)
IDS = [1, 2, 3, 4]


CLICK = {"frame": 1, "column": 300, "row": 300, "id": 2}


@pytest.fixture(scope="module")
def frames(lane) -> list[ShownFrame]:
    blocks = [lane.one(row) for row in range(20)]
    return shown_frames(
        blocks, lane.sequence.calibration.sonar, 500_000_000, lambda _: None
    )


@pytest.fixture
def server(frames, tmp_path) -> Iterator[LabelServer]:
    desk = LabelDesk(frames, Labels(log="lane.mcap"), tmp_path / "labels.json")
    page = "<script nonce={}></script>".format
    with LabelServer(desk, page, IDS) as made:
        Thread(target=made.serve_forever, args=[0.01], daemon=True).start()
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


def told(server: LabelServer, path: str, content: object) -> dict:
    return json.loads(ask(server, path, content)[1])


def saved(tmp_path: Path) -> list[int | None]:
    """Landmarks of the labels in the file."""
    labels = read_labels(tmp_path / "labels.json", Path("lane.mcap")).labels
    return [label.id for label in labels]


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
    assert ask(server, f"{other}label", CLICK)[0] == 404
    assert ask(server, "label", CLICK, Origin="http://evil.example")[0] == 400
    assert ask(server, "label", CLICK, **{"Content-Type": "text/plain"})[0] == 400
    assert server.desk.labels == ()
    assert server.server_address[0] == "127.0.0.1"


def test_requests_that_make_no_sense_are_refused(server):
    for changed in (
        {"frame": 99},
        {"frame": -1},
        {"frame": "x"},
        {"column": "a"},
        {"id": 9},
        {"id": [1]},
        {"row": None},
        {"frame": "1" * 20_000},
    ):
        assert ask(server, "label", CLICK | changed)[0] == 400
    assert ask(server, "label", [1])[0] == 400
    for path, content in (("frame/99", None), ("frame/-1", None), ("labels", CLICK)):
        assert ask(server, path, content)[0] == 404
    assert server.desk.labels == ()


def test_each_click_is_saved_and_can_be_taken_back(server, tmp_path):
    assert told(server, "label", CLICK)["total"] == 1
    state = told(server, "label", CLICK | {"id": None, "frame": 2})
    assert [len(labels) for labels in state["frames"][:4]] == [0, 1, 1, 0]
    assert abs(state["frames"][1][0]["column"] - 300) <= 1
    assert saved(tmp_path) == [2, None]
    first = server.desk.labels[0]
    assert first.stamp_ns == server.desk.frames[1].stamp_ns
    outside = CLICK | {"column": 0, "row": 600}
    assert told(server, "label", outside)["fault"] == "outside of the image"
    of_second = {"frame": 2}
    assert told(server, "take-back", of_second)["total"] == 1
    fault = told(server, "take-back", of_second)["fault"]
    assert fault == "no label in this frame"
    assert saved(tmp_path) == [2]


def test_a_label_on_one_of_the_same_frame_takes_its_place(server):
    desk = server.desk
    for frame, landmark, range_m in (
        (1, 2, 1.5),
        (1, 3, 1.8),
        (2, 4, 1.5),
        (1, 1, 1.52),
    ):
        pixel = desk.frames[frame].fan.pixel(range_m, 0.0)
        assert desk.add(frame, *pixel, landmark) is None
    assert [label.id for label in desk.labels] == [3, 4, 1]


def test_what_cannot_be_saved_is_said_and_not_kept(server, monkeypatch):
    monkeypatch.setattr(Labels, "write", Mock(side_effect=OSError("no space left")))
    answer = told(server, "label", CLICK)
    assert answer["fault"] == "not saved: no space left"
    assert answer["total"] == 0


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="no Chromium: apt install chromium")
def test_landmarks_are_clicked_in_a_browser_and_kept_over_ctrl_c(lane_log, tmp_path):
    sync_api = pytest.importorskip(
        "playwright.sync_api",
        reason="playwright is not installed: pip install playwright",
    )
    out = tmp_path / "labels.json"
    python = [sys.executable, "-m", "sonar_graph"]
    words = [*python, "label", str(lane_log), "-o", str(out), "--no-browser"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    for before in (0, 2):
        command = subprocess.Popen(words, **pipes)
        try:
            line = command.stdout.readline()
            assert f"{before} labels so far" in line
            address = re.search(r"http://127\.0\.0\.1:\d+/\S+/", line)[0]
            with sync_api.sync_playwright() as playwright:
                browser = playwright.chromium.launch(
                    executable_path=BROWSER, args=["--no-sandbox"]
                )
                click_two(browser, address, before)
                browser.close()
            command.send_signal(signal.SIGINT)
            said, complaints = command.communicate(timeout=20)
        finally:
            command.kill()
        assert (command.returncode, complaints) == (0, "")
        assert f"Labels: {out} ({before + 2})" in said
    ids = [label.id for label in read_labels(out, lane_log).labels]
    assert ids == [None, 3, None, 3]


def click_two(browser, address: str, before: int) -> None:
    page = browser.new_page(viewport={"width": 1280, "height": 900})
    said: list[str] = []
    page.on("console", lambda message: said.append(message.text))
    page.on("pageerror", lambda error: said.append(str(error)))
    press = page.keyboard.press
    locate = page.locator
    page.goto(address)
    status = locate("#said")
    until(lambda: page.evaluate("document.getElementById('picture').naturalWidth") > 0)
    if before:
        until(lambda: status.text_content() == f"{before} labels so far")
    frame = 1 + before // 2

    def is_at(number: int) -> bool:
        return locate("#where").text_content().startswith(f"{number} of ")

    for _ in range(frame):
        press("ArrowRight")
    press("PageDown")
    press("PageUp")
    until(lambda: is_at(frame + 1))
    press("3")
    assert locate("input[value='3']").is_checked()
    box = locate("#picture").bounding_box()
    middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.click(*middle)
    until(lambda: status.text_content() == f"saved: {before + 1} labels")
    press("0")
    page.mouse.click(middle[0], middle[1] + 90)
    page.mouse.click(middle[0], middle[1] - 90)
    until(lambda: status.text_content() == f"saved: {before + 3} labels")
    press("Backspace")
    until(lambda: status.text_content() == f"saved: {before + 2} labels")
    assert locate("#marks circle").count() == 2
    mark = locate("#marks circle").nth(0).bounding_box()
    assert abs(mark["x"] + mark["width"] / 2 - middle[0]) < 3
    assert abs(mark["y"] + mark["height"] / 2 - middle[1]) < 3
    held: list = []
    # a picture that is long in coming
    page.route(f"**/frame/{frame + 1}", lambda route: held.append(route))
    press("ArrowRight")
    until(lambda: locate("#frame").input_value() == f"{frame + 1}")
    press("3")
    page.mouse.click(*middle)  # of the picture that is shown, whose label it replaces
    page.wait_for_timeout(200)
    assert is_at(frame + 1)
    assert locate("#marks text").all_text_contents() == ["none", "3"]
    held[0].continue_()
    until(lambda: is_at(frame + 2))
    assert locate("#marks circle").count() == 0
    for width in (390, 1280):
        page.set_viewport_size({"width": width, "height": 900})
        assert page.evaluate("document.documentElement.scrollWidth") <= width
    assert said == []


def until(holds) -> None:
    """Wait until something holds; the page's policy allows no strings as code, by which playwright would wait."""
    for _ in range(500):
        if holds():
            return
        time.sleep(0.02)
    raise AssertionError("it never held")
