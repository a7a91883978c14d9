"""Frames in a row: split, stopped, resumed, warm, and one set for all of them."""

from __future__ import annotations

import ctypes
import gc
import json
import os
import sys
import weakref
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import bpy
import numpy as np
import pytest

from lipac.core.culling import union
from lipac.core.culling.activation import COLD_HITS
from lipac.core.culling.analysis import analyze
from lipac.core.culling.loop import Loop
from lipac.core.culling.options import CullOptions, State
from lipac.core.culling.shot import Shot
from lipac.core.error_budget.budget import Budget
from lipac.core.errors import Cancelled
from lipac.core.evaluation.judge import Judge
from lipac.core.files.atomic import replacing
from lipac.core.files.report import Report, States, load_states
from lipac.core.scene.model import RAY_TYPES
from lipac.lipac_addon.batch.job import SHOT, Job
from lipac.lipac_addon.batch.pipeline import run
from lipac.lipac_addon.batch.session import Session
from lipac.lipac_addon.batch.shots.shot_set import ShotSet
from lipac.lipac_addon.batch.shots.uniting import middles
from lipac.lipac_addon.extract import Extractor, extract_frame
from lipac.lipac_addon.open import open_scene
from lipac.lipac_addon.pictures import read_picture

from ...core.culling.test_shot import assert_as_alone

pytestmark = pytest.mark.slow

SHARED = Path(__file__).parents[3] / ".." / "shared" / "scenes"
OPTIONS = CullOptions(width=48, paths=2)
LARGER = CullOptions(width=96, paths=6, max_error=Budget(0.02, 0.1))


def report() -> Report:
    return Report("boxes", "", "", "light-paths", "", 0, 1, {"samples": 1})


def do(folder: Path, frames: Iterable[int], **how: Any) -> Report:
    """Run a job, report it."""
    r = report()
    run(Job(folder, tuple(frames), how.pop("options", OPTIONS), samples=1, **how), r)
    return r


def files(folder: Path, pattern: str = "states/*.npz") -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.glob(pattern))}


def culled(folder: Path, frame: int) -> int:
    return int((load_states(folder / "states" / f"frame_{frame:04}.npz").state == State.CULLED).sum())


def test_a_split_range_gives_the_same_states(moving: Any, tmp_path: Path) -> None:
    """Bit for bit, and what is culled changes on the way."""
    do(tmp_path / "whole", range(1, 7))
    do(tmp_path / "parts", (4, 5, 6))
    do(tmp_path / "parts", (1, 2, 3))
    assert len(files(tmp_path / "whole")) == 6
    assert files(tmp_path / "whole") == files(tmp_path / "parts")
    assert len({culled(tmp_path / "whole", k) for k in range(1, 7)}) > 1
    data = json.loads((tmp_path / "parts" / "report.json").read_text())
    assert [f["frame"] for f in data["frames"]] == [1, 2, 3, 4, 5, 6]


LARGE = "rooms1024.blend"
SUPPLIED = [
    *(
        f"small/{name}"
        for name in (
            "CesiumMan.glb", "Fox.glb", "Knight.glb", "animation_instanced.blend", "particle_hair.blend",
            "22_simple_GN.blend"
        )
    ),
    *("small/gn_nested_instances.blend", "candela_city.blend", LARGE),
]


@pytest.mark.parametrize("name", SUPPLIED)
def test_each_frame_is_what_a_fresh_start_of_it_is(name: str) -> None:
    """Scenes of others."""
    if not SHARED.is_dir():
        pytest.skip("the supplied scenes (../shared/scenes) are not here")
    open_scene(SHARED / name)
    scene = bpy.context.scene
    scene.world = None  # baking it takes long
    if not any(ob.type == "LIGHT" for ob in scene.objects):
        bpy.ops.object.light_add(type="SUN", rotation=(0.6, 0.2, 0))
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = 48, 27, 100
    assert_as_fresh_starts(scene, (1, 9) if name == LARGE else (1, 2, 9))


