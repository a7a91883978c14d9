"""Frames extracted one after the other against each extracted alone, and what is said to have changed against what
did."""

from __future__ import annotations

import gc
import math
import weakref
from collections.abc import Callable, Iterable
from dataclasses import fields
from pathlib import Path
from typing import Any

import bpy
import numpy as np
import pytest

from lipac.core.errors import InputError
from lipac.core.scene.mesh import Mesh
from lipac.core.scene.model import Camera
from lipac.lipac_addon.depsgraph import changed
from lipac.lipac_addon.extract import Extraction, Extractor, extract_frame, extract_world
from lipac.lipac_addon.open import leave_modes, open_scene
from lipac.lipac_addon.pictures import read_picture

from .conftest import add, collection, cube, grid, instance_of, nodes, scattered, wedge

ROWS = ("transform", "slots", "flags", "bounds")
ARRAYS = ("positions", "triangles", "normals", "uvs", "slots")
Step = Callable[[int], None]


def same_bytes(a: Any, b: Any) -> bool:
    """Of records the fields, for numpy leaves what lies between them as it comes."""
    if a is None or b is None:
        return a is b
    if a.shape != b.shape or a.dtype != b.dtype:
        return False
    return all(same_bytes(a[name], b[name]) for name in a.dtype.names) if a.dtype.names else a.tobytes() == b.tobytes()


def named_keys(extraction: Extraction) -> list[tuple[Any, ...]]:
    """Keys with names instead of their indices."""
    names = (*extraction.keys.names, "")
    return [(int(r["kind"]), names[r["host"]], names[r["object"]], r["path"].tolist()) for r in extraction.keys.records]


def assert_same_mesh(a: Mesh, b: Mesh) -> None:
    assert all(same_bytes(getattr(a, name), getattr(b, name)) for name in ARRAYS)


def assert_same(got: Extraction, alone: Extraction) -> None:
    """All arrays are the same, but for the numbers of meshes."""
    a, b = got.scene, alone.scene
    for name in ROWS:
        assert same_bytes(getattr(a.instances, name), getattr(b.instances, name)), name
    assert named_keys(got) == named_keys(alone)
    numbers = dict(zip(a.instances.mesh.tolist(), b.instances.mesh.tolist(), strict=True))
    assert (np.array([numbers[m] for m in a.instances.mesh.tolist()]) == b.instances.mesh).all()
    assert len(set(numbers.values())) == len(numbers)
    for m, n in numbers.items():
        assert same_bytes(a.mesh_bounds[m], b.mesh_bounds[n])
        assert_same_mesh(a.meshes[m], b.meshes[n])
    for m in set(range(len(a.meshes))) - set(numbers):
        assert (a.mesh_bounds[m][0] > a.mesh_bounds[m][1]).all() or not len(a.meshes[m].triangles) or m in unplaced(got)
    assert all(
        same_bytes(getattr(a, name), getattr(b, name)) for name in ("slot_materials", "materials", "lights", "origin")
    )
    assert all(
        same_bytes(getattr(a.textures, name), getattr(b.textures, name)) for name in ("records", "bytes", "floats")
    )
    assert same_bytes(a.world.color, b.world.color)
    assert same_bytes(a.world.image, b.world.image)
    assert all(np.array_equal(getattr(a.camera, f.name), getattr(b.camera, f.name)) for f in fields(Camera))
    names = ("uv_maps", "film", "limits")
    assert [getattr(a, name) for name in names] == [getattr(b, name) for name in names]
    assert set(a.approximated) == set(b.approximated)
    assert set(got.warnings) == set(alone.warnings)


def unplaced(extraction: Extraction) -> set[int]:
    """Meshes that are there and that nothing shows."""
    return set(range(len(extraction.scene.meshes))) - set(extraction.scene.instances.mesh.tolist())


