"""What the README and the pages of docs promise is there."""

import ast
import re
import tomllib
from pathlib import Path
from typing import get_args

import pytest

from sonar_graph.calibration import Calibration
from sonar_graph.settings import parse

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
MESSAGES = (ROOT / "docs" / "messages.md").read_text(encoding="utf-8")
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
WITH_COMMANDS = [
    "README.md",
    "docs/messages.md",
    "docs/install.md",
    "docs/quick_start.md",
    "docs/three_ways.md",
    "docs/settings.md",
]
WITH_COMMANDS += ["docs/gallery/README.md"]
WITH_COMMANDS += [
    path.relative_to(ROOT).as_posix()
    for path in sorted((ROOT / "docs" / "howto").glob("*.md"))
]


def blocks(language: str, text: str = README + MESSAGES) -> list[str]:
    return re.findall(rf" *```{language}\n(.*?)```", text, flags=re.DOTALL)


RESULT_TABLE = re.compile(r"\]\(((?:\.\./)?benchmarks/results/\w+\.md)\)")


@pytest.mark.parametrize("page", ["README.md", "docs/results.md"])
def test_numbers_in_tables_of_results_are_those_of_the_linked_result_files(
    page: str,
) -> None:
    path = ROOT / page
    text = path.read_text(encoding="utf-8")
    linked = {
        (path.parent / name).resolve().read_text(encoding="utf-8")
        for name in RESULT_TABLE.findall(text)
    }
    lines = [line for one in linked for line in one.splitlines()]
    rows = [
        [cell.strip() for cell in line.strip("| ").split("|")]
        for line in text.splitlines()
        if re.match(r"\| [^|]*\|.*\d\.\d", line)
    ]
    assert len(rows) >= 4
    for name, *numbers in rows:
        for number in numbers:
            assert any(name in line and f"| {number} |" in line for line in lines), (
                f"{name}: {number}"
            )


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_between_pages_lead_somewhere(page: Path) -> None:
    text = re.sub(
        r"```.*?```|`[^`]*`", "", page.read_text(encoding="utf-8"), flags=re.DOTALL
    )
    targets = re.findall(r"(?<!!)\[[^\]]*\]\(([^)#\s]+)", text)
    missing = [
        target
        for target in targets
        if "://" not in target and not (page.parent / target).exists()
    ]
    assert not missing


def test_example_calibration_is_one() -> None:
    example = next(block for block in blocks("toml") if "[imu]" in block)
    parsed = parse(Calibration, tomllib.loads(example), "README.md")
    assert parsed.dvl.mounting.translation_m == (0.30, 0.0, -0.15)


def test_the_table_of_topics_has_every_type_and_word_that_is_found() -> None:
    from sonar_graph.logs.adapters import SHIPPED

    names = {
        "imu": "IMU",
        "dvl": "Doppler log",
        "detections": "landmarks",
        "sonar": "sonar images",
    }
    rows = {
        row.split(" | ")[0].removeprefix("| "): row
        for row in MESSAGES.splitlines()
        if row.startswith("| ")
    }
    for role, offers in SHIPPED.items():
        row = rows[names.get(role, role.replace("_", " "))]
        for offer in offers:
            package, _, name = offer.adapter.type.split("/")
            assert (
                f"{package}`" in row
                or f"{package}/msg/{name}`" in row
                or f"`{name}`" in row
            ), offer.adapter.type
            assert name in row
            for word in offer.words:
                assert f"`{word}`" in row


def test_example_entry_point_joins_the_group() -> None:
    from sonar_graph.estimator import ENTRY_POINT_GROUP

    page = (ROOT / "docs/howto/own_estimator.md").read_text(encoding="utf-8")
    example = next(block for block in blocks("toml", page) if "entry-points" in block)
    assert ENTRY_POINT_GROUP in tomllib.loads(example)["project"]["entry-points"]


def test_names_imported_in_examples_exist() -> None:
    import sonar_graph

    nodes = [node for block in blocks("python") for node in ast.walk(ast.parse(block))]
    used = [
        n.attr
        for n in nodes
        if isinstance(n, ast.Attribute)
        and isinstance(n.value, ast.Name)
        and n.value.id == "sg"
    ]
    assert {"recognise", "compare", "write_report"} <= set(used)
    assert [name for name in used if not hasattr(sonar_graph, name)] == []


@pytest.mark.parametrize("page", WITH_COMMANDS)
def test_commands_are_understood(
    page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import typer.main

    from sonar_graph.cli.main import app

    text = (ROOT / page).read_text(encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    for name in re.findall(r"[\w./]+\.(?:mcap|toml|aris|raw|bag|json|csv)\b", text):
        if not Path(name).is_absolute():
            Path(name).parent.mkdir(parents=True, exist_ok=True)
            Path(name).touch()
    for folder in (
        "results",
        "comparison",
        "MRCLAM_Dataset6",
        "A-KIT",
        "STPERE",
        "ros2_bag_folder",
    ):
        Path(folder).mkdir(exist_ok=True)
    lines = re.findall(
        r"^ {4,8}sonar-graph ([^|\n]+)$|`sonar-graph ([a-z]+ [^`]*\.(?:mcap|toml|json)[^`]*)`",
        text,
        flags=re.MULTILINE,
    )
    assert lines
    for words in (
        (indented or inline).partition(" > ")[0].split() for indented, inline in lines
    ):
        command = typer.main.get_command(app)
        context = None
        while hasattr(command, "commands"):
            command = (
                command.commands[words.pop(0)]
                if words[0] in command.commands
                else command.commands["run"]
            )
            context = command.name
        command.make_context(context, words)


def test_settings_and_the_suite_on_their_page_exist(tmp_path: Path) -> None:
    pytest.importorskip("dask", reason="needs sonar-graph[bench]")
    from sonar_graph.batch import plan_runs, read_suite
    from sonar_graph.slam import Isam2Params

    text = (ROOT / "docs" / "settings.md").read_text(encoding="utf-8")
    suite = tmp_path / "suite.toml"
    suite.write_text(
        next(block for block in re.findall(r"```toml\n(.*?)```", text, re.DOTALL)),
        encoding="utf-8",
    )
    assert len(plan_runs(read_suite(suite))) == 6 * 3
    named = re.findall(r"`([a-z_]+)\.([a-z_]+)[`.]", text)
    assert len(named) >= 15
    sections = {**Calibration.model_fields, **Isam2Params.model_fields}
    for section, field in named:
        kinds = get_args(sections[section].annotation) or (
            sections[section].annotation,
        )
        kinds = tuple(kind for one in kinds for kind in (get_args(one) or (one,)))
        assert any(field in getattr(kind, "model_fields", {}) for kind in kinds), (
            f"{section}.{field}"
        )


def test_citation_names_the_version_of_the_package() -> None:
    from sonar_graph import __version__

    assert f"\nversion: {__version__}\n" in (ROOT / "CITATION.cff").read_text(
        encoding="utf-8"
    )


@pytest.mark.parametrize("folder", ["design", "theory", "tutorials"])
def test_every_page_of_a_folder_is_in_its_index(folder: str) -> None:
    index = (ROOT / "docs" / folder / "README.md").read_text(encoding="utf-8")
    pages = [
        page.name
        for page in (ROOT / "docs" / folder).glob("*.md")
        if page.name != "README.md"
    ]
    assert len(pages) >= 5
    assert [name for name in pages if f"({name})" not in index] == []