def test_each_frame_is_what_a_fresh_start_of_it_is_where_triangles_change(moving: Any) -> None:
    """One modifier builds a grid face by face, another changes how many copies there are; the camera, and boxes, move
    and bend."""
    moving.render.resolution_x, moving.render.resolution_y = 48, 27
    bpy.ops.mesh.primitive_grid_add(
        x_subdivisions=6, y_subdivisions=6, size=5, location=(0, -2, 2), rotation=(1.2, 0, 0)
    )
    build = bpy.context.object.modifiers.new("build", "BUILD")
    build.frame_start, build.frame_duration = 1, 6
    bpy.ops.mesh.primitive_cube_add(size=0.5, location=(-4, -3, 1))
    array = bpy.context.object.modifiers.new("array", "ARRAY")
    for frame, count in ((1, 2), (4, 9)):
        array.count = count
        array.keyframe_insert("count", frame=frame)
    assert assert_as_fresh_starts(moving, (1, 2, 3, 4, 6)) >= 6  # both, in all but the first


def assert_as_fresh_starts(scene: Any, frames: Iterable[int]) -> int:
    """Frames by themselves: states, hits and scores are those of a fresh start, bit for bit. Warm ones, at rest: states
    and hits up to the hysteresis.

    Returns how many meshes had other triangles than in the frame before.
    """
    at_rest = CullOptions(width=48, paths=4, min_share=4 * COLD_HITS / (48 * 27 * 4), settled=0.0)
    alone, warm, replaced = Shot(OPTIONS, independent=True), Shot(at_rest), 0
    with Extractor(scene, allow_no_camera=True) as extractor:
        for frame in frames:
            now = extractor.frame(frame)
            result = alone.advance(now.scene, now.change)
            expected = analyze(now.scene, OPTIONS)
            for name in ("state", "hits", "score"):
                np.testing.assert_array_equal(getattr(result, name), getattr(expected, name))
            assert_as_alone(warm, warm.advance(now.scene, now.change), now.scene, at_rest)
            replaced += len(now.change.replaced) if now.change else 0
    return replaced


def test_resuming_does_what_is_missing(moving: Any, tmp_path: Path) -> None:
    """Stopped in the second frame: the first is left alone, the others come; a picture that was lost is made again."""
    with pytest.raises(Cancelled):
        run(Job(tmp_path, (1, 2, 3), OPTIONS, "path", 1), report(), cancelled=lambda: moving.frame_current == 2)
    assert [f["frame"] for f in json.loads((tmp_path / "report.json").read_text())["frames"]] == [1]
    before = {p: p.stat().st_mtime_ns for p in (tmp_path / "frame_0001.exr", tmp_path / "states" / "frame_0001.npz")}
    done = do(tmp_path, (1, 2, 3), engine="path", resume=True)
    assert [f["frame"] for f in done.frames] == [2, 3]
    assert before == {p: p.stat().st_mtime_ns for p in before}
    assert [f["frame"] for f in json.loads((tmp_path / "report.json").read_text())["frames"]] == [1, 2, 3]
    (tmp_path / "frame_0002.png").unlink()
    assert [f["frame"] for f in do(tmp_path, (1, 2, 3), engine="path", resume=True).frames] == [2]
    assert do(tmp_path, (1, 2, 3), engine="path", resume=True).frames == []
    assert [f["frame"] for f in do(tmp_path, (1,), engine="path").frames] == [1]
    do(tmp_path / "at once", (1, 2, 3), engine="path")
    assert files(tmp_path) == files(tmp_path / "at once")
    for k in (1, 2, 3):
        assert (
            read_picture(tmp_path / f"frame_000{k}.exr") == read_picture(tmp_path / "at once" / f"frame_000{k}.exr")
        ).all()


def test_what_a_killed_command_left_goes_away(moving: Any, tmp_path: Path) -> None:
    """Parts of its own frames. What another process writes to, or what only looks like a part, stays."""
    (tmp_path / "states").mkdir()
    token = ".0123456789abcdef.part"
    left = [tmp_path / f".frame_0001{token}.png", tmp_path / "states" / f".frame_0001{token}.npz"]
    left += [tmp_path / f".{name}{token}.{end}" for name, end in (("memory", "csv"), ("report", "json"))]
    others = [tmp_path / f".frame_0002{token}.png", tmp_path / ".frame_0001.part.png", tmp_path / ".lipac"]
    for path in (*left, *others):
        path.write_bytes(b"half")
        os.utime(path, (1e9, 1e9))
    with replacing(tmp_path / "frame_0001.png") as part:
        do(tmp_path, (1,), engine="path")
        assert part.exists()
        part.write_bytes((tmp_path / "frame_0001.png").read_bytes())
    assert not any(path.exists() for path in left)
    assert all(path.exists() for path in others)


