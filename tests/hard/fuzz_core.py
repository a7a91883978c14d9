"""Random scenes of arrays, good ones and nonsense, and what must hold for all of them."""

from __future__ import annotations

import dataclasses
import unittest.mock

import numpy as np

from lipac.core.accel.blas import BlasCache
from lipac.core.accel.hitboxes import Hitboxes, box_entry
from lipac.core.accel.tlas import Tlas
from lipac.core.culling import loop
from lipac.core.culling.analysis import analyze
from lipac.core.culling.options import CullOptions, State
from lipac.core.error_budget.budget import Budget
from lipac.core.feedback.hits import Feedback
from lipac.core.jit.sampling import path_key, uniform2
from lipac.core.scene import model as s
from lipac.core.scene.camera import camera_constants, camera_ray
from lipac.core.scene.film import filter_offset, filter_offsets
from lipac.core.scene.placing import LARGEST
from lipac.core.tracing.tile_kernel import _FILTER, _LENS
from lipac.core.tracing.tracer import Prepared, prepare, trace

from ..core import scenes
from ..core.scenes import lamp, material
from .choices import Seeded

NONSENSE = (0.0, np.nan, np.inf, -np.inf, 1e-30, 1e25, 3e38)
SIZES = ((16, 9), (1, 1), (7, 5), (20, 3))


def random_scene(choose: Seeded) -> s.Scene:
    """A scene of 0 to 5 kinds of mesh in 1 to 16 places; one time in eight a part of it is nonsense."""
    scale = 10.0 ** choose.integer(-4, 4)
    meshes = [_mesh(choose) for _ in range(choose.integer(1, 5))]
    materials = [_material(choose) for _ in range(choose.integer(1, 5))]
    rng = choose.numbers()
    placement: list[tuple[int, np.ndarray, int]] = []
    for _ in range(choose.integer(1, 16)):
        transform = np.zeros((3, 4))
        transform[:, :3] = (
            np.linalg.qr(rng.normal(size=(3, 3)))[0] * 10 ** rng.uniform(-1, 0.3, 3) * rng.choice([1, 1, 1, -1], 3)
        )
        transform[:, 3] = rng.uniform(-3, 3, 3)
        transform *= scale
        if choose.rarely():
            transform[choose.integer(0, 2), choose.integer(0, 3)] = choose.one(NONSENSE)
        if choose.rarely() and placement:
            transform = placement[-1][1].astype(np.float64)  # at the place of another
        placement.append((choose.integer(0, len(meshes) - 1), transform, choose.integer(0, len(materials) - 1)))
    eye, target = rng.uniform(-5, 5, 3) * scale, rng.uniform(-1, 1, 3) * scale
    camera = scenes.look_at(tuple(eye), tuple(target), 10 ** rng.uniform(-1.5, 0.5))
    if choose.rarely():
        camera = dataclasses.replace(camera, frame=camera.frame * 4 * scale, orthographic=True)
    if choose.rarely():
        camera = dataclasses.replace(
            camera, clip_start=scale, clip_end=6 * scale, aperture=0.1 * scale, focus=3 * scale
        )
    lights = [_lamp(choose, scale) for _ in range(choose.integer(0, 3))]
    flags = rng.choice(
        [s.ALL_RAYS, s.ALL_RAYS, s.ALL_RAYS & ~1, 1, s.ALL_RAYS | s.InstanceFlag.HOLDOUT], len(placement)
    ).astype(np.uint8)
    with np.errstate(all="ignore"):
        scene = scenes.build(
            meshes,
            [(m, t.astype(np.float32), k) for m, t, k in placement],
            materials,
            camera,
            np.concatenate(lights) if lights else None,
            (0.0, 0.0, 0.0) if choose.rarely() else (0.5, 0.6, 0.7),
            choose.one(SIZES),
            s.PathLimits(total=choose.integer(0, 8), diffuse=choose.integer(0, 4), transparent=choose.integer(0, 8)),
            flags,
        )
    if choose.rarely():
        scene = dataclasses.replace(scene, world=s.World(np.zeros(3, np.float32), _image(choose)))
    return scene


