"""Processes that die in the middle of what they do on the disk."""

import itertools
import shutil
from pathlib import Path
from typing import Any

import pytest

STEPS = ("mkdir", "write_bytes", "write_text", "rename", "replace", "unlink", "rmdir")


class Died(BaseException):
    """Ends a process without a message."""


def dies_after(steps: int, patch: pytest.MonkeyPatch) -> None:
    """From then on nothing is done on the disk, and nothing is cleaned up."""
    done = itertools.count()
    for owner, name in [*((Path, name) for name in STEPS), (shutil, "rmtree")]:
        act = getattr(owner, name)

        def step(*given: Any, act: Any = act, **named: Any) -> Any:
            if next(done) >= steps:
                raise Died
            return act(*given, **named)

        patch.setattr(owner, name, step)
