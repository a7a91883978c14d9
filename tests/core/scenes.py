"""Small scenes made of arrays, for tests of the engine without Blender."""

from __future__ import annotations

import numpy as np

from lipac.core.accel.blas import BlasCache
from lipac.core.accel.tlas import Tlas
from lipac.core.scene import model as s
from lipac.core.scene.bounds import world_bounds
from lipac.core.scene.film import Picture
from lipac.core.tracing.tracer import prepare, trace

CUBE_POSITIONS = np.array([[x, y, z] for z in (-0.5, 0.5) for y in (-0.5, 0.5) for x in (-0.5, 0.5)], np.float32)
CUBE_TRIANGLES = np.array(
    [
        [0, 2, 1],
        [1, 2, 3],
        [4, 5, 6],
        [5, 7, 6],
        [0, 1, 4],
        [1, 5, 4],
        [2, 6, 3],
        [3, 6, 7],
        [0, 4, 2],
        [2, 4, 6],
        [1, 3, 5],
        [3, 7, 5],
    ],
    np.uint32,
)


def cube() -> s.Mesh:
    """Unit cube around the origin, normals outward."""
    return s.Mesh(CUBE_POSITIONS.copy(), CUBE_TRIANGLES.copy())


def quad() -> s.Mesh:
    """Unit square in the XY plane around the origin, normal +Z."""
    positions = np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]], np.float32)
    return s.Mesh(positions, np.array([[0, 1, 2], [0, 2, 3]], np.uint32))


def sphere(rings: int = 16) -> s.Mesh:
    """Unit-radius UV sphere, flat shaded."""
    theta = np.linspace(0, np.pi, rings + 1)
    phi = np.linspace(0, 2 * np.pi, 2 * rings, endpoint=False)
    t, p = np.meshgrid(theta, phi, indexing="ij")
    positions = (
        np.stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)], -1).reshape(-1, 3).astype(np.float32)
    )
    i, j = np.meshgrid(np.arange(rings), np.arange(2 * rings), indexing="ij")
    a, b = i * 2 * rings + j, i * 2 * rings + (j + 1) % (2 * rings)
    c, d = a + 2 * rings, b + 2 * rings
    triangles = np.concatenate(
        [np.stack([a, c, b], -1)[1:].reshape(-1, 3), np.stack([b, c, d], -1)[:-1].reshape(-1, 3)]
    ).astype(np.uint32)
    return s.Mesh(positions, triangles)


def placed(location: tuple[float, float, float], scale: float | tuple[float, float, float] = 1.0) -> np.ndarray:
    """(3, 4) object to world."""
    out = np.zeros((3, 4), np.float32)
    out[:, :3] = np.diag(np.broadcast_to(scale, 3))
    out[:, 3] = location
    return out


def look_at(
    eye: tuple[float, float, float], target: tuple[float, float, float], half_width: float = 0.5, aspect: float = 16 / 9
) -> s.Camera:
    """Perspective camera at eye; half_width: tangent of half the horizontal field of view."""
    z = np.subtract(eye, target).astype(float)
    z /= np.linalg.norm(z)
    x = np.cross([0.0, 0.0, 1.0], z) if abs(z[2]) < 0.999 else np.array([1.0, 0.0, 0.0])
    x /= np.linalg.norm(x)
    to_world = np.stack([x, np.cross(z, x), z, np.asarray(eye, float)], axis=1)
    return s.Camera(to_world, np.array([-half_width, half_width, -half_width / aspect, half_width / aspect]))


def build(
    meshes: list[s.Mesh],
    placement: list[tuple[int, np.ndarray, int]],
    materials: list[s.Records] | None = None,
    camera: s.Camera | None = None,
    lights: s.Records | None = None,
    world: tuple[float, float, float] = (1.0, 1.0, 1.0),
    size: tuple[int, int] = (64, 36),
    limits: s.PathLimits | None = None,
    flags: np.ndarray | None = None,
) -> s.Scene:
    """A scene of meshes placed as (mesh, transform, material), one material per instance."""
    mesh = np.array([p[0] for p in placement], np.int32)
    transform = np.stack([p[1] for p in placement]).astype(np.float32)
    mesh_bounds = np.stack([np.stack([m.positions.min(axis=0), m.positions.max(axis=0)]) for m in meshes]).astype(
        np.float32
    )
    instances = s.Instances(
        transform,
        mesh,
        np.array([p[2] for p in placement], np.int32),
        np.full(len(mesh), s.ALL_RAYS, np.uint8) if flags is None else flags,
        world_bounds(transform, mesh_bounds, mesh),
    )
    records = np.array([s.default_material()] if materials is None else materials, s.MATERIAL)
    return s.Scene(
        instances=instances,
        meshes=meshes,
        mesh_bounds=mesh_bounds,
        slot_materials=np.arange(len(records), dtype=np.int32),
        materials=records,
        lights=np.zeros(0, s.LIGHT) if lights is None else lights,
        world=s.World(np.array(world, np.float32)),
        camera=camera or look_at((0, -8, 3), (0, 0, 0)),
        film=s.Film(*size),
        limits=limits or s.PathLimits(),
    )


def render(scene: s.Scene, samples: int, active: np.ndarray | None = None, **options: object) -> Picture:
    """A picture of the active (N,) bool instances, all by default; options are those of `trace`."""
    blas = BlasCache(scene.meshes)
    active = np.ones(len(scene.instances), bool) if active is None else active
    blas.need(scene.instances.mesh[active])
    return trace(prepare(scene, blas), Tlas(scene.instances, blas, active), samples, **options)  # type: ignore[arg-type]


def material(shader: s.Shader = s.Shader.DIFFUSE, **fields: object) -> s.Records:
    """A MATERIAL record with other values of some fields."""
    m = s.default_material()
    m["shader"] = shader
    for name, value in fields.items():
        m[name] = value
    return m


def lamp(kind: s.LightKind, position: tuple[float, float, float] = (0, 0, 2), **fields: object) -> s.Records:
    """A lamp of 100 W that shines down."""
    light = np.zeros(1, s.LIGHT)
    light["kind"], light["position"], light["power"] = kind, position, 100.0
    light["axis_x"], light["axis_y"], light["axis_z"] = np.eye(3)
    light["spread"], light["spot_size"], light["visibility"], light["size"] = np.pi, 1.5, s.ALL_RAYS & ~1, 1.0
    light["cast_shadow"], light["normalize"], light["use_mis"], light["max_bounces"] = 1, 1, 1, 1024
    for name, value in fields.items():
        light[name] = value
    return light
