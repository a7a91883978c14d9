"""Pin and Ignore, as commands without a window know them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy
import pytest

from lipac.core.culling.options import CullOptions, State
from lipac.core.error_budget.budget import Budget
from lipac.core.files.report import Report, load_states
from lipac.lipac_addon import roles
from lipac.lipac_addon.batch.job import Job
from lipac.lipac_addon.batch.pipeline import run
from lipac.lipac_addon.open import open_scene

LOOSE = CullOptions(max_error=Budget(0.05, 0.3), paths=2)


@pytest.fixture
def marked_boxes(boxes: Any) -> Any:
    """Of the four boxes behind the wall one is pinned, and one is in a collection that is ignored."""
    roles.make_known()
    bpy.data.objects["box5"].lipac_role = roles.PIN
    outer, inner = (bpy.data.collections.new(name) for name in ("outer", "inner"))
    outer.children.link(inner)
    inner.objects.link(bpy.data.objects["box6"])
    outer.lipac_role = roles.IGNORE
    return boxes


@pytest.mark.parametrize(
    ("options", "engine"),
    [
        (LOOSE, ""),
        (CullOptions(policy="distance", setting=19.5), "cycles"),
        (CullOptions(policy="distance", setting=19.5), "path"),
    ],
    ids=["light paths", "rule", "rule, path tracer"],
)
def test_what_is_pinned_or_ignored_stays(marked_boxes: Any, tmp_path: Path, options: CullOptions, engine: str) -> None:
    """Also where it is elsewhere while the shutter is open, and there are more instances then than at the frame."""
    if not engine:
        marked_boxes.render.use_motion_blur = True
        for k, name in enumerate(("box4", "box5", "box7")):
            ob = bpy.data.objects[name]
            ob.keyframe_insert("location", frame=0)
            ob.location.x += k
            ob.keyframe_insert("location", frame=2)
        bpy.data.objects["box7"].scale = (0.0, 0.0, 0.0)
    run(Job(tmp_path, (1,), options, engine, samples=1), Report("boxes", "", "", options.policy, engine, 0, 1))
    states = load_states(tmp_path / "states" / "frame_0001.npz")
    shown = {states.names[k] for k in states.keys["object"][states.state != State.CULLED].tolist()}
    assert shown & {"box4", "box5", "box6", "box7"} == {"box5", "box6"}


def test_an_override_keeps_its_role_without_the_extension(boxes_file: Path, tmp_path: Path) -> None:
    """Blender drops what it does not know from a library override as it opens a file, so it has to know before."""
    roles.make_known()
    bpy.ops.wm.read_factory_settings(use_empty=True)
    with bpy.data.libraries.load(str(boxes_file), link=True) as (_, into):
        into.objects = ["box4"]
    bpy.context.scene.collection.objects.link(into.objects[0])
    into.objects[0].override_create(remap_local_usages=True).lipac_role = roles.PIN
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene.blend"))
    roles.unregister()
    open_scene(tmp_path / "scene.blend")
    assert {(ob.name, ob.library) for ob in roles.marked(roles.PIN)} == {("box4", None)}
    assert not roles.marked(roles.IGNORE)
