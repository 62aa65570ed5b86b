"""The house: which room may import which, and how large a file may grow. docs/reference/house.md draws it."""

import ast
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


def test_imports_stand_at_the_top():
    """In `cli` a command may defer what it runs, so that the others start without it."""
    inside = []
    for name, tree in TREES.items():
        for function in ast.walk(tree):
            if isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef):
                found = [node for node in ast.walk(function) if isinstance(node, ast.Import | ast.ImportFrom)]
                if found:
                    inside.append((name, function.name, len(found)))
    assert [entry for entry in inside if not entry[0].startswith("fpcal_bayes.cli.")] == []


@pytest.mark.parametrize("name", sorted(MODULES))
def test_files_are_short(name):
    assert len(MODULES[name].read_text(encoding="utf-8").splitlines()) <= 400
