"""Live culling, tick by tick: what the viewport's graph holds, and that neither renders nor files know of it."""

import threading
import time

import bpy
import numpy as np
import pytest

import lipac
from lipac.lipac_addon import roles
from lipac.lipac_addon.ui import handlers
from lipac.lipac_addon.ui.jobs import foresight, live, viewport_culling, viewport_switches
from lipac.lipac_addon.ui.state import applying, results
from lipac.lipac_addon.writeback import viewport
from lipac.lipac_addon.writeback.viewport_plan import candidates
from lipac.tests.lipac_addon.writeback.conftest import link, points, scatter, triangle

FAR = {"box4", "box5", "box6", "box7"}
OBJECTS, ROWS, FAR_ROWS = 12, 12, 6


def look(shading: str = "RENDERED", perspective: str = "CAMERA") -> None:
    """Have the viewport show that."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                area.spaces.active.shading.type = shading
                area.spaces.active.region_3d.view_perspective = perspective


def no_waiting(monkeypatch):
    """Let live culling go without its clocks."""
    for name in ("INTERVAL", "DUTY", "PATIENCE", "GRACE"):
        monkeypatch.setattr(viewport_culling, name, 0.0)
    monkeypatch.setattr(viewport_switches, "QUIET", 0.0)


@pytest.fixture
def at_once(monkeypatch):
    """Nothing waits for the clock."""
    no_waiting(monkeypatch)


@pytest.fixture
def culled(scene, at_once):
    """The scene of boxes with a scatter, half of which is far, live mode at rest and the viewport culled;
    bpy.types.Scene."""
    source = link(triangle("source"), at=(0, 0, 1))
    host = link(points("host", ROWS, faces=True))
    for k, v in enumerate(host.data.vertices):
        v.co.y += 900.0 * (k % 2)
    scatter(host, source)
    bpy.ops.object.select_all(action="DESELECT")
    bpy.context.view_layer.objects.active = None
    scene.cursor.location = scene.camera.location  # nothing is near it
    bpy.context.view_layer.update()
    look()
    scene.lipac.cull_viewport = True
    live.start()
    settle()
    yield bpy.context.scene
    live.stop()


def settle(limit=10_000):
    """Tick until nothing happens any more; returns the number of rounds."""
    still, start = 0, live.current.rounds if live.current else 0
    for _ in range(limit):
        before = live.current and (live.current.rounds, live.current.error, live.current.culling.switches.out)
        live.tick()
        now = live.current.rounds, live.current.error, live.current.culling.switches.out
        still = still + 1 if live.current.resting and before == now else 0
        if still > 3:
            return live.current.rounds - start
        time.sleep(0.001)
    raise AssertionError(f"no rest: {live.current.message} {live.current.error}")


def edit(change):
    """An edit, what Blender does after it, and what live mode does then."""
    change()
    bpy.context.view_layer.update()
    settle()


def shown() -> set[str]:
    """Names of the meshes that the viewport shows."""
    bpy.context.view_layer.update()
    return {item.name for item in bpy.context.view_layer.depsgraph.objects if item.type == "MESH"}


def rows(name: str = "host") -> int:
    """Rows of a scatter in the viewport."""
    bpy.context.view_layer.update()
    geometry = bpy.data.objects[name].evaluated_get(bpy.context.view_layer.depsgraph).evaluated_geometry()
    return len(geometry.instances_pointcloud().points)


def traces() -> list[str]:
    """What is in the file by which something is out of the viewport."""
    found = [
        block.name
        for kind in (bpy.data.objects, bpy.data.meshes, bpy.data.node_groups)
        for block in kind
        if viewport.is_ours(block)
    ]
    found += [m.name for ob in bpy.data.objects for m in ob.modifiers if m.name.startswith(viewport.NAME)]
    for scene in bpy.data.scenes:
        for layer in scene.view_layers:
            found += [viewport.KEY] * (viewport.KEY in layer) + [
                ob.name for ob in layer.objects if ob.hide_get(view_layer=layer)
            ]
    return found


def test_the_viewport_holds_what_is_kept_and_renders_hold_all(culled):
    kept = {
        name
        for name in (ob.name for ob in bpy.data.objects)
        if results.live[live.current.uid].reason(bpy.data.objects[name]).kept
    }
    assert not FAR & kept
    assert shown() == kept & shown()
    assert not FAR & shown()
    assert {"box0", "wall", "Plane", "host"} <= shown()
    assert rows() == ROWS - FAR_ROWS
    assert len(results.live[live.current.uid].state) == OBJECTS + ROWS  # live mode sees all of it
    bpy.ops.lipac.analyze()  # reads the graph of a render
    assert len(results.at(culled).state) == OBJECTS + ROWS
    assert f"of {OBJECTS + ROWS} instances" in live.current.culling.message


def test_renders_show_everything(culled, tmp_path):
    """The same picture, whether the viewport is culled or not."""
    pictures = []
    for on in (True, False):
        culled.lipac.cull_viewport = on
        settle()
        assert bool(traces()) == on
        culled.render.filepath = str(tmp_path / f"{on}.png")
        bpy.ops.render.render(write_still=True)
        pictures.append((tmp_path / f"{on}.png").read_bytes())
    assert pictures[0][-2000:] == pictures[1][-2000:]


def test_what_is_asked_for_comes_back_in_a_few_rounds(culled):
    bpy.data.objects["box5"].location = (0, 0, 0.5)  # hidden as it is
    bpy.context.view_layer.update()
    start = live.current.rounds
    while bpy.data.objects["box5"].hide_get() and live.current.rounds <= start + 2:
        live.tick()
        time.sleep(0.002)
    live.tick()
    assert "box5" in shown()
    edit(lambda: setattr(bpy.data.objects["box5"], "location", (0, 900, 0)))
    assert "box5" in shown()  # one of twenty is not worth a change
    edit(lambda: [setattr(bpy.data.objects[f"box{k}"], "location", (0, 900, 0)) for k in range(3)])
    assert not {"box0", "box1", "box2", "box5"} & shown()


def test_a_scatter_that_moves_is_shown_at_once_and_masked_anew(culled):
    host = bpy.data.objects["host"]
    mask = next(m for m in host.modifiers if m.name.startswith(viewport.NAME))
    host.data.vertices[1].co.y = 0.5
    host.data.update()
    bpy.context.view_layer.update()
    assert rows() == ROWS - FAR_ROWS + 1  # before any tick: it is not where it was
    assert mask.show_viewport
    assert not mask.show_render
    settle()
    assert rows() == ROWS - FAR_ROWS + 1
    state = results.live[live.current.uid].state
    assert len(state) == OBJECTS + ROWS
    assert "LiPaC viewport mask" in host.modifiers


@pytest.mark.parametrize("by", ["selected", "active", "edited", "cursor", "pinned", "ignored"])
def test_what_the_user_is_at_does_not_vanish(culled, by):
    box = bpy.data.objects["box5"]
    before = shown()

    def choose():
        if by == "selected":
            edit(
                lambda: setattr(bpy.context.view_layer.objects, "active", box)
            )  # Blender selects nothing that is hidden
            box.select_set(True)
            bpy.context.view_layer.objects.active = None
        elif by == "active":
            bpy.context.view_layer.objects.active = box
        elif by == "cursor":
            culled.cursor.location = box.location
        elif by in {"pinned", "ignored"}:
            box.lipac_role = roles.PIN if by == "pinned" else roles.IGNORE
        else:
            box.hide_set(False)
            bpy.context.view_layer.objects.active = box
            bpy.ops.object.mode_set(mode="EDIT")

    assert "box5" not in before
    choose()
    bpy.context.view_layer.update()
    end = time.monotonic() + 20
    while "box5" not in shown() and time.monotonic() < end:  # a thread decides, on a machine that has other work
        live.tick()
        time.sleep(0.001)
    assert "box5" in shown()
    if by == "edited":
        bpy.ops.object.mode_set(mode="OBJECT")


def test_rows_of_a_selected_scatter_do_not_vanish(culled):
    edit(lambda: bpy.data.objects["host"].select_set(True))
    assert rows() == ROWS
    edit(lambda: bpy.data.objects["host"].select_set(False))
    assert rows() == ROWS - FAR_ROWS
    edit(lambda: setattr(culled.cursor, "location", (0, 900, 0)))
    assert rows() > ROWS - FAR_ROWS


def test_live_mode_sees_what_comes_and_goes_meanwhile(culled):
    edit(lambda: link(triangle("new"), at=(0, 0, 2)))  # other data-blocks: all is read anew
    assert len(results.live[live.current.uid].state) == OBJECTS + 1 + ROWS
    assert "new" in shown()
    assert rows() == ROWS - FAR_ROWS
    edit(lambda: bpy.data.objects.remove(bpy.data.objects["box6"]))  # whose eye is closed
    assert len(results.live[live.current.uid].state) == OBJECTS + ROWS
    edit(lambda: setattr(bpy.data.objects["host"].modifiers[0], "show_viewport", False))
    assert len(results.live[live.current.uid].state) == OBJECTS
    edit(lambda: setattr(bpy.data.objects["host"].modifiers[0], "show_viewport", True))
    assert len(results.live[live.current.uid].state) == OBJECTS + ROWS
    assert rows() == ROWS - FAR_ROWS


def test_a_frame_with_what_was_out(culled):
    """Keys move what is hidden, and it is there."""
    box = bpy.data.objects["box5"]
    for frame, y in ((1, 900.0), (5, 0.0)):
        box.location.y = y
        box.keyframe_insert("location", frame=frame)
    edit(lambda: culled.frame_set(1))
    assert "box5" not in shown()
    edit(lambda: culled.frame_set(5))
    assert "box5" in shown()


@pytest.mark.parametrize("off", ["switch", "live", "shading", "camera", "unregister"])
def test_switching_off_is_exact(culled, snapshot, off):
    with_it = snapshot()
    assert traces()
    if off == "switch":
        culled.lipac.cull_viewport = False
        settle()
    elif off == "live":
        bpy.ops.lipac.live()
    elif off == "unregister":
        lipac.unregister()
        lipac.register()
    else:
        look(*(("SOLID", "CAMERA") if off == "shading" else ("RENDERED", "PERSP")))
        settle()
        assert live.current.culling.message.startswith("shows everything: ")
    assert traces() == []
    assert rows() == ROWS
    assert shown() >= FAR
    without = snapshot()
    assert {name for kind, name in with_it["blocks"] - without["blocks"]} == {viewport.NAME}
    assert {m for m in with_it["modifiers"] if m[1] != viewport.NAME} == without["modifiers"]
    if off in {"shading", "camera"}:
        look()
        settle()
        assert not FAR & shown()


def test_what_the_user_hid_stays_hidden(culled):
    edit(lambda: bpy.data.objects["box0"].hide_set(True))
    edit(lambda: bpy.data.objects["box5"].hide_set(False))  # shown by the user, and culled again
    culled.lipac.cull_viewport = False
    settle()
    assert traces() == ["box0"]


def open_without_us(path):
    """Open a file, and look at it before our handler does."""
    bpy.app.handlers.load_post.remove(handlers.after_load)
    try:
        bpy.ops.wm.open_mainfile(filepath=path)
    finally:
        bpy.app.handlers.load_post.append(handlers.after_load)


def test_nothing_of_it_is_saved(culled, tmp_path):
    path = str(tmp_path / "saved.blend")
    before, kept = rows(), shown()
    bpy.ops.wm.save_as_mainfile(filepath=path)
    assert (rows(), shown()) == (before, kept)  # it goes on
    assert settle() == 0  # and nothing was noticed
    assert (rows(), shown()) == (before, kept)
    with pytest.raises(RuntimeError):
        bpy.ops.wm.save_as_mainfile(filepath="/proc/nowhere.blend", copy=True)
    assert (rows(), shown()) == (before, kept)
    open_without_us(path)
    assert traces() == []
    assert rows() == ROWS


def test_a_file_of_a_crash_is_healed(culled, tmp_path):
    """As Blender saves by itself: no handler is called."""
    path = str(tmp_path / "autosave.blend")
    for name, handler in (("save_pre", handlers.before_save), ("save_post", handlers.after_save)):
        getattr(bpy.app.handlers, name).remove(handler)
    try:
        bpy.ops.wm.save_as_mainfile(filepath=path)
    finally:
        bpy.app.handlers.save_pre.append(handlers.before_save)
        bpy.app.handlers.save_post.append(handlers.after_save)
    live.stop()
    open_without_us(path)
    assert traces()
    bpy.ops.wm.open_mainfile(filepath=path)
    assert traces() == []
    assert rows() == ROWS


def test_undo_and_redo(culled):
    bpy.ops.ed.undo_push(message="culled")
    edit(lambda: setattr(bpy.data.objects["box5"], "location", (0, 0, 0.5)))
    bpy.ops.ed.undo_push(message="moved")
    for step, there in ((bpy.ops.ed.undo, False), (bpy.ops.ed.redo, True), (bpy.ops.ed.undo, False)):
        step()
        bpy.context.view_layer.update()
        settle()
        assert ("box5" in shown()) >= there
        assert rows() == ROWS - FAR_ROWS
        assert len(results.live[live.current.uid].state) == OBJECTS + ROWS
    live.stop()
    assert traces() == []
    bpy.ops.ed.redo()
    assert traces() == []
    assert rows() == ROWS


def test_applied_culling_ends_it(culled):
    """Live mode waits while something is applied, so the viewport shows all."""
    bpy.ops.lipac.analyze()
    bpy.ops.lipac.apply()
    assert not [
        line for line in applying.notes if applying.CHANGED in line
    ]  # the masked scatter is the one that was analysed
    assert bpy.data.objects["host"].modifiers[-1].show_render
    edit(lambda: None)
    assert "Restore" in live.current.error
    assert traces() == []
    bpy.ops.lipac.restore()
    edit(lambda: None)
    assert not FAR & shown()
    assert rows() == ROWS - FAR_ROWS


def test_nothing_goes_before_it_is_asked_for(scene, at_once):
    """By default the viewport does not change, nor in Solid shading, nor away from the camera."""
    live.start()
    try:
        for on, shading, perspective in (
            (False, "RENDERED", "CAMERA"),
            (True, "SOLID", "CAMERA"),
            (True, "RENDERED", "PERSP"),
        ):
            scene.lipac.cull_viewport = on
            look(shading, perspective)
            settle()
            assert traces() == []
    finally:
        live.stop()


def test_what_is_large_does_not_wait(culled, monkeypatch):
    """Nor does much at once; a little thing does, until a change is due."""
    box, culling = bpy.data.objects["box5"], live.current.culling
    monkeypatch.setattr(viewport_culling, "INTERVAL", 1e6)
    monkeypatch.setattr(viewport_culling, "WORTH", 1.0)
    edit(lambda: setattr(box, "scale", (0.01, 0.01, 0.01)))
    culling._next = time.monotonic() + 1e6
    edit(lambda: setattr(box, "location", (0, 0, 0.5)))
    assert "box5" not in shown()
    culling._next = 0.0
    edit(lambda: setattr(box, "location", (0, 0.01, 0.5)))
    assert "box5" in shown()
    culling._next = time.monotonic() + 1e6
    edit(lambda: setattr(bpy.data.objects["box6"], "location", (0, 0, 0.5)))
    assert "box6" in shown()
    monkeypatch.setattr(viewport_culling, "WORTH", 0.01)
    edit(lambda: [setattr(bpy.data.objects["box7"], name, (0.01,) * 3) for name in ("scale", "location")])
    assert "box7" in shown()


def test_what_looks_large_in_a_new_view_is_there_before_any_tick(culled, monkeypatch):
    """The camera turns to what was hidden behind it: it is in the graph when Blender has evaluated that."""
    monkeypatch.setattr(viewport_culling, "WORTH", 0.0)
    far = link(triangle("far"), at=(0, -900, 0))
    far.scale = (100, 100, 100)
    edit(lambda: None)
    edit(lambda: setattr(bpy.context.view_layer.objects, "active", None))
    assert not {"far", *FAR} & shown()
    before = live.current.rounds
    culled.camera.rotation_euler.x += 3.0
    bpy.context.view_layer.update()
    assert live.current.rounds == before
    assert "far" in shown()


def test_a_scatter_that_moves_in_each_frame_is_not_masked(culled, monkeypatch):
    """Not even now and then: it is masked where it has been quiet for a while."""
    monkeypatch.setattr(viewport_switches, "QUIET", 60.0)
    host = bpy.data.objects["host"]
    masked = []
    for k in range(20):
        host.data.vertices[1].co.y = 900.0 + 0.1 * k
        host.data.update()
        bpy.context.view_layer.update()
        for _ in range(20):
            live.tick()
            time.sleep(0.001)
        masked.append(len(host.modifiers) > 1)
    assert masked[-1] is False
    assert masked == sorted(masked, reverse=True)  # once it is there, it stays
    live.current.culling.switches._quiet.clear()
    settle()
    assert rows() == ROWS - FAR_ROWS


def test_changes_are_few(culled, monkeypatch):
    """Of many changes a second few reach Blender, and nothing goes while things are asked for."""
    changes = []
    monkeypatch.setattr(viewport_culling, "INTERVAL", 0.3)
    monkeypatch.setattr(foresight, "LARGE", 1e9)
    monkeypatch.setattr(viewport_culling, "WORTH", 0.9)
    original = viewport_switches.Switches.change
    monkeypatch.setattr(
        viewport_switches.Switches,
        "change",
        lambda self, *rest: (changes.append(time.monotonic()), original(self, *rest)),
    )
    for k in range(40):
        for n in range(4, 8):
            bpy.data.objects[f"box{n}"].location.y = 0.0 if (k + n) % 2 else 900.0
        bpy.context.view_layer.update()
        for _ in range(10):
            live.tick()
            time.sleep(0.001)
    assert changes
    assert (np.diff(changes) >= 0.3).all()


def test_a_decision_by_a_thread_minds_what_happens_meanwhile(culled, monkeypatch):
    """What is selected while a thread decides that it goes stays; what nobody touched goes."""
    for k in (5, 6):
        bpy.data.objects[f"box{k}"].location = (0, 0, 0.5)
    edit(lambda: None)
    assert {"box5", "box6"} <= shown()
    asked, free = threading.Event(), threading.Event()

    def slow(*arguments):
        asked.set()
        assert free.wait(60)
        return candidates(*arguments)

    monkeypatch.setattr(viewport_culling, "candidates", slow)
    monkeypatch.setattr(viewport_culling, "AT_ONCE", 0)
    monkeypatch.setattr(viewport_culling, "WORTH", 0.0)
    for k in (5, 6):
        bpy.data.objects[f"box{k}"].location = (0, 900, 0)
    bpy.context.view_layer.update()
    while not (asked.is_set() and live.current.resting):
        live.tick()
        time.sleep(0.001)
    assert {"box5", "box6"} <= shown()  # not decided yet
    bpy.data.objects["box5"].select_set(True)
    bpy.context.view_layer.update()
    free.set()
    settle()
    assert "box5" in shown() and "box6" not in shown()


def sets_of_rows(rng, hosts):
    """Rows of some of the hosts, at random, each as long as its number says."""
    found = {uid: rng.random(uid) < 0.5 for uid in hosts if rng.random() < 0.7}
    return {uid: rows for uid, rows in found.items() if rows.any()}


def out_of(one, uids=range(4, 9)):
    """What is out of a set, as a set of names."""
    return set(one.objects) | {(uid, row) for uid in uids for row in np.flatnonzero(one.rows.get(uid, ())).tolist()}


@pytest.mark.parametrize("seed", range(20))
def test_a_change_in_parts_ends_where_the_whole_does(seed):
    """What comes back goes first, and none hides what neither end hides or shows what both hide."""
    rng = np.random.default_rng(seed)
    start, goal = (
        viewport_switches.OutSet(frozenset(rng.choice(100, 20, replace=False).tolist()), sets_of_rows(rng, range(4, 9)))
        for _ in range(2)
    )
    now, first, parts = start, rng.permutation(100).tolist(), 0
    while not now.is_same(goal):
        then = now.towards(goal, 9, 3, first)
        opened, closed = now.objects - then.objects, then.objects - now.objects
        changed = [
            uid
            for uid in range(4, 9)
            if not then.is_same(now) and not np.array_equal(then.rows.get(uid, ()), now.rows.get(uid, ()))
        ]
        assert len(opened) + len(closed) <= 3
        assert sum(changed) <= 9 or len(changed) == 1
        assert opened | closed or changed
        if closed:
            assert not then.asks(goal)
        if opened:
            waiting = then.objects - goal.objects
            assert max(map(first.index, opened)) < min(map(first.index, waiting), default=100)
        assert out_of(start) & out_of(goal) <= out_of(then) <= out_of(start) | out_of(goal)
        now, parts = then, parts + 1
    assert parts > 3
    assert now.towards(goal, 9, 3, first).is_same(goal)


def test_much_goes_and_comes_back_in_parts(culled, monkeypatch):
    """A scatter or an eye a change, and in the end all of it."""
    gone = shown()
    sets, original = [], viewport_switches.Switches.change

    def change(self, layer, wanted, places):
        sets.append((self.out, wanted))
        original(self, layer, wanted, places)

    monkeypatch.setattr(viewport_switches.Switches, "change", change)
    monkeypatch.setattr(viewport_culling, "PART", 1)
    monkeypatch.setattr(viewport_culling, "ROWS", 1)
    boxes = [bpy.data.objects[name] for name in sorted(FAR)]
    edit(lambda: [setattr(box, "location", (0, 0, 0.5 + 0.1 * k)) for k, box in enumerate(boxes)])
    assert shown() >= FAR
    edit(lambda: [setattr(box, "location", (0, 900, 0)) for box in boxes])
    assert shown() == gone
    assert rows() == ROWS - FAR_ROWS
    assert len(sets) >= 2 * len(FAR)
    assert all(len(a.objects ^ b.objects) <= 1 for a, b in sets)
