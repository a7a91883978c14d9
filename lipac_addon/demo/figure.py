"""A figure with a skeleton that walks: one of our own, or a character from a file. `crowd` copies it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np

from ...core.errors import InputError
from ..open import open_scene
from .builders import material, mesh
from .solids import F64, Solid

HEIGHT = 1.8  # metres
CYCLE = 24  # frames of a step of our own figure with either foot

# Bones of our own figure: name, parent, head and tail (metres; it looks along -Y), swing of its walk: amplitude in
# radians about X and phase in cycles.
_BONES = (
    ("hips", "", (0, 0, 0.95), (0, 0, 1.1), 0.04, 0.25),
    ("spine", "hips", (0, 0, 1.1), (0, 0, 1.45), 0.05, 0.0),
    ("head", "spine", (0, 0, 1.5), (0, 0, 1.8), 0.08, 0.5),
    ("arm.L", "spine", (0.2, 0, 1.42), (0.26, 0, 1.13), 0.6, 0.5),
    ("forearm.L", "arm.L", (0.26, 0, 1.13), (0.28, -0.05, 0.85), 0.25, 0.6),
    ("arm.R", "spine", (-0.2, 0, 1.42), (-0.26, 0, 1.13), 0.6, 0.0),
    ("forearm.R", "arm.R", (-0.26, 0, 1.13), (-0.28, -0.05, 0.85), 0.25, 0.1),
    ("thigh.L", "hips", (0.1, 0, 0.95), (0.11, -0.01, 0.5), 0.55, 0.0),
    ("shin.L", "thigh.L", (0.11, -0.01, 0.5), (0.11, 0.02, 0.06), 0.45, 0.75),
    ("thigh.R", "hips", (-0.1, 0, 0.95), (-0.11, -0.01, 0.5), 0.55, 0.5),
    ("shin.R", "thigh.R", (-0.11, -0.01, 0.5), (-0.11, 0.02, 0.06), 0.45, 0.25),
)
_CLOTHES = {"hips": 1, "spine": 0, "head": 2, "arm": 0, "forearm": 2, "thigh": 1, "shin": 1}  # slot by bone
_GIRTH = {"hips": 0.17, "spine": 0.19, "head": 0.11, "arm": 0.065, "forearm": 0.05, "thigh": 0.09, "shin": 0.065}
_SIDES, _RINGS = 12, 8


@dataclass(frozen=True)
class Figure:
    """armature: object with the skeleton; parts: meshes that it deforms; action: its movement; scale: factor that makes
    its longest side HEIGHT."""

    armature: bpy.types.Object
    parts: tuple[bpy.types.Object, ...]
    action: bpy.types.Action
    scale: float


def from_file(path: Path) -> Figure:
    """The character of a scene file (glTF, .blend, USD), which replaces the open file. Raises InputError where it has
    no skeleton, mesh or movement."""
    open_scene(path)
    for armature in bpy.data.objects:
        if armature.type != "ARMATURE":
            continue
        parts = tuple(ob for ob in bpy.data.objects if ob.type == "MESH" and ob.find_armature() == armature)
        held = armature.animation_data
        action = (held and held.action) or next(
            iter(sorted(bpy.data.actions, key=lambda a: ("walk" not in a.name.lower(), a.name))), None
        )
        if parts and action is not None:
            return Figure(armature, parts, action, HEIGHT / max(float(np.ptp(_corners(parts), axis=0).max()), 1e-6))
    raise InputError(
        f"{path}: no animated character in it: --figure takes a file with a skeleton, a mesh on it and an action"
    )


def _corners(parts: tuple[bpy.types.Object, ...]) -> F64:
    """World corners of the boxes of objects: (K, 3)."""
    out = []
    for part in parts:
        matrix = np.array(part.matrix_world)
        out.append(np.array([tuple(c) for c in part.bound_box]) @ matrix[:3, :3].T + matrix[:3, 3])
    return np.concatenate(out)


def our_own() -> Figure:
    """A plain figure of eleven bones, in an empty file, with a walk of CYCLE frames."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    skeleton = bpy.data.armatures.new("Figure")
    armature = bpy.data.objects.new("Figure", skeleton)
    bpy.context.scene.collection.objects.link(armature)
    bpy.context.view_layer.objects.active = armature
    bpy.ops.object.mode_set(mode="EDIT")
    for name, parent, head, tail, _, _ in _BONES:
        bone = skeleton.edit_bones.new(name)
        bone.head, bone.tail = head, tail
        bone.parent = skeleton.edit_bones.get(parent)
    bpy.ops.object.mode_set(mode="OBJECT")
    solid, owner = _body()
    cloth, trousers, skin = (
        material("Cloth", (0.2, 0.25, 0.5), 0.8),
        material("Trousers", (0.06, 0.06, 0.08), 0.8),
        material("Skin", (0.55, 0.33, 0.22), 0.5),
    )
    body = bpy.data.objects.new("Body", mesh("Body", solid, (cloth, trousers, skin)))
    body.data.shade_smooth()
    bpy.context.scene.collection.objects.link(body)
    for k, (name, *_) in enumerate(_BONES):
        body.vertex_groups.new(name=name).add(np.flatnonzero(owner == k).tolist(), 1.0, "REPLACE")
    body.parent = armature
    body.modifiers.new("Armature", "ARMATURE").object = armature
    return Figure(armature, (body,), _walk(armature), 1.0)


