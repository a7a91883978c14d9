"""Restore is exact: random sequences of a user's edits, with our operators in between, end as the same edits without
them.

Each sequence is worked through twice on the same scene: once with everything, ending with Restore, where each edit
notes what it did; then the notes alone. Every property, modifier, data-block, keyframe and node link must be the same.
One thing nobody can tell is left out: that a user hides again what was hidden already. Live culling of the viewport is
switched on and off in between, and lives through edits, undo and files; in every other block its changes are made in
the smallest parts. Whatever has faces, levels of subdivision or a resolution is at a coarser level of detail where an
analysis is applied.
"""

import tempfile
import time
from dataclasses import replace

import bpy
import numpy as np
import pytest

from lipac.core.files.level import Level, Steps
from lipac.lipac_addon import roles
from lipac.lipac_addon.coarsening import setting_of
from lipac.lipac_addon.ui.jobs import live, viewport_culling
from lipac.lipac_addon.ui.state import asking, results, topology
from lipac.lipac_addon.writeback import viewport
from lipac.tests.lipac_addon.ui.jobs.test_viewport_culling import look, no_waiting
from lipac.tests.lipac_addon.writeback.conftest import collection, custom, empty, link, plain, points, scatter, triangle

SEQUENCES = 200
STEPS = 10
RENDERS = 0.03  # of our steps


def build() -> None:
    """Near and far objects, collections, a scatter, an instanced collection, particles, keyframes, a mesh of more
    faces, one that is subdivided, a curve; what is far is culled by distance."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    scene.collection.objects.link(camera)
    camera.location, scene.camera = (0, 0, 10), camera
    scene.render.resolution_x, scene.render.resolution_y, scene.render.engine = 16, 16, "BLENDER_WORKBENCH"
    far = collection("far", scene.collection)
    for k in range(3):
        link(triangle(f"near{k}"), at=(k, 0, 0))
        link(triangle(f"far{k}"), far, (k, 900, 0))
    host = link(points("host", 8, faces=True))
    for k, v in enumerate(host.data.vertices):
        v.co.y += 900.0 * (k % 2)
    scatter(host, bpy.data.objects["near0"])
    inside = collection("inside", scene.collection)
    link(triangle("part"), inside, (0, 0, 1))
    for k in range(2):
        link(empty(f"empty{k}", inside), at=(0, 900 * k, 0))
    emitter = link(points("emitter", 8, faces=True), at=(0, 800, 0))
    emitter.modifiers.new("particles", "PARTICLE_SYSTEM")
    settings = emitter.particle_systems[0].settings
    settings.type, settings.count, settings.render_type, settings.instance_object = (
        "HAIR",
        3,
        "OBJECT",
        bpy.data.objects["near1"],
    )
    bpy.data.objects["far1"].keyframe_insert("location", frame=1)
    bpy.ops.mesh.primitive_grid_add(x_subdivisions=4, y_subdivisions=4, location=(1, 2, 0))
    bpy.context.object.name = "grid"
    bpy.ops.mesh.primitive_cube_add(location=(2, 2, 0))
    bpy.context.object.name = "cube"
    bpy.context.object.modifiers.new("smooth", "SUBSURF").render_levels = 4
    bpy.ops.curve.primitive_bezier_circle_add(location=(3, 2, 0))
    bpy.context.object.name, bpy.context.object.data.bevel_depth = "curve", 0.1
    scene.frame_end = 2
    scene.lipac.policy, scene.lipac.distance = "distance", 100.0
    bpy.context.view_layer.update()


def levels() -> dict[int, Level | Steps]:
    """A coarser level of detail for whatever has one, by session uid; the same for all that have the same mesh."""
    found: dict[int, Level | Steps] = {}
    halves: dict[bpy.types.ID, Level] = {}
    for item in bpy.data.objects:
        if item.data is None or not item.users_collection:
            continue
        if not isinstance(setting_of(item, bpy.context.scene), str):
            found[item.session_uid] = Steps(1)
        elif item.type == "MESH" and len(item.data.polygons) > 1:
            if item.data not in halves:
                item.data.calc_loop_triangles()
                half = list(item.data.loop_triangles)[::2]
                corners = np.array([list(t.loops) for t in half], np.int32)
                halves[item.data] = Level(corners, np.array([t.polygon_index for t in half], np.int32))
            found[item.session_uid] = halves[item.data]
    return found


@pytest.fixture
def coarser(monkeypatch):
    """Has every analysis find levels of detail."""
    of = results.FrameResult.of
    monkeypatch.setattr(results.FrameResult, "of", staticmethod(lambda *given: replace(of(*given), levels=levels())))
    monkeypatch.setattr(asking, "forms_of", lambda *_: topology.forms_of(levels()))


# A user's edits: each does one at random, and returns a function that does the same to a file by names alone


def mine(rng: np.random.Generator, kind: str = "", with_modifiers: bool = False) -> str | None:
    """The name of one of the user's objects."""
    names = sorted(
        ob.name
        for ob in bpy.data.objects
        if ob.users_collection and (not kind or ob.type == kind) and (ob.modifiers or not with_modifiers)
    )
    return None if not names else names[rng.integers(len(names))]