def test_warm_frames(moving: Any, tmp_path: Path) -> None:
    """Each begins with what the last one kept; a resumed range ends in the same states as one at once."""
    do(tmp_path / "a", range(1, 5), warm=True)
    with pytest.raises(Cancelled):
        run(
            Job(tmp_path / "b", (1, 2, 3, 4), OPTIONS, warm=True), report(), cancelled=lambda: moving.frame_current == 3
        )
    assert [f["frame"] for f in do(tmp_path / "b", range(1, 5), warm=True, resume=True).frames] == [3, 4]
    assert files(tmp_path / "a") == files(tmp_path / "b")
    frames = json.loads((tmp_path / "a" / "report.json").read_text())["frames"]
    assert frames[1]["blas_built"] < frames[0]["blas_built"]


def shown(states: States) -> set[str]:
    return {states.names[k] for k in states.keys["object"][states.state == State.ACTIVE]}


@pytest.mark.parametrize("engine", ["", "path"])
def test_one_set_for_a_shot(moving: Any, tmp_path: Path, engine: str) -> None:
    """What a frame brings into it is kept in all, and nothing else; the set is certified on each frame, by an
    independent judge too."""
    do(tmp_path, range(1, 7), bake=SHOT, engine=engine, options=LARGER)
    together = [shown(load_states(tmp_path / "states" / f"frame_000{k}.npz")) for k in range(1, 7)]
    own = [shown(load_states(path)) for path in sorted((tmp_path / "analysis").glob("*_proposed.npz"))]
    assert together == [set.union(*own)] * 6
    assert 2 <= len(own) < 6
    assert len(own[0]) < len(together[0]) < len(moving.objects)
    entries = json.loads((tmp_path / "report.json").read_text())["frames"]
    assert [e["active"] for e in entries] == [len(together[0])] * 6
    assert [e["needed"] for e in entries if "needed" in e] == [len(names) for names in own]
    assert all(e["certified_mean"] <= LARGER.max_error.mean for e in entries)
    assert all(e["certified_worst"] <= LARGER.max_error.worst for e in entries)
    assert len(list(tmp_path.glob("*.png"))) == (6 if engine else 0)
    for frame in (1, 3, 6):
        judged(moving, frame, together[0], LARGER)


def judged(scene: Any, frame: int, kept: set[str], options: CullOptions) -> None:
    """That a picture with the objects that are kept is within the budget, by paths of the judge's own."""
    extraction = extract_frame(scene, frame)
    names, objects = extraction.keys.names, extraction.keys.records["object"]
    change = Judge(extraction.scene, 16).change(np.array([names[k] in kept for k in objects]))
    assert change.mean - 3 * change.mean_deviation <= options.max_error.mean
    assert change.worst - 4 * change.worst_deviation <= options.max_error.worst


