"""Cli."""

# fmt: off
from sonar_graph.cli.main import main

__all__ = [
    "main",
]
