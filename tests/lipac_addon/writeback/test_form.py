"""A mesh that was edited is told from one that was not; what is selected or hidden is no edit."""

from __future__ import annotations

from collections.abc import Callable

import bpy
import pytest

from lipac.lipac_addon.writeback.form import is_edited, is_sealed, seal, unseal


def move(mesh: bpy.types.Mesh) -> None:
    mesh.vertices[0].co.x += 0.1


def unwrap(mesh: bpy.types.Mesh) -> None:
    mesh.uv_layers[0].uv[0].vector.x += 0.1


def assign(mesh: bpy.types.Mesh) -> None:
    mesh.polygons[0].material_index = 1


def more(mesh: bpy.types.Mesh) -> None:
    mesh.vertices.add(1)


@pytest.mark.parametrize(
    "edit",
    [move, unwrap, assign, more, lambda mesh: mesh.flip_normals(), lambda mesh: mesh.materials.append(None)],
)
def test_edits_are_told(new_file: bpy.types.Scene, edit: Callable[[bpy.types.Mesh], None]) -> None:
    bpy.ops.mesh.primitive_cube_add()
    mesh = bpy.context.object.data
    assert not is_sealed(mesh) and not is_edited(mesh)
    seal(mesh)
    mesh.name, mesh.vertices[1].select, mesh.polygons[1].hide = "other", False, True
    assert is_sealed(mesh) and not is_edited(mesh)
    edit(mesh)
    assert is_edited(mesh)
    unseal(mesh)
    assert not mesh.keys() and not is_edited(mesh)
