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
    if not hasattr(group, "commands"):
        return {path: group}
    found: dict[tuple[str, ...], Any] = {}
    for name, command in group.commands.items():
        found |= commands(command, (*path, name))
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
    module = "importlib.import_module('sonar_graph.report.figures.illustrations')"
    unrendered = f"import importlib; {module}.inline_svg = lambda *_: '<svg></svg>'"
    for arguments, unused, before in (
        (["--help"], heavy, ""),
        (park, {"numba"}, ""),
        (["report", str(tmp_path)], set(), unrendered),
    ):
        code = f"""
{before}
import atexit, sys, sonar_graph.cli
atexit.register(lambda: print(sorted({unused} & set(sys.modules)), file=sys.stderr))
sonar_graph.cli.main({arguments})
"""
        env = {**os.environ, "NUMBA_CACHE_DIR": str(cache)}
        command = [sys.executable, "-c", code]
        done = subprocess.run(command, capture_output=True, text=True, env=env)
        assert done.returncode == 0
        assert done.stderr.splitlines()[-1] == "[]"
    assert not list(cache.rglob("*.nbi"))


def test_version_is_that_of_the_package_which_can_be_run_as_a_module(reply):
    version = f"sonar-graph {sonar_graph.__version__}\n"
    assert reply(0, "--version", "nonsense").out == version
    command = [sys.executable, "-m", "sonar_graph", "--version"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, version, "")


GROUPS = {(path[0],): None for path in commands() if len(path) > 1}


@pytest.mark.parametrize("path", commands() | GROUPS, ids=" ".join)
def test_every_command_and_group_has_help_that_ends_in_examples(path, reply):
    _, _, examples = reply(0, *path, "--help").out.partition("Examples:")
    assert f"sonar-graph {' '.join(path)}" in examples


def test_examples_in_help_are_understood(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    files = "dive.mcap vehicle.toml dive.toml dive.bag dive.ddf dive.aris pings.raw suite.toml imu.csv dvl.csv"
    folders = "comparison MRCLAM_Dataset6 A-KIT StPereDataset ros2_bag_folder folder_of_tables"
    for name in f"{files} dive_sonar.mcap labels.json".split():
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

    def helps_of(*path):
        return {option.name: option.help for option in commands()[path].params}

    options = BasinOptions()
    helps = helps_of("simulate", "basin")
    named = {"seed", "duration_s", "laps"}
    for name in named:
        assert helps[name].endswith(f" Default: {getattr(options, name):g}.")
    settings = helps["settings"]
    for name, presets in (("imu", IMU_PRESETS), ("dvl", DVL_PRESETS)):
        assert f"{name}: {getattr(options, name)} (default)" in settings
        assert all(preset in settings for preset in presets)
    listed = settings.partition("repeated: ")[2].partition(". ")[0]
    said = set(re.findall(r"[a-z_]+", listed)) - {"and", "with", "images", "image"}
    others = BasinOptions.model_fields.keys() - named - {"image"}
    assert said == others | ImageOptions.model_fields.keys()
    scenes = settings.partition("image.scene is")[2]
    assert all(scene in scenes for scene in SCENES)
    assert helps_of("compare")["topics"].endswith(f" Roles: {', '.join(ROLES)}.")
