"""What commands say in the same way everywhere."""

from __future__ import annotations

from rich.console import Console

WIDTH_OF_A_FILE = 200


def examples(*commands: str) -> str:
    """Commands to copy, for the end of a help page; an empty line keeps each on a line of its own."""
    return "\n\n".join(["Examples:", *commands])


def answers() -> Console:
    """Where results go: stdout, and where that is no terminal, wide enough for lines to stay whole."""
    console = Console(highlight=False)
    return console if console.is_terminal else Console(highlight=False, width=WIDTH_OF_A_FILE)