def _body() -> tuple[Solid, np.ndarray]:
    """An ellipsoid around every bone, and for each vertex the index of its bone."""
    s, owner = Solid(), []
    for k, (name, _, head, tail, _, _) in enumerate(_BONES):
        kind = name.split(".")[0]
        a, b = np.array(head, float), np.array(tail, float)
        axis = b - a
        side = np.cross(axis, (0.0, 1.0, 0.0))
        side /= np.linalg.norm(side)
        front = np.cross(side, axis) / np.linalg.norm(axis)
        ring = np.linspace(0, 2 * math.pi, _SIDES, endpoint=False)
        along = np.linspace(0, math.pi, _RINGS + 1)
        width = _GIRTH[kind] * np.sin(along)
        middle = (a + b) / 2 - axis[None] * 0.62 * np.cos(along)[:, None]
        flat = 0.7 if kind in ("hips", "spine") else 1.0
        round_ = np.cos(ring)[None, :, None] * side + flat * np.sin(ring)[None, :, None] * front
        points = (middle[:, None] + width[:, None, None] * round_).reshape(-1, 3)
        i, j = (m.ravel() for m in np.meshgrid(np.arange(_RINGS), np.arange(_SIDES), indexing="ij"))
        first, second = i * _SIDES + j, i * _SIDES + (j + 1) % _SIDES
        s.add(points, np.stack([first, second, second + _SIDES, first + _SIDES], 1), _CLOTHES[kind])
        owner.append(np.full(len(points), k))
    return s, np.concatenate(owner)


def _walk(armature: bpy.types.Object) -> bpy.types.Action:
    """A walk on the spot: every bone swings about its X axis."""
    for name, _, _, _, amplitude, phase in _BONES:
        bone = armature.pose.bones[name]
        bone.rotation_mode = "XYZ"
        for k in range(0, CYCLE + 1, CYCLE // 8):
            swing = amplitude * math.sin(2 * math.pi * (k / CYCLE + phase))
            bend = abs(amplitude) if name.startswith(("shin", "forearm")) else 0.0  # knees and elbows bend one way
            bone.rotation_euler = ((bend if name.startswith("shin") else -bend) + swing, 0.0, 0.0)
            bone.keyframe_insert("rotation_euler", index=0, frame=k + 1)
    action = armature.animation_data.action
    action.name = "Walk"
    return action