def _mesh(choose: Seeded) -> s.Mesh:
    kind = choose.integer(0, 5)
    if kind == 0:
        return scenes.cube()
    if kind == 1:
        return scenes.quad()
    if kind == 2:
        ball = scenes.sphere(choose.integer(2, 12))
        return (
            dataclasses.replace(ball, normals=np.ascontiguousarray(ball.positions[ball.triangles]))
            if choose.integer(0, 1)
            else ball
        )
    rng = choose.numbers()
    positions = rng.normal(size=(choose.integer(3, 30), 3)).astype(np.float32) * 0.5
    triangles = rng.integers(0, len(positions), (choose.integer(1, 40), 3)).astype(np.uint32)  # some without area
    if choose.rarely():
        positions[:, 2] = 0
    if choose.rarely():
        positions *= np.float32(choose.one((1e-12, 1e-6, 1e6, 1e12)))
    return s.Mesh(positions, triangles)


# a composed one has parts: with itself among them a path would never end
SIMPLE = [shader for shader in s.Shader if shader < s.Shader.MIX]


def _material(choose: Seeded) -> s.Records:
    rng = choose.numbers()
    m = material(
        choose.one(SIMPLE),
        base_color=rng.random(3),
        roughness=choose.one((0.0, 1e-4, 0.3, 1.0)),
        metallic=choose.one((0.0, 1.0, 0.5)),
    )
    m["ior"], m["transmission"], m["coat"] = (
        choose.one((1.0, 1.5, 3.0, 0.5)),
        choose.one((0.0, 1.0, 0.5)),
        choose.one((0.0, 1.0)),
    )
    m["alpha"] = choose.one((1.0, 1.0, 0.0, 0.5))
    if choose.integer(0, 3) == 3 or m["shader"] == s.Shader.EMISSION:
        m["emission"] = rng.random(3) * 10.0 ** choose.integer(-12, 12)
        m["mis_emission"], m["single_sided_emission"] = choose.integer(0, 1), choose.integer(0, 1)
    return m


def _lamp(choose: Seeded, scale: float) -> s.Records:
    rng = choose.numbers()
    light = lamp(
        choose.one(list(s.LightKind)),
        tuple(rng.uniform(-3, 3, 3) * scale),
        power=rng.random(3) * 10.0 ** choose.integer(-12, 12),
    )  # type: ignore[arg-type]
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    light["axis_x"], light["axis_y"], light["axis_z"] = turn.T
    light["radius"] = light["angle"] = choose.one((0.0, 1e-6, 0.3, 3.0))
    light["size"] = choose.one((0.0, 1e-6, 1.0, 1e4))
    light["shape"], light["spread"] = choose.integer(0, 1), choose.one((np.pi, 1.0, 0.0))
    light["spot_size"], light["spot_blend"] = choose.one((0.0, 0.5, np.pi)), choose.one((0.0, 1.0))
    light["visibility"] = s.ALL_RAYS
    light["soft_falloff"], light["normalize"] = choose.integer(0, 1), choose.integer(0, 1)
    return light


def _image(choose: Seeded) -> np.ndarray:
    image = choose.numbers().random((6, 12, 3)).astype(np.float32)
    image[choose.integer(0, 5), choose.integer(0, 11)] = choose.one((0.0, 1e6, np.nan, np.inf))
    return image


def existing(scene: s.Scene) -> np.ndarray:
    """(N,) bool: instances whose coordinates are numbers that Embree takes."""
    with np.errstate(invalid="ignore"):
        return np.asarray(
            (np.abs(scene.instances.bounds) <= LARGEST).all(axis=(1, 2))
            & np.isfinite(scene.instances.transform).all(axis=(1, 2))
        )


