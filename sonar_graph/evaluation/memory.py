"""The process's resident memory, where the operating system tells it."""

from __future__ import annotations

from pathlib import Path

STATUS = Path("/proc/self/status")
CLEAR_REFS = Path("/proc/self/clear_refs")
RESET_PEAK = "5"
"""What Linux takes for "start the high-water mark anew"."""


class PeakMemory:
    """Highest resident memory of this process from now on, above what is resident now.

    Known on Linux only. It is the whole process's: memory that an earlier run left free for reuse is not counted
    again, and caches that fill meanwhile are. It shows orders of magnitude, not kilobytes.
    """

    def __init__(self) -> None:
        self._start_mb = float("nan")
        try:
            CLEAR_REFS.write_text(RESET_PEAK)
            self._start_mb = _status_mb("VmRSS")
        except OSError:
            return

    def rise_mb(self) -> float:
        """Megabytes (10⁶ bytes) at the peak above the start; NaN where the system does not tell."""
        return max(_status_mb("VmHWM") - self._start_mb, 0.0) if self._start_mb == self._start_mb else float("nan")


def _status_mb(field: str) -> float:
    """A field of the process's status, given there in kibibytes."""
    for line in STATUS.read_text().splitlines():
        if line.startswith(f"{field}:"):
            return int(line.split()[1]) * 1024 / 1e6
    return float("nan")
