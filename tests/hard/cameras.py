"""Cameras and films at their limits."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np

from lipac.core.culling.analysis import analyze
from lipac.core.culling.options import CullOptions
from lipac.core.culling.policies import POLICIES
from lipac.core.scene import model as s
from lipac.core.scene.camera import camera_constants, camera_ray

from ..core import scenes
from ..core.scenes import lamp, material, render
from .case import Figure, case
from .places import SIZE, changed, still_life

GROUP = "Cameras"


def seen_from(camera: s.Camera, size: tuple[int, int] = SIZE) -> s.Scene:
    """The still life from another camera."""
    scene = still_life()
    return dataclasses.replace(
        scene, camera=camera, film=dataclasses.replace(scene.film, width=size[0], height=size[1])
    )


@case(GROUP)
def lenses() -> Iterator[Figure]:
    """A picture from far through a long lens is the orthographic one; the further, the less they differ, until float32
    has no digits left."""
    target, direction = np.array([0, 0, 0.3]), np.array([0, -5.0, 1.7])
    direction /= np.linalg.norm(direction)
    near = scenes.look_at(tuple(target + 8 * direction), tuple(target), 1.0)  # type: ignore[arg-type]
    flat = dataclasses.replace(near, frame=near.frame * 2.0, orthographic=True)
    limits = s.PathLimits(total=0)
    reference = render(dataclasses.replace(seen_from(flat), limits=limits), 4).mean
    for distance, lens in ((1e3, "9 m"), (1e4, "90 m"), (1e5, "900 m")):
        camera = scenes.look_at(tuple(target + distance * direction), tuple(target), 2.0 / distance)  # type: ignore[arg-type]
        figure = changed(reference, render(dataclasses.replace(seen_from(camera), limits=limits), 4).mean, 0.05)
        limit, why = 0.01, "perspective itself, and rays at edges"
        if distance > 5e4:
            limit, why = (
                0.1,
                "at 10^5 of its sizes away float32 places the scene to 8 mm and tells directions apart to 6 mm: a "
                "sixth of a pixel",
            )
        yield Figure(
            f"a lens of {lens} on a sensor of 36 mm, {distance:g} m away",
            "pixels that differ by more than 5 % from an orthographic picture",
            figure,
            limit,
            why,
        )


@case(GROUP)
def wide_lens() -> Iterator[Figure]:
    """Rays of a lens of nearly 180 degrees are unit vectors through the right place of the frame."""
    for half in (1.0, 1e3, 1e6):
        camera = camera_constants(s.Camera(np.eye(3, 4), np.array([-half, half, -half, half])))
        worst = 0.0
        for u, v in np.random.default_rng(1).uniform(0, 1, (500, 2)):
            *_, dx, dy, dz, _ = camera_ray(camera, np.float32(u), np.float32(v), np.float32(0), np.float32(0))
            exact = np.array([(2 * u - 1) * half, (2 * v - 1) * half, -1.0])
            worst = max(worst, float(np.abs(np.array([dx, dy, dz]) - exact / np.linalg.norm(exact)).max()))
        degrees = 2 * np.degrees(np.arctan(half))
        why = "6e-8 of the frame, over the distance from its middle: 1/20 of it at least"
        yield Figure(f"a lens that sees {degrees:.4f} degrees", "error of a ray's direction", worst, 4e-6, why)


@case(GROUP)
def clipping() -> Iterator[Figure]:
    """Clip planes at any distance cut exactly: a floor seen from above, from just before and just behind each plane."""
    to_world = np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 1.0]], float)
    for orthographic in (False, True):
        for start, end, visible in (
            (0.0, 1e30, 1),
            (0.999, 1.001, 1),
            (1.001, 2.0, 0),
            (0.1, 0.999, 0),
            (1e-7, 1e30, 1),
            (1e20, 1e30, 0),
            (2.0, 1.0, 0),
        ):
            camera = s.Camera(to_world, np.array([-0.1, 0.1, -0.1, 0.1]), orthographic, start, end)
            scene = scenes.build(
                [scenes.quad()],
                [(0, scenes.placed((0, 0, 0), 4.0), 0)],
                [material(s.Shader.EMISSION, emission=1.0)],
                camera,
                None,
                (0, 0, 0),
                (16, 16),
            )
            x = render(scene, 1).mean[..., 0]
            kind = "orthographic" if orthographic else "perspective"
            yield Figure(
                f"{kind} camera, clip planes at {start:g} m and {end:g} m, a floor at 1 m",
                "pixels that should be otherwise",
                float((x != visible).mean()),
                0.0,
            )


@case(GROUP)
def in_a_wall() -> Iterator[Figure]:
    """The camera inside a solid, on a face, on an edge, at a corner: finite pictures, and every policy gives states."""
    for name, place in (
        ("inside of a wall", (0, 1.8, 0.5)),
        ("on its face", (0, 1.75, 0.5)),
        ("on its edge", (0, 1.75, 1.5)),
        ("at its corner", (2.5, 1.75, 1.5)),
    ):
        scene = seen_from(scenes.look_at(place, (0, 0, 0.3)))  # type: ignore[arg-type]
        bad = float((~np.isfinite(render(scene, 4).mean)).mean())
        for policy in POLICIES:
            result = analyze(scene, CullOptions(policy=policy, width=48))
            bad += float(len(result.state) != len(scene.instances)) + float((~np.isfinite(result.score)).any())
        yield Figure(f"camera {name}", "pixels or scores that are not finite", bad, 0.0)


@case(GROUP)
def tiny_films() -> Iterator[Figure]:
    """Pictures of one pixel, one row, one column."""
    for width, height in ((1, 1), (1, 64), (64, 1), (3, 2)):
        scene = seen_from(still_life().camera, (width, height))
        picture = render(scene, 4)
        result = analyze(scene, CullOptions())
        bad = (
            float((~np.isfinite(picture.mean)).sum())
            + float(picture.mean.shape != (height, width, 4))
            + float(not result.active.any())
        )
        yield Figure(f"a picture of {width} x {height} pixels", "values that are not finite; nothing kept", bad, 0.0)


@case(GROUP)
def depth_of_field_extremes() -> Iterator[Figure]:
    """Apertures and planes of focus from the tiny to the huge."""
    for aperture in (1e-9, 1e3):
        for focus in (1e-6, 1e9):
            camera = dataclasses.replace(still_life().camera, aperture=aperture, focus=focus)
            picture = render(seen_from(camera), 4).mean
            yield Figure(
                f"aperture {aperture:g} m, focus at {focus:g} m",
                "pixels that are not finite",
                float((~np.isfinite(picture)).mean()),
                0.0,
            )
    pinhole, tiny = (
        render(seen_from(dataclasses.replace(still_life().camera, aperture=a, focus=5.0)), 4).mean for a in (0.0, 1e-9)
    )
    yield Figure(
        "aperture 1e-9 m, against a pinhole",
        "pixels that differ by more than 1 %",
        changed(pinhole, tiny),
        0.02,
        "rays at edges",
    )


@case(GROUP)
def lamps_of_all_kinds_at_the_camera() -> Iterator[Figure]:
    """The camera within a lamp, on it, and at it."""
    for kind in (s.LightKind.POINT, s.LightKind.SPOT, s.LightKind.AREA):
        scene = still_life()
        eye = scene.camera.to_world[:, 3]
        lights = lamp(kind, tuple(eye), radius=0.5, visibility=s.ALL_RAYS)  # type: ignore[arg-type]
        picture = render(dataclasses.replace(scene, lights=lights), 4).mean
        yield Figure(
            f"camera at the centre of a {kind.name.lower()} lamp",
            "pixels that are not finite",
            float((~np.isfinite(picture)).mean()),
            0.0,
        )