def check(scene: s.Scene, seed: int = 0) -> None:
    """Everything that must hold for a scene. Raises AssertionError."""
    exist = existing(scene)
    blas = BlasCache(scene.meshes)
    blas.need(scene.instances.mesh)
    tlas, prepared, some = Tlas(scene.instances, blas, exist), prepare(scene, blas), np.flatnonzero(exist)[::2]
    pictures, counts = [], []
    for threads in (1, 2):
        boxes = Hitboxes(scene.instances.bounds[some])
        feedback = Feedback.zeros(len(exist), boxes)
        pictures.append(trace(prepared, tlas, 1, seed=seed, feedback=feedback, threads=threads))
        counts.append((feedback.hits, feedback.boxes))
    assert np.isfinite(pictures[0].sums).all(), "a pixel is not finite"
    assert (pictures[0].sums[..., :3] >= 0).all(), "a pixel is negative"
    assert pictures[0].sums.tobytes() == pictures[1].sums.tobytes(), "the picture depends on threads"
    assert all((a == b).all() for a, b in zip(*counts, strict=True)), "counts depend on threads"
    assert (counts[0][0][~exist] == 0).all() or scene.materials["emission"].any(), "what does not exist was met"
    check_first_hits(scene, exist, counts[0][0], seed)
    check_boxes(scene, some, seed)
    check_states(scene, exist, prepared, pictures[0].sums, seed)


