"""The ``--help`` of every command."""

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import typer.main

import sonar_graph
from sonar_graph.cli.main import app


def commands(
    group: Any = None, path: tuple[str, ...] = ()
) -> dict[tuple[str, ...], Any]:
    """Every command by its path, groups left out."""
    group = group or typer.main.get_command(app)
    found: dict[tuple[str, ...], Any] = {}
    for name, command in group.commands.items():
        deeper = hasattr(command, "commands")
        found |= (
            commands(command, (*path, name)) if deeper else {(*path, name): command}
        )
    return found


def test_no_argument_shows_the_commands(reply):
    shown = reply(0).out
    for path in commands():
        assert path[0] in shown


@pytest.mark.usefixtures("unrendered")
def test_help_loads_nothing_heavy(run, dive, tmp_path):
    run("compare", dive, "-o", tmp_path, "--estimators", "dead-reckoning")
    heavy = {"gtsam", "matplotlib", "numba", "numpy", "scipy"}
    cache = tmp_path / "cache"
    park = ["convert", "dataset", "victoria-park", "-o", str(tmp_path / "park.mcap")]
    report = ["report", str(tmp_path)]
    module = "importlib.import_module('sonar_graph.report.figures.illustrations')"
    unrendered = f"import importlib; {module}.inline_svg = lambda *_: '<svg></svg>'"
    for arguments, unused, before in (
        (["--help"], heavy, ""),
        (park, {"numba"}, ""),
        (report, set(), unrendered),
    ):
        at_exit = f"lambda: print(sorted({unused} & set(sys.modules)), file=sys.stderr)"
        imports = "import atexit, sys, sonar_graph.cli"
        main = f"sonar_graph.cli.main({arguments})"
        code = "; ".join([f"{before}\n{imports}", f"atexit.register({at_exit})", main])
        env = {**os.environ, "NUMBA_CACHE_DIR": str(cache)}
        done = subprocess.run(
            [sys.executable, "-c", code],
            capture_output=True,
            text=True,
            check=True,
            env=env,
        )
        assert done.stderr.splitlines()[-1] == "[]"
    assert not list(cache.rglob("*.nbi"))


def test_version_is_that_of_the_package_which_can_be_run_as_a_module(run, reply):
    assert (
        reply(0, "--version", "nonsense").out
        == f"sonar-graph {sonar_graph.__version__}\n"
    )
    done = subprocess.run(
        [sys.executable, "-m", "sonar_graph", "--version"],
        capture_output=True,
        text=True,
    )
    assert (done.returncode, done.stdout, done.stderr) == (
        0,
        f"sonar-graph {sonar_graph.__version__}\n",
        "",
    )


GROUPS = {(path[0],): None for path in commands() if len(path) > 1}


@pytest.mark.parametrize("path", commands() | GROUPS, ids=" ".join)
def test_every_command_and_group_has_help_that_ends_in_examples(path, reply):
    assert (
        f"sonar-graph {' '.join(path)}"
        in reply(0, *path, "--help").out.partition("Examples:")[2]
    )


def test_examples_in_help_are_understood(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    files = "dive.mcap vehicle.toml dive.toml dive.bag dive.ddf dive.aris pings.raw suite.toml imu.csv dvl.csv"
    folders = "comparison MRCLAM_Dataset6 A-KIT StPereDataset ros2_bag_folder folder_of_tables"
    for name in (*files.split(), "dive_sonar.mcap", "labels.json"):
        Path(name).touch()
    for name in folders.split():
        Path(name).mkdir()
    for path, command in commands().items():
        lines = [line.partition(" > ")[0] for line in command.epilog.splitlines()]
        examples = [line.split() for line in lines if line.startswith("sonar-graph ")]
        assert examples
        for words in examples:
            assert tuple(words[1 : 1 + len(path)]) == path
            command.make_context(path[-1], words[1 + len(path) :])


def test_help_names_defaults_presets_and_roles_as_they_are():
    from sonar_graph.logs import ROLES
    from sonar_graph.simulation import BasinOptions
    from sonar_graph.simulation.options import DVL_PRESETS, IMU_PRESETS
    from sonar_graph.simulation.sonar_image import SCENES, ImageOptions

    options = BasinOptions()
    helps = {
        option.name: option.help for option in commands()["simulate", "basin"].params
    }
    for name in ("seed", "duration_s", "laps"):
        assert helps[name].endswith(f" Default: {getattr(options, name):g}.")
    for name, presets in (("imu", IMU_PRESETS), ("dvl", DVL_PRESETS)):
        assert f"{name}: {getattr(options, name)} (default)" in helps["settings"]
        assert all(preset in helps["settings"] for preset in presets)
    said = set(
        re.findall(
            r"[a-z_]+", helps["settings"].partition("repeated: ")[2].partition(". ")[0]
        )
    )
    others = BasinOptions.model_fields.keys() - {
        "seed",
        "duration_s",
        "laps",
        "image",
    }
    assert (
        said - {"and", "with", "images", "image"}
        == others | ImageOptions.model_fields.keys()
    )
    assert all(
        scene in helps["settings"].partition("image.scene is")[2] for scene in SCENES
    )
    topic = next(
        option.help
        for option in commands()["compare",].params
        if option.name == "topics"
    )
    assert topic.endswith(f" Roles: {', '.join(ROLES)}.")
