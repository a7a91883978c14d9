"""Simplified meshes: of what the whole ones have, within the error that they are asked for, seams and materials where
they were."""

from __future__ import annotations

import numpy as np
import pytest

from lipac.core.culling.levels.stand_ins import stand_ins
from lipac.core.scene.mesh import Mesh

from .. import scenes


def plate(side: int = 12, height: float = 0.0) -> Mesh:
    """A square of side x side squares in two triangles each, with UVs, two materials with a straight border between
    them, and a bump in the middle."""
    x, y = (c.ravel() for c in np.meshgrid(*2 * [np.linspace(0, 1, side + 1)], indexing="ij"))
    z = height * np.exp(-40 * ((x - 0.5) ** 2 + (y - 0.5) ** 2))
    a = (np.arange(side)[:, None] * (side + 1) + np.arange(side)).ravel()
    b, c, d = a + side + 1, a + side + 2, a + 1
    triangles = np.stack([a, b, c, a, c, d], axis=1).reshape(-1, 3).astype(np.uint32)
    corners = np.stack([x, y], axis=1)[triangles].astype(np.float32)
    slots = (corners[:, :, 0].mean(axis=1) > 0.5).astype(np.uint16)
    return Mesh(np.stack([x, y, z], axis=1).astype(np.float32), triangles, None, corners[None], slots)


def area(mesh: Mesh) -> np.ndarray:
    """(T,) of each triangle."""
    a, b, c = np.moveaxis(mesh.positions[mesh.triangles].astype(np.float64), 1, 0)
    return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2


def sphere(by_vertex: bool) -> Mesh:
    """A round one, with normals of corners or of vertices."""
    mesh = scenes.sphere(24)
    radial = mesh.positions / np.linalg.norm(mesh.positions, axis=1, keepdims=True)
    return Mesh(mesh.positions, mesh.triangles, radial if by_vertex else radial[mesh.triangles])


def by_corner(mesh: Mesh) -> np.ndarray:
    """(3 T, 3) normals of a mesh that has some."""
    assert mesh.normals is not None
    return mesh.normals.reshape(-1, 3) if mesh.normals.ndim == 3 else mesh.normals[mesh.triangles.reshape(-1)]


@pytest.mark.parametrize("whole", [sphere(False), sphere(True)], ids=["by corner", "by vertex"])
def test_more_error_leaves_less_and_every_corner_is_one_of_the_whole(whole: Mesh) -> None:
    found = stand_ins(whole, [0.001, 0.01, 0.05])
    counts = [len(one) for one in found]
    assert len(whole.triangles) > counts[0] > counts[1] > counts[2] > 8
    for one, error in zip(found, (0.001, 0.01, 0.05), strict=True):
        mesh = one.of(whole)
        radius = np.linalg.norm(mesh.positions[mesh.triangles].astype(np.float64).mean(axis=1), axis=1)
        assert (radius > 1 - 12 * error).all()
        assert whole.normals is not None and mesh.normals is not None
        assert np.allclose(by_corner(mesh), by_corner(whole)[one.corners.reshape(-1)], atol=1e-3)
        assert np.isin(mesh.positions.view("V12"), whole.positions.view("V12")).all()


def test_a_plate_needs_few_triangles_and_each_material_keeps_its_part() -> None:
    whole = plate()
    (found,) = stand_ins(whole, [1e-6])
    mesh = found.of(whole)
    assert len(found) <= 64  # 288 were there; the border has 12 edges
    assert mesh.slots is not None and mesh.uvs is not None
    for slot in (0, 1):
        assert area(mesh)[mesh.slots == slot].sum() == pytest.approx(0.5, abs=1e-6)
    # UVs are what they were where they are
    assert np.allclose(mesh.uvs[0], mesh.positions[mesh.triangles][..., :2])


@pytest.mark.parametrize("apart", [False, True], ids=["shared", "own"])
def test_a_material_in_the_middle_of_another_stays_there(apart: bool) -> None:
    """Whether triangles share their vertices or have their own, as many exporters write them."""
    whole = plate()
    centre = whole.positions[whole.triangles].mean(axis=1)[:, :2]
    slots = (np.abs(centre - 0.5) < 0.25).all(axis=1).astype(np.uint16)
    positions = whole.positions[whole.triangles].reshape(-1, 3) if apart else whole.positions
    triangles = np.arange(len(positions), dtype=np.uint32).reshape(-1, 3) if apart else whole.triangles
    (found,) = stand_ins(mesh := Mesh(positions, triangles, slots=slots), [1e-6])
    assert len(found) < len(whole.triangles) // 2
    left = found.of(mesh)
    assert left.slots is not None
    assert area(left)[left.slots == 1].sum() == pytest.approx(0.25, abs=1e-6)


def test_triangles_without_area_do_not_stand_in_the_way() -> None:
    whole = plate()
    flat = np.array([[0, 0, 1], [2, 3, 3]], np.uint32)
    mesh = Mesh(whole.positions, np.concatenate([flat, whole.triangles]))
    (found,) = stand_ins(mesh, [1e-6])
    assert 2 <= len(found) <= 16
    assert area(found.of(mesh)).sum() == pytest.approx(1.0, abs=1e-6)
    assert (found.triangles >= 2).all()


def test_part_of_a_mesh_names_corners_of_all_of_it() -> None:
    whole, chosen = plate(), np.arange(40, 200, dtype=np.int32)
    assert whole.uvs is not None and whole.slots is not None
    part = Mesh(whole.positions, whole.triangles[chosen], None, whole.uvs[:, chosen], whole.slots[chosen])
    (found,) = stand_ins(part, [1e-6])
    a, b = found.of(part), found.within(chosen).of(whole)
    for x, y in zip(
        (a.positions, a.triangles, a.uvs, a.slots), (b.positions, b.triangles, b.uvs, b.slots), strict=True
    ):
        assert np.array_equal(x, y)  # type: ignore[arg-type]


def test_nothing_comes_of_nothing() -> None:
    empty = Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint32))
    assert sum(map(len, stand_ins(empty, [0.1]))) == 0
