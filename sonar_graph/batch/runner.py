"""The process in which runs are done, one after the other: ``python -m sonar_graph.batch.runner``.

Planned runs and preparations come pickled on stdin, outcomes go pickled to what was stdout; whatever is printed, also
by native code, goes to stderr, which is the run's log. The process ends when stdin does, so it never outlives who
started it.
"""

from __future__ import annotations

import contextlib
import faulthandler
import logging
import os
import pickle
import sys
import tempfile
import threading
from pathlib import Path
from queue import SimpleQueue
from typing import BinaryIO

from sonar_graph.batch.planned import Outcome, PlannedRun, Preparation

READY = "ready"


def main() -> None:
    """Do runs until there are no more."""
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    faulthandler.enable()
    logging.basicConfig(stream=sys.stderr, level=logging.INFO)
    requests: SimpleQueue[PlannedRun | Preparation] = SimpleQueue()
    from sonar_graph.batch import one_run  # noqa: F401  imported before the first run is timed

    threading.Thread(target=_listen, args=(sys.stdin.buffer, requests), daemon=True).start()
    _answer(answers, READY)
    while True:
        request = requests.get()
        try:
            _answer(answers, _prepared(request) if isinstance(request, Preparation) else _outcome(request))
        except Exception as error:  # told to who waits for the answer
            _answer(answers, error)


def _outcome(run: PlannedRun) -> Outcome:
    from sonar_graph.batch.one_run import perform

    with tempfile.TemporaryDirectory(prefix="sonar-graph-run-") as scratch:
        folder = Path(scratch)
        row = perform(run, folder)
        paths = sorted(path for path in folder.rglob("*") if path.is_file())
        return Outcome(row, {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths})


def _prepared(preparation: Preparation) -> str:
    from sonar_graph.batch.one_run import warm_up

    warm_up(preparation.run)
    return READY


def _listen(source: BinaryIO, requests: SimpleQueue[PlannedRun | Preparation]) -> None:
    with contextlib.suppress(EOFError, OSError):
        while True:
            requests.put(pickle.load(source))
    os._exit(0)


def _answer(answers: BinaryIO, content: object) -> None:
    pickle.dump(content, answers)
    answers.flush()


if __name__ == "__main__":
    main()
