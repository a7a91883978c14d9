"""`mirror-city`: the case that light path guided culling is about.

A camera stands in a street and looks into a large mirror. It sees a little of the street before it and, in the mirror,
the street behind it; rows of houses close both, and the mirror hides the rest. Beyond the rows the city goes on for as
many instances as asked: the picture stays the same, the scene grows.

Houses, trees, cars, lamps, benches and tubs are instances on the points of one geometry-nodes object, in order of their
distance; the row of an instance tells nothing about whether it is seen. Street, tower and mirror are objects.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import bpy
import numpy as np

from ...core.errors import InputError
from . import city_parts as parts
from .builders import Color, material, mesh, scatter
from .city_parts import DEPTH, WIDTH
from .solids import F64, Solid

DEFAULT_INSTANCES = 20_000
FEWEST, MOST = 1_000, 1_000_000
HALF_STREET = 11.0  # from its middle line to the house fronts
SOUTH, NORTH = -150.0, 78.0  # ends of the street: fronts of the houses that close it
TOWN_HOUSES, SUBURB_HOUSES = 8, 8  # kinds; town houses line the street and are tall enough to hide the suburbs
CAMERA = (-2.2, -3.0, 2.5)
MIRROR = (1.0, 15.0)  # middle of its foot
MIRROR_SIZE = (13.0, 7.6)
MIRROR_TURN = math.radians(5.0)

_WALLS: tuple[Color, ...] = (
    (0.52, 0.18, 0.11),
    (0.75, 0.62, 0.42),
    (0.62, 0.34, 0.16),
    (0.55, 0.58, 0.60),
    (0.72, 0.45, 0.35),
    (0.36, 0.45, 0.52),
    (0.78, 0.72, 0.60),
    (0.45, 0.16, 0.13),
)
_ACCENTS: tuple[Color, ...] = ((0.05, 0.22, 0.18), (0.45, 0.05, 0.05), (0.05, 0.10, 0.30), (0.50, 0.28, 0.03))
_PAINTS: tuple[Color, ...] = (
    (0.60, 0.03, 0.02),
    (0.03, 0.12, 0.40),
    (0.75, 0.75, 0.72),
    (0.03, 0.03, 0.035),
    (0.85, 0.55, 0.05),
)
_LEAVES: tuple[Color, ...] = ((0.10, 0.25, 0.04), (0.20, 0.30, 0.03), (0.45, 0.20, 0.02))

_LAMP = TOWN_HOUSES + SUBURB_HOUSES
_TREE = _LAMP + 1
_CAR = _TREE + len(_LEAVES)
_BENCH = _CAR + len(_PAINTS)
_TUB = _BENCH + 1


def build(instances: int | None, seed: int) -> None:
    """Replace the open file by mirror-city with exactly `instances` instances (1,000 to 1,000,000)."""
    count = DEFAULT_INSTANCES if instances is None else instances
    if not FEWEST <= count <= MOST:
        raise InputError(f"mirror-city takes {FEWEST:,} to {MOST:,} instances, not {count:,}: change --instances")
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    points, kind, turn, size = layout(count, np.random.default_rng(seed))
    scatter("City", sources(np.random.default_rng(seed + 1)), points, kind, turn, size)
    add_street(scene, float(np.abs(points[:, :2]).max()) + 60.0)
    add_mirror(scene)
    add_light(scene)
    add_camera(scene)


def layout(
    count: int, rng: np.random.Generator, leave_out: Callable[[F64], np.ndarray] | None = None
) -> tuple[F64, np.ndarray, F64, F64]:
    """Where everything stands: points (count, 3) metres, kind (count,) index of the part, turn (count,) radians about
    Z, size (count,) factor.

    The street comes first and is the same for every count; then suburb blocks by distance, cut off at `count`.
    leave_out: which rows of the street, (K, 5) of x, y, kind, turn, size, are to be missing.
    """
    own = _street_rows(np.random.default_rng(rng.integers(1 << 32)))
    if leave_out is not None:
        own = own[~leave_out(own)]
    suburb = _blocks(count - len(own), np.random.default_rng(rng.integers(1 << 32)))
    rows = np.concatenate([own, suburb])
    return np.column_stack([rows[:, :2], np.zeros(len(rows))]), rows[:, 2].astype(np.int64), rows[:, 3], rows[:, 4]


def _rows(x: F64 | float, y: F64 | float, kind: np.ndarray | int, turn: F64 | float, size: F64 | float = 1.0) -> F64:
    """Placements as rows of x, y, kind, turn, size; on a grid of 1/16 m, 1/64 turn and 1/32 size, which makes the saved
    file small."""
    row = np.stack([np.ravel(a) for a in np.broadcast_arrays(x, y, kind, turn, size)], 1).astype(float)
    row[:, :2] = np.round(row[:, :2] * 16) / 16
    row[:, 3] = np.round(row[:, 3] / math.tau * 64) % 64 * (math.tau / 64)
    row[:, 4] = np.round(row[:, 4] * 32) / 32
    return row


def _street_rows(rng: np.random.Generator) -> F64:
    """The closed street: houses on both sides and across both ends, and what stands on its pavements."""
    out = []
    y = np.arange(SOUTH + WIDTH / 2, NORTH, WIDTH)
    for side in (-1, 1):
        facing, along = -side * math.pi / 2, side * math.pi / 2  # towards the road, and in the direction of its traffic
        houses = np.concatenate([rng.permutation(TOWN_HOUSES) for _ in range(len(y) // TOWN_HOUSES + 1)])[: len(y)]
        trees = np.arange(SOUTH + 7, NORTH - 4, 11.5)
        trees = trees[np.abs(trees - CAMERA[1]) > 6]
        n = len(trees)
        cars = np.arange(SOUTH + 4, NORTH - 4, 6.2)
        cars = cars[(rng.uniform(size=len(cars)) < 0.7) & (np.abs(cars - MIRROR[1]) > 7)]
        c = len(cars)
        tubs = np.arange(SOUTH + 6, NORTH - 3, 6.0)
        out += [
            _rows(side * HALF_STREET, y, houses, facing),
            _rows(
                side * 8.2,
                trees,
                _TREE + rng.integers(len(_LEAVES), size=n),
                rng.uniform(0, math.tau, n),
                rng.uniform(0.75, 1.1, n),
            ),
            _rows(side * 7.0, np.arange(SOUTH + 3, NORTH, 23.0), _LAMP, math.pi if side > 0 else 0.0),
            _rows(
                side * 5.2,
                cars + rng.uniform(-0.4, 0.4, c),
                _CAR + rng.integers(len(_PAINTS), size=c),
                along + rng.normal(0, 0.03, c),
            ),
            _rows(side * 10.0, np.arange(SOUTH + 13, NORTH - 6, 17.0), _BENCH, facing),
            _rows(side * 10.3, tubs, _TUB, rng.uniform(0, math.tau, len(tubs)), rng.uniform(0.7, 1.0, len(tubs))),
        ]
    across = np.arange(-1.5, 2) * WIDTH
    out.append(_rows(across, SOUTH, rng.permutation(TOWN_HOUSES)[:4], math.pi))
    out.append(_rows(across, NORTH, rng.permutation(TOWN_HOUSES)[:4], 0.0))
    return np.concatenate(out)


def _blocks(count: int, rng: np.random.Generator) -> F64:
    """`count` placements in suburb blocks around the street, nearest blocks first."""
    houses, road = 5, 14.0
    pitch = np.array([houses * WIDTH + road, 2 * DEPTH + road])
    template = _block(rng, houses)
    reach = math.ceil(math.sqrt(count / len(template))) + 12
    i, j = (a.ravel() for a in np.meshgrid(np.arange(-reach, reach + 1), np.arange(-2 * reach, 2 * reach + 1)))
    centre = np.stack([i * pitch[0], j * pitch[1] + (SOUTH + NORTH) / 2], 1)
    margin = DEPTH + road + pitch / 2
    inside = (
        (np.abs(centre[:, 0]) < HALF_STREET + margin[0])
        & (centre[:, 1] > SOUTH - margin[1])
        & (centre[:, 1] < NORTH + margin[1])
    )
    distance = np.hypot(centre[:, 0], centre[:, 1] - (SOUTH + NORTH) / 2)
    centre = centre[np.argsort(np.where(inside, np.inf, distance), kind="stable")][: math.ceil(count / len(template))]
    row = np.tile(template, (len(centre), 1))[:count]
    row[:, :2] += np.repeat(centre, len(template), axis=0)[:count]
    kind = row[:, 2]
    house, tree, car = kind < _LAMP, (kind >= _TREE) & (kind < _CAR), (kind >= _CAR) & (kind < _BENCH)
    kind[house] = TOWN_HOUSES + rng.integers(SUBURB_HOUSES, size=house.sum())
    kind[tree] = _TREE + rng.integers(len(_LEAVES), size=tree.sum())
    kind[car] = _CAR + rng.integers(len(_PAINTS), size=car.sum())
    turned = tree | (kind == _TUB)
    turn = np.where(turned, rng.uniform(0, math.tau, len(row)), row[:, 3])
    size = np.where(turned, rng.uniform(0.6, 1.0, len(row)), 1.0)
    shift = np.where(car[:, None], rng.uniform(-0.5, 0.5, (len(row), 2)) * (1, 0), 0)
    return _rows(row[:, 0] + shift[:, 0], row[:, 1], kind, turn, size)


def _block(rng: np.random.Generator, houses: int) -> F64:
    """One block about the origin: two rows of houses back to back, and its pavements."""
    x = (np.arange(houses) - (houses - 1) / 2) * WIDTH
    span = houses * WIDTH / 2
    out = []
    for side in (-1, 1):
        turn = 0.0 if side < 0 else math.pi
        out.append(_rows(x, side * DEPTH, 0, turn))
        furniture = (
            (_TREE, 4.0, 9.0, 2.2, 0.0),
            (_CAR, 2.5, 5.5, 4.4, 0.0),
            (_LAMP, 0.5, 20.0, 3.2, side * math.pi / 2),
            (_BENCH, 7.0, 15.0, 1.0, turn),
            (_TUB, 1.5, 6.0, 0.7, 0.0),
        )
        for kind, start, step, y, angle in furniture:
            out.append(_rows(np.arange(-span + start, span, step), side * (DEPTH + y), kind, angle))
    return np.concatenate(out)


def sources(rng: np.random.Generator) -> list[bpy.types.Object]:
    """The objects that are instanced, in the order of the kinds."""
    stone = material("Stone", (0.62, 0.58, 0.50), 0.8)
    glass = material("Window", (0.02, 0.03, 0.04), 0.04)
    frame = material("Frame", (0.80, 0.78, 0.72), 0.4)
    slate, tiles = material("Slate", (0.07, 0.08, 0.10), 0.5), material("Tiles", (0.35, 0.09, 0.04), 0.7)
    iron = material("Iron", (0.03, 0.035, 0.035), 0.35, 1.0)
    wood = material("Wood", (0.30, 0.13, 0.04), 0.5)
    bark = material("Bark", (0.10, 0.06, 0.035), 0.9)
    out = []

    def add(name: str, solid: Solid, *materials: bpy.types.Material) -> None:
        out.append(bpy.data.objects.new(name, mesh(name, solid, materials)))

    for k in range(TOWN_HOUSES + SUBURB_HOUSES):
        town = k < TOWN_HOUSES
        roof = ("mansard", "flat", "gable")[k % 3]
        storeys = 4 + k % 3 if town else 2 + k % 2
        solid = parts.building(
            rng, storeys, bays=(3, 4, 5)[(k // 2) % 3], roof=roof, balconies=town and k % 4 in (0, 3), arched=k % 2 == 1
        )
        wall = material(f"Wall {k % len(_WALLS)}", _WALLS[k % len(_WALLS)], 0.85)
        accent = material(f"Accent {k % len(_ACCENTS)}", _ACCENTS[k % len(_ACCENTS)], 0.4)
        add(
            "Town house" if town else "Suburb house",
            solid,
            wall,
            stone,
            glass,
            frame,
            tiles if roof == "gable" else slate,
            accent,
        )
    add("Lamp", parts.lamp(), iron, material("Lamp glass", (0.9, 0.85, 0.7), 0.2))
    for k, color in enumerate(_LEAVES):
        add("Tree", parts.tree(rng, height=8.0, leaves=1750), bark, material(f"Leaves {k}", color, 0.7), iron)
    tyre, tinted = material("Tyre", (0.015, 0.015, 0.015), 0.8), material("Tinted glass", (0.01, 0.012, 0.015), 0.05)
    chrome = material("Chrome", (0.75, 0.75, 0.75), 0.15, 1.0)
    for k, color in enumerate(_PAINTS):
        add(
            "Van" if k == 4 else "Car", parts.car(van=k == 4), material(f"Paint {k}", color, 0.25), tinted, tyre, chrome
        )
    add("Bench", parts.bench(), wood, iron)
    add("Tub", parts.planter(rng), stone, material("Hedge", (0.05, 0.16, 0.03), 0.7))
    return out


def _object(scene: bpy.types.Scene, name: str, solid: Solid, *materials: bpy.types.Material) -> bpy.types.Object:
    made = bpy.data.objects.new(name, mesh(name, solid, materials))
    scene.collection.objects.link(made)
    return made


def add_street(scene: bpy.types.Scene, reach: float) -> None:
    """Ground of the whole city, and the street's pavements and markings."""
    ground = Solid()
    ground.quads([[[-reach, -reach, 0], [reach, -reach, 0], [reach, reach, 0], [-reach, reach, 0]]], 0)
    _object(scene, "Ground", ground, material("Asphalt", (0.10, 0.10, 0.105), 0.9))
    street = Solid()
    for side in (-1, 1):
        inner, outer = sorted((side * 6.4, side * HALF_STREET))
        street.boxes((inner, SOUTH, 0), (outer, NORTH, 0.14), 0)
        kerb = sorted((side * 6.4, side * 6.15))
        street.boxes((kerb[0], SOUTH, 0), (kerb[1], NORTH, 0.16), 1)
        joints = np.arange(SOUTH, NORTH, 2.0)
        street.boxes(_column(inner, joints, 0.13), _column(outer, joints + 0.05, 0.143), 1)
    dashes = np.arange(SOUTH + 2, NORTH - 3, 6.0)
    street.boxes(_column(-0.08, dashes, 0.0), _column(0.08, dashes + 3, 0.006), 2)
    for y in (4.0, -40.0):  # zebra crossings
        x = np.arange(-5.6, 5.6, 1.0)
        street.boxes(_column(x, y, 0.0), _column(x + 0.5, y + 3, 0.008), 2)
    paint = material("Road paint", (0.75, 0.75, 0.72), 0.6)
    _object(
        scene,
        "Street",
        street,
        material("Paving", (0.36, 0.34, 0.31), 0.8),
        material("Kerb", (0.22, 0.21, 0.20), 0.8),
        paint,
    )
    shared = [bpy.data.materials[name] for name in ("Wall 6", "Stone", "Window", "Frame", "Slate")]
    tower = _object(scene, "Clock tower", parts.clock_tower(), *shared, material("Copper", (0.12, 0.35, 0.28), 0.6))
    tower.location = (6.0, SOUTH - DEPTH - 7.0, 0.0)


