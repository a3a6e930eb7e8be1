"""What all tests share: the recordings, a plotting backend without a screen, hypothesis without deadlines."""

from __future__ import annotations

import os
import tarfile
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

os.environ["MPLBACKEND"] = "Agg"

settings.register_profile("sonar_graph", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("sonar_graph")


@pytest.fixture(scope="session")
def recordings() -> Path:
    """The folder with recorded data."""
    folder = os.environ.get("SONAR_GRAPH_DATA")
    if not folder:
        pytest.skip("recorded data is found through the environment variable SONAR_GRAPH_DATA, which is not set")
    if not Path(folder).is_dir():
        pytest.skip(f"SONAR_GRAPH_DATA={folder} is not a folder")
    return Path(folder)


@pytest.fixture(scope="session")
def unpacked(recordings: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
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