def assert_change(before: Extraction, held: dict[int, Mesh], now: Extraction) -> None:
    """What is not said to have changed has not. held: meshes of the frame before."""
    change = now.change
    assert change is not None
    a, b = before.scene.instances, now.scene.instances
    previous = np.arange(len(b)) if change.previous is None else change.previous
    moved = np.zeros(len(b), bool) if change.moved is None else change.moved
    keys, old_keys = named_keys(now), named_keys(before)
    assert [old_keys[p] for p in previous if p >= 0] == [key for key, p in zip(keys, previous, strict=True) if p >= 0]
    assert {key for key, p in zip(map(repr, keys), previous, strict=True) if p < 0} == set(map(repr, keys)) - set(
        map(repr, old_keys)
    )
    differ = previous < 0
    for name in (*ROWS, "mesh"):
        x, y = getattr(b, name), getattr(a, name)[previous]
        differ |= (x != y).reshape(len(x), -1).any(axis=1)
    np.testing.assert_array_equal(differ, moved)
    assert not set(change.deformed.tolist()) & set(change.replaced.tolist())
    for m, mesh in held.items():
        after = now.scene.meshes[m]
        if m in change.deformed:
            assert same_bytes(mesh.triangles, after.triangles)
            assert not all(same_bytes(getattr(mesh, name), getattr(after, name)) for name in ARRAYS)
        elif m not in change.replaced:
            assert_same_mesh(mesh, after)
    if not change.shading:
        assert same_bytes(before.scene.lights, now.scene.lights)
        assert same_bytes(before.scene.materials, now.scene.materials)
        assert same_bytes(before.scene.slot_materials, now.scene.slot_materials)
    if not change.camera:
        assert same_bytes(before.scene.camera.to_world, now.scene.camera.to_world)


def follow(frames: Iterable[int], step: Step = lambda _: None, keep: bool = True) -> list[Extraction]:
    """Extract frames in a row and alone, and compare. step: called before each frame."""
    scene = bpy.context.scene
    row: list[Extraction] = []
    extractor = Extractor(scene, allow_no_camera=True)
    held: dict[int, Mesh] = {}
    for frame in frames:
        step(frame)
        now = extractor.frame(frame, keep)
        if row:
            assert_change(row[-1], held, now)
        held = {m: now.scene.meshes[m] for m in set(now.scene.instances.mesh.tolist())}
        row.append(now)
    extractor.release()
    for frame, got in zip(frames, row, strict=True):
        step(frame)
        scene.frame_set(frame)
        assert_same(got, extract_frame(scene, frame, allow_no_camera=True))
    return row


@pytest.mark.parametrize("keep", [True, False], ids=["graph kept", "graph anew"])
@pytest.mark.parametrize(
    "name",
    [
        "CesiumMan.glb", "Fox.glb", "Knight.glb", "animation_instanced.blend", "particle_hair.blend",
        "22_simple_GN.blend"
    ],
)
def test_supplied_animations(shared: Path, name: str, keep: bool) -> None:
    """Armatures, particles and animated nodes. Where the graph is kept, the meshes that do not move are not said to
    have changed."""
    open_scene(shared / "small" / name)
    bpy.context.scene.world = None  # of no interest here
    row = follow((1, 2, 2), keep=keep)
    change = row[2].change
    assert change is not None and (change.previous, change.moved, change.camera, change.shading) == (
        None, None, False, False
    )


def key(target: Any, path: str, values: dict[int, Any]) -> None:
    """Keyframes of a property."""
    for frame, value in values.items():
        setattr(target, path, value)
        target.keyframe_insert(path, frame=frame)


def input_key(socket: Any, values: dict[int, Any]) -> None:
    """Keyframes of the value of a node's input."""
    key(socket, "default_value", values)


def test_objects_move_appear_and_vanish() -> None:
    """Rows are found again by their keys; a shared mesh goes with its last user, and its number to the next mesh."""
    mesh = wedge()
    key(add("a", mesh), "hide_render", {1: False, 2: True, 4: False})
    key(add("b", mesh, location=(3, 0, 0)), "location", {1: (3, 0, 0), 3: (3, 1, 0)})
    key(add("c", cube()), "hide_render", {1: False, 2: True, 3: True, 5: False})
    key(add("late", cube("other")), "hide_render", {1: True, 3: True, 4: False})
    add("still", wedge("still"))
    row = follow(range(1, 6))
    assert len(row[-1].scene.meshes) == 4  # as many as there are at a time
    changes = [e.change for e in row[1:]]
    assert all(c is not None and len(c.deformed) == 0 for c in changes)
    assert [e.scene.instances.mesh[-1] for e in row] == [row[0].scene.instances.mesh[-1]] * 5
    assert [len(e.scene.instances) for e in row] == [4, 2, 2, 4, 5]