def _column(x: F64 | float, y: F64 | float, z: float) -> F64:
    return np.stack(np.broadcast_arrays(x, y, z), 1)


def add_mirror(scene: bpy.types.Scene) -> None:
    """A mirror of 13 by 7.6 m in a gilded frame, across the street."""
    half, height, foot = MIRROR_SIZE[0] / 2, MIRROR_SIZE[1], 0.5
    s = Solid()
    s.quads([[[-half, 0, foot], [half, 0, foot], [half, 0, foot + height], [-half, 0, foot + height]]], 0)
    for inset, depth in ((0.0, 0.22), (0.22, 0.12), (0.4, 0.04)):  # a stepped moulding
        a, b = half + 0.45 - inset, 0.22
        z0, z1 = foot - 0.45 + inset, foot + height + 0.45 - inset
        low = [(-a, -depth, z0), (a - b, -depth, z0), (-a, -depth, z0), (-a, -depth, z1 - b)]
        high = [(-a + b, 0.3, z1), (a, 0.3, z1), (a, 0.3, z0 + b), (a, 0.3, z1)]
        s.boxes(low, high, 1)
    s.boxes((-half, 0.05, foot), (half, 0.28, foot + height), 2)
    for x in (-half + 1.0, half - 1.0):
        s.boxes((x - 0.25, -0.8, 0), (x + 0.25, 1.4, 0.3), 1)
    silver, gilding = (
        material("Mirror", (0.95, 0.95, 0.95), 0.0, 1.0),
        material("Gilding", (0.83, 0.60, 0.22), 0.3, 1.0),
    )
    made = _object(scene, "Mirror", s, silver, gilding, material("Backing", (0.10, 0.06, 0.04), 0.8))
    made.location = (*MIRROR, 0.0)
    made.rotation_euler = (0.0, 0.0, MIRROR_TURN)


