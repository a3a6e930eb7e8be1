"""A suite is understood, and a mistake in it is reported with file, line and key."""

import tomllib
from pathlib import Path

import pytest

from sonar_graph.batch import plan_runs, read_suite, suite
from sonar_graph.batch.suite import line_of
from sonar_graph.errors import BatchError
from sonar_graph.evaluation import SCORES

from .conftest import BASIN, DEAD_RECKONING, HEADER

SUITES = sorted((Path(__file__).parents[2] / "benchmarks" / "suites").glob("*.toml"))
ISAM2 = '\n[[estimators]]\nname = "isam2"\n'
LAG_TWICE = "params = { smoother.lag_s = 3 }\ngrid = { smoother.lag_s = [4] }\n"
EXCLUSIVE = 'params = { identity.policy = "max-mixture" }\ngrid = { history.policy = ["whole", "bounded"] }\n'
AGAIN = ISAM2 + 'variant = "again"\n'
OTHER = '[[logs]]\nname = "a"\n'
REF = 'reference = "dead-reckoning"\n'
LAPS = "laps = 1 }\n"
SAME = ", seed 0: is the same run as "
PARK = 'dataset = "victoria-park"\n'
POOL = BASIN.replace('"basin"\ngen', '"pool"\ngen')


def second(entry: str) -> str:
    return entry.replace("]]", "]]  # second", 1)


MISTAKES = [
    (REF, "&nmae = 1\n", "nmae", "nmae: there is no such field; did you mean name?"),
    ('"short"', '"a\\u001b[2J"', "name", "expected a name without control"),
    (LAPS, '&log = "x.mcap"\n', "[[logs]]", "exactly one of log, dataset and generator"),
    ('"basin"\nopt', '"pool"\nopt', "generator", "there are: basin, mission"),
    ("laps = 1", "lapse = 1", "lapse", "options.lapse"),
    ("120", "20", "options", "too short for laps"),
    ("laps = 1", "seed = 1", "seed =", "seeds = [...]"),
    (LAPS, "&grid = { wrong_id_rate = [2.0] }\n", "grid", "grid.wrong_id_rate"),
    (LAPS, "&grid = { wrong_id_rate = [] }\n", "grid", "has no values"),
    (LAPS, "&grid = { laps = [1, 2] }\n", "grid", "grid.laps: is also in options"),
    (DEAD_RECKONING, f"&{ISAM2}{LAG_TWICE}", "grid", "grid.smoother.lag_s: is also in params"),
    (DEAD_RECKONING, f"&{ISAM2}{EXCLUSIVE}", "grid =", 'grid.history: history.policy = "bounded" cannot be with'),
    (LAPS, "&seeds = 0\n", "seeds", "has no seeds"),
    (LAPS, "&landmarks = {}\n", "[[logs]]", "a generator has its own"),
    ('name = "dead-', 'name = "deaf-', "deaf", "estimators.0.name: no estimator is called"),
    (DEAD_RECKONING, f"&{ISAM2}params = {{ smoother.lag = 1 }}\n", "lag = 1", "did you mean lag_s?"),
    (DEAD_RECKONING, f"&{ISAM2}[estimators.grid]\n\nsmoother.lag_s = [1, -1]\n", "lag_s", "grid.smoother.lag_s"),
    (DEAD_RECKONING, ISAM2, "reference", "'dead-reckoning' does not run here; what does: isam2"),
    (REF, '&metrics = ["causal.ate_ra"]\n', "metrics", "did you mean causal.ate_raw_m?"),
    (LAPS, f"&{second(BASIN)}", "# second", "logs.1: two logs are called 'basin'"),
    (LAPS, f"&{second(POOL)}", "# second", "logs.1: 'pool', dead-reckoning/default, seed 0: is the same run as 'basin'"),
    (DEAD_RECKONING, f"&{second(DEAD_RECKONING)}", "# second", "estimators.1: dead-reckoning/default is there twice"),
    (DEAD_RECKONING, f"&{ISAM2}{second(AGAIN)}", "# second", f"isam2/again{SAME}'basin', isam2/default"),
    (LAPS, "&seeds = [1, 1]\n", "seeds", "list of different whole numbers"),
    (LAPS, "&seeds = [9223372036854775808]\n", "seeds", "to 9223372036854775807"),
    (LAPS, "&seeds = 1000001\n", "seeds", "up to 1000000"),
    (LAPS, "&seeds = true\n", "seeds", "not true"),
    (LAPS, "&grid = { wrong_id_rate = [0.1, 0.1] }\n", "grid", "has 0.1 more than once"),
    ("[[logs]]", "[logs]", "[logs]", "expected a list of tables, [[logs]]"),
    ('"basin"\ngen', '"all logs"\ngen', "all logs", "stands for all logs"),
    (BASIN, f'{OTHER}log = "no.mcap"\n', "no.mcap", "no.mcap is not in"),
    (BASIN, f'{OTHER}log = "suite.toml"\n', "suite.toml", "not an MCAP file but a text"),
    (BASIN, f'{OTHER}log = "."\n', "log =", "is a folder without metadata.yaml"),
    (BASIN, f'{OTHER}dataset = "mrclam"\n', "[[logs]]", "robot: is missing"),
    (BASIN, f"{OTHER}{PARK}landmarks = {{ seed = 1 }}\n", "landmarks", "logs.0.landmarks.seed: cannot be set"),
    ("[[logs]]", "[[logs]", "[[logs]", "not TOML"),
]  # fmt: skip
"""What is put in place of a text of a suite, where & stands for that text; the line at fault, and words about it."""