def test_frames_in_which_a_set_does_not_hold_have_their_say(
    moving: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All that is proposed is the floor: in the end each frame holds all the same, and the report tells who brought
    what."""

    def nothing(loop: Loop, _progress: Any = None) -> Any:
        n = len(loop.activation)
        return loop.result(np.arange(n) == 0, np.zeros(n, np.float32), np.zeros((n, RAY_TYPES), np.int64))

    monkeypatch.setattr(union, "propose", nothing)
    r = do(tmp_path, range(1, 7), bake=SHOT, options=LARGER)
    together = shown(load_states(tmp_path / "states" / "frame_0003.npz"))
    decided = sorted(path.stem for path in (tmp_path / "analysis").glob("frame_000?.npz"))
    assert decided
    assert all(e["certified_worst"] <= LARGER.max_error.worst for e in r.frames)
    for frame in (1, 3, 6):
        judged(moving, frame, together, LARGER)


def test_where_nothing_helps_all_stays(moving: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Analyses that keep nothing but the floor, too: everything is kept, and a line says so."""

    def nothing(loop: Loop, _progress: Any = None) -> Any:
        n = len(loop.activation)
        return loop.result(np.arange(n) == 0, np.zeros(n, np.float32), np.zeros((n, RAY_TYPES), np.int64))

    monkeypatch.setattr(union, "propose", nothing)
    monkeypatch.setattr(union, "decide_closer", nothing)
    r = do(tmp_path, (1, 2), bake=SHOT)
    assert [e["culled"] for e in r.frames] == [0, 0]
    assert any("all stays" in line for line in r.warnings)


def test_the_middle_of_each_run_has_its_say() -> None:
    frames = tuple(range(10, 30))
    assert middles([20, 19, 18], frames, {}) == [19]
    assert middles([10, 11, 29, 13], frames, {}) == [11, 13, 29]
    assert middles([18, 19, 20], frames, {19: 1}) in ([18], [20])
    assert middles([18, 19], frames, {18: 1, 19: 2}) == [18]
    assert middles([], frames, {}) == []


def test_a_shot_is_resumed(moving: Any, tmp_path: Path) -> None:
    """Stopped while frames are looked at, and again while they are rendered: what is there is not done again."""
    job = Job(tmp_path, (1, 2, 3), OPTIONS, "path", 1, bake=SHOT)
    with pytest.raises(Cancelled):
        run(job, report(), cancelled=lambda: moving.frame_current == 3)
    analyses = {p.name: p.stat().st_mtime_ns for p in (tmp_path / "analysis").glob("*.npz")}
    assert sorted(analyses) == ["frame_0001_proposed.npz"]
    with pytest.raises(Cancelled):
        run(Job(**{**vars(job), "resume": True}), report(), cancelled=(tmp_path / "frame_0001.png").exists)
    assert {p.name: p.stat().st_mtime_ns for p in (tmp_path / "analysis").glob("*.npz")}.items() >= analyses.items()
    done = do(tmp_path, (1, 2, 3), engine="path", bake=SHOT, resume=True)
    assert [f["frame"] for f in done.frames] == [2, 3]
    do(tmp_path / "at once", (1, 2, 3), engine="path", bake=SHOT)
    assert files(tmp_path) == files(tmp_path / "at once")


def test_a_shot_is_split(moving: Any, tmp_path: Path) -> None:
    """Parts of it in one folder give the states of the whole; what one has found out the other does not look at again;
    of other options nothing is taken."""
    whole = tuple(range(1, 7))
    do(tmp_path / "whole", whole, bake=SHOT)
    do(tmp_path / "parts", (1,), bake=SHOT, shot=whole, options=CullOptions(width=24, paths=1))
    (tmp_path / "parts" / "report.json").unlink()
    do(tmp_path / "parts", (1, 2), bake=SHOT, shot=whole)
    before = {p: p.stat().st_mtime_ns for p in (tmp_path / "parts" / "analysis").glob("*.npz")}
    assert len(before) >= 8
    do(tmp_path / "parts", (3, 4, 5, 6), bake=SHOT, shot=whole)
    assert before == {p: p.stat().st_mtime_ns for p in before}
    assert files(tmp_path / "whole") == files(tmp_path / "parts")
    report_of_both = json.loads((tmp_path / "parts" / "report.json").read_text())
    assert [f["frame"] for f in report_of_both["frames"]] == list(whole)


def test_a_baked_file_renders_the_same_without_us(moving: Any, tmp_path: Path) -> None:
    """Cycles on the saved copy, opened and rendered with nothing of ours, gives the pictures of the command; the open
    file is as it was."""
    moving.cycles.seed = 0
    visible = {ob.name: ob.hide_render for ob in bpy.data.objects}
    generous = replace(LARGER, max_error=Budget(0.2, 1.0))  # so that few paths are sure that something may go
    do(tmp_path, (1, 2), bake=SHOT, engine="cycles", save=tmp_path / "baked.blend", options=generous)
    assert {ob.name: ob.hide_render for ob in bpy.data.objects} == visible
    hidden = set(visible) - shown(load_states(tmp_path / "states" / "frame_0002.npz"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "baked.blend"))
    scene = bpy.context.scene
    assert {ob.name for ob in bpy.data.objects if ob.hide_render} >= {name for name in hidden if name.startswith("box")}
    assert any(ob.hide_render for ob in bpy.data.objects)
    scene.render.image_settings.file_format, scene.render.image_settings.color_depth = "OPEN_EXR", "32"
    for frame in (1, 2):
        scene.frame_set(frame)
        scene.cycles.samples = 1
        scene.render.filepath = str(tmp_path / f"plain{frame}.exr")
        bpy.ops.render.render(write_still=True)
        plain, ours = read_picture(tmp_path / f"plain{frame}.exr"), read_picture(tmp_path / f"frame_000{frame}.exr")
        np.testing.assert_array_equal(plain[..., :3], ours[..., :3])


def test_a_set_of_frames_with_other_instances() -> None:
    """Frames with instances in another order, more of them, and other names for their indices."""

    def frame(objects: list[str], kept: list[bool]) -> States:
        names = tuple(sorted(set(objects)))
        n = len(objects)
        keys: dict[str, np.ndarray] = {"kind": np.zeros(n, np.uint8), "host": np.full(n, -1, np.int32)}
        keys["object"] = np.array([names.index(o) for o in objects], np.int32)
        keys["path"] = np.zeros((n, 0), np.int32)
        return States(
            np.where(kept, State.ACTIVE, State.CULLED).astype(np.uint8),
            np.zeros(n, np.float32),
            np.zeros((n, 5), np.int64),
            keys,
            names,
        )

    a, b, c = (
        frame(["b", "c"], [True, False]),
        frame(["c", "b"], [False, False]),
        frame(["a", "c", "d"], [False, True, True]),
    )
    shot = ShotSet()
    for one in (a, b, c):
        shot.add(one)
    assert shot.of(a).tolist() == [True, True]
    assert shot.of(b).tolist() == [True, True]
    assert shot.of(c).tolist() == [False, True, True]
    assert {shot.keys.names[k["object"]] for k in shot.keys.records[shot.active]} == {"b", "c", "d"}
    with pytest.raises(ValueError, match="not added"):
        shot.of(frame(["e"], [True]))


def test_faces_of_a_shot_are_those_that_any_frame_keeps() -> None:
    """An object that a frame keeps as a whole, or with another number of faces, stays as a whole; one that a frame
    culls is as the others say."""

    def frame(kept: dict[str, list[bool] | bool]) -> States:
        names, n = tuple(kept), len(kept)
        keys: dict[str, np.ndarray] = {
            "kind": np.zeros(n, np.uint8),
            "host": np.full(n, -1, np.int32),
            "object": np.arange(n, dtype=np.int32),
        }
        keys["path"] = np.zeros((n, 0), np.int32)
        state = np.array([State.CULLED if value is False else State.ACTIVE for value in kept.values()], np.uint8)
        faces = {name: np.array(value) for name, value in kept.items() if isinstance(value, list)}
        return States(state, np.zeros(n, np.float32), np.zeros((n, 5), np.int64), keys, names, "", faces)

    some, others = [True, False, False], [False, False, True]
    frames = [
        frame({"a": some, "b": some, "c": True, "d": False, "e": some}),
        frame({"e": others[:2], "d": others, "c": some, "b": True, "a": others}),
        frame({"a": False, "b": some, "c": some, "d": some, "e": some}),
    ]
    for order in (frames, frames[::-1]):
        shot = ShotSet()
        for one in order:
            shot.add(one)
        assert {name: mask.tolist() for name, mask in shot.faces.items()} == {
            "a": [True, False, True],
            "d": [True, False, True],
        }


def test_a_whole_render_is_only_counted(moving: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """--cull none by Blender's engines extracts nothing; counts and states are those of an extraction."""
    expected = extract_frame(moving, 2)
    monkeypatch.setattr(Extractor, "frame", lambda *_: pytest.fail("extracted"))
    r = do(tmp_path, (2,), engine="cycles", options=CullOptions(policy="none"))
    n = len(expected.scene.instances)
    assert (r.frames[0]["instances"], r.frames[0]["active"], r.frames[0]["meshes"]) == (
        n,
        n,
        len(expected.scene.meshes),
    )
    states = load_states(tmp_path / "states" / "frame_0002.npz")
    assert (states.state == State.ACTIVE).all()
    assert [states.names[k] for k in states.keys["object"]] == [
        expected.keys.names[k] for k in expected.keys.records["object"]
    ]


class Mallinfo2(ctypes.Structure):
    """What glibc's mallinfo2 (2.33 and later) returns."""

    _fields_ = tuple((name, ctypes.c_size_t) for name in (
        "arena", "ordblks", "smblks", "hblks", "hblkhd", "usmblks", "fsmblks", "uordblks", "fordblks", "keepcost"
    ))  # fmt: skip


def held() -> float:
    """Megabytes that this process has asked for and not freed; what of them is resident goes up and down by tens."""
    library = ctypes.CDLL(None)
    library.mallinfo2.restype = Mallinfo2
    info = library.mallinfo2()
    return float(info.uordblks + info.hblkhd) / 1e6


@pytest.mark.skipif(
    sys.platform != "linux" or not hasattr(ctypes.CDLL(None), "mallinfo2"), reason="needs glibc 2.33 or later"
)
@pytest.mark.parametrize(("keep", "last"), [(True, 40), (False, 25)], ids=["graph kept", "graph anew"])
def test_memory_is_flat(moving: Any, tmp_path: Path, keep: bool, last: int) -> None:
    """A mesh of 40,000 vertices deforms, and is loaded and built in each frame. If one array of it stayed, the smallest
    has 0.48 MB, that would be seen."""
    bpy.ops.mesh.primitive_grid_add(x_subdivisions=200, y_subdivisions=200, size=4, location=(0, -2, 3))
    wave = bpy.context.object.modifiers.new("w", "WAVE")
    wave.height, wave.time_offset = 0.3, -100
    session = Session(Job(tmp_path, tuple(range(1, 99)), OPTIONS))
    session.keep = keep
    seen = []
    for frame in range(1, last + 1):
        extraction, _ = session.sync(frame)
        result = session.decide(extraction)
        assert result.active.any()
        change = extraction.change
        assert change is None or len(change.deformed) + len(change.replaced) >= 1
        if frame in (10, last):
            del extraction, result
            gc.collect()
            seen.append(held())
    session.close()
    assert seen[1] - seen[0] < 0.24 * (last - 10)


def test_the_last_frame_keeps_nothing_to_compare_it_with(boxes: Any, tmp_path: Path) -> None:
    """What Blender gave of a scatter, 64 bytes an instance, is let go of before the analysis; meshes can still be
    read."""
    box = bpy.data.objects["box1"]
    host = bpy.data.objects.new("host", box.data)
    bpy.context.scene.collection.objects.link(host)
    host.modifiers.new("scatter", "NODES").node_group = _scatter_group(box)
    session = Session(Job(tmp_path, (1,), OPTIONS, "cycles"))
    extraction, _ = session.sync(1)
    assert session._extractor is not None
    found = [
        node.geometry.columns
        for node in session._extractor._reader.graph.order
        if node.geometry is not None and len(node.geometry.columns)
    ]
    columns = [weakref.ref(array) for array in found]
    assert len(columns) == 1
    found.clear()
    assert columns[0]() is not None
    session.end_reading()
    gc.collect()
    assert columns[0]() is None
    assert session.decide(extraction).active.any()
    session.close()


def _scatter_group(source: Any) -> Any:
    """A modifier's node group that instances an object on the points of the geometry."""
    group = bpy.data.node_groups.new("scatter", "GeometryNodeTree")
    group.is_modifier = True
    for way in ("INPUT", "OUTPUT"):
        group.interface.new_socket("Geometry", in_out=way, socket_type="NodeSocketGeometry")
    kinds = ("NodeGroupInput", "NodeGroupOutput", "GeometryNodeInstanceOnPoints", "GeometryNodeObjectInfo")
    inputs, output, place, info = (group.nodes.new(kind) for kind in kinds)
    info.inputs["Object"].default_value = source
    info.inputs["As Instance"].default_value = True
    group.links.new(inputs.outputs[0], place.inputs["Points"])
    group.links.new(info.outputs["Geometry"], place.inputs["Instance"])
    group.links.new(place.outputs["Instances"], output.inputs[0])
    return group


def test_a_baked_file_says_that_it_keeps_what_is_linked(moving: Any, tmp_path: Path) -> None:
    """Blender would not save that a directly linked object is hidden."""
    do(tmp_path / "local", (1,), bake=SHOT)
    seen = shown(load_states(tmp_path / "local" / "states" / "frame_0001.npz"))
    name = min(ob.name for ob in bpy.data.objects if ob.name.startswith("box") and ob.name not in seen)
    library = str(tmp_path / "library.blend")
    bpy.data.libraries.write(library, {bpy.data.objects[name]})
    bpy.data.objects.remove(bpy.data.objects[name])
    with bpy.data.libraries.load(library, link=True) as (_, to):
        to.objects = [name]
    moving.collection.objects.link(to.objects[0])
    done = do(tmp_path / "linked", (1,), bake=SHOT, save=tmp_path / "baked.blend")
    assert any("its object is linked" in line for line in done.warnings)
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "baked.blend"))
    assert not bpy.data.objects[name].hide_render