def ob(name: str) -> bpy.types.Object:
    return bpy.data.objects[name]


def users_modifiers(name: str) -> list[str]:
    return [m.name for m in ob(name).modifiers if not m.name.startswith("LiPaC")]


def move(rng):
    name, place = mine(rng), rng.uniform(-5, 5, 3).tolist()
    if ob(name).animation_data:
        return None  # without a key it lasts until Blender goes to another frame
    return lambda: setattr(ob(name), "location", place)


def rename(rng):
    name, new = mine(rng), f"name{rng.integers(1 << 30)}"
    return lambda: setattr(ob(name), "name", new)


def show_or_hide(rng):
    name = mine(rng)
    value = not ob(name).hide_render
    if value and ob(name).get("lipac_writeback"):
        return None  # it was hidden by us, and shown by the user since
    return lambda: setattr(ob(name), "hide_render", value)


def close_or_open_eye(rng):
    name = mine(rng)
    value = not ob(name).hide_get()
    if not value and ob(name) in viewport.closed_eyes(bpy.context.view_layer):
        return None  # we closed it, and it is open for the user
    return lambda: ob(name).hide_set(value)


def show_or_hide_collection(rng):
    names = sorted(c.name for c in bpy.data.collections)
    name = names[rng.integers(len(names))]
    value = not bpy.data.collections[name].hide_render
    if value and bpy.data.collections[name].get("lipac_writeback"):
        return None
    return lambda: setattr(bpy.data.collections[name], "hide_render", value)


def new_object(rng):
    name, at = f"new{rng.integers(1 << 30)}", (float(rng.integers(5)), 900.0 * float(rng.integers(2)), 0.0)
    return lambda: link(triangle(name), at=at)


def copy_object(rng):
    name, new = mine(rng, "MESH"), f"copy{rng.integers(1 << 30)}"

    def run():
        made = ob(name).copy()
        made.name = new
        bpy.context.scene.collection.objects.link(made)

    return run


def remove_object(rng):
    name = mine(rng, "MESH")
    # what instances them crashes Blender 5.0
    return None if name in {"near0", "near1"} else lambda: bpy.data.objects.remove(ob(name))


def new_modifier(rng):
    name, kind = mine(rng, "MESH"), ("ARRAY", "BEVEL", "TRIANGULATE")[rng.integers(3)]
    return lambda: ob(name).modifiers.new(kind.lower(), kind)


def remove_modifier(rng):
    name = mine(rng, "MESH", with_modifiers=True)
    found = [] if name is None else [m for m in users_modifiers(name) if m != "particles"]
    if not found:
        return None
    modifier = found[rng.integers(len(found))]
    return lambda: ob(name).modifiers.remove(ob(name).modifiers[modifier])


def set_modifier(rng):
    name = mine(rng, "MESH", with_modifiers=True)
    found = [] if name is None else users_modifiers(name)
    if not found:
        return None
    modifier, value = found[rng.integers(len(found))], bool(rng.integers(2))
    return lambda: setattr(ob(name).modifiers[modifier], "show_viewport", value)


def set_levels(rng):
    name, value = mine(rng, with_modifiers=True), int(rng.integers(6))
    found = [] if name is None else [m for m in ob(name).modifiers if m.type == "SUBSURF"]
    if not found or found[0].render_levels == value:
        return None  # as we had set it, and the user did, too
    modifier = found[0].name
    return lambda: setattr(ob(name).modifiers[modifier], "render_levels", value)


