"""Meshes that no modeller should make, and that every file holds."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np

from lipac.core.accel.blas import BlasCache
from lipac.core.culling.analysis import analyze
from lipac.core.culling.options import CullOptions
from lipac.core.feedback.hits import Feedback
from lipac.core.scene import model as s
from lipac.core.scene.bounds import world_bounds

from ..core import scenes
from ..core.scenes import lamp, material, render
from .case import Figure, case
from .places import changed

GROUP = "Meshes"
CAMERA = scenes.look_at((0, -4, 2), (0, 0, 0.5))


def picture_of(mesh: s.Mesh, emission: float = 0.0) -> np.ndarray:
    """The mesh on a floor in slanting sun and grey light."""
    placement = [(0, scenes.placed((0, 0, 0.7)), 1), (1, scenes.placed((0, 0, 0), 8.0), 0)]
    materials = [material(base_color=0.6), material(s.Shader.PRINCIPLED, base_color=0.7, emission=emission)]
    sun = lamp(s.LightKind.SUN, power=2)
    sun["axis_z"] = np.array([0.5, -0.4, 0.7]) / np.linalg.norm([0.5, -0.4, 0.7])
    return render(
        scenes.build([mesh, scenes.quad()], placement, materials, CAMERA, sun, (0.3, 0.3, 0.3), (96, 54)), 4
    ).mean


def joined(*parts: s.Mesh) -> s.Mesh:
    """One mesh of all parts."""
    offsets = np.cumsum([0, *[len(p.positions) for p in parts[:-1]]])
    triangles = np.concatenate([p.triangles.astype(np.int64) + o for p, o in zip(parts, offsets, strict=True)])
    return s.Mesh(np.concatenate([p.positions for p in parts]), triangles.astype(np.uint32))


def dirt(kind: str) -> s.Mesh:
    """Geometry that must not show: added to a body, it changes nothing."""
    rng = np.random.default_rng(7)
    if kind == "zero-area triangles":
        a, b = rng.uniform(-2, 2, (2, 500, 3))
        corners = np.stack([a, b, (a + b) / 2], 1)  # three in line, but for rounding
        corners[:250, 2] = corners[:250, 1]
        corners[:100, 1] = corners[:100, 0]
    elif kind == "needles":
        a, b = rng.uniform(-2, 2, (2, 500, 3))
        corners = np.stack([a, b, a + rng.normal(size=(500, 3)) * 1e-7], 1)
    else:
        corners = rng.uniform(-1, 1, (300, 3, 3))
        corners[np.arange(300), rng.integers(0, 3, 300), rng.integers(0, 3, 300)] = np.array(
            [np.nan, np.inf, -np.inf, 3e38]
        )[np.arange(300) % 4]
    return s.Mesh(
        corners.reshape(-1, 3).astype(np.float32), np.arange(3 * len(corners), dtype=np.uint32).reshape(-1, 3)
    )


@case(GROUP)
def dirt_does_not_show() -> Iterator[Figure]:
    """Triangles without area, needles thinner than 1e-7, vertices that are no numbers: beside a good body in one
    mesh."""
    body = scenes.sphere(16)
    reference = picture_of(body)
    for kind in ("zero-area triangles", "needles", "vertices that are NaN, infinite or 3e38"):
        with np.errstate(all="ignore"):
            mesh = joined(body, dirt(kind))
            what = f"{len(mesh.triangles) - len(body.triangles)} {kind} in a good mesh"
            # core takes bounds from a scene; extraction makes them of usable vertices alone, and so does this
            picture = picture_of(mesh) if "NaN" not in kind else broken_picture(mesh, body)
        limit = 0.01 if kind == "needles" else 0.0
        yield Figure(
            what,
            "pixels that differ by more than 1 %",
            changed(reference, picture),
            limit,
            "single rays meet a needle" if limit else "",
        )


def broken_picture(mesh: s.Mesh, sound: s.Mesh) -> np.ndarray:
    """`picture_of` a mesh with unusable vertices: what Embree is given holds them."""
    whole = s.Mesh(mesh.positions, mesh.triangles)
    scene_mesh = [whole, scenes.quad()]
    placement = [(0, scenes.placed((0, 0, 0.7)), 1), (1, scenes.placed((0, 0, 0), 8.0), 0)]
    materials = [material(base_color=0.6), material(s.Shader.PRINCIPLED, base_color=0.7)]
    sun = lamp(s.LightKind.SUN, power=2)
    sun["axis_z"] = np.array([0.5, -0.4, 0.7]) / np.linalg.norm([0.5, -0.4, 0.7])
    scene = scenes.build([sound, scenes.quad()], placement, materials, CAMERA, sun, (0.3, 0.3, 0.3), (96, 54))
    return render(dataclasses.replace(scene, meshes=scene_mesh), 4).mean


@case(GROUP)
def duplicates_and_non_manifold() -> Iterator[Figure]:
    """Every triangle twice, and three sheets on one edge: the same hits, one or the other of equals."""
    body = scenes.sphere(16)
    double = s.Mesh(body.positions, np.concatenate([body.triangles, body.triangles]))
    yield Figure(
        "every triangle twice",
        "pixels that differ by more than 1 %",
        changed(picture_of(body), picture_of(double)),
        0.0,
    )
    flipped = s.Mesh(body.positions, np.concatenate([body.triangles, body.triangles[:, ::-1]]))
    yield Figure(
        "every triangle twice, facing both ways",
        "pixels that differ by more than 1 %",
        changed(picture_of(body), picture_of(flipped)),
        0.0,
    )
    sheets = s.Mesh(
        np.array([[0, 0, -1], [0, 0, 1], [1, 0, 0], [-1, 0.5, 0], [0, 1, 0]], np.float32),
        np.array([[0, 1, 2], [0, 1, 3], [1, 0, 4]], np.uint32),
    )
    picture = picture_of(sheets)
    yield Figure(
        "three triangles on one edge", "pixels that are not finite", float((~np.isfinite(picture)).mean()), 0.0
    )


@case(GROUP)
def inside_out() -> Figure:
    """A closed diffuse body with its normals turned in looks as with normals out."""
    body = scenes.sphere(16)
    turned = s.Mesh(body.positions, np.ascontiguousarray(body.triangles[:, ::-1]))
    return Figure(
        "normals turned inside out",
        "pixels that differ by more than 1 %",
        changed(picture_of(body), picture_of(turned)),
        0.0,
    )


@case(GROUP)
def coplanar_overlap() -> Iterator[Figure]:
    """Two overlapping floors in one plane, of one material, axis-aligned and turned: no shadow of one on the other."""
    for name, turn in (
        ("axis-aligned", np.eye(3)),
        ("turned", np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))[0]),
    ):
        turn = turn * np.sign(np.linalg.det(turn))  # noqa: PLW2901
        pictures = []
        for copies in (1, 2):
            corners = np.concatenate(
                [
                    scenes.quad().positions @ turn.T * size + turn[:, 0] * shift
                    for size, shift in ((8.0, 0.0), (7.3, 0.21))[:copies]
                ]
            )
            triangles = np.concatenate([scenes.quad().triangles + 4 * k for k in range(copies)])
            mesh = s.Mesh(corners.astype(np.float32), triangles.astype(np.uint32))
            sun = lamp(s.LightKind.SUN, power=2)
            sun["axis_z"] = turn @ (np.array([0.5, -0.4, 0.7]) / np.linalg.norm([0.5, -0.4, 0.7]))
            camera = scenes.look_at(tuple(turn @ [0, -2, 4]), (0, 0, 0), 0.3)  # type: ignore[arg-type]
            pictures.append(
                render(
                    scenes.build(
                        [mesh],
                        [(0, scenes.placed((0, 0, 0)), 0)],
                        [material(base_color=0.5)],
                        camera,
                        sun,
                        (0, 0, 0),
                        (64, 36),
                    ),
                    8,
                ).mean
            )
        yield Figure(
            f"two overlapping floors in one plane, {name}",
            "pixels that differ by more than 1 %",
            changed(pictures[0], pictures[1]),
            0.0,
        )


@case(GROUP)
def nothing_in_a_mesh() -> Iterator[Figure]:
    """Meshes of no vertices, of vertices alone, of loose edges (which reach the core as no triangles)."""
    empty = s.Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint32))
    loose = s.Mesh(np.ones((5, 3), np.float32), np.zeros((0, 3), np.uint32))
    ball = scenes.sphere(12)
    scene = scenes.build(
        [ball, scenes.quad()],
        [(0, scenes.placed((0, 0, 1)), 0), (1, scenes.placed((0, 0, 0), 8.0), 0)],
        camera=CAMERA,
        size=(64, 36),
    )
    bounds = np.concatenate([scene.mesh_bounds, [[[1, 1, 1], [-1, -1, -1]]], [[[1, 1, 1], [1, 1, 1]]]]).astype(
        np.float32
    )
    transform = np.concatenate([scene.instances.transform, np.stack([scenes.placed((0, 0, 1))] * 2)])
    mesh, two = np.array([0, 1, 2, 3], np.int32), np.zeros(2, np.int32)
    instances = dataclasses.replace(
        scene.instances,
        transform=transform,
        mesh=mesh,
        slots=np.append(scene.instances.slots, two).astype(np.int32),
        flags=np.full(4, s.ALL_RAYS, np.uint8),
        bounds=world_bounds(transform, bounds, mesh),
    )
    with_empty = dataclasses.replace(
        scene, meshes=[ball, scenes.quad(), empty, loose], mesh_bounds=bounds, instances=instances
    )
    result = analyze(with_empty, CullOptions(width=64, policy="none"))
    figure = changed(render(scene, 4).mean, render(with_empty, 4, result.active).mean, 0.0)
    yield Figure("meshes without vertices, and with loose ones only", "pixels that differ in any bit", figure, 0.0)
    kept = analyze(with_empty, CullOptions(width=64)).active
    yield Figure("meshes without triangles, culled by light paths", "kept", float(kept[2:].sum()), 0.0)


@case(GROUP, slow=True)
def ten_million_triangles() -> Iterator[Figure]:
    """One wavy surface of ten million triangles: every downward ray meets it, at its height."""
    n = 2237
    x = np.linspace(-1, 1, n, dtype=np.float32)
    grid = np.stack([*np.meshgrid(x, x), np.zeros((n, n), np.float32)], -1)
    grid[..., 2] = 0.1 * np.sin(9 * grid[..., 0]) * np.cos(7 * grid[..., 1])
    i = np.arange(n * n, dtype=np.uint32).reshape(n, n)
    a, b, c, d = i[:-1, :-1].ravel(), i[:-1, 1:].ravel(), i[1:, 1:].ravel(), i[1:, :-1].ravel()
    mesh = s.Mesh(grid.reshape(-1, 3), np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)]))
    to_world = np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2]], float)
    camera = s.Camera(to_world, np.array([-0.99, 0.99, -0.99, 0.99]), orthographic=True)
    scene = scenes.build([mesh], [(0, scenes.placed((0, 0, 0)), 0)], camera=camera, size=(256, 256))
    blas = BlasCache(scene.meshes)
    blas.need(np.zeros(1, np.int64))
    feedback = Feedback.zeros(1)
    picture = render(scene, 4, feedback=feedback)
    paths = 256 * 256 * 4
    yield Figure(
        f"{len(mesh.triangles):,} triangles in one mesh",
        "rays that pass through it",
        1.0 - feedback.hits[0, s.RayType.CAMERA] / paths,
        0.0,
    )
    yield Figure(
        f"{len(mesh.triangles):,} triangles in one mesh",
        "pixels that are not finite",
        float((~np.isfinite(picture.mean)).mean()),
        0.0,
    )
