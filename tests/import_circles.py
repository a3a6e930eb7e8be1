"""Circles of imports between the files of a package, found in their source without importing anything.

A name that is imported from a package counts as an import of the file that defines the name, not of the package's
``__init__``. Imports under ``if TYPE_CHECKING`` do not count; imports inside functions do, because they only postpone
a circle.
"""

import ast
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

Graph = dict[Path, set[Path]]
"""Files that each file imports."""


class Import(NamedTuple):
    """A module that is imported, and one name that is taken from it."""

    module: str
    name: str | None
    """None where the module is imported as a whole."""


class SourceFiles:
    """All Python files of some packages in one folder, and what they import from each other."""

    def __init__(self, root: Path, packages: tuple[str, ...]) -> None:
        self._root = root
        files = [
            path
            for package in packages
            for path in sorted((root / package).rglob("*.py"))
        ]
        self._modules = {self._name(path): path for path in files}
        self._listed: dict[str, dict[str, str]] = {}
        self.trees = {path: ast.parse(path.read_text("utf-8")) for path in files}

    @cached_property
    def imports(self) -> Graph:
        """Files that each file imports while it runs."""
        found: Graph = {}
        for module, path in self._modules.items():
            targets = [
                self._definition(*one)
                for one in self._imported(module, is_typing=False)
            ]
            found[path] = {
                target for target in targets if target is not None and target != path
            }
        return found

    def shown(self, path: Path) -> str:
        """The path of a file within the folder."""
        return path.relative_to(self._root).as_posix()

    def _name(self, path: Path) -> str:
        parts = path.relative_to(self._root).with_suffix("").parts
        return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)

    def _imported(self, module: str, *, is_typing: bool) -> list[Import]:
        """Imports of a module; ``is_typing``: also those under ``if TYPE_CHECKING``."""
        found: list[Import] = []
        for node in statements(self.trees[self._modules[module]], is_typing=is_typing):
            if isinstance(node, ast.Import):
                found += [Import(alias.name, None) for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                target = self._target(module, node)
                found += [Import(target, alias.name) for alias in node.names]
        return found

    def _target(self, module: str, node: ast.ImportFrom) -> str:
        """Absolute name of the module of a ``from`` import, which may be relative."""
        if not node.level:
            return node.module or ""
        is_package = self._modules[module].name == "__init__.py"
        parts = module.split(".")
        parents = parts[: len(parts) - node.level + is_package]
        return ".".join([*parents, *([node.module] if node.module else [])])

    def _definition(self, module: str, name: str | None) -> Path | None:
        """File that defines a name that is imported from a module; None outside of the packages."""
        if name is not None and f"{module}.{name}" in self._modules:
            return self._modules[f"{module}.{name}"]
        if module not in self._modules:
            return None
        path = self._modules[module]
        if name is None or path.name != "__init__.py":
            return path
        # A package may import its names at their first use: it then lists them under TYPE_CHECKING.
        if module not in self._listed:
            listed = self._imported(module, is_typing=True)
            self._listed[module] = {
                one.name: one.module
                for one in listed
                if one.name and one.module != module
            }
        if name not in self._listed[module]:
            return path
        return self._definition(self._listed[module][name], name) or path


def statements(tree: ast.AST, *, is_typing: bool) -> Iterator[ast.AST]:
    """All nodes of a tree; without ``is_typing`` those under ``if TYPE_CHECKING`` are left out."""
    waiting = [tree]
    while waiting:
        node = waiting.pop()
        yield node
        if isinstance(node, ast.If) and not is_typing and is_type_checking(node.test):
            waiting.extend(node.orelse)
        elif not isinstance(node, ast.expr):  # no import is inside an expression
            waiting.extend(ast.iter_child_nodes(node))


def is_type_checking(test: ast.expr) -> bool:
    """Whether a condition is ``TYPE_CHECKING`` or ``typing.TYPE_CHECKING``."""
    return "TYPE_CHECKING" in (getattr(test, "id", ""), getattr(test, "attr", ""))


def reachable(graph: Graph, start: Path) -> set[Path]:
    """Files that a file imports directly or through others."""
    found: set[Path] = set()
    waiting = [start]
    while waiting:
        for target in graph[waiting.pop()] - found:
            found.add(target)
            waiting.append(target)
    return found


def tangles(graph: Graph) -> list[frozenset[Path]]:
    """Largest sets of files in which every file imports every other one, directly or through others."""
    below = {path: reachable(graph, path) for path in graph}
    found = {
        frozenset(other for other in below[path] if path in below[other])
        for path in graph
        if path in below[path]
    }
    return sorted(found, key=sorted)
