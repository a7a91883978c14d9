"""Large meshes by parts: all of a mesh is in its parts, paths ask for them, and what nobody asks for is neither built
nor read."""

from __future__ import annotations

import dataclasses
import weakref
from collections.abc import Sequence

import numpy as np
import pytest

from lipac.core.accel.blas import BlasCache
from lipac.core.culling.analysis import analyze, decide
from lipac.core.culling.certificate import TOLERATED, Certificate
from lipac.core.culling.division import PART, Division, Parts
from lipac.core.culling.loop import Loop
from lipac.core.culling.options import CullOptions
from lipac.core.error_budget.budget import Budget
from lipac.core.evaluation.judge import Judge
from lipac.core.feedback.tiles import TILES
from lipac.core.files.scratch import Scratch
from lipac.core.scene import model as s
from lipac.core.scene.mesh import DIVIDED_LEAST, DIVIDED_MOST, Mesh, MeshSequence, divided_from

from .. import scenes
from .test_budget_cases import CAMERA, facing, material, sun

SIZE = (96, 54)
OPTIONS = CullOptions(width=SIZE[0], max_error=Budget(0.01, 0.05), parts=True)
FLAGS = np.uint8(s.ALL_RAYS | s.InstanceFlag.DIVISIBLE)


def grid(side: int, quads: bool = True) -> Mesh:
    """A unit square in the xy plane of side x side squares with a little relief, of two triangles each, which are one
    face where quads says so."""
    x, y = (c.ravel() for c in np.meshgrid(*2 * [np.linspace(-1, 1, side + 1)], indexing="ij"))
    positions = np.stack([x, y, 0.02 * np.sin(9 * x) * np.cos(7 * y)], axis=1).astype(np.float32)
    corner = (np.arange(side)[:, None] * (side + 1) + np.arange(side)).ravel()
    triangles = (
        np.stack([corner, corner + side + 1, corner + side + 2, corner, corner + side + 2, corner + 1], axis=1)
        .reshape(-1, 3)
        .astype(np.uint32)
    )
    return Mesh(positions, triangles, faces=np.arange(len(triangles), dtype=np.int32) // 2 if quads else None)


def terrain(
    flags: np.uint8 = FLAGS, side: int = 100, emission: float = 0.0, meshes: Sequence[Mesh] | None = None
) -> s.Scene:
    """A camera near the ground of a terrain of one mesh, and a cube on it that is too small to be divided."""
    return scenes.build(
        list(meshes or [grid(side), scenes.cube()]),
        [(0, scenes.placed((0, 0, 0), 60.0), 0), (1, scenes.placed((0, 4, 0.5), 0.5), 1)],
        [material(base_color=0.6, emission=emission), material(base_color=0.2)],
        CAMERA,
        sun((1, 0, 1)),
        (0.4, 0.5, 0.7),
        SIZE,
        s.PathLimits(total=1, diffuse=1),
        np.full(2, flags, np.uint8),
    )


def test_each_triangle_is_in_one_part_and_in_its_box() -> None:
    mesh = grid(40)
    parts = Parts.of(mesh, Scratch())
    count = -(-len(mesh.triangles) // PART)
    assert len(parts.boxes) == count
    rows = []
    for number in range(count):
        part = parts.part(number)
        corners = part.positions[part.triangles]
        assert 0 < len(part.triangles) <= PART
        assert len(np.unique(part.triangles)) == len(part.positions)  # vertices of its own, no others
        assert (corners >= parts.boxes[number, 0]).all()
        assert (corners <= parts.boxes[number, 1]).all()
        rows.append(corners.reshape(len(corners), 9))
    whole = mesh.positions[mesh.triangles].reshape(-1, 9)
    assert np.array_equal(np.unique(np.concatenate(rows), axis=0), np.unique(whole, axis=0))
    assert parts.faces(np.ones(count, bool)).all()
    one = parts.faces(np.arange(count) == 3)
    assert PART // 2 <= one.sum() <= PART  # squares, some of them with one triangle in another part


def test_all_that_belongs_to_triangles_goes_with_them() -> None:
    mesh, rng = grid(40), np.random.default_rng(0)
    n = len(mesh.triangles)
    normals, uvs = rng.random((n, 3, 3), np.float32), rng.random((2, n, 3, 2), np.float32)
    mesh = Mesh(mesh.positions, mesh.triangles, normals, uvs, rng.integers(0, 9, n).astype(np.uint16))
    parts = Parts.of(mesh, Scratch())
    part, chosen = parts.part(5), parts.order[5 * PART : 6 * PART]
    assert part.normals is not None and part.uvs is not None and part.slots is not None
    assert np.array_equal(part.positions[part.triangles], mesh.positions[mesh.triangles[chosen]])
    assert np.array_equal(part.normals, mesh.normals[chosen])  # type: ignore[index]
    assert np.array_equal(part.uvs, mesh.uvs[:, chosen])  # type: ignore[index]
    assert np.array_equal(part.slots, mesh.slots[chosen])  # type: ignore[index]
    by_vertex = Mesh(mesh.positions, mesh.triangles, rng.random(mesh.positions.shape, np.float32))
    part = Parts.of(by_vertex, Scratch()).part(5)
    assert part.normals is not None and by_vertex.normals is not None
    assert np.array_equal(part.normals[part.triangles], by_vertex.normals[mesh.triangles[chosen]])


def test_a_terrain_keeps_the_budget_by_few_of_its_triangles() -> None:
    """By 64 fresh paths per pixel of another seed, less two of their deviations."""
    loop = Loop(terrain(), OPTIONS)
    result = decide(loop)
    whole = analyze(terrain(), CullOptions(width=SIZE[0], max_error=OPTIONS.max_error))
    assert result.active.all()
    assert len(result.active) == 2
    assert result.stats["triangles"] < 0.5 * whole.stats["triangles"]
    change = Judge(loop.scene, 64).change(loop.activation.kept)
    assert change.mean - 2 * change.mean_deviation <= OPTIONS.max_error.mean
    assert change.worst - 2 * change.worst_deviation <= OPTIONS.max_error.worst
    assert change.mean > 0  # something that matters a little went
    assert result.hits[0].sum() > 0
    assert list(result.faces) == [0]
    kept = int(result.faces[0].sum())
    assert 0 < kept < 0.5 * 100 * 100
    assert result.stats["triangles"] - 12 <= 2 * kept  # a square stays with one of its triangles


def test_parts_are_the_same_at_any_number_of_threads() -> None:
    one, two = (
        analyze(terrain(), CullOptions(width=SIZE[0], parts=True, threads=threads)).faces[0] for threads in (1, 2)
    )
    assert np.array_equal(one, two)


def test_whole_meshes_are_never_built_where_parts_are(monkeypatch: pytest.MonkeyPatch) -> None:
    build, sizes = BlasCache._build, list[int]()

    def counted(self: BlasCache, index: int, mesh: Mesh) -> object:
        sizes.append(len(mesh.triangles))
        return build(self, index, mesh)

    monkeypatch.setattr(BlasCache, "_build", counted)
    analyze(terrain(), OPTIONS)
    assert 0 < max(sizes) <= PART
    assert sum(sizes) < 2 * 100 * 100


class Read(list[Mesh]):
    """Meshes that note which of them are read."""

    def __init__(self, meshes: Sequence[Mesh]) -> None:
        super().__init__(meshes)
        self.read: set[int] = set()

    def __getitem__(self, index):  # type: ignore[no-untyped-def]
        self.read.add(index)
        return super().__getitem__(index)


def test_what_no_path_asks_for_is_never_read() -> None:
    """A large mesh behind the camera, before a wall that the sun shines on from the front."""
    meshes = Read([scenes.quad(), grid(80)])
    wall = (0, facing((1, 0, 0), (0, -1, 0), (0, 3, 0), 40, 40), 0)
    look, flags = scenes.look_at((0, -8, 0.5), (0, 0, 0.5)), np.full(2, FLAGS, np.uint8)
    placement, limits = [wall, (1, scenes.placed((0, -90, 0), 3.0), 0)], s.PathLimits(total=1, diffuse=0)
    scene = scenes.build(meshes, placement, None, look, sun((0, -1, 1)), (0, 0, 0), SIZE, limits, flags)
    meshes.read.clear()
    result = analyze(scene, OPTIONS)
    assert result.active.tolist() == [True, False]
    assert meshes.read == {0}
    assert result.faces == {}


class Fresh(MeshSequence):
    """Meshes that are made anew each time they are read; most: how many were there at a time; read: which, one by
    one."""

    def __init__(self, meshes: Sequence[Mesh]) -> None:
        self._meshes = meshes
        self._made: list[weakref.ref[np.ndarray]] = []
        self.most = 0
        self.read: list[int] = []

    def __len__(self) -> int:
        return len(self._meshes)

    def mesh(self, index: int) -> Mesh:
        self.read.append(index)
        made = dataclasses.replace(self._meshes[index], triangles=self._meshes[index].triangles.copy())
        self._made = [ref for ref in self._made if ref() is not None] + [weakref.ref(made.triangles)]
        self.most = max(self.most, len(self._made))
        return made


def test_whole_meshes_are_not_held_for_their_parts() -> None:
    """One at a time, which is read once."""
    whole = [grid(70) for _ in range(6)]
    places = [(k, scenes.placed((8 * k - 20, 6, 0), 4.0), 0) for k in range(6)]
    limits, flags = s.PathLimits(total=1, diffuse=1), np.full(6, FLAGS, np.uint8)
    scene = scenes.build(whole, places, None, CAMERA, sun((1, 0, 1)), (0.4, 0.5, 0.7), SIZE, limits, flags)
    meshes = Fresh(whole)
    found = analyze(dataclasses.replace(scene, meshes=meshes), OPTIONS)
    assert len(found.faces) > 3
    assert meshes.most <= 2  # one, and the next
    assert meshes.read == sorted(set(meshes.read))


def test_parts_that_stay_are_built_once_a_path_needs_them() -> None:
    """Ground behind a wall: no path meets it, until the wall is culled; then it changes the picture by what it would,
    had it been built from the start."""
    wall = (1, facing((1, 0, 0), (0, -1, 0), (0, 3, 0), 90, 60), 1)
    scene = scenes.build(
        [grid(100), scenes.quad()],
        [(0, scenes.placed((0, 0, 0), 30.0), 0), wall],
        [material(base_color=0.6), material(base_color=0.2)],
        CAMERA,
        sun((1, 0, 1)),
        (0.4, 0.5, 0.7),
        SIZE,
        s.PathLimits(total=1, diffuse=1),
        np.array([FLAGS, s.ALL_RAYS], np.uint8),
    )
    loops = [Loop(scene, OPTIONS) for _ in range(2)]
    found = []
    for loop, all_built in zip(loops, (False, True), strict=True):
        loop.run()
        hidden = np.flatnonzero(loop.activation.exists & (loop.scene.instances.bounds[:, 0, 1] > 10))
        assert len(hidden) > 10
        if all_built:
            loop.activation.activate(loop.activation.exists)
        judge, keep = Certificate(loop, 1 << 16, np.full(TILES, 4), OPTIONS.max_error), loop.activation.exists.copy()
        assert judge.judge(keep).mean <= TOLERATED * OPTIONS.max_error.mean  # by boxes that nobody opened
        assert loop.activation.active[hidden].all() == all_built
        keep[1] = False
        found.append(judge.judge(keep, doubts=False))
        assert loop.activation.active[hidden].mean() > 0.5
    assert found[0].mean > 0.1
    assert np.allclose(found[0].tiles, found[1].tiles, rtol=0.01)  # but for such boxes


def test_meshes_with_a_share_of_all_triangles_are_divided() -> None:
    """Where others have a hundred times as many, it is neither divided nor read for that."""
    small = grid(20)
    for others, divided in ((0, True), (100, False)):
        meshes = Read([small, scenes.cube()])
        scene = terrain(meshes=[small, scenes.cube()])
        count = np.array([len(small.triangles), 12 + others * len(small.triangles)], np.int64)
        scene = dataclasses.replace(scene, meshes=meshes, triangles=count)
        division = Division(scene)
        assert division.divide(np.ones(2, bool)) == divided
        assert (0 in meshes.read) == divided
        assert len(division.owner) == (-(-len(small.triangles) // PART) if divided else 0)
    assert divided_from(None) == divided_from(np.full(9, 10**9)) == DIVIDED_MOST
    assert divided_from(np.array([100_000, 50_000])) == 1500
    assert divided_from(np.array([12])) == DIVIDED_LEAST == 2 * PART


@pytest.mark.parametrize("why", ["not flagged", "small", "emits", "shared", "pinned", "switched off"])
def test_what_is_not_divided(why: str) -> None:
    scene, options, pinned = terrain(), OPTIONS, None
    if why == "not flagged":
        scene = terrain(np.uint8(s.ALL_RAYS))
    elif why == "small":
        scene = terrain(side=int((DIVIDED_MOST / 2) ** 0.5) - 1)
    elif why == "emits":
        scene = terrain(emission=1.0)
    elif why == "shared":
        places, flags = [(0, scenes.placed((x, 0, 0), 30.0), 0) for x in (-30, 30)], np.full(2, FLAGS, np.uint8)
        scene = scenes.build([grid(100)], places, None, CAMERA, sun((1, 0, 1)), size=SIZE, flags=flags)
    elif why == "pinned":
        pinned = np.array([True, False])
    else:
        options = CullOptions(width=SIZE[0])
    assert not Division(scene).divide(np.zeros(2, bool))
    result = analyze(scene, options, pinned=pinned)
    assert result.faces == {}
    assert "parts" not in result.stats or result.stats["parts"] == 0
    assert result.active[0]
