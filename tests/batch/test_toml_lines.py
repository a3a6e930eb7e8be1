from __future__ import annotations

import pytest

from sonar_graph.batch.suite import Place, line_of

TEXT = '''name = "a"
note = """
name = "not a key"
[[logs]]
"""

[[logs]]
name = "one"
[logs.options]
seed = 3

[[logs]]
options = { "odd key" = 1 }
grid.lag_s = [
  1,
]
[top.'inner part']
x.y = 1
'''


@pytest.mark.parametrize(
    ("place", "line"),
    [
        (("name",), 1),
        (("note",), 2),
        (("logs",), 7),
        (("logs", 0), 7),
        (("logs", 0, "name"), 8),
        (("logs", 0, "options"), 9),
        (("logs", 0, "options", "seed"), 10),
        (("logs", 1), 12),
        (("logs", 1, "options", "odd key"), 13),
        (("logs", 1, "grid", "lag_s", 0), 14),
        (("logs", 1, "missing"), 12),
        (("top", "inner part", "x", "y"), 18),
        (("nothing",), 1),
        ((), 1),
    ],
)
def test_line_is_that_of_the_key_or_of_what_holds_it(place: Place, line: int) -> None:
    assert line_of(TEXT, place) == line
