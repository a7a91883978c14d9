"""Simplified meshes: objects get other data, made of corners of what they had, with all that these bear; and settings
of objects by which renders have fewer triangles.

A level is a copy of the mesh with fewer faces: materials and properties stay, attributes of points, corners and faces
are those of the whole mesh, vertex groups too where an armature goes by them. Normals are kept as custom ones. What the
object had is kept by a pointer of it and put back as where objects are emptied (`emptying`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ...core.files.level import AnyLevel, Level, Steps
from ..coarsening import Setting, setting_of
from . import marks
from .emptying import LEVEL, exchange
from .form import VALUES, seal, values_of

if TYPE_CHECKING:
    from ...core.culling.result import CullingResult
    from ..extract import Extraction

NAME = "LiPaC level"
# what makes the mesh, or is made anew
_OWN = {"position", "custom_normal"}


def levels_of(extraction: Extraction, result: CullingResult) -> dict[str, AnyLevel]:
    """What takes the place of meshes, by full name of the objects that show them, by a result for the frame that was
    extracted. Objects with the same mesh have the same `Level`."""
    # these load kernels: not where an add-on registers
    from ...core.culling.levels.stand_ins import Coarser
    from ..extract.geometry.meshes import corners_of, faces_of

    out: dict[str, AnyLevel] = {}
    mesh, ob = extraction.scene.instances.mesh, extraction.keys.records["object"]
    for number, stand_in in result.stand_ins.items():
        level: AnyLevel
        if isinstance(stand_in, Coarser):
            level = Steps(stand_in.steps)
        else:
            whole = extraction.scene.meshes.sources[number].geometry.mesh  # type: ignore[attr-defined]
            level = Level(corners_of(whole).reshape(-1)[stand_in.corners], faces_of(whole)[stand_in.triangles])
        for name in np.unique(ob[result.active & (mesh == number)]).tolist():
            out[extraction.keys.names[name]] = level
    return out


def coarser_settings(
    levels: Iterable[tuple[bpy.types.Object, AnyLevel]], scene: bpy.types.Scene
) -> Iterator[tuple[bpy.types.Object, Setting, int]]:
    """Objects that have fewer triangles in renders of a scene, by what setting, and what that is to be."""
    for ob, level in levels:
        setting = setting_of(ob, scene)
        if isinstance(setting, Setting) and isinstance(level, Steps):
            yield ob, setting, setting.values[level.steps - 1]


def simplify(levels: Iterable[tuple[bpy.types.Object, Level]]) -> None:
    """Exchange the meshes of objects, which have been marked."""
    made: dict[tuple[str, int], bpy.types.Mesh] = {}
    for ob, level in levels:
        mesh = ob.data
        deforms = len(ob.modifiers) > 0
        key = mesh.name_full, id(level)
        if key not in made:
            made[key] = level_of(mesh, level, turns=deforms)
        groups = [(g.name, g.lock_weight) for g in ob.vertex_groups]
        active = ob.vertex_groups.active_index
        exchange(ob, made[key])
        if deforms and groups:
            _copy_groups(ob, mesh, level, groups, active)


def level_of(mesh: bpy.types.Mesh, level: Level, turns: bool = False) -> bpy.types.Mesh:
    """A new mesh of corners of another. turns: something deforms it, and its normals are to turn with it."""
    corners = level.corners.reshape(-1)
    vertices, index = _vertices(mesh, level)
    count = len(level.faces)
    with marks.making() as made:
        made.append(out := mesh.copy())
        out.name, out.use_fake_user = NAME, False
        out[marks.KEY] = LEVEL
        out.clear_geometry()
        out.vertices.add(len(vertices))
        out.loops.add(3 * count)
        out.polygons.add(count)
        _put(out.attributes["position"], values_of(mesh.attributes["position"])[vertices])
        out.polygons.foreach_set("loop_start", np.arange(0, 3 * count, 3, dtype=np.int32))
        out.loops.foreach_set("vertex_index", index.astype(np.int32))
        out.update(calc_edges=True)
        rows = {"POINT": vertices, "CORNER": corners, "FACE": level.faces}
        for name in [a.name for a in mesh.attributes]:
            source = mesh.attributes[name]
            if source.domain in rows and source.data_type in VALUES and name not in _OWN and not name.startswith("."):
                target = out.attributes.new(name, source.data_type, source.domain)
                _put(target, values_of(source)[rows[source.domain]])
        _mark_active(mesh, out)
        if mesh.normals_domain != "FACE":
            normals: NDArray[np.float32] = np.empty(3 * len(mesh.loops), np.float32)
            mesh.corner_normals.foreach_get("vector", normals)
            _set_normals(out, normals.reshape(-1, 3)[corners], turns)
        # Generated coordinates are those of the whole mesh
        place, size = tuple(mesh.texspace_location), tuple(mesh.texspace_size)
        out.use_auto_texspace = False
        out.texspace_location, out.texspace_size = place, size
        seal(out)
    return out


def _vertices(mesh: bpy.types.Mesh, level: Level) -> tuple[NDArray[np.int32], NDArray[np.intp]]:
    """Which vertices of a mesh a level has, (V,), and the one of these of each of its corners."""
    of_corner: NDArray[np.int32] = np.empty(len(mesh.loops), np.int32)
    mesh.loops.foreach_get("vertex_index", of_corner)
    vertices, index = np.unique(of_corner[level.corners.reshape(-1)], return_inverse=True)
    return vertices, index.reshape(-1)


def _put(attribute: Any, values: NDArray[Any]) -> None:
    attribute.data.foreach_set(VALUES[attribute.data_type][0], np.ascontiguousarray(values).reshape(-1))


def _mark_active(mesh: bpy.types.Mesh, out: bpy.types.Mesh) -> None:
    """Have the same UV map and colours active, in renders too."""
    for layer in mesh.uv_layers:
        if layer.active_render and layer.name in out.uv_layers:
            out.uv_layers[layer.name].active_render = True
    if mesh.uv_layers.active is not None and mesh.uv_layers.active.name in out.uv_layers:
        out.uv_layers.active = out.uv_layers[mesh.uv_layers.active.name]
    for name in ("active_color_name", "default_color_name"):
        if getattr(mesh.attributes, name):
            setattr(out.attributes, name, getattr(mesh.attributes, name))


def _set_normals(mesh: bpy.types.Mesh, normals: NDArray[np.float32], turns: bool) -> None:
    """Custom normals of corners, (C, 3): as they are, or relative to the surface, which Blender turns with it."""
    if turns:
        mesh.normals_split_custom_set(normals)  # type: ignore[arg-type]
    else:
        _put(mesh.attributes.new("custom_normal", "FLOAT_VECTOR", "CORNER"), normals)


def _copy_groups(
    ob: bpy.types.Object, mesh: bpy.types.Mesh, level: Level, groups: list[tuple[str, bool]], active: int
) -> None:
    """Give an object with a level of a mesh its vertex groups again, with the weights of the vertices that are left."""
    for name, locked in groups[len(ob.vertex_groups) :]:
        ob.vertex_groups.new(name=name).lock_weight = locked
    ob.vertex_groups.active_index = active
    vertices, _ = _vertices(mesh, level)
    if any(v.groups for v in ob.data.vertices):  # another object with the same mesh has set them
        return
    for new, old in enumerate(vertices.tolist()):
        for item in mesh.vertices[old].groups:
            ob.vertex_groups[item.group].add([new], item.weight, "REPLACE")
