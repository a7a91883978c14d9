"""Culling renders of the open file by a result, and taking that back; the scene's switches say for which frames it is
so."""

from __future__ import annotations

import secrets
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import bpy
import numpy as np

from ... import roles, writeback
from ...keys import Kind
from ...writeback.emptying import EDITED_LEVEL
from ...writeback.marks import COARSER, EMPTIED, HIDDEN, MASKED, PARTICLES, SIMPLIFIED, all_marks, culled_libraries
from ...writeback.references import scenes_in_picture
from . import results, scatters, session, topology
from .results import FrameResult

if TYPE_CHECKING:
    from ....core.files.level import AnyLevel

T = TypeVar("T")
CHANGED = "their scatter has changed since the analysis: analyze again"
RESHAPED = "their mesh has changed since the analysis: analyze again"
REFORMED = "they, or their modifiers, have changed since the analysis: analyze again"
MULTI_VIEW = "Stereoscopy renders from several cameras, of which only one is analyzed: switch it off"
_COUNTED = (  # words of marks, and what to say of so many
    (HIDDEN, "objects"),
    (MASKED, "scatters or meshes in part"),
    (PARTICLES, "particle systems"),
    (EMPTIED, "sources"),
    (SIMPLIFIED, "meshes, simplified"),
    (COARSER, "levels of subdivision"),
)
notes: tuple[str, ...] = ()  # of the last `apply`: which culled instances stay, and why
_culled_libraries: list[str] = []  # what is linked from these is hidden again when the file is opened again


@dataclass(frozen=True)
class Applied:
    """What was applied until Restore: a result, for frames of a scene."""

    uid: int
    result: FrameResult
    frames: range


# What `apply` did last, beside renders, by the number that the file bears since: undo goes back to an older one
_done: dict[int, Applied] = {}
_HELD = 4  # of them, for results of large scenes are large
_held: Applied | None = None  # what comes back when the running render ends
# words of marks by session uid, and how many objects there were
_marked: tuple[int, dict[int, list[str]]] | None = None


def apply(
    scene: bpy.types.Scene, result: FrameResult, in_render: bool = False, frames: range | None = None
) -> writeback.WritebackResult:
    """Hide what a result culls from renders, and have what stays at its levels of detail; pinned and ignored objects
    stay as they are, and so do scatters and meshes that have changed since they were analysed.

    in_render: until the running render ends. frames: that it holds for, None: its own. Write-back speaks of the whole
    file, so this takes the place of what another scene's result had hidden.
    """
    global notes  # noqa: PLW0603
    restore(in_render)
    culled = result.culled & ~result.of_objects(roles.marked(roles.PIN, roles.IGNORE))
    changed = culled & _of_changed(scene, result)
    keys = result.current_keys()
    rows = (
        {}
        if scene.render.use_motion_blur
        else {name: result.scatters[uid] for name, uid in _names(result, keys.names) if uid in result.scatters}
    )
    faces, reshaped = _faces(result, keys.names)
    levels, reformed = _levels(result, keys.names)
    applied = writeback.apply(
        culled & ~changed,
        keys,
        rows,
        scene=scene,
        lasting=not in_render,
        in_render=in_render,
        faces=faces,
        levels=levels,
    )
    if changed.any():
        applied.kept[CHANGED] = int(changed.sum())
    if reshaped:
        applied.whole[RESHAPED] = reshaped
    shown = 0 if in_render else sum(SIMPLIFIED in words for words in marks().values())
    notes = (
        *(f"{count:,} culled instances stay in renders: {why}" for why, count in applied.kept.items()),
        *(f"{count:,} objects keep all faces in renders: {why}" for why, count in applied.whole.items()),
        *([f"{reformed:,} objects keep their own level of detail in renders: {REFORMED}"] if reformed else []),
        *([f"{shown:,} objects show a simplified mesh until Restore: edit them after that"] if shown else []),
    )
    settings = scene.lipac
    settings.in_render, settings.applied = in_render, not in_render
    if not in_render:
        frames = frames or range(result.frame, result.frame + 1)
        settings.applied_from, settings.applied_to, settings.applied_step = frames[0], frames[-1], frames.step
        settings.applied_count, settings.applied_as = int(applied.removed.sum()), secrets.randbits(31)
        _done[settings.applied_as] = Applied(scene.session_uid, result, frames_of(scene))
        for old in list(_done)[:-_HELD]:
            del _done[old]
    return applied