def set_resolution(rng):
    name, value = mine(rng, "CURVE"), int(rng.integers(20))
    if name is None or ob(name).data.render_resolution_u == value:
        return None
    return lambda: setattr(ob(name).data, "render_resolution_u", value)


def reshape(rng):
    name, place = mine(rng, "MESH"), rng.uniform(-1, 1, 3).tolist()
    if "lipac_kept" in ob(name) or not ob(name).data.vertices:
        return None  # it would be lost: the panel says so

    def run():
        ob(name).data.vertices[0].co = place
        ob(name).data.update()

    return run


def activate_modifier(rng):
    name = mine(rng, "MESH", with_modifiers=True)
    found = [] if name is None else users_modifiers(name)
    if not found:
        return None
    modifier = found[rng.integers(len(found))]
    return lambda: setattr(ob(name).modifiers, "active", ob(name).modifiers[modifier])


def key_location(rng):
    name, frame = mine(rng), int(rng.integers(1, 5))
    return lambda: ob(name).keyframe_insert("location", frame=frame)


def key_visibility(rng):
    name = mine(rng)
    if ob(name).get("lipac_writeback"):
        return None  # it would key what we set
    return lambda: ob(name).keyframe_insert("hide_render", frame=1)


def new_collection(rng):
    name, new = mine(rng), f"collection{rng.integers(1 << 30)}"
    return lambda: collection(new, bpy.context.scene.collection).objects.link(ob(name))


def mark(rng):
    name, role = mine(rng), (roles.PIN, roles.IGNORE, roles.AUTO)[rng.integers(3)]
    return lambda: setattr(ob(name), "lipac_role", role)


def custom_property(rng):
    name, value = mine(rng), int(rng.integers(100))
    return lambda: ob(name).__setitem__("mine", value)


def save_and_open(rng):
    """Both ways of working through do it: Blender drops what nobody uses."""
    if rng.integers(2):
        return None

    def run():
        with tempfile.TemporaryDirectory() as folder:
            path = f"{folder}/file.blend"
            bpy.ops.wm.save_as_mainfile(filepath=path)
            bpy.ops.wm.open_mainfile(filepath=path)

    return run


EDITS = (
    *(move, rename, show_or_hide, close_or_open_eye, show_or_hide_collection, new_object, copy_object, remove_object),
    *(new_modifier, remove_modifier, set_modifier, set_levels, set_resolution, reshape),
    *(activate_modifier, key_location, key_visibility, new_collection, mark, custom_property, save_and_open),
)


def ours(rng: np.random.Generator) -> None:
    """One of our operators."""
    lipac = bpy.ops.lipac
    if rng.random() < RENDERS:
        bpy.context.scene.lipac.use_for_renders = True
        bpy.ops.render.render()
        bpy.context.scene.lipac.use_for_renders = False
        return
    what = rng.integers(9)
    if what > 5:
        cull_viewport(rng)
    elif what == 0 or (what < 4 and not lipac.apply.poll()):
        lipac.analyze()
    elif what == 1:
        bpy.ops.ed.undo_push(message="before")
        lipac.apply("EXEC_DEFAULT", True)
        bpy.ops.ed.undo()
        if rng.integers(2):
            bpy.ops.ed.redo()
    elif what < 4:
        lipac.apply()
    elif what == 4:
        lipac.restore()
    else:
        lipac.bake_shot()


def cull_viewport(rng):
    """Live culling: off, or on for some while, and now and then a step of undo in the midst of it."""
    if rng.random() < 0.3:
        live.stop()
        return
    look()
    bpy.context.scene.lipac.cull_viewport = True
    if not live.is_on():
        live.start()
    if rng.integers(2):
        bpy.ops.lipac.restore()  # it waits while something is applied
    bpy.ops.ed.undo_push(message="before")
    for _ in range(int(rng.integers(20, 400))):
        live.tick()
        if live.current.resting and not rng.integers(3):
            break
        time.sleep(0.0005)
    if rng.random() < 0.3:
        bpy.ops.ed.undo_push(message="culled")
        bpy.ops.ed.undo()
        live.tick()
        if rng.integers(2):
            bpy.ops.ed.redo()


