"""Share of small random faults in the code that no fast test finds.

Lines are chosen at random by a seed, each is broken alone in a copy of the checkout, and the fast tests that import
the broken module or its package are run until the first failure. A fault is one of: a comparison turned or shifted, a
sign or an operator exchanged, a number changed, ``and`` and ``or`` exchanged, a condition negated, a returned value
dropped, a call left out. Only the bodies of functions are touched, without messages and annotations; constants and
defaults of settings are not. A test that finds a fault is also run without it, and must pass.

``--root`` judges another checkout in the same way. ``--against`` names an older checkout: each fault that survives is
made there too, in the same statement wherever it stands, and judged by the older tests; one that they find is a guard
that was lost. ``--keep`` holds results, so that a run that was interrupted goes on.
"""

import argparse
import ast
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path
from threading import Lock
from typing import NamedTuple

sys.path.insert(0, str(Path(__file__).parents[1]))
from common import conclude, note, print_table

PACKAGES = ("sonar_graph", "baselines")
COMPARISONS = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
}  # fmt: skip
OPERATORS = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Mult,
    ast.Pow: ast.Mult, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd, ast.MatMult: ast.Add,
}  # fmt: skip
TIMEOUT_S = 600


class Mutant(NamedTuple):
    """One fault: where, and the line before and after."""

    path: str
    line: int
    before: str
    after: str
    statement: str
    source: str

    @property
    def name(self) -> str:
        return f"{self.path}:{self.line}"


def sites(tree: ast.Module) -> Iterator[tuple[ast.AST, str, int]]:
    """Nodes that can be broken, with the kind of fault and a number where a node has several."""
    untouched: set[int] = set()
    for node in ast.walk(tree):
        for child in ast.iter_child_nodes(node):
            child._parent = node  # type: ignore[attr-defined]  # for `_statement_of`
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            annotations = [
                a.annotation for a in ast.walk(node.args) if isinstance(a, ast.arg)
            ] + [node.returns]
            untouched |= {
                id(n)
                for a in (*annotations, *node.decorator_list)
                if a
                for n in ast.walk(a)
            }
        elif isinstance(node, ast.AnnAssign):
            untouched |= {id(n) for n in ast.walk(node.annotation)}
        elif isinstance(node, ast.Raise | ast.JoinedStr):
            untouched |= {id(n) for n in ast.walk(node)}
    for function in ast.walk(tree):
        if not isinstance(function, ast.FunctionDef):
            continue
        for node in (n for statement in function.body for n in ast.walk(statement)):
            if id(node) in untouched:
                continue
            untouched.add(id(node))  # of nested functions, once
            if isinstance(node, ast.Compare):
                yield from ((node, "comparison", k) for k in range(len(node.ops)))
            elif (
                isinstance(node, ast.BinOp)
                and type(node.op) in OPERATORS
                and not _is_text(node)
            ):
                yield node, "operator", 0
            elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
                yield node, "sign", 0
            elif isinstance(node, ast.Constant) and type(node.value) in (int, float):
                yield node, "number", 0
            elif isinstance(node, ast.BoolOp):
                yield node, "and/or", 0
            elif isinstance(node, ast.If | ast.IfExp | ast.While):
                yield node, "condition", 0
            elif (
                isinstance(node, ast.Return)
                and node.value is not None
                and not isinstance(node.value, ast.Constant)
            ):
                yield node, "return", 0
            elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Call):
                yield node, "call", 0


def _is_text(node: ast.BinOp) -> bool:
    return any(
        isinstance(n, ast.JoinedStr)
        or (isinstance(n, ast.Constant) and isinstance(n.value, str))
        for n in ast.walk(node)
    )


def broken(node: ast.AST, number: int) -> ast.AST:
    """The node with its fault."""
    if isinstance(node, ast.Compare):
        node.ops[number] = COMPARISONS[type(node.ops[number])]()
    elif isinstance(node, ast.BinOp):
        node.op = OPERATORS[type(node.op)]()
    elif isinstance(node, ast.UnaryOp):
        return node.operand
    elif isinstance(node, ast.Constant):
        return ast.Constant(node.value + 1)
    elif isinstance(node, ast.BoolOp):
        node.op = ast.Or() if isinstance(node.op, ast.And) else ast.And()
    elif isinstance(node, ast.If | ast.IfExp | ast.While):
        node.test = ast.UnaryOp(ast.Not(), node.test)
    elif isinstance(node, ast.Return):
        node.value = ast.Constant(None)
    else:
        return ast.Pass()
    return node


