"""What a comparison ran on: versions, machine, date, command."""

from __future__ import annotations

import os
import platform
import shlex
import sys
from datetime import UTC, datetime
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path

import sonar_graph

LIBRARIES = ("gtsam", "numpy", "scipy", "numba")


def describe_environment() -> dict[str, str]:
    """Versions, machine, date (UTC) and command, each as text."""
    command = [Path(sys.argv[0]).name, *sys.argv[1:]]
    return {
        "sonar_graph": sonar_graph.__version__,
        "python": platform.python_version(),
        **_library_versions(),
        "machine": f"{platform.system()} {platform.machine()}, {os.cpu_count()} processors",
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": shlex.join(command),
    }


@lru_cache
def _library_versions() -> dict[str, str]:
    """Looked up once: each look goes through all that is installed."""
    return {library: version(library) for library in LIBRARIES}
