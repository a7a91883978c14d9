"""`flythrough`: the city of `mirror-city` on the move. The camera drives along a side street, turns the corner into the
street, and ends before the mirror.

Until the corner the picture shows what lies ahead; then the street comes into view, and with it, in the mirror, what
lies behind. Shortly before the end there is a cut to a road beyond the street, and a cut back: everything comes into
view in one frame.
"""

from __future__ import annotations

import math

import bpy
import numpy as np

from ...core.errors import InputError
from . import mirror_city as city
from .builders import scatter
from .solids import F64

FRAMES = 120
CUT, BACK = 90, 102  # frames (from 0) of the cut away and of the cut back
SIDE_STREET = -17.0  # y of its middle line: a road between the suburb's blocks
_OPENING = 13.0  # half the width that is left out of the row of houses
_START, _CORNER = -95.0, 7.0  # x where the drive begins; radius of the turn
_EYE, _TILT = city.CAMERA[2], math.radians(95.5)
_END_TURN = math.radians(-9.0)
_ELSEWHERE, _PACE = (95.0, 21.0), 1.5  # where the cut goes to, and metres per frame along the road there


def build(instances: int | None, seed: int) -> None:
    """Replace the open file by the flythrough, `instances` of them in the city (1,000 to 1,000,000)."""
    count = city.DEFAULT_INSTANCES if instances is None else instances
    if not city.FEWEST <= count <= city.MOST:
        raise InputError(
            f"flythrough takes {city.FEWEST:,} to {city.MOST:,} instances, not {count:,}: change --instances"
        )
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    points, kind, turn, size = city.layout(count, np.random.default_rng(seed), leave_out=_in_the_way)
    scatter("City", city.sources(np.random.default_rng(seed + 1)), points, kind, turn, size)
    city.add_street(scene, float(np.abs(points[:, :2]).max()) + 60.0)
    city.add_mirror(scene)
    city.add_light(scene)
    city.add_camera(scene)
    _drive(scene)


def _in_the_way(rows: F64) -> np.ndarray:
    """Which rows of the street (K, 5) stand where the side street opens into it."""
    return (rows[:, 0] < -4.0) & (np.abs(rows[:, 1] - SIDE_STREET) < _OPENING)


def path() -> F64:
    """Position and heading of the camera in every frame: (FRAMES, 4) x, y, z in metres and the turn about Z in
    radians."""
    away = np.arange(BACK - CUT)
    elsewhere = np.column_stack(
        [_ELSEWHERE[0] + _PACE * away, np.full((len(away), 3), (_ELSEWHERE[1], _EYE, -math.pi / 2))]
    )
    drive = _road(FRAMES - len(away))
    return np.concatenate([drive[:CUT], elsewhere, drive[CUT:]])


def _road(frames: int) -> F64:
    """The drive alone, (frames, 4): straight on, a quarter circle to the left, straight on to where `mirror-city`
    stands; it brakes towards the end."""
    x1, y1 = city.CAMERA[0], city.CAMERA[1]
    first = x1 - _CORNER - _START
    arc = _CORNER * math.pi / 2
    last = y1 - (SIDE_STREET + _CORNER)
    t = np.linspace(0, 1, frames)
    s = (first + arc + last) * (1 - (1 - t) ** 1.7)  # distance driven
    angle = np.clip((s - first) / _CORNER, 0, math.pi / 2)
    x = np.minimum(_START + s, x1 - _CORNER) + _CORNER * np.sin(angle)
    y = SIDE_STREET + _CORNER * (1 - np.cos(angle)) + np.maximum(s - first - arc, 0)
    straight = np.clip((s - first - arc) / last, 0, 1)
    heading = -math.pi / 2 + angle + straight * _END_TURN
    return np.column_stack([x, y, np.full(frames, _EYE), heading])


def _drive(scene: bpy.types.Scene) -> None:
    """A keyframe of the camera in every frame."""
    scene.frame_start, scene.frame_end = 1, FRAMES
    camera = scene.camera
    for k, (x, y, z, heading) in enumerate(path()):
        camera.location, camera.rotation_euler = (x, y, z), (_TILT, 0.0, heading)
        camera.keyframe_insert("location", frame=k + 1)
        camera.keyframe_insert("rotation_euler", frame=k + 1)
    scene.frame_set(1)
