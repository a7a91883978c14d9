"""Scale and place: the same scene at any size, and far from where its coordinates begin."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np

from lipac.core.arrays import F32
from lipac.core.culling.analysis import analyze
from lipac.core.culling.options import CullOptions
from lipac.core.scene import model as s
from lipac.core.scene.placing import local_origin, shifted

from ..core import scenes
from ..core.scenes import lamp, material, render
from .case import Figure, case

GROUP = "Scale and place"
SIZE = (96, 54)


def still_life(scale: float = 1.0, brightness: float = 1.0) -> s.Scene:
    """Everything the tracer knows, in a few metres times scale: diffuse, metal, glass, transparency, an emitter, lamps,
    a wall that hides things.

    brightness multiplies every light. Lamps' powers follow their areas, so that the picture is the same at every scale.
    """
    materials = [
        material(base_color=(0.7, 0.6, 0.5)),
        material(s.Shader.PRINCIPLED, metallic=1.0, roughness=0.2),
        material(s.Shader.GLASS, roughness=0.0, base_color=1.0),
        material(s.Shader.PRINCIPLED, alpha=0.4, base_color=(0.9, 0.2, 0.1)),
        material(s.Shader.EMISSION, emission=np.array([4.0, 5.0, 6.0]) * brightness),
    ]
    rng = np.random.default_rng(11)
    placement = [(0, scenes.placed((0, 0, 0), 8.0), 0), (2, scenes.placed((0, 1.8, 0.5), (5, 0.1, 2)), 0)]
    for k in range(5):
        turn = np.zeros((3, 4), np.float32)
        turn[:, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0] * 0.35
        turn[:, 3] = (0.8 * k - 1.6, 0.2 * (k % 2), 0.5)
        placement.append((1 + k % 2, turn, k))
    placement += [(2, scenes.placed((0.4 * k - 3, 3.0, 0.2), 0.3), 0) for k in range(16)]  # behind the wall
    placement = [(mesh, transform * np.float32(scale), index) for mesh, transform, index in placement]
    area = brightness * scale * scale
    lights = np.concatenate(
        [
            lamp(s.LightKind.POINT, (2 * scale, -2 * scale, 2 * scale), radius=0.2 * scale, power=100 * area),
            lamp(s.LightKind.AREA, (-1 * scale, -1 * scale, 2.5 * scale), size=0.5 * scale, power=50 * area),
            lamp(s.LightKind.SUN, power=brightness, angle=0.1),
        ]
    )
    eye, target = (0.0, -5.0 * scale, 2.0 * scale), (0.0, 0.0, 0.3 * scale)
    meshes = [scenes.quad(), scenes.sphere(12), scenes.cube()]
    world = (0.3 * brightness, 0.3 * brightness, 0.4 * brightness)
    return scenes.build(meshes, placement, materials, scenes.look_at(eye, target), lights, world=world, size=SIZE)


def changed(a: F32, b: F32, by: float = 0.01) -> float:
    """Share of the pixels in which some channel differs by more than a share `by` of its value (or of the mean)."""
    floor = max(float(np.abs(a[..., :3]).mean()), 1e-300)
    different = np.abs(a.astype(np.float64) - b) > by * np.maximum(np.abs(a), floor)
    return float((different.any(axis=-1) | ~np.isfinite(b).all(axis=-1)).mean())


@case(GROUP)
def scaled_by_powers_of_two() -> Iterator[Figure]:
    """Scaling by a power of two rounds nothing: where no constant has a length's unit, every bit is the same."""
    reference = render(still_life(), 4).mean
    options = CullOptions(width=SIZE[0])
    states = analyze(still_life(), options).state
    for exponent in (-20, 20):
        scene = still_life(2.0**exponent)
        what = f"scene scaled by 2^{exponent} ({2.0**exponent:.0e})"
        yield Figure(what, "pixels that differ in any bit", changed(reference, render(scene, 4).mean, 0.0), 0.0)
        different = float((analyze(scene, options).state != states).mean())
        yield Figure(f"{what}, culled by light paths", "states that differ", different, 0.0)


@case(GROUP)
def scaled() -> Iterator[Figure]:
    """Other factors round every number anew: single rays may fall to the other side of an edge."""
    reference = render(still_life(), 4).mean
    why = "rays at an edge may fall to either side of it: of 96 x 54 pixels, a hundredth hold edges"
    for scale in (1e-6, 1e-3, 1e3, 1e6):
        yield Figure(
            f"scene scaled by {scale:.0e}",
            "pixels that differ by more than 1 %",
            changed(reference, render(still_life(scale), 4).mean),
            0.02,
            why,
        )


def put(mesh: s.Mesh, transform: np.ndarray, camera: s.Camera, remedy: bool) -> tuple[s.Mesh, np.ndarray]:
    """A mesh and its float64 transform (3, 4) as an extracted scene would hold them. remedy: with a local origin of the
    mesh."""
    if not remedy:
        return mesh, transform.astype(np.float32)
    positions = mesh.positions.astype(np.float64)
    origin = local_origin(positions.min(axis=0), positions.max(axis=0), transform[None], camera)
    return dataclasses.replace(mesh, positions=(positions - origin).astype(np.float32)), shifted(
        transform[None], origin
    )[0].astype(np.float32)


