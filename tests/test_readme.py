"""What the README and the pages of docs promise is there."""

import ast
import re
import tomllib
from pathlib import Path

import pytest

from sonar_graph.calibration import Calibration
from sonar_graph.settings import parse

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
MESSAGES = (ROOT / "docs" / "messages.md").read_text(encoding="utf-8")
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README + MESSAGES, flags=re.DOTALL)


def test_readme_fits_on_two_screens() -> None:
    assert README.count("\n") <= 100


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_between_pages_lead_somewhere(page: Path) -> None:
    text = re.sub(r"```.*?```|`[^`]*`", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    targets = re.findall(r"(?<!!)\[[^\]]*\]\(([^)#\s]+)", text)
    missing = [target for target in targets if "://" not in target and not (page.parent / target).exists()]
    assert not missing


def test_example_calibration_is_one() -> None:
    example = next(block for block in blocks("toml") if "[imu]" in block)
    parsed = parse(Calibration, tomllib.loads(example), "README.md")
    assert parsed.dvl.mounting.translation_m == (0.30, 0.0, -0.15)


def test_table_of_topics_has_every_type_and_word_that_is_found_without_being_asked_for() -> None:
    from sonar_graph.logs.adapters.drivers import SHIPPED
    from sonar_graph.logs.roles import ROLES

    names = {"imu": "IMU", "dvl": "Doppler log", "detections": "landmarks", "sonar": "sonar images"}
    rows = {row.split(" | ")[0].removeprefix("| "): row for row in MESSAGES.splitlines() if row.startswith("| ")}
    for role, offers in SHIPPED.items():
        row = rows[names.get(role, role.replace("_", " "))]
        for offer in offers:
            package, _, name = offer.adapter.type.split("/")
            assert f"{package}`" in row or f"{package}/msg/{name}`" in row or f"`{name}`" in row, offer.adapter.type
            assert name in row
            for word in offer.words:
                assert f"`{word}`" in row
                assert f"'{word}'" in ROLES[role].describe(), "inspect says the same words"


def test_example_entry_point_joins_the_group() -> None:
    from sonar_graph.estimator import ENTRY_POINT_GROUP

    example = next(block for block in blocks("toml") if "entry-points" in block)
    assert ENTRY_POINT_GROUP in tomllib.loads(example)["project"]["entry-points"]


def test_names_imported_in_examples_exist() -> None:
    import sonar_graph

    nodes = [node for block in blocks("python") for node in ast.walk(ast.parse(block))]
    used = [
        n.attr for n in nodes if isinstance(n, ast.Attribute) and isinstance(n.value, ast.Name) and n.value.id == "sg"
    ]
    assert {"recognise", "compare", "write_report"} <= set(used)
    assert [name for name in used if not hasattr(sonar_graph, name)] == []


def test_commands_are_understood(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import typer.main

    from sonar_graph.cli.main import app

    monkeypatch.chdir(tmp_path)
    Path("benchmarks/suites").mkdir(parents=True)
    for name in ("dive.mcap", "dive.aris", "joined.mcap", "vehicle.toml", "benchmarks/suites/smoke.toml"):
        Path(name).touch()
    group = typer.main.get_command(app)
    lines = re.findall(
        r"^    sonar-graph (.+)$|`sonar-graph ([a-z]+ [^`]*\.mcap[^`]*)`", README + MESSAGES, flags=re.MULTILINE
    )
    assert len(lines) >= 4
    for words in ((indented or inline).split() for indented, inline in lines):
        group.commands[words[0]].make_context(words[0], words[1:])  # type: ignore[attr-defined]


def test_citation_names_the_version_of_the_package() -> None:
    from sonar_graph import __version__

    assert f"\nversion: {__version__}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")


def test_every_page_on_design_is_in_the_index() -> None:
    index = (ROOT / "docs" / "README.md").read_text(encoding="utf-8")
    assert [page.name for page in (ROOT / "docs" / "design").glob("*.md") if f"design/{page.name}" not in index] == []
