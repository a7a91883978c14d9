"""`crowd`: characters with skeletons fill a few parallel streets, each deformed on its own, at its own place in its
walk.

The camera stands in the middle street among them. It sees those near it, in the glass of a shop front some more, and
nothing of the other streets.
"""

from __future__ import annotations

import math
from pathlib import Path

import bpy
import numpy as np

from ...core.errors import InputError
from . import city_parts as parts
from . import figure
from . import mirror_city as city
from .builders import material, mesh
from .city_parts import DEPTH, WIDTH
from .figure import Figure
from .solids import F64, Solid

DEFAULT_FIGURES = 500
MOST = 20_000
FRAMES = 48
PER_STREET = 250
LENGTH = 8 * WIDTH  # of a street
_WALK = 6.0  # half the width that people walk on, in metres
_STREET = 18.0  # from front to front
_SPEED = 0.05  # metres per frame
_SHIRTS = (
    (0.5, 0.06, 0.05),
    (0.07, 0.2, 0.45),
    (0.1, 0.35, 0.12),
    (0.6, 0.5, 0.1),
    (0.55, 0.55, 0.52),
    (0.3, 0.1, 0.35),
)


def build(instances: int | None, seed: int, path: Path | None = None) -> None:
    """Replace the open file by a crowd of `instances` figures (1 to 20,000): the character in the file `path`, or one
    of our own.

    Raises InputError for an unusable number or file.
    """
    count = DEFAULT_FIGURES if instances is None else instances
    if not 1 <= count <= MOST:
        raise InputError(f"crowd takes 1 to {MOST:,} figures, not {count:,}: change --instances")
    rng = np.random.default_rng(seed)
    one = figure.our_own() if path is None else figure.from_file(path)
    scene = bpy.context.scene
    _, upright, scale = one.armature.matrix_world.decompose()  # parents that turn or scale it go
    one.armature.parent, one.armature.rotation_mode = None, "XYZ"
    one.armature.rotation_euler, one.armature.scale = upright.to_euler(), scale
    for ob in [ob for ob in bpy.data.objects if ob != one.armature and ob not in one.parts]:
        bpy.data.objects.remove(ob)
    streets = -(-count // PER_STREET)
    _streets(scene, streets, rng)
    _populate(one, places(count, rng), rng, plain=path is None)
    city.add_light(scene)
    city.add_camera(scene)
    scene.camera.location = (-3.5, -LENGTH / 2 + 3.0, 2.1)
    scene.camera.rotation_euler = (math.radians(88), 0.0, math.radians(-8))
    scene.frame_start, scene.frame_end = 1, FRAMES
    scene.frame_set(1)


def places(count: int, rng: np.random.Generator) -> F64:
    """Where figures stand: (count, 4) x, y in metres, street (0 is the camera's, then alternately left and right),
    direction of walk (1 or -1)."""
    k = np.arange(count)
    street = k // PER_STREET
    middle = np.where(street % 2, (street + 1) // 2, -(street // 2)) * (_STREET + 2 * DEPTH)
    columns = 8
    x = (k % PER_STREET % columns - (columns - 1) / 2) * (2 * _WALK / columns)
    rows = -(-PER_STREET // columns)
    y = (k % PER_STREET // columns - (rows - 1) / 2) * ((LENGTH - 12.0) / rows)
    jitter = rng.uniform(-0.5, 0.5, (count, 2)) * (0.7, 1.6)
    return np.column_stack([middle + x + jitter[:, 0], y + jitter[:, 1], street, np.where(x < 0, 1, -1)])


def _populate(one: Figure, where: F64, rng: np.random.Generator, plain: bool) -> None:
    """Copies of a figure, each with a skeleton of its own in a pose of its own; the first is the figure itself."""
    carriers: dict[tuple[int, int], bpy.types.Object] = {}
    shirts = [material(f"Shirt {k}", color, 0.8) for k, color in enumerate(_SHIRTS)] if plain else []
    start, end = one.action.frame_range
    armature = one.armature
    if armature.animation_data is not None:
        armature.animation_data_clear()
    scale, upright = armature.scale.copy(), armature.rotation_euler.copy()
    size = one.scale * rng.uniform(0.92, 1.06, len(where))
    for k, (x, y, street, direction) in enumerate(where):
        copy = armature if k == 0 else armature.copy()
        if k:
            _link(copy)
        way = int(street), int(direction)
        if way not in carriers:
            carriers[way] = _carrier(*way)
        copy.parent = carriers[way]
        copy.location = (x, y, 0.0)
        copy.rotation_mode = "XYZ"
        copy.rotation_euler = (upright[0], upright[1], math.pi if direction > 0 else 0.0)
        copy.scale = scale * float(size[k])
        _animate(copy, one.action, float(rng.uniform(0, end - start)))
        for part in one.parts:
            body = part if k == 0 else part.copy()
            if k:
                _link(body)
                if part.parent == armature:
                    body.parent = copy
                for modifier in body.modifiers:
                    if modifier.type == "ARMATURE":
                        modifier.object = copy
            if shirts:
                body.material_slots[0].link = "OBJECT"
                body.material_slots[0].material = shirts[int(rng.integers(len(shirts)))]


def _link(ob: bpy.types.Object) -> None:
    bpy.context.scene.collection.objects.link(ob)


def _carrier(street: int, direction: int) -> bpy.types.Object:
    """What moves all figures that walk along a street in one direction."""
    carrier = bpy.data.objects.new(f"Walk {street} {direction:+d}", None)
    _link(carrier)
    for frame in (1, FRAMES):
        carrier.location = (0.0, direction * _SPEED * (frame - 1), 0.0)
        carrier.keyframe_insert("location", index=1, frame=frame)
    return carrier


def _animate(armature: bpy.types.Object, action: bpy.types.Action, phase: float) -> None:
    """Play the action over and over, phase frames ahead."""
    armature.animation_data_clear()
    track = armature.animation_data_create().nla_tracks.new()
    start, end = action.frame_range
    strip = track.strips.new(action.name, 1, action)
    strip.action_frame_start, strip.action_frame_end = start, end
    strip.repeat = 2 + (FRAMES + end - start) / max(end - start, 1.0)
    strip.frame_start_ui = 1 - phase


def _streets(scene: bpy.types.Scene, count: int, rng: np.random.Generator) -> None:
    """Ground and rows of houses along every street; its ends are closed, so that it shows nothing of the others."""
    pitch = _STREET + 2 * DEPTH
    reach = LENGTH / 2 + pitch * count
    ground = Solid()
    ground.quads([[[-reach, -reach, 0], [reach, -reach, 0], [reach, reach, 0], [-reach, reach, 0]]], 0)
    _object(scene, "Ground", ground, [material("Paving", (0.36, 0.34, 0.31), 0.8)])
    kinds = []
    for k in range(6):
        solid = parts.building(
            rng,
            3 + k % 3,
            bays=(3, 4, 5)[k % 3],
            roof=("mansard", "flat", "gable")[k % 3],
            balconies=k % 2 == 0,
            arched=k % 2 == 1,
        )
        colors = ((0.52, 0.18, 0.11), (0.75, 0.62, 0.42), (0.36, 0.45, 0.52))
        walls = [
            material(f"Wall {k % 3}", colors[k % 3], 0.85),
            material("Stone", (0.62, 0.58, 0.50), 0.8),
            material("Window", (0.02, 0.03, 0.04), 0.04),
        ]
        walls += [
            material("Frame", (0.8, 0.78, 0.72), 0.4),
            material("Slate", (0.07, 0.08, 0.1), 0.5),
            material("Accent", (0.05, 0.22, 0.18), 0.4),
        ]
        kinds.append(mesh(f"House {k}", solid, walls))
    for street in range(count):
        middle = ((street + 1) // 2 if street % 2 else -(street // 2)) * pitch
        for side in (-1, 1):
            for y in np.arange(-LENGTH / 2 + WIDTH / 2, LENGTH / 2, WIDTH):
                _house(
                    scene, kinds[rng.integers(len(kinds))], (middle + side * _STREET / 2, float(y)), -side * math.pi / 2
                )
            for x in (-WIDTH / 2 - 3.0, WIDTH / 2 + 3.0):
                _house(
                    scene,
                    kinds[rng.integers(len(kinds))],
                    (middle + x, side * LENGTH / 2),
                    0.0 if side > 0 else math.pi,
                )
    glass = Solid()
    glass.quads([[[0, -5, 0.4], [0, 5, 0.4], [0, 5, 3.2], [0, -5, 3.2]]], 0)
    pane = _object(scene, "Shop front", glass, [material("Mirror", (0.95, 0.95, 0.95), 0.0, 1.0)])
    pane.location = (_STREET / 2 - 1.3, -LENGTH / 2 + 30.0, 0.0)
    pane.rotation_euler = (0.0, 0.0, math.pi)


def _house(scene: bpy.types.Scene, data: bpy.types.Mesh, place: tuple[float, float], turn: float) -> None:
    made = bpy.data.objects.new(data.name, data)
    made.location, made.rotation_euler = (*place, 0.0), (0.0, 0.0, turn)
    scene.collection.objects.link(made)


def _object(scene: bpy.types.Scene, name: str, solid: Solid, materials: list[bpy.types.Material]) -> bpy.types.Object:
    made = bpy.data.objects.new(name, mesh(name, solid, materials))
    scene.collection.objects.link(made)
    return made
