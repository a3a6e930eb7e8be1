"""Processes that answer requests, so that what native code or another package does to a process stays there.

Requests come pickled on stdin, and answers go pickled to what was stdout. Everything printed, also by native code, goes
to stderr. A process ends with its stdin, so it never outlives the one that started it.
"""

import contextlib
import faulthandler
import io
import os
import pickle
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from queue import Empty, SimpleQueue
from typing import IO, Any, BinaryIO, NoReturn

READY = "ready"
OWN = "sonar_graph."
LOOK_EVERY_S = 0.2
JOIN_S = 5.0
"""Longest wait for the thread that listens to an ended process, whose detached children may keep the pipe open."""
Tell = Callable[[object], None]
"""Function that sends something before the answer, such as progress."""


class KilledError(Exception):
    """A process, or its work, was ended; the text is the reason."""


class OwnProcess:
    """A Python process of its own, whose program calls `serve`; its first answer is `READY`.

    ``program``: ``-m`` and a module, or ``-c`` and code.

    It and its children have a session of their own, which Ctrl-C in a terminal does not reach and which `end` ends as a
    whole.
    """

    def __init__(
        self,
        program: tuple[str, str],
        environment: Mapping[str, str] | None = None,
        log: IO[bytes] | None = None,
    ) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-P", *program],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log,
            env=os.environ | dict(environment or {}),
            # Ctrl-C in the terminal goes to the whole foreground group
            start_new_session=True,
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._requests: IO[bytes] = self._process.stdin
        self._answers: SimpleQueue[Any] = SimpleQueue()
        self._collector = threading.Thread(
            target=self._collect, args=(self._process.stdout,), daemon=True
        )
        self._collector.start()

    def _collect(self, source: BinaryIO) -> None:
        """Put the answers of the process into the queue; at their end None, or why one cannot be read."""
        end = None
        with source:
            try:
                while True:
                    self._answers.put(_Answers(source).load())
            except pickle.UnpicklingError as error:
                end = KilledError(f"its answer cannot be read: {error}")
            except Exception:  # it ended, perhaps in the middle of an answer
                pass
        self._answers.put(end)

    @property
    def pid(self) -> int:
        """Number of the process."""
        return self._process.pid

    def is_alive(self) -> bool:
        """True while it runs."""
        return self._process.poll() is None

    def send(self, request: object) -> None:
        """Send a request; a process that is gone is noticed by its missing answer."""
        with contextlib.suppress(OSError):
            pickle.dump(request, self._requests)
            self._requests.flush()

    def look(self) -> Any:
        """The next answer; None if none comes within `LOOK_EVERY_S`.

        Raises `KilledError` when the process ended, and an answer that is an exception.
        """
        is_gone = not self.is_alive()
        with contextlib.suppress(Empty):
            answer = self._answers.get(timeout=LOOK_EVERY_S)
            if answer is None:
                raise KilledError(self._ending())
            if isinstance(answer, Exception):
                raise answer
            return answer
        if is_gone:  # its children may live on and keep the pipe open
            raise KilledError(self._ending())
        return None

    def answer(self) -> Any:
        """The next answer, whenever it comes; errors are those of `look`."""
        while (answer := self.look()) is None:
            pass
        return answer

    def ask(self, request: object) -> Any:
        """Send a request; its answer, whenever it comes."""
        self.send(request)
        return self.answer()

    def end(self) -> None:
        """Kill the process and its children, which hold its pipe open."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.pid, signal.SIGKILL)
        self._process.wait()
        self._collector.join(JOIN_S)
        with contextlib.suppress(OSError):
            self._requests.close()

    def _ending(self) -> str:
        try:
            code = self._process.wait(JOIN_S)
        except subprocess.TimeoutExpired:
            return "its answer cannot be read"
        if code >= 0:
            return f"its process ended with code {code}"
        return f"its process was ended by {signal.Signals(-code).name}"


class _Answers(pickle.Unpickler):
    """Reader of answers that loads no other package: its code would run here, and change what others compute."""

    def find_class(self, module: str, name: str) -> Any:
        if module not in sys.modules and not module.startswith(OWN):
            raise pickle.UnpicklingError(
                f"it has a {module}.{name}; expected a class of sonar_graph"
            )
        return super().find_class(module, name)


class _Plain(pickle.Pickler):
    """Writer of answers, in which what has a class derived from one of sonar_graph has that one."""

    def reducer_override(self, value: object) -> Any:
        kind = next(
            (one for one in type(value).__mro__ if one.__module__.startswith(OWN)), None
        )
        if kind in (None, type(value)) or not is_dataclass(kind):
            return NotImplemented
        return kind, tuple(getattr(value, column.name) for column in fields(kind))


def serve(handle: Callable[[Any, Tell], object]) -> NoReturn:
    """Answer requests until stdin ends; what ``handle`` raises is the answer."""
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    # whatever others' code prints must not end up among the answers
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    faulthandler.enable()
    requests: SimpleQueue[Any] = SimpleQueue()

    def listen() -> None:
        with contextlib.suppress(EOFError, OSError):
            while True:
                requests.put(pickle.load(sys.stdin.buffer))
        os._exit(0)

    def tell(content: object) -> None:
        packed = io.BytesIO()
        try:
            _Plain(packed).dump(content)
        except Exception:
            packed = io.BytesIO(
                pickle.dumps(RuntimeError(f"{type(content).__name__}: {content}"))
            )
        answers.write(packed.getvalue())
        answers.flush()

    threading.Thread(target=listen, daemon=True).start()
    tell(READY)
    while True:
        request = requests.get()
        try:
            answer = handle(request, tell)
        except Exception as error:  # for the process that waits for the answer
            answer = error
        except (
            BaseException
        ) as error:  # of an estimator that calls sys.exit or raises such things itself
            answer = KilledError(f"{type(error).__name__}: {error}")
        tell(answer)