def snapshot() -> dict:
    """All plain and custom properties of all data-blocks, their modifiers, links, members and keyframes."""
    found: dict = {}
    for kind in (p.identifier for p in bpy.data.bl_rna.properties if p.type == "COLLECTION"):
        if kind in {"all_ids", "images", "window_managers", "screens", "workspaces", "libraries", "texts"}:
            continue
        for block in getattr(bpy.data, kind):
            values = plain(block) | {"custom": custom(block)}
            for derived in ("filepath", "dimensions", "bound_box"):  # of the last evaluation, whenever that was
                values.pop(derived, None)
            found[kind, block.name_full] = values
    for item in bpy.data.objects:
        values = found["objects", item.name_full]
        values["modifiers"] = [m.name for m in item.modifiers]
        values |= {
            ("modifier", m.name): {k: v for k, v in plain(m).items() if k != "persistent_uid"} for m in item.modifiers
        }
        values["active modifier"] = item.modifiers.active.name if item.modifiers.active else None
        values["in"] = sorted(c.name for c in item.users_collection)
        values["role"] = item.lipac_role
        values["eye"] = item.hide_get()
        values["data"] = item.data.name if item.data else None
    found["view layer"] = sorted(bpy.context.view_layer.keys())
    for c in (*bpy.data.collections, bpy.context.scene.collection):
        found["members", c.name] = [o.name for o in c.objects], [x.name for x in c.children]
    for action in bpy.data.actions:
        curves = [
            c for layer in action.layers for strip in layer.strips for bag in strip.channelbags for c in bag.fcurves
        ]
        found["actions", action.name]["keys"] = [
            (c.data_path, c.array_index, [tuple(p.co) for p in c.keyframe_points]) for c in curves
        ]
    for tree in bpy.data.node_groups:
        found["node_groups", tree.name]["nodes"] = [plain(n) for n in tree.nodes], len(tree.links)
    return found


def difference(a: dict, b: dict) -> dict:
    return {k: (a.get(k), b.get(k)) for k in a.keys() | b.keys() if a.get(k) != b.get(k)}


def explain(with_us: dict, without: dict) -> dict:
    """What differs, as far down as it goes."""
    out = {}
    for key, (x, y) in difference(with_us, without).items():
        out[key] = explain(x, y) if isinstance(x, dict) and isinstance(y, dict) else (x, y)
    return out


@pytest.fixture
def start(ui, tmp_path, monkeypatch):
    """Opens the scene."""
    no_waiting(monkeypatch)
    build()
    path = str(tmp_path / "start.blend")
    bpy.ops.wm.save_as_mainfile(filepath=path)
    yield lambda: bpy.ops.wm.open_mainfile(filepath=path)
    bpy.ops.wm.read_factory_settings(use_empty=True)


@pytest.mark.parametrize("block", range(10))
def test_as_the_user_left_it(start, coarser, block, monkeypatch):
    if block % 2:  # what the viewport shows changes by an eye or a scatter a tick
        monkeypatch.setattr(viewport_culling, "PART", 1)
        monkeypatch.setattr(viewport_culling, "ROWS", 1)
    touched = culled = simplified = 0
    for seed in range(block * SEQUENCES // 10, (block + 1) * SEQUENCES // 10):
        rng = np.random.default_rng(seed)
        start()
        notes = []
        for _ in range(STEPS):
            if rng.integers(2):
                ours(rng)
                touched += any(item.get("lipac_writeback") for item in bpy.data.objects if item.users_collection)
                simplified += any("lipac_kept" in item for item in bpy.data.objects)
                culled += bool(viewport.masked() or viewport.closed_eyes(bpy.context.view_layer))
                continue
            edit = EDITS[rng.integers(len(EDITS))]
            note = edit(rng)
            if note is not None:
                note()
                notes.append((edit.__name__, note))
                bpy.context.view_layer.update()
        live.stop()
        bpy.ops.lipac.restore()
        bpy.context.view_layer.update()
        with_us = snapshot()
        start()
        for _, note in notes:
            note()
            bpy.context.view_layer.update()
        without = snapshot()
        assert with_us == without, f"seed {seed}: {[name for name, _ in notes]}: {explain(with_us, without)}"
    assert (touched > 20, culled > 5, simplified > 5) == (True, True, True)  # or nothing was tried
