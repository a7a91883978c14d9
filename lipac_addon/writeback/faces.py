"""The face modifier: geometry nodes that delete single faces of an object's mesh, after all its other modifiers.

The culled faces are a boolean attribute on the points of a mask mesh, as those of instances are (`mask`). What stays is
shaded as before: normals at the cut would be those of fewer faces, so where a face is smooth its normals are kept as
custom ones first.
"""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from . import mask

NAME = f"{mask.NAME} of faces"


def add(ob: bpy.types.Object, culled: NDArray[np.bool_]) -> None:
    """Append the modifier that deletes the faces culled (F,) bool, by their numbers behind the other modifiers, from
    renders, as long as there are F of them: an edit that adds or removes some numbers them anew."""
    group = next((g for g in bpy.data.node_groups if mask.is_ours(g) and g.name.startswith(NAME)), None) or _new_group()
    mask.append(ob, group, NAME, {"Mask": mask.mask_object(culled, None)})


def _new_group() -> bpy.types.NodeTree:
    """The node group: inputs Geometry and Mask (object), output Geometry."""
    group = mask.new_group(NAME, (("Mask", "Object"),))
    nodes = mask.Nodes(group)
    inputs, output = nodes.new("NodeGroupInput"), nodes.new("NodeGroupOutput")
    points = nodes.new("GeometryNodeObjectInfo", {"Object": inputs.outputs["Mask"]}).outputs["Geometry"]
    named = nodes.field("GeometryNodeInputNamedAttribute", {"Name": mask.ATTRIBUTE}, data_type="BOOLEAN")
    sampled: dict[str, Any] = {"data_type": "BOOLEAN", "domain": "POINT", "clamp": False}
    goes = nodes.field(
        "GeometryNodeSampleIndex",
        {"Geometry": points, "Value": named, "Index": nodes.field("GeometryNodeInputIndex")},
        **sampled,
    )
    geometry = inputs.outputs["Geometry"]
    sizes = [
        next(
            s
            for s in nodes.new("GeometryNodeAttributeDomainSize", {"Geometry": of}, component="MESH").outputs
            if s.name == name
        )
        for of, name in ((points, "Point Count"), (geometry, "Face Count"))
    ]
    same = nodes.field("FunctionNodeCompare", {"A": sizes[0], "B": sizes[1]}, data_type="INT", operation="EQUAL")
    goes = nodes.both("AND", goes, same)
    smooth = nodes.field("GeometryNodeInputShadeSmooth")
    some = nodes.field(
        "GeometryNodeAttributeStatistic",
        {"Geometry": geometry, "Attribute": smooth},
        output=4,
        data_type="FLOAT",
        domain="FACE",
    )
    normal = nodes.field("GeometryNodeInputNormal")
    fixed = nodes.field(
        "GeometryNodeSetMeshNormal", {"Mesh": geometry, "Custom Normal": normal}, mode="FREE", domain="CORNER"
    )
    shaded = nodes.field(
        "GeometryNodeSwitch", {"Switch": some, "False": geometry, "True": fixed}, input_type="GEOMETRY"
    )
    nodes.link(
        nodes.field("GeometryNodeDeleteGeometry", {"Geometry": shaded, "Selection": goes}, mode="ALL", domain="FACE"),
        output.inputs["Geometry"],
    )
    return group
