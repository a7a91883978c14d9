"""crowd: as many figures as asked, each deformed on its own, of any character file; what the camera does not see is not
built."""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np
import pytest

from lipac.core.culling.options import CullOptions
from lipac.core.culling.shot import Shot
from lipac.core.errors import InputError
from lipac.lipac_addon.demo import build, crowd
from lipac.lipac_addon.extract import extract_frame

CHARACTERS = Path(__file__).parents[4] / "shared" / "scenes" / "small"


def shapes(frame: int) -> list[np.ndarray]:
    """Evaluated vertices of every figure, in its own space."""
    bpy.context.scene.frame_set(frame)
    graph = bpy.context.evaluated_depsgraph_get()
    out = []
    for ob in bpy.data.objects:
        if any(m.type == "ARMATURE" for m in ob.modifiers):
            data = ob.evaluated_get(graph).data
            points = np.empty(3 * len(data.vertices), np.float32)
            data.vertices.foreach_get("co", points)
            out.append(points)
    return out


def test_every_figure_has_a_shape_of_its_own_and_moves() -> None:
    build("crowd", 12, 1)
    first, later = shapes(1), shapes(7)
    assert len(first) == 12
    for k in range(12):
        assert np.abs(first[k] - later[k]).max() > 0.01  # metres
        assert all(np.abs(first[k] - first[j]).max() > 1e-3 for j in range(k))
    assert len({ob.parent.name for ob in bpy.data.objects if ob.type == "ARMATURE"}) == 2  # both directions
    walkers = [ob for ob in bpy.data.objects if ob.name.startswith("Walk 0 +1")]
    assert walkers[0].matrix_world.translation.y > 0


def test_the_same_seed_gives_the_same_crowd_and_streets_fill_one_after_the_other() -> None:
    a, b, c = (
        crowd.places(600, np.random.default_rng(4)),
        crowd.places(600, np.random.default_rng(4)),
        crowd.places(600, np.random.default_rng(5)),
    )
    np.testing.assert_array_equal(a, b)
    assert (a != c).any()
    assert np.bincount(a[:, 2].astype(int)).tolist() == [crowd.PER_STREET, crowd.PER_STREET, 100]
    middle = np.array([0.0, 42.0, -42.0])[a[:, 2].astype(int)]
    assert (np.abs(a[:, 0] - middle) < 9.0).all()  # nobody stands in a house
    distance = np.linalg.norm(a[:, None, :2] - a[None, :, :2], axis=2) + 10 * np.eye(600)
    assert distance.min() > 0.2


@pytest.mark.parametrize("name", ["CesiumMan.glb", "Fox.glb", "Knight.glb"])
def test_a_character_file_is_the_figure(name: str) -> None:
    if not (CHARACTERS / name).exists():
        pytest.skip(f"no {CHARACTERS / name}")
    build("crowd", 3, 0, CHARACTERS / name)
    one, other = shapes(1), shapes(9)
    assert any(np.abs(a - b).max() > 1e-3 for a, b in zip(one, other, strict=True))
    graph = bpy.context.evaluated_depsgraph_get()
    figures = [ob.evaluated_get(graph) for ob in bpy.data.objects if any(m.type == "ARMATURE" for m in ob.modifiers)]
    corners = np.concatenate([_world(ob) for ob in figures])
    assert 0.5 < np.ptp(corners[:, 2]) < 2.5  # stands upright, in metres
    assert corners[:, 2].min() > -0.6


def _world(ob: bpy.types.Object) -> np.ndarray:
    matrix = np.array(ob.matrix_world)
    return np.array([tuple(c) for c in ob.bound_box]) @ matrix[:3, :3].T + matrix[:3, 3]


def test_figures_of_other_streets_are_never_built() -> None:
    build("crowd", crowd.PER_STREET + 30, 0)
    bpy.context.scene.render.resolution_x, bpy.context.scene.render.resolution_y = 96, 54
    scene = extract_frame(bpy.context.scene, 1).scene
    shot = Shot(CullOptions(width=96, paths=2, min_share=2e-4))
    result = shot.advance(scene)
    figures = np.flatnonzero(np.bincount(scene.instances.mesh, minlength=len(scene.meshes))[scene.instances.mesh] == 1)
    middle = (scene.instances.bounds.mean(axis=1) + scene.origin)[:, 0]
    other = figures[
        (middle[figures] > 30) & (middle[figures] < 54) & (scene.instances.bounds[figures, 1, 2] + scene.origin[2] < 3)
    ]
    assert len(other) == 30
    assert not result.active[other].any()
    assert result.active[figures].sum() > 10
    assert shot.loop is not None
    assert shot.loop.blas.scenes[scene.instances.mesh[other]].astype(bool).sum() == 0


@pytest.mark.parametrize(
    ("count", "figure", "says"),
    [(0, None, "--instances"), (20_001, None, "--instances"), (3, Path("no.glb"), "no such file")],
)
def test_unusable_requests_say_what_to_do(count: int, figure: Path | None, says: str) -> None:
    with pytest.raises(InputError, match=says):
        build("crowd", count, 0, figure)


def test_a_file_without_a_character_says_so(tmp_path: Path) -> None:
    build("mirror-city", 1000)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "city.blend"))
    with pytest.raises(InputError, match="skeleton"):
        build("crowd", 3, 0, tmp_path / "city.blend")
    with pytest.raises(InputError, match="--figure"):
        build("mirror-city", 1000, 0, tmp_path / "city.blend")