@pytest.mark.parametrize("keep", [True, False], ids=["graph kept", "graph anew"])
def test_a_mesh_that_loses_all_its_faces(keep: bool) -> None:
    """Its object stays, among objects that are as they were."""
    add("still", wedge())
    build = add("build", cube("built")).modifiers.new("b", "BUILD")
    build.frame_start, build.frame_duration, build.use_reverse = 1, 2, True
    assert [len(e.scene.instances) for e in follow(range(1, 5), keep=keep)] == [2, 2, 1, 1]


def test_shapes_and_topology() -> None:
    """Shape keys, a build modifier, an array whose count is animated, a subdivided mesh that is bent, and n-gons whose
    triangles follow their shape."""
    item = add("shape keys", cube())
    item.shape_key_add(name="rest")
    bent = item.shape_key_add(name="bent")
    bent.data[0].co = (-3, -3, -3)
    key(bent, "value", {1: 0.0, 4: 1.0})
    build = add("build", cube("built")).modifiers.new("b", "BUILD")
    build.frame_start, build.frame_duration = 1, 6
    key(add("array", wedge("rows")).modifiers.new("a", "ARRAY"), "count", {1: 2, 2: 2, 3: 4})
    smooth = add("subdivided", cube("smooth"))
    smooth.modifiers.new("s", "SUBSURF").render_levels = 1
    bend = smooth.modifiers.new("d", "SIMPLE_DEFORM")
    key(bend, "angle", {1: 0.0, 4: 1.0})
    ngon = bpy.data.meshes.new("ngon")
    ngon.from_pydata([(math.cos(a), math.sin(a), 0) for a in np.arange(7)], [], [tuple(range(7))])
    flat = add("ngon", ngon)
    flat.shape_key_add(name="rest")
    dent = flat.shape_key_add(name="dent")
    dent.data[0].co = (-0.9, 0.1, 0)
    key(dent, "value", {1: 0.0, 4: 1.0})
    row = follow(range(1, 6))

    def of(name: str, extraction: Extraction) -> str:
        change = extraction.change
        assert change is not None
        names = [extraction.keys.names[k] for k in extraction.keys.records["object"]]
        mesh = extraction.scene.instances.mesh[names.index(name)]
        return "deformed" if mesh in change.deformed else "replaced" if mesh in change.replaced else "same"

    assert [of("shape keys", e) for e in row[1:]] == ["deformed"] * 3 + ["same"]
    assert [of("subdivided", e) for e in row[1:]] == ["deformed"] * 3 + ["same"]
    assert [of("array", e) for e in row[1:]] == ["same", "replaced", "same", "same"]
    assert "replaced" in [of("build", e) for e in row[1:]]
    assert "replaced" in [of("ngon", e) for e in row[1:]]