def first_rays(scene: s.Scene, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Origins, directions and lengths of the first sample's camera rays, as the kernel makes them."""
    width, height = scene.film.width, scene.film.height
    camera, pixel_filter = camera_constants(scene.camera), filter_offsets(scene.film)
    rays = []
    for y in range(height):
        for x in range(width):
            key = np.uint64(path_key(np.uint64(seed), np.uint64(y * width + x), np.uint64(0)))
            f, lens = uniform2(key, _FILTER), uniform2(key, _LENS)
            u = (np.float32(x) + np.float32(0.5) + filter_offset(pixel_filter, np.float32(f[0]))) / np.float32(width)
            v = (np.float32(y) + np.float32(0.5) + filter_offset(pixel_filter, np.float32(f[1]))) / np.float32(height)
            rays.append(camera_ray(camera, np.float32(u), np.float32(v), np.float32(lens[0]), np.float32(lens[1])))
    out = np.array(rays)
    return out[:, :3], out[:, 3:6], out[:, 6]


def check_first_hits(scene: s.Scene, exist: np.ndarray, hits: np.ndarray, seed: int) -> None:
    """Camera hits against every ray with every triangle, in float64. Rays that pass an edge, or two surfaces, within
    float32's doubt may go either way."""
    passes = (scene.materials["shader"] == s.Shader.TRANSPARENT) | (
        (scene.materials["shader"] == s.Shader.PRINCIPLED) & (scene.materials["alpha"] < 1)
    )
    if passes.any():
        return  # what lies behind counts as well
    # beyond, which extraction leaves out, float32 has no inverse
    sound = np.abs(scene.instances.transform).max(axis=(1, 2)) <= LARGEST
    seen = np.flatnonzero(exist & sound & (scene.instances.flags & 1 != 0))
    origin, direction, far = first_rays(scene, seed)
    corners, owner = [np.zeros((0, 3, 3))], [np.zeros(0, np.int64)]
    for i in seen:
        mesh, t = scene.meshes[scene.instances.mesh[i]], scene.instances.transform[i].astype(np.float64)
        corners.append(mesh.positions[mesh.triangles].astype(np.float64) @ t[:, :3].T + t[:, 3])
        owner.append(np.full(len(mesh.triangles), i))
    triangles, owners = np.concatenate(corners), np.concatenate(owner)
    expected, doubtful = np.zeros(len(exist), np.int64), 0
    size = np.abs(triangles).max(axis=(1, 2), initial=0)
    for o, d, end in zip(origin, direction, far, strict=True):
        t, margin = _meet(triangles - o, d)
        doubt = 1e-4 * (size + np.abs(o).max())
        near = (margin > -1e-3) & (t > -doubt) & (t < end + doubt)
        if not near.any():
            continue
        first = np.where(near, t, np.inf).argmin()
        close = near & (t <= t[first] + doubt.max(initial=0, where=near))
        sure = (
            margin[first] > 1e-3
            and doubt[first] < t[first] < end - doubt[first]
            and (owners[close] == owners[first]).all()
        )
        doubtful += not sure
        expected[owners[first]] += sure
    got = hits[:, s.RayType.CAMERA]
    assert (got >= expected).all(), f"camera hits {got - expected} more than brute force"
    assert (got - expected).sum() <= doubtful, (
        f"{(got - expected).sum()} more camera hits than brute force finds, {doubtful} are open"
    )


def _meet(triangle: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances of triangles (n, 3, 3), relative to the origin of a ray, along it, and their smallest barycentric
    coordinate there (negative: outside)."""
    a, b, c = triangle[:, 0], triangle[:, 1], triangle[:, 2]
    normal = np.cross(b - a, c - a)
    with np.errstate(all="ignore"):
        t = np.einsum("ij,ij->i", a, normal) / (normal @ d)
        p = t[:, None] * d
        area = np.einsum("ij,ij->i", normal, normal)
        parts = [
            np.einsum("ij,ij->i", np.cross(y - p, z - p), normal) / area
            for x, y, z in ((a, b, c), (b, c, a), (c, a, b))
        ]
    margin = np.min(parts, axis=0)
    ok = np.isfinite(t) & np.isfinite(margin)
    return np.where(ok, t, np.inf), np.where(ok, margin, -np.inf)


def check_boxes(scene: s.Scene, some: np.ndarray, seed: int) -> None:
    """Boxes that the camera rays cross in an otherwise empty scene, against the slab test of every pair: exactly
    equal."""
    bounds = scene.instances.bounds[some]
    empty = BlasCache(scene.meshes)
    tlas = Tlas(scene.instances, empty, np.zeros(len(scene.instances), bool))
    boxes = Hitboxes(bounds)
    feedback = Feedback.zeros(len(scene.instances), boxes)
    trace(prepare(scene, empty), tlas, 1, seed=seed, feedback=feedback)
    origin, direction, far = first_rays(scene, seed)
    crossed = np.zeros(len(bounds), np.int64)
    for o, d, end in zip(origin, direction, far, strict=True):
        o32, d32, far32 = o.astype(np.float32), d.astype(np.float32), float(np.float32(end))
        crossed += np.array([box_entry(*box[0], *box[1], *o32, *d32, far32) >= 0 for box in bounds], np.int64)  # type: ignore[call-arg]
    assert (feedback.boxes[:, s.RayType.CAMERA] == crossed).all(), "box crossings differ from brute force"


def check_states(scene: s.Scene, exist: np.ndarray, prepared: Prepared, sums: np.ndarray, seed: int) -> None:
    """`none` keeps everything and renders the reference; light paths decide the same at any number of threads, by
    budget or by counts."""
    everything = analyze(scene, CullOptions(policy="none"))
    whole = (scene.mesh_bounds[scene.instances.mesh, 0] <= scene.mesh_bounds[scene.instances.mesh, 1]).all(axis=1)
    assert (everything.active == (exist & whole)).all(), "none culls, or keeps what does not exist"
    again = trace(prepared, Tlas(scene.instances, prepared.blas, everything.active), 1, seed=seed)
    assert again.sums.tobytes() == sums.tobytes(), "none renders something else"
    options = CullOptions(
        width=16, seed=seed, paths=1, max_error=Budget(0.02, 0.1), min_share=0.001 if seed % 2 else None
    )
    with unittest.mock.patch.object(loop, "ROUND_PATHS", 1 << 11):  # as decisive for these tiny pictures, and quicker
        one, two = (analyze(scene, dataclasses.replace(options, threads=threads)) for threads in (1, 2))
    assert (one.state == two.state).all() and (one.hits == two.hits).all() and (one.score == two.score).all(), (
        "states depend on threads"
    )
    assert np.isin(one.state, list(State)).all() and len(one.state) == len(exist)
    assert np.isfinite(one.score).all() and (one.score >= 0).all(), "a score is negative or not finite"
    assert not (one.active & ~exist).any(), "what does not exist is kept"
    assert all(np.isfinite(value) and value >= 0 for value in one.stats.values() if isinstance(value, int | float)), (
        "a figure of the report is no number"
    )