def add_light(scene: bpy.types.Scene) -> None:
    sun = bpy.data.lights.new("Sun", "SUN")
    sun.energy, sun.angle, sun.color = 9.0, math.radians(1.0), (1.0, 0.9, 0.75)
    lamp = bpy.data.objects.new("Sun", sun)
    lamp.rotation_euler = (math.radians(36), 0.0, math.radians(-62))  # onto the fronts that the mirror shows
    scene.collection.objects.link(lamp)
    world = bpy.data.worlds.new("Sky")
    background = world.node_tree.nodes["Background"]
    background.inputs["Color"].default_value = (0.38, 0.58, 0.95, 1.0)
    background.inputs["Strength"].default_value = 1.6
    scene.world = world


def add_camera(scene: bpy.types.Scene) -> None:
    data = bpy.data.cameras.new("Camera")
    data.lens = 25.0
    data.clip_end = 2000.0
    camera = bpy.data.objects.new("Camera", data)
    camera.location = CAMERA
    camera.rotation_euler = (math.radians(95.5), 0.0, math.radians(-9.0))
    scene.collection.objects.link(camera)
    scene.camera = camera
    scene.render.engine = "CYCLES"
    scene.cycles.device = "CPU"
    scene.cycles.samples = 64
    scene.cycles.use_denoising = False
    scene.cycles.use_adaptive_sampling = False
    scene.render.resolution_x, scene.render.resolution_y = 960, 540
    scene.view_settings.view_transform = "AgX"
