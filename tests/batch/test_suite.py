from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from sonar_graph.batch.plan import plan_runs
from sonar_graph.batch.suite import METRICS, read_suite
from sonar_graph.errors import BatchError

from .conftest import BASIN, DEAD_RECKONING, HEADER, WriteSuite

SUITES = sorted((Path(__file__).parents[2] / "benchmarks" / "suites").glob("*.toml"))
ISAM2 = '\n[[estimators]]\nname = "isam2"\n'


def line(text: str, word: str) -> int:
    return next(number for number, content in enumerate(text.splitlines(), 1) if word in content)


def second(entry: str) -> str:
    return entry.replace("]]", "]]  # second", 1)


@pytest.mark.parametrize(
    ("text", "at", "words"),
    [
        (HEADER + "nmae = 1\n" + BASIN + DEAD_RECKONING, "nmae", "nmae: there is no such field; did you mean name?"),
        (HEADER.replace('"short"', "3") + BASIN + DEAD_RECKONING, "name", "name: Input should be a valid string"),
        (HEADER + BASIN + DEAD_RECKONING + "grdi = {}\n", "grdi", "did you mean grid?"),
        (HEADER + BASIN + "seeds = -1.5\n" + DEAD_RECKONING, "seeds", "seeds"),
        (HEADER + BASIN + 'log = "x.mcap"\n' + DEAD_RECKONING, "[[logs]]", "exactly one of log, dataset and generator"),
        (
            HEADER + BASIN.replace('"basin"\nopt', '"pool"\nopt') + DEAD_RECKONING,
            "generator",
            "there are: basin, mission",
        ),
        (HEADER + BASIN.replace("laps = 1", "lapse = 1") + DEAD_RECKONING, "lapse", "options.lapse"),
        (HEADER + BASIN.replace("120", "20") + DEAD_RECKONING, "options", "too short for laps"),
        (HEADER + BASIN.replace("laps = 1", "seed = 1") + DEAD_RECKONING, "seed =", "seeds = [...]"),
        (HEADER + BASIN + "grid = { wrong_id_rate = [2.0] }\n" + DEAD_RECKONING, "grid", "grid.wrong_id_rate"),
        (HEADER + BASIN + "grid = { wrong_id_rate = [] }\n" + DEAD_RECKONING, "grid", "has no values"),
        (HEADER + BASIN + "grid = { laps = [1, 2] }\n" + DEAD_RECKONING, "grid", "grid.laps: is also in options"),
        (
            HEADER
            + BASIN
            + DEAD_RECKONING
            + ISAM2
            + "params = { smoother.lag_s = 3 }\ngrid = { smoother.lag_s = [4] }\n",
            "grid",
            "grid.smoother.lag_s: is also in params",
        ),
        (HEADER + BASIN + "seeds = 0\n" + DEAD_RECKONING, "seeds", "has no seeds"),
        (HEADER + BASIN + "seeds = []\n" + DEAD_RECKONING, "seeds", "has no seeds"),
        (HEADER + BASIN + "landmarks = {}\n" + DEAD_RECKONING, "[[logs]]", "a generator has its own"),
        (
            HEADER + BASIN + DEAD_RECKONING.replace("dead-", "deaf-"),
            "deaf",
            "estimators.0.name: no estimator is called",
        ),
        (HEADER + BASIN + DEAD_RECKONING + ISAM2 + "params = { smoother.lag = 1 }\n", "lag = 1", "did you mean lag_s?"),
        (
            HEADER + BASIN + DEAD_RECKONING + ISAM2 + "[estimators.grid]\n\nsmoother.lag_s = [1, -1]\n",
            "lag_s",
            "grid.smoother.lag_s",
        ),
        (HEADER + BASIN + ISAM2, "reference", "'dead-reckoning' does not run here; what does: isam2"),
        (HEADER + 'metrics = ["ate"]\n' + BASIN + DEAD_RECKONING, "metrics", "there is no score 'ate'"),
        (HEADER + BASIN + second(BASIN) + DEAD_RECKONING, "# second", "logs.1: two logs are called 'basin'"),
        (
            HEADER + BASIN + second(BASIN.replace('"basin"\ngen', '"pool"\ngen')) + DEAD_RECKONING,
            "# second",
            "logs.1: 'pool' and 'basin' are the same with seed 0",
        ),
        (
            HEADER + BASIN + DEAD_RECKONING + second(DEAD_RECKONING),
            "# second",
            "estimators.1: dead-reckoning/default is there twice",
        ),
        (
            HEADER + BASIN + DEAD_RECKONING + ISAM2 + second(ISAM2) + 'variant = "again"\n',
            "# second",
            "estimators.2: isam2/again and isam2/default have the same settings",
        ),
        (HEADER + BASIN + "seeds = [1, 1]\n" + DEAD_RECKONING, "seeds", "list of different whole numbers"),
        (HEADER + BASIN + "seeds = [-1]\n" + DEAD_RECKONING, "seeds", "logs.0.seeds: expected the number of seeds"),
        (HEADER + BASIN + "seeds = [9223372036854775808]\n" + DEAD_RECKONING, "seeds", "to 9223372036854775807"),
        (HEADER + BASIN + "seeds = 1000001\n" + DEAD_RECKONING, "seeds", "up to 1000000"),
        (HEADER + BASIN + "seeds = true\n" + DEAD_RECKONING, "seeds", "not True"),
        (HEADER + BASIN + 'seeds = "2"\n' + DEAD_RECKONING, "seeds", "not '2'"),
        (HEADER + BASIN.replace("120", "inf") + DEAD_RECKONING, "options", "options.duration_s"),
        (HEADER + BASIN + "grid = { wrong_id_rate = [0.1, 0.1] }\n" + DEAD_RECKONING, "grid", "has 0.1 more than once"),
        (
            HEADER + BASIN.replace("[[logs]]", "[logs]") + DEAD_RECKONING,
            "[logs]",
            "expected a list of tables, [[logs]]",
        ),
        (HEADER + BASIN.replace('"basin"\ngen', '"all logs"\ngen') + DEAD_RECKONING, "all logs", "stands for all logs"),
        (HEADER + BASIN + DEAD_RECKONING + "params = { lag = 3 }\n", "lag = 3", "it has: none"),
        (HEADER + "metrics = []\n" + BASIN + DEAD_RECKONING, "metrics", "metrics"),
        (
            HEADER + 'metrics = ["causal.ate_se3"]\n' + BASIN + DEAD_RECKONING,
            "metrics",
            "did you mean causal.ate_se3_m?",
        ),
        (HEADER + '[[logs]]\nname = "a"\nlog = "no.mcap"\n' + DEAD_RECKONING, "no.mcap", "no.mcap is not in"),
        (
            HEADER + '[[logs]]\nname = "a"\nlog = "suite.toml"\n' + DEAD_RECKONING,
            "suite.toml",
            "not an MCAP file but a text",
        ),
        (
            HEADER + '[[logs]]\nname = "a"\nlog = "."\n' + DEAD_RECKONING,
            "log =",
            "is a folder; give the .mcap file in it",
        ),
        (HEADER + '[[logs]]\nname = "a"\ndataset = "mrclam"\n' + DEAD_RECKONING, "[[logs]]", "robot: is missing"),
        (
            HEADER + '[[logs]]\nname = "a"\ndataset = "victoria-park"\nlandmarks = { seed = 1 }\n' + DEAD_RECKONING,
            "landmarks",
            "logs.0.landmarks.seed: cannot be set",
        ),
        (HEADER + "[[logs]\n", "[[logs]", "not TOML"),
    ],
)
def test_mistake_is_told_with_file_line_and_key(write_suite: WriteSuite, text: str, at: str, words: str) -> None:
    path = write_suite(text)
    with pytest.raises(BatchError) as caught:
        plan_runs(read_suite(path))
    message = str(caught.value)
    assert message.startswith(str(path))
    assert f"line {line(text, at)}" in message
    assert words in message
    assert "\n" not in message