def test_what_nobody_holds_is_not_read(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a deforming mesh that is not active only the box is read; it counts as replaced."""
    item = add("shape keys", cube())
    item.shape_key_add(name="rest")
    bent = item.shape_key_add(name="bent")
    bent.data[0].co = (-3, -3, -3)
    key(bent, "value", {1: 0.0, 4: 1.0})
    monkeypatch.setattr("lipac.lipac_addon.extract.geometry.mesh_table.load", lambda *_: pytest.fail("read"))
    monkeypatch.setattr("lipac.lipac_addon.extract.geometry.meshes.load", lambda *_: pytest.fail("read"))
    with Extractor(bpy.context.scene) as extractor:
        extractor.frame(1)
        change = extractor.frame(2).change
    assert change is not None and len(change.replaced) == 1 and not len(change.deformed)


def scatter(source: Any, side: int = 30) -> Any:
    """A geometry-nodes host with side x side instances of an object."""
    host = add("host", cube("host"))
    nodes(
        host,
        lambda g, new: scattered(
            new,
            grid(new, side),
            new("GeometryNodeObjectInfo", {"Object": source, "As Instance": True}).outputs["Geometry"],
        ),
    )
    return host


@pytest.mark.parametrize("keep", [True, False], ids=["graph kept", "graph anew"])
def test_a_still_scatter_is_not_placed_again(keep: bool) -> None:
    """The camera moves, an object moves, the scatter does not: its rows are taken over, and where nothing moves so are
    the arrays."""
    scatter(add("leaf", wedge(), collection("hidden", linked=False)))
    key(bpy.context.scene.camera, "location", {1: (3, -20, 8), 9: (3.5, -20, 8)})
    key(add("car", cube("car")), "location", {1: (0, 0, 0), 3: (0, 0, 0), 4: (1, 0, 0)})
    row = follow((1, 2, 3, 4), keep=keep)
    a, b, c, d = (e.scene.instances for e in row)
    assert a.transform is b.transform is c.transform
    change = row[3].change
    assert change is not None and change.moved is not None and change.previous is None
    assert change.moved.sum() == 1
    assert d.transform is not c.transform


def test_scatters_of_moving_things() -> None:
    """The source of a scatter deforms, moves, hides; the scatter's own count and places change; its host moves."""
    leaf = add("leaf", wedge(), collection("hidden", linked=False))
    tip = leaf.shape_key_add(name="rest") and leaf.shape_key_add(name="tip")
    tip.data[3].co = (0, 0, 5)
    key(tip, "value", {1: 0.0, 2: 0.0, 4: 1.0})
    host = scatter(leaf, 4)
    key(host, "location", {1: (0, 0, 0), 4: (0, 0, 0), 5: (0, 0, 2)})
    size = next(n for n in host.modifiers[0].node_group.nodes if n.bl_idname == "GeometryNodeMeshGrid")
    input_key(size.inputs["Vertices X"], {1: 4, 5: 4, 6: 5, 7: 3})
    row = follow(range(1, 8))
    assert [len(e.scene.instances) for e in row] == [16] * 5 + [20, 12]
    last = row[-1].change
    assert last is not None and last.previous is not None


def test_collections_of_moving_things() -> None:
    """Members of an instanced collection move, hide and shine; what instances it moves; nested ones too."""
    held, outer = collection("held", linked=False), collection("outer", linked=False)
    key(add("one", wedge(), held), "location", {1: (0, 0, 0), 2: (0, 0, 0), 3: (0, 1, 0)})
    key(add("two", cube(), held), "hide_render", {1: False, 4: True})
    lamp = bpy.data.lights.new("lamp", "POINT")
    key(lamp, "energy", {1: 5.0, 4: 5.0, 5: 9.0})
    add("lamp", lamp, held)
    inner = instance_of("inner", held)
    bpy.context.scene.collection.objects.unlink(inner)
    outer.objects.link(inner)
    for k in range(3):
        key(
            instance_of(f"e{k}", outer if k == 2 else held, location=(5 * k, 0, 0)),
            "location",
            {1: (5 * k, 0, 0), 5: (5 * k, 0, 0), 6: (5 * k, 0, k)},
        )
    row = follow(range(1, 7))
    assert [len(e.scene.instances) for e in row] == [6, 6, 6, 3, 3, 3]
    # at the end the lamp in the collection moves
    assert [e.change.shading for e in row[1:] if e.change] == [False, False, False, True, True]


def test_lights_materials_cameras() -> None:
    """A lamp's power by its data and by its nodes, a material's colour, a camera that is cut to another by a marker, a
    focal length, a world's colour."""
    scene = bpy.context.scene
    material = bpy.data.materials.new("m")
    socket = next(n for n in material.node_tree.nodes if n.type == "BSDF_PRINCIPLED").inputs["Base Color"]
    input_key(socket, {1: (0.1, 0.1, 0.1, 1), 2: (0.1, 0.1, 0.1, 1), 3: (0.9, 0.1, 0.1, 1), 4: (0.9, 0.1, 0.1, 1)})
    mesh = cube()
    mesh.materials.append(material)
    add("cube", mesh)
    sun = bpy.data.lights.new("sun", "SUN")
    key(sun, "energy", {1: 1.0, 4: 1.0, 5: 3.0, 6: 3.0})
    add("sun", sun)
    other = add("Other", bpy.data.cameras.new("Other"), location=(0, -300, 0), rotation=(1.5, 0, 0))
    key(other.data, "lens", {1: 50.0, 7: 50.0, 8: 51.0})
    for frame, camera in ((1, scene.camera), (6, other)):
        scene.timeline_markers.new(f"m{frame}", frame=frame).camera = camera
    world = scene.world = bpy.data.worlds.new("World")
    world.color = (0.1, 0.1, 0.1)
    background = next((n for n in world.node_tree.nodes if n.type == "BACKGROUND"), None) if world.node_tree else None
    if background is not None:
        input_key(background.inputs["Strength"], {1: 1.0, 8: 1.0, 9: 2.0})
    row = follow(range(1, 10))
    changes = [e.change for e in row[1:]]
    assert all(c is not None for c in changes)
    assert [c.camera for c in changes if c] == [k in (6, 8) for k in range(2, 10)]
    # at 6 the origin is another
    assert [k for k, c in zip(range(2, 10), changes, strict=True) if c and c.shading] == [
        3,
        5,
        6,
        *([9] if background else []),
    ]
    moved = [k for k, c in zip(range(2, 10), changes, strict=True) if c and c.moved is not None]
    assert moved == [6]


def test_colours_of_objects_that_change() -> None:
    """A material that shows them is another, though nothing of it changes."""
    material = bpy.data.materials.new("m")
    tree = material.node_tree
    socket = next(n for n in tree.nodes if n.type == "BSDF_PRINCIPLED").inputs["Base Color"]
    tree.links.new(tree.nodes.new("ShaderNodeObjectInfo").outputs["Color"], socket)
    mesh = cube()
    mesh.materials.append(material)
    key(add("cube", mesh), "color", {1: (0.1, 0.1, 0.1, 1), 2: (0.1, 0.1, 0.1, 1), 3: (0.9, 0.5, 0.1, 1)})
    row = follow(range(1, 4))
    found = [e.scene.materials["base_color"][0].tolist() for e in row]
    np.testing.assert_allclose(found, [[0.1] * 3, [0.1] * 3, [0.9, 0.5, 0.1]], rtol=1e-6)
    assert [bool(e.change and e.change.shading) for e in row[1:]] == [False, True]


def test_an_animated_sky_is_rendered_when_it_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    world = bpy.context.scene.world = bpy.data.worlds.new("World")
    if world.node_tree is None:
        pytest.skip("this Blender makes worlds without a node tree")
    gradient, tree = world.node_tree.nodes.new("ShaderNodeTexGradient"), world.node_tree
    tree.links.new(tree.nodes.new("ShaderNodeTexCoord").outputs["Generated"], gradient.inputs[0])
    background = next(n for n in tree.nodes if n.type == "BACKGROUND")
    tree.links.new(gradient.outputs["Color"], background.inputs["Color"])
    input_key(background.inputs["Strength"], {1: 1.0, 2: 1.0, 3: 2.0, 4: 2.0})
    add("cube", cube())
    baked = []
    from lipac.lipac_addon.extract import world as module

    bake = module.bake
    monkeypatch.setattr(module, "BAKE_HEIGHT", 16)

    def counted(*arguments: Any) -> Any:
        baked.append(1)
        return bake(*arguments)

    monkeypatch.setattr(module, "bake", counted)
    with Extractor(bpy.context.scene) as extractor:
        row = [extractor.frame(k) for k in (1, 2, 3, 4)]
    assert len(baked) == 2
    a, b, c, d = (e.scene.world.image for e in row)
    assert a is b and c is d and a is not None and c is not None
    np.testing.assert_allclose(c, 2 * a, rtol=1e-5)
    assert [e.change.shading for e in row[1:] if e.change] == [False, True, False]


def test_other_renders_between_frames() -> None:
    """The graph is lost to another engine's render, and to a change of the engine: the next frame is read in full, and
    equals the one alone."""
    scene = bpy.context.scene
    scene.render.resolution_x = scene.render.resolution_y = 8
    scene.cycles.samples = 1
    scatter(add("leaf", wedge(), collection("hidden", linked=False)), 5)
    key(add("car", cube("car")), "location", {1: (0, 0, 0), 5: (1, 0, 0)})
    extractor = Extractor(scene)

    def render(_: int) -> None:
        extractor.release()
        scene.render.engine = "CYCLES"
        bpy.ops.render.render()

    engine = scene.render.engine
    for frame in (1, 2, 3):
        render(frame)
        got = extractor.frame(frame)
        assert scene.render.engine != "CYCLES"
    extractor.release()
    assert scene.render.engine == "CYCLES"
    scene.render.engine = engine
    assert got.change is not None and got.change.moved is not None and got.change.moved.sum() == 1
    assert_same(got, extract_frame(scene, 3))


def test_vanished_meshes_are_freed() -> None:
    """Nothing holds the geometry of what is gone, nor that of the frame before."""
    key(add("a", cube()), "hide_render", {1: False, 2: True})
    deforming = add("b", wedge())
    deforming.shape_key_add(name="rest")
    tip = deforming.shape_key_add(name="tip")
    tip.data[0].co = (0, 0, -1)
    key(tip, "value", {1: 0.0, 3: 1.0})
    with Extractor(bpy.context.scene) as extractor:
        first = extractor.frame(1)
        sources = [weakref.ref(source) for source in first.scene.meshes.sources]  # type: ignore[attr-defined]
        del first
        second = extractor.frame(2)
        gc.collect()
        assert [source() for source in sources] == [None, None]
        assert len(second.scene.instances) == 1


def test_rows_of_a_scatter_are_read_in_place_and_stay_when_blender_has_forgotten_them() -> None:
    host = scatter(add("leaf", wedge(), collection("hidden", linked=False)))
    extraction = extract_frame(bpy.context.scene)
    rows = extraction.scatters[host.name]
    assert not rows.flags.owndata
    was = rows.copy()
    placed = (
        extraction.scene.instances.transform[extraction.keys.records["path"][:, 0] >= 0][:, :, 3]
        + extraction.scene.origin
    )
    assert np.allclose(was, placed, atol=1e-5)  # 20 m in float32
    del extraction
    bpy.ops.wm.read_factory_settings(use_empty=True)
    gc.collect()
    junk = [np.full(16 * 900, 7, np.float32) for _ in range(1000)]  # into what was freed
    assert np.array_equal(rows, was)
    del junk


def saved_pixels(scene: Any, folder: Path) -> np.ndarray:
    """What the user gets who saves the render that is shown."""
    image = next(i for i in bpy.data.images if i.type == "RENDER_RESULT")
    image.save_render(str(folder / "saved.png"), scene=scene)
    return read_picture(folder / "saved.png")


@pytest.mark.parametrize("shown", [0, 2])
@pytest.mark.parametrize("order", [("frame", "world"), ("world", "frame")])
def test_the_users_render_is_not_lost(tmp_path: Path, shown: int, order: tuple[str, str]) -> None:
    """An extraction renders, and so does the bake of a world; a picture that is not saved yet can be saved afterwards,
    and is the one that is shown."""
    scene = bpy.context.scene
    add("cube", cube())
    world = scene.world = bpy.data.worlds.new("World")
    gradient = world.node_tree.nodes.new("ShaderNodeTexGradient")
    world.node_tree.links.new(
        gradient.outputs["Color"], next(n for n in world.node_tree.nodes if n.type == "BACKGROUND").inputs["Color"]
    )
    scene.render.engine, scene.cycles.samples, scene.cycles.use_denoising = "CYCLES", 1, False
    scene.render.resolution_x, scene.render.resolution_y = 16, 8
    bpy.ops.render.render()
    before = saved_pixels(scene, tmp_path)
    slots = next(i for i in bpy.data.images if i.type == "RENDER_RESULT").render_slots
    slots.active_index = shown  # the user looks at another slot than the one that was rendered
    for what in order:
        if what == "frame":
            extract_frame(scene)
        else:
            extract_world(scene)
    assert slots.active_index == shown
    slots.active_index = 0
    assert (saved_pixels(scene, tmp_path) == before).all()
    assert len(slots) == 9  # one is ours, and used again


def test_a_mesh_that_is_edited_is_said(boxes_in_edit_mode: str) -> None:
    with pytest.raises(InputError, match=f"'{boxes_in_edit_mode}' is in Edit Mode"):
        extract_frame(bpy.context.scene)
    leave_modes()
    assert len(extract_frame(bpy.context.scene).scene.instances) == 1


@pytest.fixture
def boxes_in_edit_mode() -> str:
    """A cube with a Mirror modifier that is being edited; its name."""
    item = add("edited", cube())
    item.modifiers.new("mirror", "MIRROR")
    bpy.context.view_layer.objects.active = item
    bpy.ops.object.mode_set(mode="EDIT")
    return item.name


@pytest.mark.parametrize("kind", ["meshes", "hair_curves", "pointclouds"])
def test_a_mesh_that_is_edited_and_others_show_is_said(boxes_in_edit_mode: str, kind: str) -> None:
    """An object of any kind whose nodes instance it, in a picture without the object itself."""
    host = bpy.data.objects.new("host", getattr(bpy.data, kind).new("host"))
    bpy.context.scene.collection.objects.link(host)
    tree = bpy.data.node_groups.new("shows", "GeometryNodeTree")
    tree.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    found, put = tree.nodes.new("GeometryNodeObjectInfo"), tree.nodes.new("GeometryNodeGeometryToInstance")
    found.inputs["Object"].default_value = bpy.data.objects[boxes_in_edit_mode]
    tree.links.new(found.outputs["Geometry"], put.inputs[0])
    tree.links.new(put.outputs[0], tree.nodes.new("NodeGroupOutput").inputs[0])
    host.modifiers.new("shows", "NODES").node_group = tree
    bpy.data.objects[boxes_in_edit_mode].hide_render = True
    with pytest.raises(InputError, match="'host' shows a mesh that is in Edit Mode"):
        extract_frame(bpy.context.scene)
    leave_modes()
    assert len(extract_frame(bpy.context.scene).scene.instances) == 1


def test_what_cannot_be_put_back_keeps_nothing_else_from_it() -> None:
    """A film format whose colour mode reads "" (RGBA with a codec without alpha)."""
    settings = bpy.context.scene.render.image_settings
    settings.media_type = "VIDEO"
    settings.file_format = "FFMPEG"
    before = settings.file_format, settings.color_mode
    with changed(settings, media_type="IMAGE", file_format="PNG", color_mode="RGBA"):
        assert settings.color_mode == "RGBA"
    assert (settings.file_format, settings.color_mode) == before
    render = bpy.context.scene.render
    with pytest.raises(TypeError), changed(render, use_border=True, engine="NO_SUCH_ENGINE"):
        pass
    assert not render.use_border


def test_what_cycles_dices_is_subdivided() -> None:
    """Adaptive subdivision without levels of its own: a ball, not the cube that Blender evaluates; the file keeps its
    levels, and what has levels enough is as it is."""
    ob = add("cube", cube())
    modifier = ob.modifiers.new("dice", "SUBSURF")
    modifier.levels = modifier.render_levels = 0
    scene = bpy.context.scene
    assert len(extract_frame(scene).scene.meshes[0].triangles) == 12
    modifier.use_adaptive_subdivision = True
    mesh = extract_frame(scene).scene.meshes[0]
    assert len(mesh.triangles) == 12 * 4**3
    assert np.linalg.norm(mesh.positions, axis=1).max() < 1  # its corners were at the root of 3
    assert modifier.render_levels == 0
    modifier.render_levels = 4
    assert len(extract_frame(scene).scene.meshes[0].triangles) == 12 * 4**4
