from pathlib import Path

import pytest

from .import_circles import SourceFiles, tangles

CONTENTS = "from made.room.a import A\nfrom made.room.b import B\n"
AT_FIRST_USE = (
    "if TYPE_CHECKING:\n    from made.room.a import A\n    from made.room.b import B\n"
)
FOR_TYPES = "if typing.TYPE_CHECKING:\n    from made.b import B\n"


def circles(root: Path, files: dict[str, str]) -> list[str]:
    """Files of each tangle in a package that consists of these files."""
    for name, text in files.items():
        path = root / "made" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, "utf-8")
    source = SourceFiles(root, ("made",))
    found = [map(source.shown, sorted(tangle)) for tangle in tangles(source.imports)]
    return [" ".join(name.removeprefix("made/") for name in tangle) for tangle in found]


def test_an_import_inside_a_function_closes_a_circle(tmp_path: Path) -> None:
    files = {
        "a.py": "from made.b import B",
        "b.py": "def f(): from made import a",
        "__init__.py": "",
    }
    assert circles(tmp_path, files) == ["a.py b.py"]


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
    assert circles(tmp_path, files) == ["room/a.py room/b.py"]


def test_imports_for_types_only_do_not_count(tmp_path: Path) -> None:
    files = {"__init__.py": "", "a.py": FOR_TYPES, "b.py": "from made.a import A"}
    assert circles(tmp_path, files) == []
    files["a.py"] = f"{FOR_TYPES}else:\n    from made.b import B\n"
    assert circles(tmp_path, files) == ["a.py b.py"]
