"""The house: which module may import which, how large folders, modules and classes may be."""

from __future__ import annotations

import ast
import fnmatch
import re
import tomllib
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import lipac
from lipac.scripts.dev.pages import architecture_page

ROOT = Path(lipac.__file__).parent
FOLDERS = ("core", "page", "lipac_addon", "scripts")
MODULES_TO_A_FOLDER, LINES_TO_A_MODULE, LINES_TO_A_CLASS = 12, 400, 200

# Each imports from floors above it in this list, and from its own. A module belongs to the longest name that fits it.
FLOORS = (
    "version core.arrays core.errors core.progress",
    "core.jit core",
    "core.files",
    "core.scene",
    "core.accel",
    "core.feedback",
    "core.error_budget",
    "core.tracing.bsdf",
    "core.tracing.lights core.tracing.textures core.tracing.surface",
    "core.tracing",
    "core.culling",
    "core.hybrid",
    "core.evaluation",
    "page",
    "core.warmup",
    "lipac_addon.console lipac_addon.keys lipac_addon.timeline lipac_addon.depsgraph lipac_addon.pictures "
    "lipac_addon.images lipac_addon.roles lipac_addon.attributes lipac_addon.coarsening",
    "lipac_addon.extract.materials",
    "lipac_addon.extract.geometry",
    "lipac_addon.extract",
    "lipac_addon.open lipac_addon.raster lipac_addon.writeback lipac_addon.memory",
    "lipac_addon.batch.engines",
    "lipac_addon.demo lipac_addon.batch",
    "lipac_addon.farm",
    "lipac_addon.farm.jobs",
    "lipac_addon.ui.state",
    "lipac_addon.ui.jobs",
    "lipac_addon.ui.draw",
    "lipac_addon.ui",
    "lipac_addon lipac_addon.family_trial lipac_addon.library",
    "lipac",
    "scripts",
    "tests scripts.dev",
)


@cache
def sources() -> dict[str, Path]:
    """Files of the package by module name without `lipac.`; `lipac` itself by that name."""
    found = {"lipac": ROOT / "__init__.py", "version": ROOT / "version.py"}
    for folder in FOLDERS:
        for path in (ROOT / folder).rglob("*.py"):
            found[".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")] = path
    return found


@cache
def tree(name: str) -> ast.Module:
    """The parsed module of a name."""
    return ast.parse(sources()[name].read_text())


def imports(name: str) -> set[str]:
    """Names of our modules that a module imports, wherever that stands: in functions and for types alone, too."""
    found = set()
    package = name.split(".") if sources()[name].name == "__init__.py" else name.split(".")[:-1]
    package = [] if name == "lipac" else package
    for node in ast.walk(tree(name)):
        if isinstance(node, ast.ImportFrom) and node.level:
            base = package[: len(package) - node.level + 1] + (node.module.split(".") if node.module else [])
            for alias in node.names:
                module = ".".join([*base, alias.name])
                found.add(module if module in sources() else ".".join(base) or "lipac")
    return found - {name}


@cache
def graph() -> dict[str, set[str]]:
    """What each module imports."""
    return {name: imports(name) for name in sources()}


def floor(name: str) -> int:
    """The floor of a module: an index of FLOORS."""
    parts = name.split(".")
    for k in range(len(parts), 0, -1):
        for number, names in enumerate(FLOORS):
            if ".".join(parts[:k]) in names.split():
                return number
    raise AssertionError(f"{name} is on no floor: add it to FLOORS")


def test_nothing_is_imported_in_a_circle() -> None:
    needs = {name: {used for used in of if used in sources()} for name, of in graph().items()}
    assert needs["core.culling.loop"] >= {"core.accel.blas", "core.culling.frame_tracer"}  # or nothing was read
    list(TopologicalSorter(needs).static_order())  # raises CycleError


def test_no_import_goes_upwards() -> None:
    up = [f"{name} imports {used}" for name, of in graph().items() for used in of if floor(used) > floor(name)]
    assert not up


@pytest.mark.parametrize("folder", FOLDERS)
def test_folders_are_small(folder: str) -> None:
    for path in (ROOT / folder, *(p for p in (ROOT / folder).rglob("*") if p.is_dir() and p.name != "__pycache__")):
        modules = [p.name for p in path.glob("*.py") if p.name != "__init__.py"]
        assert len(modules) <= MODULES_TO_A_FOLDER, f"{path.relative_to(ROOT)}: {sorted(modules)}"


def test_rooms_say_what_lives_there() -> None:
    for name, path in sources().items():
        if path.name == "__init__.py" and name != "lipac":
            assert ast.get_docstring(tree(name)), name


def test_modules_and_classes_are_short() -> None:
    modules = {name: len(path.read_text().splitlines()) for name, path in sources().items()}
    assert not {name: lines for name, lines in modules.items() if lines > LINES_TO_A_MODULE}
    classes = {
        f"{name}.{node.name}": (node.end_lineno or 0) - node.lineno + 1
        for name in sources()
        for node in ast.walk(tree(name))
        if isinstance(node, ast.ClassDef)
    }
    assert not {name: lines for name, lines in classes.items() if lines > LINES_TO_A_CLASS}


def test_the_user_interface_hides_no_import_of_its_own() -> None:
    for name in sources():
        if name.startswith("lipac_addon.ui"):
            inside = {
                node
                for function in ast.walk(tree(name))
                if isinstance(function, ast.FunctionDef)
                for node in ast.walk(function)
            }
            for node in inside:
                if isinstance(node, ast.ImportFrom) and node.level:
                    depth = len(name.split(".")) - node.level + (sources()[name].name == "__init__.py")
                    base = [*name.split(".")[:depth], *(node.module or "").split(".")]
                    assert base[:2] != ["lipac_addon", "ui"], (name, node.lineno)


def test_the_diagrams_are_current() -> None:
    """`python -m lipac.scripts.dev.pages` draws them."""
    text = architecture_page.PAGE.read_text()
    assert "culling --> tracing" in text
    assert architecture_page.page(text) == text


def test_names_that_vulture_cannot_see_used_are_still_there() -> None:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["vulture"]
    words = {word for path in sources().values() for word in re.findall(r"\w+", path.read_text())}
    assert not [name for name in settings["ignore_names"] if not fnmatch.filter(words, name)]