def test_the_same_suites_without_mistakes_are_planned(write_suite: WriteSuite) -> None:
    assert len(plan_runs(read_suite(write_suite(HEADER, BASIN, "seeds = [4, 2]\n", DEAD_RECKONING, ISAM2)))) == 4


def test_data_beside_the_suite_goes_before_the_folder_of_data_sets(
    write_suite: WriteSuite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "dive.mcap").touch()
    monkeypatch.setenv("SONAR_GRAPH_DATA", str(elsewhere))
    file = read_suite(write_suite())
    assert file.find(("logs",), "dive.mcap") == str(elsewhere / "dive.mcap")
    (tmp_path / "dive.mcap").touch()
    assert file.find(("logs",), "dive.mcap") == str(tmp_path / "dive.mcap")


@pytest.mark.parametrize("path", SUITES, ids=lambda path: path.stem)
def test_suites_that_ship_are_sound(path: Path) -> None:
    file = read_suite(path)
    assert file.suite.name == path.stem
    assert file.suite.description
    assert set(file.suite.metrics) <= set(METRICS)
    if not any(entry.dataset and entry.options for entry in file.suite.logs):
        assert plan_runs(file)


def test_example_in_the_documentation_of_the_module_is_a_suite(write_suite: WriteSuite) -> None:
    from sonar_graph.batch import suite

    example = "\n".join(row[4:] for row in (suite.__doc__ or "").splitlines() if row.startswith("    "))
    assert tomllib.loads(example)["name"] == "smoke"
    assert len(plan_runs(read_suite(write_suite(example)))) == 2 * 3 * 3
