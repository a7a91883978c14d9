"""Materials that look at their mesh as a whole: one of which faces are gone would look otherwise where it stays."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

# Light inside the surface, which needs it closed; and what is near, of the same mesh
NODES = frozenset(
    f"ShaderNode{kind}"
    for kind in (
        "SubsurfaceScattering", "VolumeAbsorption", "VolumeScatter", "VolumePrincipled", "VolumeCoefficients",
        "AmbientOcclusion", "Bevel", "Raycast"
    )
)
# of the Geometry node: made from neighbours, and from what hangs together
OUTPUTS = ("Pointiness", "Random Per Island")
FLAT = ("True Normal", "Parametric")  # of the same: of one triangle


def needs_whole_mesh(material: Any) -> bool:
    """Whether a material, or None, shades a face by others of its mesh."""
    return material is not None and _has(material.node_tree, _node_looks_around, set())


def reads_triangles(material: Any) -> bool:
    """Whether a material, or None, shows how its mesh is made of triangles."""
    return material is not None and _has(material.node_tree, _node_reads_triangles, set())


def _has(tree: Any, test: Callable[[Any], bool], seen: set[int]) -> bool:
    """Whether a node of a tree, or of a group in it, passes a test."""
    if tree is None or tree.as_pointer() in seen:
        return False
    seen.add(tree.as_pointer())
    return any(test(node) or _has(getattr(node, "node_tree", None), test, seen) for node in tree.nodes)


def _node_reads_triangles(node: Any) -> bool:
    if node.bl_idname == "ShaderNodeNewGeometry":
        return any(node.outputs[name].is_linked for name in FLAT if name in node.outputs)
    return bool(node.bl_idname == "ShaderNodeWireframe")


def _node_looks_around(node: Any) -> bool:
    if node.bl_idname in NODES:
        return True
    if node.bl_idname == "ShaderNodeNewGeometry":
        return any(node.outputs[name].is_linked for name in OUTPUTS if name in node.outputs)
    weight = node.inputs.get("Subsurface Weight") if node.bl_idname == "ShaderNodeBsdfPrincipled" else None
    return weight is not None and (weight.is_linked or weight.default_value > 0)
