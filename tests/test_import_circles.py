from pathlib import Path

import pytest

from .import_circles import SourceFiles, shortest_circle, tangles

CONTENTS = "from made.room.a import A\nfrom made.room.b import B\n"
AT_FIRST_USE = (
    "if TYPE_CHECKING:\n    from made.room.a import A\n    from made.room.b import B\n"
)
FOR_TYPES = "if typing.TYPE_CHECKING:\n    from made.b import B\n"


def circles(root: Path, files: dict[str, str]) -> list[str]:
    """Shortest circle of each tangle in a package that consists of these files."""
    for name, text in files.items():
        path = root / "made" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, "utf-8")
    source = SourceFiles(root, ("made",))
    found = [
        shortest_circle(source.imports, tangle) for tangle in tangles(source.imports)
    ]
    return [
        " > ".join(source.shown(path).removeprefix("made/") for path in circle)
        for circle in found
    ]


def test_an_import_inside_a_function_closes_a_circle(tmp_path: Path) -> None:
    files = {
        "a.py": "from made.b import B",
        "b.py": "def f(): from made import a",
        "__init__.py": "",
    }
    assert circles(tmp_path, files) == ["a.py > b.py > a.py"]


def test_relative_imports_are_followed(tmp_path: Path) -> None:
    files = {
        "__init__.py": "",
        "a.py": "from . import b",
        "b.py": "from .room.c import C",
        "room/__init__.py": "",
        "room/c.py": "from ..a import A",
    }
    assert circles(tmp_path, files) == ["a.py > b.py > room/c.py > a.py"]


@pytest.mark.parametrize("contents", [CONTENTS, AT_FIRST_USE])
def test_a_name_from_a_package_counts_as_its_file(
    tmp_path: Path, contents: str
) -> None:
    files = {
        "__init__.py": "",
        "room/__init__.py": contents,
        "room/a.py": "",
        "room/b.py": "from made.room import A",
    }
    assert circles(tmp_path, files) == []
    files["room/a.py"] = "from . import B"
    assert circles(tmp_path, files) == ["room/a.py > room/b.py > room/a.py"]


def test_a_package_imported_as_a_whole_counts_as_its_table_of_contents(
    tmp_path: Path,
) -> None:
    files = {
        "__init__.py": "",
        "room/__init__.py": CONTENTS,
        "room/a.py": "from made import room",
        "room/b.py": "",
    }
    assert circles(tmp_path, files) == [
        "room/__init__.py > room/a.py > room/__init__.py"
    ]


def test_imports_for_types_only_do_not_count(tmp_path: Path) -> None:
    files = {"__init__.py": "", "a.py": FOR_TYPES, "b.py": "from made.a import A"}
    assert circles(tmp_path, files) == []
    files["a.py"] = f"{FOR_TYPES}else:\n    from made.b import B\n"
    assert circles(tmp_path, files) == ["a.py > b.py > a.py"]


def test_two_circles_are_found_one_by_one(tmp_path: Path) -> None:
    names = {"a": "b", "b": "a", "c": "d", "d": "c"}
    files = {f"{name}.py": f"import made.{target}" for name, target in names.items()}
    files["a.py"] += "\nimport made.c"
    assert circles(tmp_path, {"__init__.py": "", **files}) == [
        "a.py > b.py > a.py",
        "c.py > d.py > c.py",
    ]
