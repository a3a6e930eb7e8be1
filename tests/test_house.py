"""Rules of the house: who may import what, how large a table of contents is, how docstrings begin, what runs."""

import ast
import doctest
import subprocess
import sys
import tomllib
from collections import Counter
from importlib import import_module
from pathlib import Path
from types import FunctionType, ModuleType

import pytest

import sonar_graph

from .import_circles import SourceFiles, tangles

ROOT = Path(__file__).parents[1]
PACKAGES = ("sonar_graph", "baselines")
FILES = [
    path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))
]
ROOMS_WITH_EXAMPLES = (
    "testing",
    "navigation",
    "slam",
    "sonar",
    "evaluation",
    "simulation",
)


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_name(path): path for path in FILES}


@pytest.fixture(scope="module")
def source() -> SourceFiles:
    return SourceFiles(ROOT, PACKAGES)


def imports_past_a_table_of_contents(path: Path, tree: ast.Module) -> list[str]:
    """Modules of a package that are imported from outside of it, instead of the package."""
    own = f"{module_name(path)}."
    imported = [
        node.module
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and node.module in MODULES
    ]
    return [
        module
        for module in imported
        if (package := module.rpartition(".")[0]) not in (*PACKAGES, "")
        and MODULES[module].name != "__init__.py"
        and not own.startswith(f"{package}.")
    ]


def test_nobody_imports_past_the_table_of_contents_of_a_package(
    source: SourceFiles,
) -> None:
    found = {
        module_name(path): imports_past_a_table_of_contents(path, tree)
        for path, tree in source.trees.items()
    }
    assert {name: past for name, past in found.items() if past} == {}


@pytest.mark.parametrize(
    "path", [p for p in FILES if p.name == "__init__.py"], ids=module_name
)
def test_a_package_is_a_short_table_of_contents_with_few_modules(path: Path) -> None:
    if path.parent != ROOT / "sonar_graph":
        assert path.read_text("utf-8").count("\n") <= 30
    assert len([p for p in path.parent.glob("*.py") if p.name != "__init__.py"]) <= 13


# Folders that import files of each other. The list may only become shorter.
KNOWN_MUTUAL_FOLDERS = {
    ("sonar_graph/navigation", "sonar_graph/navigation/dvl_screening"),
    ("sonar_graph/report", "sonar_graph/report/figures"),
    ("sonar_graph/simulation", "sonar_graph/simulation/sonar_image"),
    ("sonar_graph/slam", "sonar_graph/slam/landmarks"),
}


def test_no_files_import_each_other_in_a_circle(source: SourceFiles) -> None:
    found = tangles(source.imports)
    assert [sorted(map(source.shown, tangle)) for tangle in found] == []


def test_no_further_folders_import_each_other(source: SourceFiles) -> None:
    examples: dict[tuple[str, str], str] = {}
    for path, targets in source.imports.items():
        for target in targets:
            folders = (source.shown(path.parent), source.shown(target.parent))
            # A table of contents lists files of folders below, and everything may use the files of the root.
            if (
                path.name != "__init__.py"
                and folders[0] != folders[1]
                and "sonar_graph" not in folders
            ):
                examples[folders] = f"{source.shown(path)} -> {source.shown(target)}"
    mutual = {pair for pair in examples if pair[::-1] in examples and pair[0] < pair[1]}
    new = [
        f"{examples[pair]}, {examples[pair[::-1]]}"
        for pair in sorted(mutual - KNOWN_MUTUAL_FOLDERS)
    ]
    assert not new, "\n".join(new)
    assert not KNOWN_MUTUAL_FOLDERS - mutual, (
        "these import each other no more: remove them from the list"
    )


def test_names_of_files_and_of_public_classes_occur_once(source: SourceFiles) -> None:
    stems = Counter(path.stem for path in FILES if not path.stem.startswith("__"))
    classes = Counter(
        node.name
        for tree in source.trees.values()
        for node in tree.body
        if isinstance(node, ast.ClassDef)
    )
    assert [name for name, count in (stems + classes).items() if count > 1] == []


@pytest.mark.parametrize(
    ("entry", "heavy"),
    [
        (
            "import sonar_graph",
            ("gtsam", "numba", "matplotlib", "scipy", "numpy", "cv2", "pydantic"),
        ),
        (
            "from sonar_graph import read_log, inspect_log",
            ("numba", "matplotlib", "cv2", "jinja2"),
        ),
    ],
    ids=["the front door", "reading a log"],
)
def test_what_begins_often_loads_nothing_heavy(
    entry: str, heavy: tuple[str, ...]
) -> None:
    code = f"import sys; {entry}; sys.exit(any(m in sys.modules for m in {heavy}))"
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize(
    "package",
    ["sonar_graph", "sonar_graph.devices", "sonar_graph.logs", "sonar_graph.report"],
)
def test_names_that_are_imported_at_first_use_are_those_that_are_listed(
    package: str,
) -> None:
    module = import_module(package)
    tree = ast.parse(Path(str(module.__file__)).read_text("utf-8"))
    block = next(node for node in tree.body if isinstance(node, ast.If))
    listed = {
        a.name
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for a in node.names
    }
    assert listed == set(module.__all__)
    assert [name for name in module.__all__ if not hasattr(module, name)] == []


def run_examples(found: object, name: str) -> int:
    """Run the examples in a docstring, as a user who has imported nothing; the number of examples."""
    runner = doctest.DocTestRunner(
        optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
    )
    module = sys.modules[getattr(found, "__module__", "sonar_graph")]
    for test in doctest.DocTestFinder(recurse=False).find(
        found, name, module=module, globs=dict(vars(module))
    ):
        runner.run(test)
    assert runner.failures == 0, name
    return runner.tries


NAMES = tomllib.loads((ROOT / "docs" / "reference" / "names.toml").read_text("utf-8"))
LISTED = [(package, name) for package, names in NAMES.items() for name in names]


@pytest.mark.parametrize(
    ("package", "name"), LISTED, ids=[".".join(one) for one in LISTED]
)
def test_every_name_of_the_reference_has_an_example_that_runs(
    package: str, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert name in import_module(package).__all__
    assert run_examples(getattr(import_module(package), name), name) > 0


def test_the_reference_lists_all_of_the_front_door() -> None:
    assert sorted(NAMES["sonar_graph"]) == sorted(sonar_graph.__all__)
    assert set(NAMES) >= {f"sonar_graph.{room}" for room in ROOMS_WITH_EXAMPLES}
    assert len({name for _, name in LISTED}) == len(LISTED)


@pytest.mark.parametrize("room", ROOMS_WITH_EXAMPLES)
def test_examples_of_a_room_run(
    room: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also of those of its names that the reference does not list."""
    monkeypatch.chdir(tmp_path)
    module: ModuleType = import_module(f"sonar_graph.{room}")
    others = {
        name: getattr(module, name)
        for name in module.__all__
        if name not in NAMES[module.__name__]
    }
    for name, found in others.items():
        if isinstance(found, type | FunctionType):
            run_examples(found, name)