@pytest.mark.parametrize(("old", "new", "at", "words"), MISTAKES)
def test_mistake_is_told_with_file_line_and_key(write_suite, old, new, at, words):
    sound = HEADER + BASIN + DEAD_RECKONING
    assert old in sound
    path = write_suite(sound.replace(old, new.replace("&", old), 1))
    lines = path.read_text().splitlines()
    line = next(number for number, text in enumerate(lines, 1) if at in text)
    with pytest.raises(BatchError) as caught:
        plan_runs(read_suite(path))
    message = str(caught.value)
    assert message.startswith(str(path))
    assert f"line {line}" in message
    assert words in message
    assert "\n" not in message


def test_data_beside_the_suite_goes_before_the_folder_of_data_sets(
    write_suite, tmp_path, monkeypatch
):
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "dive.mcap").touch()
    monkeypatch.setenv("SONAR_GRAPH_DATA", str(elsewhere))
    file = read_suite(write_suite())
    assert file.find(("logs",), "dive.mcap") == str(elsewhere / "dive.mcap")
    (tmp_path / "dive.mcap").touch()
    assert file.find(("logs",), "dive.mcap") == str(tmp_path / "dive.mcap")


@pytest.mark.parametrize("path", SUITES, ids=lambda path: path.stem)
def test_suites_that_ship_are_sound(path):
    file = read_suite(path)
    assert file.suite.name == path.stem
    assert file.suite.description
    assert set(file.suite.metrics) <= set(SCORES)
    if not any(entry.dataset and entry.options for entry in file.suite.logs):
        assert plan_runs(file)


def test_the_documented_suites_are_planned(write_suite):
    two = write_suite(HEADER, BASIN, "seeds = [4, 2]\n", DEAD_RECKONING, ISAM2)
    assert len(plan_runs(read_suite(two))) == 4
    rows = (suite.__doc__ or "").splitlines()
    example = "\n".join(row[4:] for row in rows if row.startswith("    "))
    assert tomllib.loads(example)["name"] == "smoke"
    assert len(plan_runs(read_suite(write_suite(example)))) == 2 * 3 * 3


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


# fmt: off
LINES = {
    ("name",): 1, ("note",): 2, ("logs",): 7, ("logs", 0): 7, ("logs", 0, "name"): 8, ("logs", 0, "options"): 9,
    ("logs", 0, "options", "seed"): 10, ("logs", 1): 12, ("logs", 1, "options", "odd key"): 13,
    ("logs", 1, "grid", "lag_s", 0): 14, ("logs", 1, "missing"): 12, ("top", "inner part", "x", "y"): 18,
    ("nothing",): 1, (): 1,
}
# fmt: on


def test_line_is_that_of_the_key_or_of_what_holds_it():
    assert {place: line_of(TEXT, place) for place in LINES} == LINES
