"""What the scenes of `family` are made of: a camera at eye height that looks along +Y, panels, scattered shapes, lamps.
Metres, Z up."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import bpy
import numpy as np
from mathutils import Matrix, Vector

from .builders import Color, material, mesh, scatter
from .solids import F64, Solid

SIZE = (320, 180)  # of the picture, in pixels
LENSES = 24.0, 35.0, 50.0, 85.0  # millimetres
SENSOR = 36.0
ASPECT = SIZE[1] / SIZE[0]


@dataclass(frozen=True)
class Scatter:
    """Where instances are.

    points: (N, 3) metres; size: (N,) metres; turn: (N, 3) Euler angles; shapes: names in `SHAPES`, of which each
    instance has one; colors: one for each shape and a material of its own, None: anything; which: (N,) the shape of
    each, None: any; glow: watts per square metre that shapes emit; middle: of what is seen.
    """

    points: F64
    size: F64
    turn: F64
    shapes: tuple[str, ...]
    middle: tuple[float, float, float]
    colors: tuple[Color, ...] | None = None
    which: F64 | None = None
    glow: float = 0.0


def _blade(s: Solid) -> None:
    angle = np.arange(3) * (2 * math.pi / 3)
    ring = np.stack([0.15 * np.cos(angle), 0.15 * np.sin(angle), np.full(3, -0.5)], 1)
    s.frustum(ring, ring * (0.02, 0.02, -1.0), 0)


def _ball(s: Solid) -> None:
    rings, sides = 8, 12
    t, p = np.meshgrid(np.linspace(0.0, math.pi, rings + 1), np.arange(sides) * (2 * math.pi / sides), indexing="ij")
    points = 0.5 * np.stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)], -1)
    across = np.roll(points, -1, axis=1)
    s.quads(np.stack([points[:-1], points[1:], across[1:], across[:-1]], 2)[1:-1], 0)
    for k, cap in ((0, points[1]), (rings, points[-2])):
        fan = np.stack([cap, np.roll(cap, -1 if k == 0 else 1, axis=0), np.broadcast_to(points[k, 0], cap.shape)], 1)
        s.add(fan.reshape(-1, 3), np.arange(3 * sides).reshape(-1, 3), 0)


SHAPES: dict[str, Callable[[Solid], None]] = {
    "cube": lambda s: s.boxes((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5), 0),
    "leaf": lambda s: s.quads([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]], 0),
    "flat": lambda s: s.quads([[-0.5, 0, -0.5], [0.5, 0, -0.5], [0.5, 0, 0.5], [-0.5, 0, 0.5]], 0),
    "rod": lambda s: s.column((0, 0, -0.5), (0.04, 0.04), 1.0, 0, sides=5),
    "blade": _blade,
    "ball": _ball,
}


def _solid(shape: str) -> Solid:
    solid = Solid()
    SHAPES[shape](solid)
    return solid


@dataclass
class Stage:
    """A scene under construction. lens: of the camera, in millimetres; eye: height of the camera; back: where a wall
    across the picture stands, along Y."""

    scene: bpy.types.Scene
    rng: np.random.Generator
    lens: float
    eye: float = 2.0
    back: float = math.inf
    _made: int = field(default=0)

    def settings(self, bounces: int) -> None:
        """Camera, and Cycles without anything that would make renders of two versions of a scene differ by more than
        what the scene differs by."""
        camera = bpy.data.cameras.new("Camera")
        camera.lens, camera.sensor_width, camera.clip_end = self.lens, SENSOR, 2000.0
        self.scene.camera = self.add(bpy.data.objects.new("Camera", camera))
        self.scene.camera.location, self.scene.camera.rotation_euler = (
            (0.0, 0.0, self.eye),
            (math.radians(90 - self.rng.uniform(0, 8)), 0.0, 0.0),
        )
        render, cycles = self.scene.render, self.scene.cycles
        render.engine, render.resolution_x, render.resolution_y, render.resolution_percentage = "CYCLES", *SIZE, 100
        cycles.samples, cycles.use_denoising, cycles.use_adaptive_sampling, cycles.max_bounces = (
            64, False, False, bounces
        )
        cycles.sampling_pattern = "TABULATED_SOBOL"  # blue noise would tie neighbouring pixels together
        self.scene.view_settings.view_transform = "Standard"
        self.sky(0.0)

    def add(self, ob: bpy.types.Object) -> bpy.types.Object:
        """Link an object to the scene."""
        self.scene.collection.objects.link(ob)
        return ob

    def pixel(self, distance: float) -> float:
        """Metres that a pixel covers there."""
        return distance * SENSOR / (self.lens * SIZE[0])

    def half_width(self, distance: float | F64) -> float | F64:
        """Half the width of what the camera sees there."""
        return distance * (SENSOR / 2 / self.lens)

    def color(self, low: float, high: float) -> Color:
        """With channels between two numbers."""
        red, green, blue = (float(x) for x in self.rng.uniform(low, high, 3))
        return red, green, blue

    def material(
        self, color: Color, roughness: float = 0.8, metallic: float = 0.0, glow: float = 0.0, transmission: float = 0.0
    ) -> bpy.types.Material:
        """A new material. glow: watts per square metre that it emits, in its colour."""
        self._made += 1
        made = material(f"Material {self._made}", color, roughness, metallic)
        inputs = made.node_tree.nodes["Principled BSDF"].inputs
        inputs["Transmission Weight"].default_value = transmission
        inputs["Emission Color"].default_value, inputs["Emission Strength"].default_value = (*color, 1.0), glow
        return made

    def any_material(self) -> bpy.types.Material:
        """Mostly matt; some metal, a little glass."""
        style = self.rng.choice(["matt", "metal", "glass"], p=[0.8, 0.12, 0.08])
        roughness = float(self.rng.uniform(0.1, 1.0))
        return self.material(
            self.color(0.03, 0.9), roughness, float(style == "metal"), transmission=float(style == "glass")
        )

    def panel(
        self,
        center: Sequence[float],
        width: float,
        height: float,
        facing: Sequence[float] = (0, -1, 0),
        color: Color | None = None,
        **values: float,
    ) -> bpy.types.Object:
        """A rectangle whose front faces a direction; width is horizontal. color None: some grey or brown; values: the
        rest of its material."""
        if color is None:
            red, green, blue = self.color(0.8, 1.0)
            grey = float(self.rng.uniform(0.2, 0.8))
            color = red * grey, green * grey, blue * grey
        ob = self._object("leaf", self.material(color, **values))
        turn = Vector(facing).to_track_quat("Z", "Y").to_matrix().to_4x4()
        ob.matrix_world = Matrix.Translation(center) @ turn @ Matrix.Diagonal((width, height, 1.0, 1.0))
        return ob

    def _object(self, shape: str, made: bpy.types.Material) -> bpy.types.Object:
        return self.add(bpy.data.objects.new(shape, mesh(shape, _solid(shape), [made])))

    def ground(self, color: Color | None = None) -> bpy.types.Object:
        """A floor to the horizon."""
        return self.panel((0, 0, 0), 800, 800, (0, 0, 1), color)

    def furniture(self, low: Sequence[float], high: Sequence[float]) -> None:
        """Up to three boxes or balls that stand on the floor, between two corners of a rectangle in x, y."""
        for _ in range(self.rng.integers(0, 4)):
            size = float(self.rng.uniform(0.3, 1.2))
            ob = self._object(str(self.rng.choice(["cube", "ball"])), self.any_material())
            ob.location, ob.scale = (*self.rng.uniform(low, high), size / 2), (size, size, size)

    def scatter(self, wanted: Scatter, parts: int) -> bpy.types.Object:
        """Place instances by geometry nodes. parts: of each, above 1: a row is a collection of so many, which together
        are as large as one would be."""
        sources: list[bpy.types.Object | bpy.types.Collection] = []
        for k, shape in enumerate(wanted.shapes):
            made = self.any_material() if wanted.colors is None else self.material(wanted.colors[k], glow=wanted.glow)
            data = mesh(shape, _solid(shape), [made])
            sources.append(self._cluster(data, parts) if parts > 1 else bpy.data.objects.new(shape, data))
        which = self.rng.integers(0, len(sources), len(wanted.points)) if wanted.which is None else wanted.which
        return scatter("Scatter", sources, wanted.points, which, wanted.turn, wanted.size)

    def _cluster(self, data: bpy.types.Mesh, parts: int) -> bpy.types.Collection:
        cluster = bpy.data.collections.new("Cluster")
        for place in self.rng.uniform(-0.35, 0.35, (parts, 3)):
            ob = bpy.data.objects.new(data.name, data)
            ob.location, ob.scale, ob.rotation_euler = place, (0.45, 0.45, 0.45), (0, 0, self.rng.uniform(0, 6.28))
            cluster.objects.link(ob)
        return cluster

    def pane(self) -> None:
        """A pane of clear glass before the camera."""
        pane = self._object("cube", self.material((0.95, 0.95, 0.95), 0.0, transmission=1.0))
        pane.location, pane.scale = (0.0, 1.0, self.eye), (4.0, 0.02, 4.0)

    def mirrored(self) -> None:
        """A mirror before the camera, turned by some 45 degrees; the camera stands aside, so that it looks at the scene
        by way of it."""
        camera = self.scene.camera
        self.panel(
            (0, 0, self.eye),
            6,
            6,
            (1, 1, 0),
            (0.95, 0.95, 0.95),
            roughness=float(self.rng.choice([0.0, 0.1])),
            metallic=1.0,
        )
        camera.location = (3.0, 0.0, self.eye)
        camera.rotation_euler = (camera.rotation_euler[0], 0.0, math.radians(90))

    def sky(self, strength: float, color: Color = (0.8, 0.9, 1.0)) -> None:
        """Light from everywhere."""
        world = self.scene.world or bpy.data.worlds.new("Sky")
        self.scene.world = world
        background = world.node_tree.nodes["Background"].inputs
        background["Color"].default_value, background["Strength"].default_value = (*color, 1.0), strength

    def light(self, name: str, middle: Sequence[float]) -> None:
        """A light for what is around a point: "sky", or a lamp above it, somewhere."""
        rng = self.rng
        if name == "sky":
            self.sky(float(rng.uniform(0.3, 1.2)), self.color(0.6, 1.0))
            return
        lamp = bpy.data.lights.new(name, name.upper())
        toward = Vector((rng.uniform(-1, 1), rng.uniform(-1, 0.6), rng.uniform(0.7, 1.6)))
        distance = float(max(np.linalg.norm(middle), 4.0)) * rng.uniform(0.6, 1.2)
        ob = self.add(bpy.data.objects.new(name, lamp))
        place = Vector(middle) + toward * distance
        place.y = min(place.y, self.back - 1.5)
        toward = (place - Vector(middle)) / distance
        ob.location, ob.rotation_euler = place, toward.to_track_quat("Z", "Y").to_euler()
        lamp.energy = (
            float(rng.uniform(1.5, 4.0))
            if name == "sun"
            else 60.0 * (toward.length * distance) ** 2 * float(rng.uniform(0.5, 2.0))
        )
        if name == "sun":
            lamp.angle = float(rng.choice([0.01, 0.1]))
        elif name == "area":
            lamp.size = distance * float(rng.uniform(0.05, 0.5))
            lamp.energy *= 0.5
        elif name == "spot":
            lamp.spot_size, lamp.shadow_soft_size = math.radians(rng.uniform(40, 90)), distance * 0.01
            lamp.energy *= 1.5
        else:
            lamp.shadow_soft_size = distance * 0.02
