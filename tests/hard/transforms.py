"""Transforms that stretch, shear, mirror, flatten or are no numbers."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from lipac.core.culling.analysis import analyze
from lipac.core.culling.options import CullOptions
from lipac.core.feedback.hits import Feedback
from lipac.core.scene import model as s
from lipac.core.scene.placing import usable_transforms

from ..core import scenes
from ..core.scenes import lamp, material, render
from .case import Figure, case
from .places import changed

GROUP = "Transforms"
LIMITS = s.PathLimits(total=3, diffuse=3)


def rotation(seed: int) -> np.ndarray:
    """(3, 3) proper rotation."""
    q = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    return q * np.sign(np.linalg.det(q))


def shear(amount: float) -> np.ndarray:
    """(3, 3): x grows by amount times z."""
    out = np.eye(3)
    out[0, 2] = amount
    return out


LINEAR = {
    "mirrored": rotation(1) @ np.diag([-1.0, 1.0, 1.0]),
    "scaled 1 : 1e3 : 1": rotation(2) @ np.diag([1.0, 1e-3, 1.0]),
    "scaled 1 : 1e6 : 1": rotation(3) @ np.diag([1.0, 1e-6, 1.0]),
    "scaled 1e3 : 1 : 1e-3": rotation(4) @ np.diag([1e3, 1.0, 1e-3]),
    "sheared by 10": rotation(5) @ shear(10.0),
    "sheared by 1000": rotation(6) @ shear(1000.0),
    "near-singular, determinant 1e-6": rotation(7) @ np.diag([1.0, 1.0, 1e-6]) @ rotation(8),
}


def self_hits(linear: np.ndarray, mesh: s.Mesh) -> float:
    """Share of a convex body's diffuse bounces that meet it again: none can. It stands ten of its sizes from the
    origin, seen from outside."""
    transform = np.zeros((3, 4), np.float32)
    transform[:, :3] = linear
    size = float(np.linalg.norm(linear, axis=0).max())
    centre = np.array([7.0, 5.0, 3.0]) * size
    transform[:, 3] = centre
    axes, sizes, _ = np.linalg.svd(linear)
    # long bodies are seen from the side, near their middle
    eye = centre + (axes[:, 0] + 2 * axes[:, 1] + 3 * axes[:, 2]) * sizes[1]
    camera = scenes.look_at(tuple(eye), tuple(centre), 0.35)  # type: ignore[arg-type]
    scene = scenes.build([mesh], [(0, transform, 0)], [material()], camera, size=(96, 54), limits=LIMITS)
    feedback = Feedback.zeros(1)
    render(scene, 16, feedback=feedback)
    seen = feedback.hits[0, s.RayType.CAMERA]
    return float(feedback.hits[0, s.RayType.DIFFUSE] / seen) if seen > 100 else float("nan")


@case(GROUP)
def convex_bodies_do_not_meet_themselves() -> Iterator[Figure]:
    """The ray offset's error bound holds whatever the transform."""
    for name, linear in LINEAR.items():
        for what, mesh in (("sphere", scenes.sphere(24)), ("cube", scenes.cube())):
            yield Figure(f"{what} {name}", "bounces that meet their own convex body", self_hits(linear, mesh), 0.0)


@case(GROUP)
def transformed_equals_baked() -> Iterator[Figure]:
    """A cube under a transform, and the same vertices transformed in float64 beforehand: the same picture."""
    cube = scenes.cube()
    for name, linear in LINEAR.items():
        if "1e3 : 1" in name or "1000" in name:
            continue  # too long for one picture: what they do is seen in the case above
        transform = np.zeros((3, 4), np.float32)
        transform[:, :3], transform[:, 3] = linear, (0.2, 0.3, 1.0)
        positions = (cube.positions @ transform[:, :3].astype(float).T + transform[:, 3]).astype(np.float32)
        flip = np.linalg.det(linear) < 0
        baked = s.Mesh(positions, np.ascontiguousarray(cube.triangles[:, ::-1]) if flip else cube.triangles)
        pictures = []
        for mesh, at in ((cube, transform), (baked, scenes.placed((0, 0, 0)))):
            placement = [(0, at, 0), (1, scenes.placed((0, 0, -2), 12.0), 0)]
            sun = lamp(s.LightKind.SUN, power=3)
            camera = scenes.look_at((1, -7, 4), (0, 0, 0.5))
            pictures.append(
                render(scenes.build([mesh, scenes.quad()], placement, lights=sun, camera=camera, size=(96, 54)), 4).mean
            )
        why = "rays at its edges may fall to either side of them"
        yield Figure(
            f"cube {name}, against its vertices transformed beforehand",
            "pixels that differ by more than 1 %",
            changed(pictures[0], pictures[1]),
            0.02,
            why,
        )


