"""Fixtures and settings of all tests: recordings, a plotting backend without a screen, hypothesis without deadlines.

Linear algebra runs in one thread: matrices here are small, and the threads of several workers wait for each other.
"""

from __future__ import annotations

import gc
import os
import signal
import tarfile
import threading
from collections.abc import Callable, Generator
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hypothesis import HealthCheck, settings

if TYPE_CHECKING:
    from sonar_graph.recognition import Recognition

    from .recognition.imaged_lane import Lane

os.environ["MPLBACKEND"] = "Agg"
for name in (
    "OPENBLAS_NUM_THREADS",
    "OMP_NUM_THREADS",
):  # before numpy is loaded, here and in the workers
    os.environ.setdefault(name, "1")
if (
    threading.current_thread() is threading.main_thread()
):  # a shell's job in the background ignores interrupts
    signal.signal(signal.SIGINT, signal.default_int_handler)

settings.register_profile(
    "thorough", deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.register_profile("fast", settings.get_profile("thorough"), max_examples=20)
# --hypothesis-profile=thorough: a hundred examples for each property
settings.load_profile("fast")


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Leave the modules and tests, which stay to the end, out of every collection of garbage.

    They are some 400,000 objects. To go through them again and again took a third of the time of importing the tests,
    and a seventh of that of running them.
    """
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


@pytest.fixture(scope="session")
def recordings() -> Path:
    """The folder with recorded data."""
    folder = os.environ.get("SONAR_GRAPH_DATA")
    if not folder:
        pytest.skip(
            "recorded data is found through the environment variable SONAR_GRAPH_DATA, which is not set"
        )
    if not Path(folder).is_dir():
        pytest.skip(f"SONAR_GRAPH_DATA={folder} is not a folder")
    return Path(folder)


@pytest.fixture(scope="session")
def unpacked(
    recordings: Path, tmp_path_factory: pytest.TempPathFactory
) -> Callable[[str], Path]:
    """Unpacks an archive among the recordings, once a session, and gives the folder with its content."""
    folders: dict[str, Path] = {}

    def unpack(name: str) -> Path:
        if name not in folders:
            archive = recordings / name
            if not archive.exists():
                pytest.skip(f"{name} is not among the recordings in {recordings}")
            folders[name] = tmp_path_factory.mktemp(name.split(".")[0])
            with tarfile.open(archive) as content:
                content.extractall(folders[name], filter="data")
        return folders[name]

    return unpack


@pytest.fixture
def unrendered(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pages whose figures are drawn, but not laid out and written, which takes most of the time of a page."""
    # the function of the same name hides the module from a path of names
    module = import_module("sonar_graph.report.figures.illustrations")
    monkeypatch.setattr(module, "inline_svg", lambda *_: "<svg></svg>")


@pytest.fixture(scope="session")
def lane() -> Lane:
    """A short run along all four landmarks, a stone and a rough patch, with images; simulated once a session."""
    from .recognition.imaged_lane import lane_run

    return lane_run(1)


@pytest.fixture(scope="session")
def lane_log(lane: Lane, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same as a log; not to be written to."""
    return lane.write(tmp_path_factory.mktemp("lane") / "lane.mcap")


@pytest.fixture(scope="session")
def lane_recognition(lane: Lane) -> Recognition:
    """What is recognised in its images."""
    from sonar_graph.recognition import recognise_images

    found = recognise_images([lane.frames], lane.sequence)
    assert found is not None
    return found
