"""Rays that start or end on edges, run along faces, and have zeros for components; surfaces that must not shadow
themselves."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numba import njit

from lipac.core.accel import embree, hitboxes
from lipac.core.accel.blas import BlasCache
from lipac.core.accel.hitboxes import box_entry
from lipac.core.accel.tlas import Tlas
from lipac.core.feedback.hits import Feedback
from lipac.core.scene import model as s

from ..core import scenes
from ..core.scenes import lamp, material, render
from ..stats import z_limit
from .case import Figure, case
from .transforms import rotation

GROUP = "Rays"
MILLION = 1_000_000


@njit(nogil=True)
def misses(tlas: Any, origin: Any, direction: Any) -> Any:
    """Rays of (n, 3) float32 that meet nothing."""
    ray = np.zeros(embree.RAY, np.float32)
    count = 0
    for i in range(len(origin)):
        embree.set_ray(
            ray, origin[i, 0], origin[i, 1], origin[i, 2], direction[i, 0], direction[i, 1], direction[i, 2], 0.0,
            np.inf, 1
        )
        count += not embree.intersect(tlas, ray)
    return count


def knot(points: int, around: int) -> s.Mesh:
    """A closed tube along a trefoil knot: smooth, curved every way, with thin and long triangles."""
    t = np.linspace(0, 2 * np.pi, points, endpoint=False)
    curve = np.stack([np.sin(t) + 2 * np.sin(2 * t), np.cos(t) - 2 * np.cos(2 * t), -np.sin(3 * t)], -1) / 3
    along = np.roll(curve, -1, 0) - np.roll(curve, 1, 0)
    side = np.cross(along, curve + np.array([0, 0, 5]))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    up = np.cross(side, along)
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    phi = np.linspace(0, 2 * np.pi, around, endpoint=False)
    ring = np.cos(phi)[None, :, None] * side[:, None] + np.sin(phi)[None, :, None] * up[:, None]
    i, j = np.meshgrid(np.arange(points), np.arange(around), indexing="ij")
    a, b = i * around + j, i * around + (j + 1) % around
    c, d = (i + 1) % points * around + j, (i + 1) % points * around + (j + 1) % around
    triangles = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([b, d, c], -1).reshape(-1, 3)])
    return s.Mesh((curve[:, None] + 0.12 * ring).reshape(-1, 3).astype(np.float32), triangles.astype(np.uint32))


def targets(mesh: s.Mesh, transform: np.ndarray, count: int) -> np.ndarray:
    """World points of a mesh: the first half on edges, the other at vertices. (count, 3) float64."""
    rng = np.random.default_rng(21)
    corners = mesh.positions[mesh.triangles[rng.integers(0, len(mesh.triangles), count)]].astype(np.float64)
    start = rng.integers(0, 3, count)
    rows = np.arange(count)
    f = np.where(rows < count // 2, rng.random(count), 0.0)[:, None]
    points = corners[rows, start] * (1 - f) + corners[rows, (start + 1) % 3] * f
    return points @ transform[:, :3].astype(np.float64).T + transform[:, 3]


def escapes(mesh: s.Mesh, transform: np.ndarray, inside: np.ndarray, count: int, flags: int) -> tuple[int, int, int]:
    """Rays from points inside of a closed mesh (object space, (k, 3)) that meet nothing: of count / 2 at its edges,
    count / 2 at its vertices, count anywhere.

    flags: of the BLAS and the TLAS.
    """
    scene = scenes.build([mesh], [(0, transform, 0)])
    robust, embree.SCENE_ROBUST = embree.SCENE_ROBUST, flags
    try:
        blas = BlasCache(scene.meshes)
        blas.need(np.zeros(1, np.int64))
        tlas = Tlas(scene.instances, blas, np.ones(1, bool))
    finally:
        embree.SCENE_ROBUST = robust
    rng = np.random.default_rng(22)
    origin = inside[rng.integers(0, len(inside), count)] @ transform[:, :3].astype(np.float64).T + transform[:, 3]
    direction = (targets(mesh, transform, count) - origin).astype(np.float32)
    start, half = origin.astype(np.float32), count // 2
    anywhere = (rng.normal(size=(count, 3)) @ transform[:, :3].T).astype(np.float32)
    return tuple(
        int(misses(tlas.handle, o, d))
        for o, d in ((start[:half], direction[:half]), (start[half:], direction[half:]), (start, anywhere))
    )  # type: ignore[return-value]


def lost_at_vertices(mesh: s.Mesh, count: int) -> float:
    """How many of so many rays at vertices of a closed mesh the arithmetic may lose.

    Embree's robust test computes the sign of a ray against an edge alike for both of its triangles, so that no ray
    passes an edge. Near a vertex with k edges all k signs are those of rounding errors. A triangle is hit where one of
    its two edges at the vertex has the one sign and the next has the other; around the vertex that happens nowhere only
    if all signs agree: 2**(1 - k), were they coins. Embree counts zero and the nearly zero as a hit, so they are better
    than coins, by how much depends on the instructions of the machine (with fused multiply-add or without). Vertices
    are aimed at as often as triangles have them. On top of the mean: what chance adds to it, at the significance of all
    tests.
    """
    edges = np.unique(np.sort(np.concatenate([mesh.triangles[:, [k, (k + 1) % 3]] for k in range(3)]), axis=1), axis=0)
    valence = np.bincount(edges.ravel(), minlength=len(mesh.positions))
    share = float((2.0 ** (1 - valence[mesh.triangles.ravel()])).mean())
    return share * count + z_limit(1) * np.sqrt(share * count)


@case(GROUP)
def watertight() -> Iterator[Figure]:
    """From within a closed mesh, rays at points of its edges, at its vertices, and anywhere: a million or more in
    all."""
    knot_mesh = knot(300, 16)
    within = knot_mesh.positions.reshape(300, 16, 3).mean(axis=1)
    turned = np.zeros((3, 4), np.float32)
    turned[:, :3], turned[:, 3] = rotation(12) * 3.7, (3.0, -7.0, 1.0)
    stretched = np.zeros((3, 4), np.float32)
    stretched[:, :3], stretched[:, 3] = rotation(13) @ np.diag([1e-3, 1.0, 1e3]), (3.0, -7.0, 1.0)
    middle = np.random.default_rng(1).uniform(-0.3, 0.3, (50, 3))
    at_vertices = (
        "at a vertex, the sign of each of its k edges is a coin at worst: all agree, and no triangle is hit, for "
        "2**(1 - k) of rays"
    )
    for name, mesh, transform, inside in (
        ("a knot", knot_mesh, scenes.placed((0, 0, 0)), within),
        ("a knot, turned and moved", knot_mesh, turned, within),
        ("a sphere, stretched 1e-3 : 1 : 1e3", scenes.sphere(32), stretched, middle),
        ("a cube, turned and moved", scenes.cube(), turned, middle),
    ):
        plain = escapes(mesh, transform, inside, MILLION // 2, 0)
        robust = escapes(mesh, transform, inside, MILLION // 2, embree.SCENE_ROBUST)
        half = MILLION // 4
        yield Figure(
            f"{half:,} rays from inside at edges of {name}",
            "rays that leave it",
            robust[0],
            0.0,
            "before: without Embree's robust mode",
            plain[0],
        )
        yield Figure(
            f"{half:,} rays from inside at vertices of {name}",
            "rays that leave it",
            robust[1],
            lost_at_vertices(mesh, half),
            at_vertices,
            plain[1],
        )
        yield Figure(
            f"{2 * half:,} rays from inside of {name}, anywhere", "rays that leave it", robust[2], 0.0, "", plain[2]
        )


@case(GROUP)
def zero_components() -> Figure:
    """The slab test against exact arithmetic: origins on faces, edges, corners, inside; components 0 and -0. All
    coordinates are small integers."""
    rng = np.random.default_rng(4)
    wrong, count = 0, 100_000
    low = rng.integers(-2, 1, (count, 3)).astype(float)
    high = low + rng.integers(0, 3, (count, 3))
    origin = rng.integers(-3, 4, (count, 3)).astype(float)
    direction = rng.choice([0.0, -0.0, 1.0, -1.0, 2.0], (count, 3))
    far = rng.choice([0.0, 0.5, 1.0, 4.0], count)
    for i in range(count):
        got = box_entry(*low[i], *high[i], *origin[i], *direction[i], far[i]) >= 0.0  # type: ignore[call-arg]
        near, end = 0.0, far[i]
        for axis in range(3):
            d = direction[i, axis]
            if d == 0:
                if not low[i, axis] <= origin[i, axis] <= high[i, axis]:
                    end = -1.0
            else:
                a, b = sorted(((low[i, axis] - origin[i, axis]) / d, (high[i, axis] - origin[i, axis]) / d))
                near, end = max(near, a), min(end, b)
        wrong += got != (near <= end)
    return Figure(
        "rays with components 0 and -0, origins on box faces, edges, corners, and inside",
        "box tests that are wrong, of 100,000",
        float(wrong),
        0.0,
    )


@njit(nogil=True)
def crossings(handle: Any, counters: Any, query: Any, origin: Any, direction: Any, far: Any) -> Any:
    """Count all boxes that segments cross."""
    ray = np.zeros(embree.RAY, np.float32)
    for i in range(len(origin)):
        embree.set_ray(
            ray, origin[i, 0], origin[i, 1], origin[i, 2], direction[i, 0], direction[i, 1], direction[i, 2], 0.0, 1e30,
            1
        )
        hitboxes.count_crossings(handle, counters, query, ray, far, 0, hitboxes.ALL_CROSSINGS)


@case(GROUP)
def hitboxes_at_every_scale() -> Iterator[Figure]:
    """Counts of boxes crossed against the slab test of every pair, for boxes from 1e-12 to 1e12 m, flat ones and single
    points among them."""
    for scale in (1e-12, 1e-6, 1.0, 1e6, 1e12):
        rng = np.random.default_rng(5)
        center, half = rng.uniform(-10, 10, (400, 3)), rng.uniform(0, 2, (400, 3)) * (rng.random((400, 3)) < 0.8)
        boxes = (np.stack([center - half, center + half], axis=1) * scale).astype(np.float32)
        origin = (rng.uniform(-12, 12, (400, 3)) * scale).astype(np.float32)
        direction = rng.normal(size=(400, 3)).astype(np.float32)
        origin[:100], direction[100:200, :2] = boxes[:100, 0], 0.0  # from corners; along an axis
        origin[100:200] = boxes[100:200].mean(axis=1)
        subject = hitboxes.Hitboxes(boxes)
        far = np.float32(30 * scale)
        crossings(subject.handle, subject.counters, np.zeros(hitboxes.QUERY, np.int64), origin, direction, far)
        expected = np.zeros(400, np.int64)
        for o, d in zip(origin, direction, strict=True):
            expected += [box_entry(*b[0], *b[1], *o, *d, float(far)) >= 0 for b in boxes]  # type: ignore[call-arg]
        wrong = int(np.abs(subject.counters[:, 0] - expected).sum())
        yield Figure(
            f"400 boxes of about {scale:g} m", f"miscounts, of {expected.sum():,} crossings", float(wrong), 0.0
        )


def far_floor(distance: float, degrees: float) -> float:
    """Share of camera rays that miss a floor which they graze at an angle, a distance away; none can."""
    angle = np.radians(degrees)
    eye = np.array([0.0, -distance * np.cos(angle), distance * np.sin(angle)])
    half = 0.2 * angle
    camera = scenes.look_at(tuple(eye), (0, 0, 0), half, 1.0)  # type: ignore[arg-type]
    scene = scenes.build(
        [scenes.quad()], [(0, scenes.placed((0, 0, 0), 40 * distance), 0)], camera=camera, size=(64, 64)
    )
    feedback = Feedback.zeros(1)
    render(scene, 4, feedback=feedback)
    return 1.0 - feedback.hits[0, s.RayType.CAMERA] / (64 * 64 * 4)


@case(GROUP)
def grazing() -> Iterator[Figure]:
    """Camera rays along a floor, and what bounces off it: none passes it, none comes from below."""
    for degrees in (1.0, 0.01, 1e-4):
        yield Figure(
            f"camera rays {degrees:g} degrees above a floor", "rays that miss it", far_floor(1.0, degrees), 0.0
        )


@case(GROUP)
def closed_room_stays_dark() -> Iterator[Figure]:
    """Inside of a closed, unlit body in a world of light: nothing leaks in, from any start, over scales and places.
    Paths of 8 diffuse bounces."""
    limits = s.PathLimits(total=8, diffuse=8)
    for name, mesh in (
        ("cube", scenes.cube()),
        ("sphere of 4,000 triangles", scenes.sphere(32)),
        ("knot", knot(300, 16)),
    ):
        for scale in (1e-6, 1.0, 1e6):
            for shift in (0.0, 100.0):
                transform = np.zeros((3, 4), np.float32)
                transform[:, :3] = rotation(9) * scale
                transform[:, 3] = np.array([0.6, 0.5, 0.62]) * shift * scale
                inside = (
                    mesh.positions.reshape(300, 16, 3).mean(axis=1)[7] if name == "knot" else np.array([0.1, 0.05, 0.0])
                )
                eye = transform[:, :3].astype(float) @ inside + transform[:, 3]
                camera = scenes.look_at(tuple(eye), tuple(eye + np.array([0.3, 1, 0.2]) * scale), 1.0)  # type: ignore[arg-type]
                sun = lamp(s.LightKind.SUN, power=1e3)
                scene = scenes.build(
                    [mesh],
                    [(0, transform, 0)],
                    [material(base_color=1.0)],
                    camera,
                    sun,
                    (1e3, 1e3, 1e3),
                    (64, 36),
                    limits,
                )
                lit = render(scene, 8).mean[..., :3].max(axis=-1) > 0
                yield Figure(
                    f"inside of a closed {name}, scale {scale:g}, {shift:g} sizes from the origin",
                    "pixels that light leaks into",
                    float(lit.mean()),
                    0.0,
                )


@case(GROUP)
def thin_walls() -> Iterator[Figure]:
    """A box with walls of two faces each, a share of its size apart, in light: none gets in. Ten sizes from the origin,
    turned."""
    for thickness in (1e-2, 1e-3, 1e-4, 1e-5):
        outer, inner = scenes.cube(), scenes.cube()
        size = np.float32(1.0 - 2 * thickness)
        both = s.Mesh(
            np.concatenate([outer.positions, inner.positions * size]),
            np.concatenate([outer.triangles, inner.triangles[:, ::-1] + 8]).astype(np.uint32),
        )
        transform = np.zeros((3, 4), np.float32)
        transform[:, :3], transform[:, 3] = rotation(9), (6.0, 5.0, 6.2)
        eye = transform[:, 3].astype(float)
        camera = scenes.look_at(tuple(eye), tuple(eye + np.array([0.3, 1, 0.2])), 1.0)  # type: ignore[arg-type]
        limits = s.PathLimits(total=8, diffuse=8)
        sun = lamp(s.LightKind.SUN, power=1e3)
        scene = scenes.build(
            [both], [(0, transform, 0)], [material(base_color=1.0)], camera, sun, (1e3, 1e3, 1e3), (64, 36), limits
        )
        lit = render(scene, 8).mean[..., :3].max(axis=-1) > 0
        yield Figure(
            f"walls {thickness:g} of the room's size thick", "pixels that light leaks into", float(lit.mean()), 0.0
        )


@case(GROUP)
def contact_shadow() -> Iterator[Figure]:
    """A sheet just above a floor, turned: the floor under it is in its shadow. The gap is a share of the distance from
    the origin."""
    turn = rotation(9)
    for gap in (1e-4, 1e-5, 3e-6):
        for shift in (1.0, 100.0):
            transform = np.zeros((3, 4), np.float32)
            transform[:, :3], transform[:, 3] = turn, turn @ np.array([0.6, 0.5, 0.62]) * shift
            above = transform.copy()
            above[:, :3] *= 0.5
            above[:, 3] += turn[:, 2] * gap * shift
            camera = s.Camera(
                np.concatenate([turn, transform[:, 3:] + turn[:, 2:] * 3], axis=1),
                np.array([-0.2, 0.2, -0.2, 0.2]),
                orthographic=True,
            )
            flags = np.array([s.ALL_RAYS, s.ALL_RAYS & ~1], np.uint8)
            sun = lamp(s.LightKind.SUN, power=3)
            sun["axis_z"] = turn[:, 2]
            scene = scenes.build(
                [scenes.quad()],
                [(0, transform, 0), (0, above, 0)],
                [material()],
                camera,
                sun,
                (0, 0, 0),
                (32, 32),
                s.PathLimits(total=0),
                flags,
            )
            lit = float((render(scene, 4).mean[..., 0] > 0).mean())
            limit, why = (
                (0.0, "")
                if gap >= 1e-5
                else (
                    1.0,
                    "below the bound of Embree's own error, 12 roundings of each of three coordinates, a shadow ray "
                    "starts above the sheet",
                )
            )
            yield Figure(
                f"a sheet {gap:g} of the distance from the origin above a floor, {shift:g} m from it",
                "pixels under it that are lit",
                lit,
                limit,
                why,
            )