def far_mesh(place: float, remedy: bool) -> F32:
    """A ball on a floor, its vertices at place in its own space, brought back by its transform. They are multiples of
    1/64: float32 holds them up to 2^18."""
    ball = scenes.sphere(12)
    mesh = dataclasses.replace(
        ball, positions=(np.round(ball.positions.astype(np.float64) * 64) / 64 + place).astype(np.float32)
    )
    camera = scenes.look_at((0, -5, 2), (0, 0, 0.5))
    back = np.eye(3, 4)
    back[:, 3] = 0.0, 0.0, 1.0
    back[:, 3] -= place
    moved, transform = put(mesh, back, dataclasses.replace(camera, clip_start=0.1), remedy)
    placement = [(0, transform, 0), (1, scenes.placed((0, 0, 0), 8.0), 0)]
    return render(
        scenes.build(
            [moved, scenes.quad()],
            placement,
            lights=lamp(s.LightKind.SUN, power=3, angle=0.05),
            camera=camera,
            size=SIZE,
        ),
        4,
    ).mean


@case(GROUP)
def mesh_far_from_its_own_origin() -> Iterator[Figure]:
    """A scan or a city model with the coordinates of its country."""
    reference = far_mesh(0.0, True)
    for place in (1e3, 1e4, 1e5):
        with_it, without = (changed(reference, far_mesh(place, remedy)) for remedy in (True, False))
        yield Figure(
            f"mesh with vertices at {place:.0e} m in its own space",
            "pixels that differ by more than 1 %",
            with_it,
            0.002,
            "rays at edges",
            without,
        )


def screw_on_terrain(extent: float, tilt: bool, place: tuple[float, float], remedy: bool = True) -> F32:
    """A 1 mm cube on a square terrain of 32 x 32 cells, at place (share of half the extent) of it, in slanting sun,
    from 5 mm away.

    The origin is the camera's, as in every extracted scene. tilt: all of it turned by an arbitrary rotation, so that
    nothing is aligned to an axis.
    """
    turn = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))[0] if tilt else np.eye(3)
    turn *= np.sign(np.linalg.det(turn))
    x = np.linspace(-0.5, 0.5, 33)
    grid = np.stack([*np.meshgrid(x, x), np.zeros((33, 33))], axis=-1).reshape(-1, 3)
    i = np.arange(33 * 33).reshape(33, 33)
    a, b, c, d = i[:-1, :-1].ravel(), i[:-1, 1:].ravel(), i[1:, 1:].ravel(), i[1:, :-1].ravel()
    triangles = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)]).astype(np.uint32)
    eye = np.array([0.002, -0.004, 0.003])
    centre = np.array([place[0] * extent / 2, place[1] * extent / 2, 0.0])

    def at(scale: float, point: np.ndarray) -> np.ndarray:
        return np.concatenate([turn * scale, (turn @ (point - eye))[:, None]], axis=1)

    camera = scenes.look_at(tuple(eye), (0, 0, 0.0003), half_width=0.4)  # type: ignore[arg-type]
    camera = dataclasses.replace(
        camera, to_world=np.concatenate([turn @ camera.to_world[:, :3], np.zeros((3, 1))], axis=1), clip_start=0.001
    )
    terrain, terrain_at = put(s.Mesh((grid * extent).astype(np.float32), triangles), at(1.0, -centre), camera, remedy)
    direction = np.linalg.qr(np.stack([[1.0, 1.0, 0.7], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], 1))[0]
    direction[:, 0] *= np.sign(direction[2, 0])
    sun = lamp(s.LightKind.SUN, power=3)
    sun["axis_z"], sun["axis_x"], sun["axis_y"] = (turn @ direction[:, k] for k in range(3))
    placement = [(0, terrain_at, 0), (1, at(0.001, np.array([0, 0, 0.0005])).astype(np.float32), 0)]
    return render(
        scenes.build([terrain, scenes.cube()], placement, [material(base_color=0.5)], camera, sun, (0, 0, 0), SIZE), 4
    ).mean


@case(GROUP)
def screw_beside_terrain() -> Iterator[Figure]:
    """Against the same screw on a patch of 10 cm."""
    for tilt in (False, True):
        reference = screw_on_terrain(0.1, tilt, (0.013, 0.017))
        for name, place in (("its middle", (0.0130001, 0.0170003)), ("its corner", (0.91, 0.87))):
            for extent in (1e2, 1e4):
                with_it, without = (
                    changed(reference, screw_on_terrain(extent, tilt, place, remedy)) for remedy in (True, False)
                )
                what = f"1 mm screw at {name} of a terrain of {extent / 1e3:g} km{', all turned' if tilt else ''}"
                why = (
                    "the edge of its shadow; triangles of 300 m, whose plane float32 knows to 0.1 mm, move it"
                    if extent > 1e3
                    else "the edge of its shadow"
                )
                yield Figure(
                    what, "pixels that differ by more than 1 %", with_it, 0.06 if extent > 1e3 else 0.01, why, without
                )