class _Replace(ast.NodeTransformer):
    def __init__(self, target: int, number: int) -> None:
        self._target, self._number = target, number

    def visit(self, node: ast.AST) -> ast.AST:
        if getattr(node, "_site", None) == self._target:
            return ast.copy_location(broken(node, self._number), node)
        return self.generic_visit(node)


def choose(root: Path, count: int, seed: int) -> list[Mutant]:
    """Faults drawn over all lines that can be broken, so that long files have more."""
    places: list[tuple[Path, int]] = []
    for package in PACKAGES:
        for path in sorted((root / package).rglob("*.py")):
            n = len(list(sites(ast.parse(path.read_text("utf-8")))))
            places += [(path, k) for k in range(n)]
    drawn = random.Random(seed).sample(places, count)
    return [_mutant(root, path, k) for path, k in drawn]


def _mutant(root: Path, path: Path, k: int) -> Mutant:
    text = path.read_text("utf-8")
    tree = ast.parse(text)
    node, kind, number = list(sites(tree))[k]
    statement = _statement_of(node)
    text_before = ast.unparse(statement)
    before = ast.get_source_segment(text, statement) or ""
    first, last = statement.lineno, statement.end_lineno or statement.lineno
    node._site = k  # type: ignore[attr-defined]  # a mark for the transformer
    line = getattr(node, "lineno", first)
    changed = ast.unparse(
        ast.fix_missing_locations(_Replace(k, number).visit(statement))
    )
    indent = text.splitlines()[first - 1][: statement.col_offset]
    lines = text.split("\n")
    lines[first - 1 : last] = [indent + row for row in changed.split("\n")]
    old, new = before.split("\n"), changed.split("\n")
    shown = next(
        ((a, b) for a, b in zip(old, new, strict=False) if a.split() != b.split()),
        (old[0], new[0]),
    )
    return Mutant(
        str(path.relative_to(root)),
        line,
        shown[0].strip(),
        f"{kind}: {shown[1].strip()}",
        text_before,
        "\n".join(lines),
    )


@cache
def faults_by_statement(root: Path) -> dict[str, list[tuple[Path, int]]]:
    """All places where a fault can be made, by the text of their statement."""
    places: dict[str, list[tuple[Path, int]]] = {}
    for package in PACKAGES:
        for path in sorted((root / package).rglob("*.py")):
            tree = ast.parse(path.read_text("utf-8"))
            texts: dict[int, str] = {}
            for k, (node, _, _) in enumerate(sites(tree)):
                statement = _statement_of(node)
                text = texts.setdefault(id(statement), ast.unparse(statement))
                places.setdefault(text, []).append((path, k))
    return places


def same_fault(mutant: Mutant, old_root: Path) -> Mutant | None:
    """The fault in an older checkout: in a statement with the same text there; None where there is none."""
    for path, k in faults_by_statement(old_root).get(mutant.statement, []):
        found = _mutant(old_root, path, k)
        if "".join(found.after.split()) == "".join(mutant.after.split()):
            return found
    return None


def _statement_of(node: ast.AST) -> ast.stmt:
    """The innermost statement that holds a node."""
    while not isinstance(node, ast.stmt):
        node = node._parent  # type: ignore[attr-defined]  # set by `sites`
    return node


