"""Container file and conda recipe agree with pyproject.toml; neither is built here."""

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
RECIPE = (ROOT / "docs/packaging/conda/recipe.yaml").read_text("utf-8")
OTHER_NAMES = {"opencv-python-headless": "py-opencv", "matplotlib": "matplotlib-base"}


def listed(heading: str, text: str) -> list[str]:
    """Items below a heading of the recipe."""
    found = re.search(rf"^ *{heading}:\n((?: +- .*\n)+)", text, re.MULTILINE)
    assert found, heading
    return re.findall(r"- (.*)", found[1])


def test_the_recipe_has_the_versions_of_the_project():
    from sonar_graph import __version__

    assert f'version: "{__version__}"' in RECIPE
    wanted = {f"python {PROJECT['requires-python']}"}
    for dependency in PROJECT["dependencies"]:
        name, version = re.fullmatch(r"([a-z0-9-]+)(.*)", dependency).groups()
        wanted.add(f"{OTHER_NAMES.get(name, name)} {version.removeprefix('==')}")
    assert set(listed("run", RECIPE)) == wanted
    assert set(listed("run", RECIPE.replace("numpy >=2.0", "numpy >=1.0"))) != wanted, (
        "a difference is found"
    )


def test_the_recipe_starts_the_command_of_the_project():
    assert listed("entry_points", RECIPE) == [
        f"{name} = {place}" for name, place in PROJECT["scripts"].items()
    ]


def test_the_container_file_copies_all_that_a_build_needs():
    text = (ROOT / "docs/packaging/Containerfile").read_text("utf-8")
    copied = {
        word
        for line in re.findall(r"^COPY (.*) /source", text, re.MULTILINE)
        for word in line.split()
    }
    assert copied == {
        "pyproject.toml",
        "README.md",
        "LICENSE",
        "sonar_graph",
        "baselines",
    }
    assert all((ROOT / name).exists() for name in copied)
    for extra in re.search(r"/source\[(.*)\]", text)[1].split(","):
        assert extra in PROJECT["optional-dependencies"]