def forget() -> None:
    """Another file is open."""
    global notes, _held
    notes, _held = (), None
    _culled_libraries.clear()
    _done.clear()
    recount()


def restore(in_render: bool = False) -> bool:
    """Show again all that was hidden, by whichever scene; True where there was something. in_render: a handler of a
    render calls."""
    recount()
    if bpy.data.libraries and not any(scene.lipac.in_render for scene in bpy.data.scenes):  # else the marks are ours
        _culled_libraries.extend(name for name in culled_libraries() if name not in _culled_libraries)
    found = writeback.restore(in_render)
    for scene in bpy.data.scenes:
        for name in ("applied", "in_render"):
            if scene.library is None and getattr(scene.lipac, name):
                setattr(scene.lipac, name, False)
    return found


# Within renders


def cull_frame(scene: bpy.types.Scene) -> None:
    """Before a frame is rendered: hide what its analysis culls, nothing where it was not analysed. What was applied
    stays for its frames; else it comes back when the render has ended, where it is known, and is gone where it is not.
    """
    global _held  # noqa: PLW0603
    owner, frame, multi_view = applied_scene(), scene.frame_current, scene.render.use_multiview
    if owner is not None:
        # there removing the mask would crash Blender
        if (owner == scene and frame in frames_of(scene) and not multi_view) or scenes_in_picture(scene):
            return
        _held = what_is_applied()
        restore()  # of one scene alone as outside of a render: Blender has evaluated it without what was hidden
    result = None if multi_view else results.at(scene)
    if _held is not None and _held.uid == scene.session_uid and frame in _held.frames and not multi_view:
        apply(scene, _held.result, in_render=True)
    elif result is not None:
        apply(scene, result, in_render=True)
    elif scene.lipac.in_render:
        restore(in_render=True)


def end_render(scene: bpy.types.Scene) -> None:
    """When the render has ended, in whatever way: all is as before."""
    global _held
    if scene.lipac.in_render:
        restore(in_render=True)
    held, _held = _held, None
    if held is not None:
        apply_again(held)


def apply_again(applied: Applied) -> None:
    """Apply what was applied before."""
    scene = session.find_scene(applied.uid)
    if scene is not None:
        apply(scene, applied.result, frames=applied.frames)


# What is hidden


def applied_scene() -> bpy.types.Scene | None:
    """The scene whose result is applied until Restore."""
    return next((scene for scene in bpy.data.scenes if scene.library is None and scene.lipac.applied), None)


def frames_of(scene: bpy.types.Scene) -> range:
    """Frames that what is applied holds for."""
    settings = scene.lipac
    return range(settings.applied_from, settings.applied_to + 1, max(1, settings.applied_step))


def what_is_applied() -> Applied | None:
    """What is applied, where that is known: not of a file that was opened, nor after many steps of undo."""
    owner = applied_scene()
    applied = _done.get(owner.lipac.applied_as) if owner is not None else None
    return applied if owner is not None and applied is not None and applied.uid == owner.session_uid else None


def marks() -> dict[int, list[str]]:
    """What is hidden in the file, by whomever: the words of write-back's marks by session uid."""
    global _marked  # noqa: PLW0603
    if _marked is None or _marked[0] != len(bpy.data.objects):
        _marked = len(bpy.data.objects), {ob.session_uid: words for ob, words in all_marks().items()}
    return _marked[1]


def recount() -> None:
    """What is hidden may have changed: write-back, undo, another file."""
    global _marked  # noqa: PLW0603
    _marked = None


def edits_level() -> bool:
    """Whether the user edits, sculpts or paints a simplified mesh, which cannot be exchanged meanwhile."""
    return any(SIMPLIFIED in marks().get(ob.session_uid, ()) for ob in session.not_in_object_mode())


def edited_levels() -> set[str]:
    """Names of simplified meshes that Restore has kept, for the user had edited them."""
    return {mesh.name for mesh in bpy.data.meshes if mesh.name.startswith(EDITED_LEVEL)}


