"""The tables of docs/supported.md, from the code: nodes that are followed, what it says of others, what it refuses."""

from __future__ import annotations

import ast
import re
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path

import bpy

from lipac.lipac_addon.extract.materials import nodes, shaders
from lipac.lipac_addon.extract.materials.reader import WORTHLESS

from .architecture_page import ROOT, filled

PAGE = ROOT / "docs" / "supported.md"
SAID = re.compile(
    r"not rendered|rendered (as|by|with)|replaced by|: half|left out|taken for|taken to be|not drawn|"
    r"no lines are|was looked at|not run|alone is rendered|of one moment|as they come out|are combined|"
    r"picture is of|one view is|whole picture is|: black|may differ|is taken to be worth"
)
_REPORTS = {"report", "doubt"}  # functions that take a line for `approximated`
_PLACES = ("lipac_addon/extract", "lipac_addon/batch/engines/wishes.py")
_REFUSALS = ("lipac_addon/extract", "lipac_addon/batch", "lipac_addon/raster", "lipac_addon/open.py")
# No value and no shader of a material: groups and frames are dissolved by Blender, the others are outputs
_STRUCTURE = {
    "GROUP",
    "GROUP_INPUT",
    "GROUP_OUTPUT",
    "FRAME",
    "REROUTE",
    "OUTPUT_MATERIAL",
    "OUTPUT_WORLD",
    "OUTPUT_LIGHT",
    "OUTPUT_AOV",
    "OUTPUT_LINESTYLE",
}
_CONVERTER = {
    "NORMAL_MAP",
    "MAPPING",
    "UVMAP",
    "TEX_COORD",
    "FRESNEL",
    "LAYER_WEIGHT",
}  # followed by whom they are linked to


def page(text: str) -> str:
    """The page's text with its tables written anew."""
    return filled(text, {"nodes": _nodes(), "lines": _listed(approximations()), "refused": _listed(refusals())})


def node_types() -> dict[str, str]:
    """Label by type of the shader nodes that Blender has."""
    tree = bpy.data.node_groups.new("types", "ShaderNodeTree")
    try:
        found = {}
        for name in dir(bpy.types):
            if name.startswith("ShaderNode") and name not in ("ShaderNode", "ShaderNodeTree"):
                try:
                    node = tree.nodes.new(name)
                except RuntimeError:  # a base class, or no node of this kind of tree
                    continue
                found[node.type] = node.bl_label
        return found
    finally:
        bpy.data.node_groups.remove(tree)


def is_followed(kind: str) -> bool:
    """Whether the analysis has a function for a type of node."""
    name = f"node_{kind.lower()}"
    return hasattr(nodes, name) or hasattr(shaders, name) or kind in _CONVERTER


def _nodes() -> str:
    kinds = {kind: label for kind, label in node_types().items() if kind not in _STRUCTURE}
    yes = sorted({label for kind, label in kinds.items() if is_followed(kind)})
    no = sorted({label for kind, label in kinds.items() if not is_followed(kind)} - set(yes))
    texts = (
        f"Followed: {', '.join(yes)}.",
        f"Replaced by a pattern, a constant or an average, or taken as diffuse, which the report says: "
        f"{', '.join(no)}.",
    )
    return "\n\n".join(textwrap.fill(text, 120) for text in texts)


def approximations() -> list[str]:
    """Lines that `approximated` may hold; … stands for a name or a number."""
    said = {text for path in _files(_PLACES) for text in _texts(path) if SAID.search(text)}
    return sorted(text for text in said if not text.startswith((":", " ")))  # what other lines end with


def reported() -> set[str]:
    """Texts that are handed to functions which report: all of them are approximations."""
    found = set()
    for path in _files(_PLACES):
        for call in (node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call)):
            name = call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")
            if name in _REPORTS and call.args:
                found |= {text for node in ast.walk(call.args[0]) if (text := template(node)) and " " in text}
    return {text for text in found if not any(text != other and text.strip("…: ") in other for other in found)}


def refusals() -> list[str]:
    """What `InputError` is raised with."""
    found = set()
    for path in _files(_REFUSALS):
        for node in ast.walk(ast.parse(path.read_text())):
            call = node.exc if isinstance(node, ast.Raise) else None
            if isinstance(call, ast.Call) and getattr(call.func, "id", "") == "InputError":
                found |= {text for text in map(template, call.args) if " " in text}
    return sorted(found)


def _files(places: tuple[str, ...]) -> Iterator[Path]:
    for place in places:
        path = ROOT / place
        yield from sorted(path.rglob("*.py")) if path.is_dir() else [path]


def _texts(path: Path) -> Iterator[str]:
    tree = ast.parse(path.read_text())
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef)
    doc = {
        id(n.body[0].value)
        for n in ast.walk(tree)
        if isinstance(n, documented) and n.body and isinstance(n.body[0], ast.Expr)
    }
    inside = {id(part) for n in ast.walk(tree) if isinstance(n, ast.JoinedStr) for part in n.values}
    yield from (template(n) for n in ast.walk(tree) if id(n) not in doc | inside)


def template(node: ast.AST) -> str:
    """The text of a literal, with … for what is filled in; "" of all else, and of an ending by itself."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return "" if node.value == WORTHLESS else node.value
    if isinstance(node, ast.JoinedStr):
        return "".join(map(_part, node.values))
    return ""


def _part(part: ast.expr) -> str:
    if isinstance(part, ast.Constant):
        return str(part.value)
    value = getattr(part, "value", None)
    return WORTHLESS if isinstance(value, ast.Name) and value.id == "WORTHLESS" else "…"


def _listed(lines: list[str]) -> str:
    return "\n".join(f"- `{line}`" for line in lines)


def main() -> int:
    """Write the tables into the page; the text around them stays."""
    PAGE.write_text(page(PAGE.read_text()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