def tests_of(root: Path, path: str) -> list[str]:
    """Test files that import the module or its package, those that import the module first."""
    module = path.removesuffix(".py").replace("/", ".").removesuffix(".__init__")
    package = module.rpartition(".")[0]
    direct, near = [], []
    for test in sorted((root / "tests").rglob("test_*.py")):
        imported = set()
        for node in ast.walk(ast.parse(test.read_text("utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module:
                imported |= {
                    node.module,
                    *(f"{node.module}.{alias.name}" for alias in node.names),
                }
            elif isinstance(node, ast.Import):
                imported |= {alias.name for alias in node.names}
        name = str(test.relative_to(root))
        if module in imported:
            direct.append(name)
        elif (
            any(i == package or i.startswith(package + ".") for i in imported)
            and package not in PACKAGES
        ):
            near.append(name)
    room = root / "tests" / Path(path).parts[1 if path.startswith("sonar_graph") else 0]
    inside = (
        [str(p.relative_to(root)) for p in sorted(room.rglob("test_*.py"))]
        if room.is_dir()
        else []
    )
    return list(dict.fromkeys([*direct, *near, *inside])) or ["tests"]


def judge(root: Path, mutant: Mutant, tests: list[str]) -> str:
    """``killed``, ``survived`` or ``timeout``, which counts as killed; in a copy of the checkout, compiled code too.

    What fails must pass on sound code, or it would kill every mutant.
    """
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder, "checkout")
        shutil.copytree(
            root,
            copy,
            ignore=shutil.ignore_patterns(
                ".git", ".venv", "build", "demo", "node_modules"
            ),
        )
        (copy / mutant.path).write_text(mutant.source, "utf-8")
        outcome, failed = run_tests(copy, tests)
    if outcome == "killed" and run_tests(root, failed)[0] != "survived":
        raise RuntimeError(f"{root}: fails without a fault: {' '.join(failed)}")
    return outcome


def run_tests(copy: Path, tests: list[str]) -> tuple[str, list[str]]:
    """Outcome of the tests, and the first that fails; a module that cannot be imported fails with its test file."""
    environment = os.environ | {"PYTHONPATH": str(copy)}
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-x",
        "-q",
        "-rfE",
        "--tb=no",
        "-p",
        "no:cacheprovider",
        *tests,
    ]
    process = subprocess.Popen(
        command, cwd=copy, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True,
        text=True, encoding="utf-8", errors="replace",
    )  # fmt: skip
    try:
        said, _ = process.communicate(timeout=TIMEOUT_S)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        return "timeout", []
    if process.returncode == 0:
        return "survived", []
    failed = re.findall(
        r"^(?:FAILED|ERROR) (tests/\S+\.py(?:::.*?)?)(?: - |$)", said, re.MULTILINE
    )
    if not failed:
        raise RuntimeError(
            f"pytest ended with {process.returncode} and has judged nothing: {' '.join(tests[:3])} ..."
        )
    return "killed", failed[:1]


def main() -> None:
    """Choose, break, test, count."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument(
        "--root",
        type=Path,
        default=Path(__file__).parents[2],
        help="the checkout to judge",
    )
    parser.add_argument("--mutants", type=int, default=60)
    parser.add_argument("--seed", type=int, default=16)
    parser.add_argument("--keep", type=Path, help="JSON file with the results so far")
    parser.add_argument(
        "--against", type=Path, help="an older checkout that judges the survivors"
    )
    parser.add_argument(
        "--workers", type=int, default=1, help="faults judged side by side; one a core"
    )
    parser.add_argument(
        "--quick", action="store_true", help="three mutants, to see that it runs"
    )
    arguments = parser.parse_args()
    root = arguments.root.resolve()
    mutants = choose(root, 3 if arguments.quick else arguments.mutants, arguments.seed)
    kept: dict[str, str] = (
        json.loads(arguments.keep.read_text())
        if arguments.keep and arguments.keep.exists()
        else {}
    )
    writing = Lock()

    def remember(key: str, root: Path, mutant: Mutant) -> str:
        if key not in kept:
            began = time.perf_counter()
            tests = tests_of(root, mutant.path)
            outcome = judge(root, mutant, tests)
            note(f"{outcome:8s} {time.perf_counter() - began:4.0f} s  {key}")
            with writing:
                kept[key] = outcome
                if arguments.keep:
                    arguments.keep.write_text(json.dumps(kept, indent=1))
        return kept[key]

    def judged(keys: list[str], root: Path, mutants: list[Mutant]) -> list[str]:
        with ThreadPoolExecutor(arguments.workers) as pool:
            return list(pool.map(remember, keys, [root] * len(keys), mutants))

    outcomes = judged([f"{m.name} {m.after}" for m in mutants], root, mutants)
    survivors = [
        m for m, outcome in zip(mutants, outcomes, strict=True) if outcome == "survived"
    ]
    figures = {
        "mutants": len(mutants),
        "survived": len(survivors),
        "survival": round(len(survivors) / len(mutants), 3),
    }
    said = ["not judged"] * len(survivors)
    if arguments.against:
        old_root = arguments.against.resolve()
        older = [same_fault(m, old_root) for m in survivors]
        there = [o for o in older if o]
        answers = iter(
            judged([f"older {o.name} {o.after}" for o in there], old_root, there)
        )
        said = [next(answers) if o else "not there" for o in older]
        figures |= {
            "found_by_older_tests": sum(
                s not in ("survived", "not there") for s in said
            )
        }
    rows = [
        [m.name, m.before[:60], m.after[:70], s]
        for m, s in zip(survivors, said, strict=True)
    ]
    print_table(["survivor", "before", "fault", "older tests"], rows)
    if arguments.against:
        figures |= {
            "not_comparable": said.count("not there"),
            "passed": figures["found_by_older_tests"] == 0,
        }
    conclude({"passed": True} | figures, is_quick=arguments.quick)


if __name__ == "__main__":
    main()
