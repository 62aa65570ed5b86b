"""The house: which room may import which, and how large a file may grow. docs/reference/house.md draws it."""

import ast
import importlib
import inspect
import re
import sys
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

import fpcal_bayes

PACKAGE = Path(fpcal_bayes.__file__).parent

#: From the ground up: a room imports from itself and from rooms further left.
FLOORS = (
    "core",
    "model",
    "measure",
    "io",
    "fringes",
    "simulator",
    "motion",
    "rig",
    "infer",
    "tracking",
    "decision",
    "analysis",
    "study",
    "report",
    "cli",
)
MODULES = {
    ".".join(("fpcal_bayes", *path.relative_to(PACKAGE).with_suffix("").parts)): path for path in PACKAGE.rglob("*.py")
}


def imported(tree: ast.AST) -> Iterator[tuple[str, ast.stmt]]:
    """Every module of the package that a syntax tree imports, with the statement."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            whole = [f"{node.module}.{alias.name}" for alias in node.names]
            names = [name if name in MODULES else str(node.module) for name in whole]
        else:
            continue
        for name in names:
            if name.split(".")[0] == "fpcal_bayes":
                yield name, node


def floor(module: str) -> int:
    parts = module.split(".")
    return FLOORS.index(parts[1]) if len(parts) > 1 and parts[1] in FLOORS else len(FLOORS)


TREES = {name: ast.parse(path.read_text(encoding="utf-8")) for name, path in MODULES.items()}


def test_every_room_has_a_floor():
    rooms = {path.name for path in PACKAGE.iterdir() if path.is_dir() and (path / "__init__.py").exists()}
    assert rooms == set(FLOORS)


def test_no_arrow_points_upwards():
    upward = [
        f"{name} -> {other}"
        for name, tree in TREES.items()
        for other, _ in imported(tree)
        if name not in ("fpcal_bayes.__init__", "fpcal_bayes.__main__") and floor(other) > floor(name)
    ]
    assert upward == []


def test_no_circle():
    graph = {name: {other for other, _ in imported(tree) if other != name} for name, tree in TREES.items()}
    # The face of the package names everything and is imported by nothing.
    graph.pop("fpcal_bayes.__init__")
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(f"circle: {' -> '.join(error.args[1])}")


#: Libraries that are an extra, or that take long to import and are not always needed.
SLOW = {"arviz_base", "arviz_stats", "matplotlib", "nptdms", "pandas", "xarray"}


def test_imports_stand_at_the_top():
    """A function imports a slow library at most; `cli.main` alone loads what a command runs when it is known which."""
    inside = []
    for name, tree in TREES.items():
        for function in ast.walk(tree):
            if isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef):
                for node in ast.walk(function):
                    if isinstance(node, ast.Import | ast.ImportFrom):
                        source = node.names[0].name if isinstance(node, ast.Import) else str(node.module)
                        if source.split(".")[0] not in SLOW:
                            inside.append(f"{name}.{function.name}: {source}")
    assert inside == []


def test_one_import_waits_in_the_program():
    """What a command runs is loaded by its name, in one place; options need nothing that is slow to import."""
    waiting = [name for name, tree in TREES.items() for node in ast.walk(tree) if is_deferred_import(node)]
    # The other one loads the names of a room when they are first used.
    assert sorted(waiting) == ["fpcal_bayes.cli.main", "fpcal_bayes.core.lazy"]
    options = {"fpcal_bayes.cli.arguments", "fpcal_bayes.cli.main"}
    light = {f"fpcal_bayes.core.{name}" for name in ("errors", "resources", "version")} | options
    assert {other for name in options for other, _ in imported(TREES[name])} <= light
    standard = {
        alias.name if isinstance(node, ast.Import) else node.module
        for name in options
        for node in ast.walk(TREES[name])
        if isinstance(node, ast.Import | ast.ImportFrom)
        for alias in node.names
    }
    assert {name.split(".")[0] for name in standard} - {"fpcal_bayes"} <= sys.stdlib_module_names


def is_deferred_import(node: ast.AST) -> bool:
    return isinstance(node, ast.Call) and ast.unparse(node.func).split(".")[-1] in ("import_module", "__import__")


def test_report_computes_nothing():
    """It may name types and constants of the rooms that compute; their functions are called in `analysis`."""
    computing = tuple(f"fpcal_bayes.{room}." for room in ("fringes", "infer", "tracking", "decision"))
    called = []
    for name, tree in TREES.items():
        if not name.startswith("fpcal_bayes.report."):
            continue
        for other, statement in imported(tree):
            if not other.startswith(computing):
                continue
            source = importlib.import_module(other)
            for alias in statement.names:
                # A whole module would bring its functions.
                found = getattr(source, alias.name, source)
                if inspect.ismodule(found) or inspect.isroutine(inspect.unwrap(found)):
                    called.append(f"{name} imports {other}.{alias.name}")
    assert called == []


@pytest.mark.parametrize("name", sorted(MODULES))
def test_files_are_short(name):
    assert len(MODULES[name].read_text(encoding="utf-8").splitlines()) <= 400


def test_studies_docs_and_benchmarks_know_the_faces_only():
    """They import from the package or from a room; kernels' benchmarks time what has no public name."""
    root, deep = PACKAGE.parent, []
    places = [path for folder in ("studies", "benchmarks") for path in (root / folder).glob("**/*.py")]
    for path in (*places, *(root / "docs").glob("**/*.md")):
        named = re.findall(r"(?:from|import) (fpcal_bayes(?:\.\w+)+)", path.read_text(encoding="utf-8"))
        far = [name for name in named if len(name.split(".")) > 2 and not re.search(r"\.kernels(\.|$)", name)]
        deep += [f"{path.relative_to(root)}: {name}" for name in far]
    assert deep == []
