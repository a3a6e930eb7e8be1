"""Commands of ``sonar-graph``, a module each; `main` starts them."""

# fmt: off
from sonar_graph.files import loading

with loading():  # a Ctrl-C meanwhile ends without a traceback
    from sonar_graph.cli.main import main

__all__ = [
    "main",
]