def comes_back() -> str:
    """A sentence on what is shown again only as long as the file is open; "" where nothing is."""
    names = ", ".join(_culled_libraries)
    return names and f"Until this file is opened again: {names} was saved with culling applied; Restore there"


def status(scene: bpy.types.Scene) -> tuple[str, bool]:
    """What renders of a scene show, in a sentence or more, and whether that wants a look."""
    line, alert = _status(scene)
    return (f"{line}. {comes_back()}", True) if comes_back() and not marks() else (line, alert)


def _status(scene: bpy.types.Scene) -> tuple[str, bool]:
    owner, frame = applied_scene(), scene.frame_current
    own = scene.lipac.use_for_renders
    if not marks():
        if not own:
            return "Renders show everything", False
        if scene.render.use_multiview:
            return f"Renders show everything. {MULTI_VIEW}", True
        if results.at(scene) is None:
            return f"Frame {frame} is not analyzed: it renders in full", True
        return f"Renders hide what frame {frame} does not need", False
    if owner is None:
        words = [word for words in marks().values() for word in words]
        counts = ((sum(word.startswith(own) for word in words), name) for own, name in _COUNTED)
        what = ", ".join(f"{count:,} {name}" for count, name in counts if count) or "nothing that is there any more"
        return f"Hidden from renders, by another session or file: {what}. Restore shows all", True
    frames = frames_of(owner)
    when = f"frame {frames[0]}" if len(frames) == 1 else f"frames {frames[0]} to {frames[-1]}"
    line = (
        f"Hidden from renders: {owner.lipac.applied_count:,} instances, for "
        f"{when}{'' if owner == scene else f' of scene {owner.name}'}"
    )
    if scene.render.use_multiview:
        return f"{line}. {MULTI_VIEW}", True
    if owner == scene and frame in frames:
        return line, False
    if own and not scenes_in_picture(scene):
        return (
            f"{line}. Frame {frame} renders {'in full' if results.at(scene) is None else 'by its own analysis'}",
            False,
        )
    return f"{line}. What frame {frame} shows may be missing: Restore, or Bake Shot", True


def _names(result: FrameResult, names: tuple[str, ...]) -> list[tuple[str, int]]:
    return [(name, uid) for name, uid in zip(names, result.uids.tolist(), strict=True) if name]


def _levels(result: FrameResult, names: tuple[str, ...]) -> tuple[dict[str, AnyLevel], int]:
    """By the name of an object, what takes the place of its mesh; and how many objects keep theirs, for they were
    edited."""
    wanted = _wanted(result.levels)
    now = topology.forms_of(wanted)
    same = {uid for uid, digest in now.items() if digest == result.forms.get(uid)}
    return {name: wanted[uid] for name, uid in _names(result, names) if uid in same}, len(now) - len(same)


def _faces(result: FrameResult, names: tuple[str, ...]) -> tuple[dict[str, np.ndarray], int]:
    """By the name of an object, (F,) bool, faces of it that stay; and of how many objects nothing is known any more,
    for they were edited."""
    wanted = _wanted(result.faces)
    now = topology.digests_of(wanted)
    same = {uid for uid, digest in now.items() if digest == result.shapes.get(uid)}
    return {name: wanted[uid] for name, uid in _names(result, names) if uid in same}, len(now) - len(same)


def _wanted(of: Mapping[int, T]) -> dict[int, T]:
    """What there is by the uids of objects, less those that renders show as the user has them."""
    marked = {ob.session_uid for ob in roles.marked(roles.PIN, roles.IGNORE)} if of else set()
    return {uid: value for uid, value in of.items() if uid not in marked}


def _of_changed(scene: bpy.types.Scene, result: FrameResult) -> np.ndarray:
    """(N,) bool: instances of scatters that have changed. Nothing is known of a frame that the viewport does not
    show."""
    now = scatters.prints_of(scene, result.prints) if result.prints else {}
    changed = np.array([uid for uid, seen in now.items() if seen != result.prints[uid]], np.int64)
    host = result.keys.records["host"]
    table = np.append(np.isin(result.uids, changed), False)  # index -1: no host
    return np.asarray(table[host] & (result.keys.records["kind"] == Kind.GEOMETRY_NODES))
