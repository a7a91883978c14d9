"""The kinds of scenes of `family`. A function of each builds what stands around, and says where instances are."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .builders import Color
from .family_stage import ASPECT, Scatter, Stage
from .solids import F64

_SOLID = "cube", "ball", "blade", "rod", "leaf"
_REC709 = np.array([0.2126, 0.7152, 0.0722])


@dataclass(frozen=True)
class Kind:
    """build: (stage, count, pixels) -> where instances are. lights: the lamps that it needs, None: any; veils: whether
    it may be seen through glass or in a mirror; clusters: whether an instance may be several things; largest: pixels;
    layers: of instances over the whole picture, at most: what is large comes in smaller numbers."""

    build: Callable[[Stage, int, float], Scatter]
    lights: tuple[str, ...] | None = None
    veils: bool = True
    clusters: bool = True
    largest: float = 100.0
    layers: float = 30.0


def _sizes(stage: Stage, count: int, size: float) -> F64:
    """Of some spread, sometimes with a few much larger ones."""
    sizes = size * np.exp(stage.rng.normal(0, 0.3, count))
    return np.where(stage.rng.random(count) < 0.1, 4 * sizes, sizes) if stage.rng.random() < 0.3 else sizes


def _tumbled(stage: Stage, count: int) -> F64:
    return stage.rng.uniform(0, 2 * math.pi, (count, 3))


def _upright(stage: Stage, count: int) -> F64:
    return stage.rng.uniform(0, 2 * math.pi, (count, 1)) * (0.0, 0.0, 1.0)


def _shapes(stage: Stage, most: int = 3) -> tuple[str, ...]:
    return tuple(str(x) for x in stage.rng.choice(_SOLID, stage.rng.integers(1, most + 1)))


def _on_the_ground(
    stage: Stage, count: int, pixels: float, near: float, far: float, shapes: tuple[str, ...], turn: F64
) -> Scatter:
    """Between two distances, over somewhat less to a good deal more than the width of the picture."""
    stage.ground()
    middle = math.sqrt(near * far)
    stage.furniture((-2, near), (2, middle))
    y = near + (far - near) * stage.rng.random(count) ** 1.5
    x = stage.rng.uniform(-1, 1, count) * stage.half_width(y) * stage.rng.uniform(0.7, 3.0)
    size = _sizes(stage, count, pixels * stage.pixel(middle))
    return Scatter(np.column_stack([x, y, size / 2]), size, turn, shapes, (0, middle, 0))


def lawn(stage: Stage, count: int, pixels: float) -> Scatter:
    """Blades up to the horizon."""
    return _on_the_ground(
        stage,
        count,
        pixels,
        3.0,
        float(stage.rng.uniform(15, 60)),
        ("blade",) * int(stage.rng.integers(1, 3)),
        _upright(stage, count),
    )


def heap(stage: Stage, count: int, pixels: float) -> Scatter:
    """Things of all kinds that lie about."""
    return _on_the_ground(
        stage, count, pixels, 4.0, float(stage.rng.uniform(8, 20)), _shapes(stage), _tumbled(stage, count)
    )


def posts(stage: Stage, count: int, pixels: float) -> Scatter:
    """A wide field of things that stand, seen along the ground."""
    stage.eye = 1.2
    stage.scene.camera.location.z = stage.eye
    return _on_the_ground(
        stage, count, pixels, 4.0, float(stage.rng.uniform(40, 120)), ("blade", "rod"), _upright(stage, count)
    )


def wall(stage: Stage, count: int, pixels: float) -> Scatter:
    """Cubes that touch, facing the camera; behind them a brighter wall."""
    distance = float(stage.rng.uniform(10, 25))
    columns = max(int(math.sqrt(count / ASPECT)), 1)
    k = np.arange(count)
    size = pixels * stage.pixel(distance)
    x, z = k % columns - (columns - 1) / 2, k // columns - (count / columns - 1) / 2
    points = np.column_stack([x * size, np.full(count, distance), stage.eye + z * size])
    stage.back = distance * 1.5
    stage.panel((0, stage.back, 0), 8 * distance, 8 * distance, color=(0.8, 0.8, 0.8))
    gap = float(stage.rng.choice([1.0, 0.98, 0.8]))
    return Scatter(
        points,
        np.full(count, size * gap),
        np.zeros((count, 3)),
        ("cube",) * int(stage.rng.integers(1, 3)),
        (0, distance, stage.eye),
    )


def crown(stage: Stage, count: int, pixels: float) -> Scatter:
    """Leaves in a ball above the picture: what is seen of them is their shadow."""
    stage.ground()
    stage.furniture((-2, 4), (2, 9))
    distance = 8.0
    radius = float(stage.rng.uniform(1.5, 4.0))
    d = stage.rng.normal(size=(count, 3))
    points = d / np.linalg.norm(d, axis=1, keepdims=True) * radius * stage.rng.random((count, 1)) ** (1 / 3)
    above = stage.eye + stage.half_width(distance) * ASPECT + 1.2 * radius
    size = _sizes(stage, count, pixels * stage.pixel(distance))
    return Scatter(points + np.array([0, distance, above]), size, _tumbled(stage, count), ("leaf",), (0, distance, 0))


def gravel(stage: Stage, count: int, pixels: float) -> Scatter:
    """Behind the camera, seen in a mirror alone."""
    stage.ground()
    away, ahead = float(stage.rng.uniform(4, 10)), 6.0
    stage.panel(
        (0, ahead, 2.5),
        6,
        5,
        (0, -1, -0.12),
        (0.95, 0.95, 0.95),
        roughness=float(stage.rng.choice([0.0, 0.02, 0.15])),
        metallic=1.0,
    )
    size = _sizes(stage, count, pixels * stage.pixel(2 * ahead + away))
    points = np.column_stack([stage.rng.uniform(-8, 8, count), -2 - 2 * away * stage.rng.random(count), size / 2])
    return Scatter(points, size, _tumbled(stage, count), _shapes(stage), (0, 2, 0))


def _backed(stage: Stage, color: Color | None = None) -> float:
    """A wall across the picture, and a floor; its distance."""
    distance = float(stage.rng.uniform(8, 16))
    stage.back = distance
    stage.panel((0, distance, 4), 60, 40, color=color)
    stage.ground()
    return distance


def confetti(stage: Stage, count: int, pixels: float) -> Scatter:
    """In the air before a wall."""
    distance = _backed(stage)
    y = stage.rng.uniform(2.5, 0.95 * distance, count)
    half = stage.half_width(y) * stage.rng.uniform(0.4, 1.5)
    points = np.column_stack(
        [
            stage.rng.uniform(-1, 1, count) * half,
            y,
            np.maximum(stage.eye + stage.rng.uniform(-1, 1, count) * half * ASPECT, 0.02),
        ]
    )
    return Scatter(
        points,
        _sizes(stage, count, pixels * stage.pixel(0.6 * distance)),
        _tumbled(stage, count),
        ("leaf",) * 2,
        (0, 0.6 * distance, stage.eye),
    )


def _on_a_wall(stage: Stage, count: int, pixels: float, distance: float) -> tuple[F64, F64]:
    """Points just before a wall, some way across the picture, and sizes."""
    size = _sizes(stage, count, pixels * stage.pixel(distance))
    half = stage.half_width(distance) * stage.rng.uniform(0.2, 1.1)
    x, z = stage.rng.uniform(-1, 1, (2, count))
    return np.column_stack(
        [x * half, distance - 0.01 - 0.005 * stage.rng.random(count), stage.eye + z * half * ASPECT]
    ), size


def twins(stage: Stage, count: int, pixels: float) -> Scatter:
    """Patches of several colours on a grey wall, all of the same luminance."""
    grey = float(stage.rng.uniform(0.15, 0.5))
    distance = _backed(stage, (grey, grey, grey))
    colors: list[Color] = []
    while len(colors) < 3:
        color = stage.rng.random(3) ** 2
        color *= grey / (color @ _REC709)
        if color.max() < 1:
            colors.append((float(color[0]), float(color[1]), float(color[2])))
    points, size = _on_a_wall(stage, count, pixels, distance)
    return Scatter(points, size, np.zeros((count, 3)), ("flat",) * 3, (0, distance, stage.eye), tuple(colors))


def marks(stage: Stage, count: int, pixels: float) -> Scatter:
    """Black and white on grey: squares of a checkerboard, or strokes in lines like text; their mean is the wall's, or
    not far from it."""
    distance = _backed(stage, (0.4, 0.4, 0.4))
    size = pixels * stage.pixel(distance)
    columns = max(int(math.sqrt(count / ASPECT)), 1)
    k = np.arange(count)
    column, row = k % columns, k // columns
    text = stage.rng.random() < 0.5
    step = np.array([0.6, 1.8]) if text else np.array([1.0, 1.0])
    x = (column - (columns - 1) / 2) * step[0] * size
    z = (row - (count / columns - 1) / 2) * step[1] * size
    turn = np.zeros((count, 3))
    if text:
        turn[:, 1] = stage.rng.choice([0.0, 0.0, 0.6, 1.57], count)
        keep = stage.rng.random(count) < 0.8  # gaps between words
        x, z, turn, column, row = x[keep], z[keep], turn[keep], column[keep], row[keep]
    points, sizes = np.column_stack([x, np.full(len(x), distance - 0.01), stage.eye + z]), np.full(len(x), size)
    middle, dark, bright = (0, distance, stage.eye), (0.02, 0.02, 0.02), (0.78, 0.78, 0.78)
    if text:
        return Scatter(points, sizes, turn, ("rod",), middle, (dark,))
    return Scatter(points, sizes, turn, ("flat", "flat"), middle, (dark, bright), (column + row) % 2.0)


def specks(stage: Stage, count: int, pixels: float) -> Scatter:
    """Glowing specks in the dark, which light what is near them."""
    distance = _backed(stage)
    stage.furniture((-2, 3), (2, 0.8 * distance))
    y = stage.rng.uniform(3, 0.98 * distance, count)
    half = stage.half_width(y)
    points = np.column_stack([stage.rng.uniform(-1, 1, count) * half, y, stage.rng.uniform(0.02, stage.eye + 2, count)])
    size = _sizes(stage, count, pixels * stage.pixel(0.7 * distance))
    area = float((size**2).sum())
    colors = tuple((float(r), float(g), float(b)) for r, g, b in stage.rng.uniform(0.3, 1.0, (2, 3)))
    return Scatter(
        points,
        size,
        _tumbled(stage, count),
        ("leaf", "cube"),
        (0, 0.7 * distance, stage.eye),
        colors,
        glow=float(np.clip(60.0 / area, 0.5, 500.0)),
    )


def rods(stage: Stage, count: int, pixels: float) -> Scatter:
    """A stand of long rods between lamps and the floor that is seen."""
    stage.ground()
    stage.furniture((-2, 4), (2, 8))
    distance = 7.0
    size = np.maximum(_sizes(stage, count, 10 * pixels * stage.pixel(distance)), 1e-3)
    reach = float(stage.rng.uniform(2, 6))
    x, y, z = stage.rng.uniform((-reach, distance - reach / 2, 0), (reach, distance + reach / 2, 3), (count, 3)).T
    return Scatter(
        np.column_stack([x, y, z + size / 2]), size, stage.rng.normal(0, 0.15, (count, 3)), ("rod",), (0, distance, 0)
    )


def interior(stage: Stage, count: int, pixels: float) -> Scatter:
    """A closed room, lit by a panel behind things that hang in its light."""
    width, depth, height = 7.0, 11.0, 4.5
    walls = (
        ((0, 4, 0), width, depth + 4, (0, 0, 1)),
        ((0, 4, height), width, depth + 4, (0, 0, -1)),
        ((0, depth, height / 2), width, height, (0, -1, 0)),
        ((0, -3, height / 2), width, height, (0, 1, 0)),
        ((-width / 2, 4, height / 2), depth + 4, height, (1, 0, 0)),
        ((width / 2, 4, height / 2), depth + 4, height, (-1, 0, 0)),
    )
    for center, wide, high, facing in walls:
        stage.panel(center, wide, high, facing)
    stage.furniture((-2, 4), (2, 9))
    aside = bool(stage.rng.random() < 0.5)  # else on the far wall
    if aside:
        stage.panel((width / 2 - 0.05, 6, 2.4), 3, 2, (-1, 0, 0), (1, 0.9, 0.75), glow=12.0)
        points = stage.rng.uniform((width / 2 - 1.2, 3.8, 0.8), (width / 2 - 0.3, 8.2, 4.0), (count, 3))
    else:
        stage.panel((0, depth - 0.05, 2.6), 3.5, 2, (0, -1, 0), (1, 0.9, 0.75), glow=12.0)
        points = stage.rng.uniform((-2.4, depth - 2.0, 1.0), (2.4, depth - 0.3, 4.0), (count, 3))
    distance = 6.0 if aside else depth - 1
    return Scatter(
        points,
        _sizes(stage, count, pixels * stage.pixel(distance)),
        _tumbled(stage, count),
        _shapes(stage, 2),
        (0, distance, 1),
    )


KINDS = {
    "lawn": Kind(lawn),
    "heap": Kind(heap),
    "posts": Kind(posts),
    "wall": Kind(wall, clusters=False),
    "crown": Kind(crown, ("sun",), veils=False),
    "gravel": Kind(gravel, veils=False),
    "confetti": Kind(confetti),
    "twins": Kind(twins, clusters=False),
    "marks": Kind(marks, clusters=False),
    "specks": Kind(specks, (), clusters=False),
    "rods": Kind(rods),
    "interior": Kind(interior, (), veils=False, largest=30.0, layers=3.0),
}