def broken_scene(number: float) -> s.Scene:
    """A cube on a floor, and a cube whose transform holds a number that is none; lamps and a world."""
    broken = scenes.placed((0.0, 0.0, 0.5))
    broken[0, 0] = number
    moved = scenes.placed((number, 0.0, 0.5))
    flat = scenes.placed((1.0, 0.0, 0.5), (1.0, 0.0, 1.0))
    point = scenes.placed((1.0, 0.0, 0.5), 0.0)
    placement = [
        (1, scenes.placed((0, 0, 0), 8.0), 0),
        (0, scenes.placed((0, 1, 0.5)), 0),
        *[(0, t, 0) for t in (broken, moved, flat, point)],
    ]
    with np.errstate(all="ignore"):
        return scenes.build(
            [scenes.cube(), scenes.quad()], placement, lights=lamp(s.LightKind.SUN, power=3), size=(64, 36)
        )


@case(GROUP)
def not_numbers() -> Iterator[Figure]:
    """Transforms with NaN, infinity or too much, flat ones and ones without extent, beside good ones."""
    for number in (np.nan, np.inf, -np.inf, 3e38, 1e25):
        scene = broken_scene(number)
        for policy in ("light-paths", "none"):
            result = analyze(scene, CullOptions(policy=policy, width=64))
            picture = render(scene, 2, result.active).mean
            bad = float((~np.isfinite(picture)).mean()) + float(result.active[2:4].any())
            yield Figure(
                f"transforms with {number:g}, flat and empty ones; policy {policy}",
                "pixels that are not finite; the unusable kept",
                bad,
                0.0,
            )


@case(GROUP)
def singular_transforms_are_known() -> Figure:
    """What extraction leaves out: against the condition number in float64 of random transforms, scaled from 1e-12 to
    1e12."""
    rng = np.random.default_rng(3)
    transform = np.zeros((4000, 3, 4))
    transform[:, :, :3] = rng.normal(size=(4000, 3, 3)) * 10.0 ** rng.uniform(-12, 12, 4000)[:, None, None]
    flat = rng.random(4000) < 0.5
    transform[flat, :, 2] = transform[flat, :, :2] @ rng.normal(size=2)
    wrong = (usable_transforms(transform) == flat).mean()
    return Figure(
        "random transforms, half of them singular, sizes 1e-12 to 1e12", "taken for the other kind", float(wrong), 0.0
    )


@case(GROUP)
def many_at_one_place() -> Iterator[Figure]:
    """Thousands of cubes in one place. Their boxes coincide too: a cold start must get to one of them all the same."""
    count = 4_000
    placement = [(0, scenes.placed((0, 0, 0.5)), 0)] * count + [(1, scenes.placed((0, 0, 0), 8.0), 0)]
    scene = scenes.build(
        [scenes.cube(), scenes.quad()], placement, lights=lamp(s.LightKind.SUN, power=3), size=(64, 36)
    )
    only = np.zeros(count + 1, bool)
    only[[0, count]] = True
    one = render(scene, 4, only).mean
    yield Figure(
        "4,000 instances at one place, against one",
        "pixels that differ in any bit",
        changed(one, render(scene, 4).mean, 0.0),
        0.0,
    )
    culled = analyze(scene, CullOptions(width=32))
    figure = changed(one, render(scene, 4, culled.active).mean, 0.0)
    yield Figure("4,000 instances at one place, culled by light paths", "pixels that differ in any bit", figure, 0.0)
