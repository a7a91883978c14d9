"""Modules of the user interface import one way, and none hides an import of another inside a function."""

import ast
from graphlib import TopologicalSorter
from pathlib import Path

from lipac.lipac_addon import ui

FOLDER = Path(ui.__file__).parent


def imported(tree, names):
    """Of the modules that are named, those that a tree imports."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.level == 1:
            found |= {node.module} if node.module else {alias.name for alias in node.names}
    return found & names


def test_no_circles_and_nothing_hidden():
    trees = {path.stem: ast.parse(path.read_text()) for path in FOLDER.glob("*.py")}
    names = trees.keys() - {"__init__"}
    needs = {name: imported(tree, names) for name, tree in trees.items()}
    assert needs["panel"] >= {"operators", "results"}  # or nothing was read
    order = list(TopologicalSorter(needs).static_order())  # raises CycleError
    assert order.index("results") < order.index("job") < order.index("operators") < order.index("panel")
    for name, tree in trees.items():
        for function in ast.walk(tree):
            if isinstance(function, ast.FunctionDef):
                assert not imported(function, names), (name, function.name)
