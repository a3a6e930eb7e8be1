"""Loaded by the Dask workers of this machine: Ctrl-C in a terminal goes to them too, and the batch ends them itself."""

from __future__ import annotations

import signal


def dask_setup(_worker: object) -> None:
    """Leave the signal to the batch; Dask calls this when a worker starts."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
