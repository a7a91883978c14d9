"""Light sampling in kernels: a light from a point, a place on it, and the density of that; the table is that of
`lights`."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from ...jit.pointers import f32_pointer, load_f32, load_i32, load_i64, load_u64, offset
from ...jit.sampling import OPTIONS, normalize
from ...scene.mesh import MESH
from ..surface import T_TRANSFORM, corners
from .environment import environment_pdf, find_interval, sample_environment
from .lamps import FAR, LAMP, SUN, lamp_pdf, sample_lamp
from .light_tree import sample_tree, tree_pdf
from .lights import EMITTER

# Light table, uint64[LIGHTS]: counts and addresses.
(
    L_LAMPS, L_EMITTERS, L_INFINITE, L_EMITTER_RECORDS, L_TRAILS, L_CDF, L_TRIANGLES, L_INSTANCE_EMITTER,
    L_LAMP_EMITTER, L_INFINITE_CDF, L_INFINITE_LAMP, L_MESHES, L_IMAGE, L_WIDTH, L_HEIGHT, L_MARGINAL, L_CONDITIONAL,
    L_WORLD_VISIBILITY, L_WORLD_LIGHT, L_COUNT_SHAPES, L_SEEN
) = range(21)
_EMITTER_SIZE = np.uint64(EMITTER.itemsize)
_LAMP, _INSTANCE, _FIRST, _COUNT = (offset(EMITTER, n) for n in ("lamp", "instance", "first", "count"))
_MESH_SIZE = np.uint64(MESH.itemsize)
NONE, WORLD, INSTANCE = -1, -2, 1 << 40  # what sample_light returns: a lamp's index, WORLD, or INSTANCE + emitter
_ZERO, _ONE, _HALF = np.float32(0.0), np.float32(1.0), np.float32(0.5)


@njit(**OPTIONS)
def finite_share(lights):
    """Probability of sampling a lamp or emissive instance instead of a light at infinity."""
    if lights[L_EMITTERS] == np.uint64(0):
        return _ZERO
    return _ONE if lights[L_INFINITE] == np.uint64(0) else _HALF


@njit(**OPTIONS)
def triangle_edges(meshes, table, instance, triangle):
    """World-space first corner of a triangle of an instance, and its edges to the second and the third: 9 float32.

    The edges are transformed as differences: of world-space corners a small emitter far from the origin would have lost
    them.
    """
    mesh = meshes + np.uint64(load_i32(table[1], instance)) * _MESH_SIZE
    m = table[T_TRANSFORM] + np.uint64(48) * np.uint64(instance)
    ax, ay, az, bx, by, bz, cx, cy, cz = corners(mesh, triangle)
    ux, uy, uz, vx, vy, vz = bx - ax, by - ay, bz - az, cx - ax, cy - ay, cz - az
    m00, m01, m02, tx = load_f32(m, 0), load_f32(m, 1), load_f32(m, 2), load_f32(m, 3)
    m10, m11, m12, ty = load_f32(m, 4), load_f32(m, 5), load_f32(m, 6), load_f32(m, 7)
    m20, m21, m22, tz = load_f32(m, 8), load_f32(m, 9), load_f32(m, 10), load_f32(m, 11)
    return (
        m00 * ax + m01 * ay + m02 * az + tx,
        m10 * ax + m11 * ay + m12 * az + ty,
        m20 * ax + m21 * ay + m22 * az + tz,
        m00 * ux + m01 * uy + m02 * uz,
        m10 * ux + m11 * uy + m12 * uz,
        m20 * ux + m21 * uy + m22 * uz,
        m00 * vx + m01 * vy + m02 * vz,
        m10 * vx + m11 * vy + m12 * vz,
        m20 * vx + m21 * vy + m22 * vz,
    )


@njit(**OPTIONS)
def sample_light(table, lights, lamps, nodes, children, px, py, pz, nx, ny, nz, u, u0, u1, ls, chosen):
    """Sample a light from a point p with shading normal n.

    table: SceneTable; lights, lamps, nodes, children: of `Lights`; u, u0, u1: uniform numbers; ls:
    float32[LIGHT_SAMPLE], D_*; chosen: int64[2], instance and triangle of an emissive sample. Returns a lamp's index,
    WORLD, INSTANCE, or NONE where nothing arrives.
    """
    finite = finite_share(lights)
    if u < finite:
        u /= finite
        e = np.int64(0)
        share = finite
        if lights[L_EMITTERS] > np.uint64(1):
            e, p = sample_tree(nodes, children, u, px, py, pz, nx, ny, nz)
            if e < 0:
                return NONE
            share *= p
        record = lights[L_EMITTER_RECORDS] + np.uint64(e) * _EMITTER_SIZE
        lamp = np.int64(load_i32(record + _LAMP, 0))
        if lamp < 0:
            instance = np.int64(load_i32(record + _INSTANCE, 0))
            first = load_i64(record + _FIRST, 0)
            i = find_interval(lights[L_CDF], first, load_i64(record + _COUNT, 0), u0)
            a, b = load_f32(lights[L_CDF], first + i), load_f32(lights[L_CDF], first + i + 1)
            u0 = min((u0 - a) / max(b - a, np.float32(1e-30)), np.float32(1.0))
            triangle = np.int64(load_i32(lights[L_TRIANGLES], first + i))
            root = math.sqrt(u0)
            b1 = root * (_ONE - u1)
            b2 = root * u1
            ax, ay, az, ux, uy, uz, vx, vy, vz = triangle_edges(lights[L_MESHES], table, instance, triangle)
            dx, dy, dz, t = normalize(
                ax - px + b1 * ux + b2 * vx, ay - py + b1 * uy + b2 * vy, az - pz + b1 * uz + b2 * vz
            )
            cos_area = abs((uy * vz - uz * vy) * dx + (uz * vx - ux * vz) * dy + (ux * vy - uy * vx) * dz) * _HALF
            if not (cos_area > _ZERO and t > _ZERO):
                return NONE
            ls[0], ls[1], ls[2], ls[3] = dx, dy, dz, t
            ls[4] = share * (b - a) * t * t / cos_area
            ls[5] = _ONE
            ls[6], ls[7] = b1, b2
            chosen[0], chosen[1] = instance, triangle
            return INSTANCE
    else:
        u = (u - finite) / max(_ONE - finite, np.float32(1e-30))
        i = find_interval(lights[L_INFINITE_CDF], np.int64(0), np.int64(lights[L_INFINITE]), u)
        share = (_ONE - finite) * (load_f32(lights[L_INFINITE_CDF], i + 1) - load_f32(lights[L_INFINITE_CDF], i))
        lamp = np.int64(load_i32(lights[L_INFINITE_LAMP], i))
        if lamp < 0:
            dx, dy, dz, pdf = sample_environment(
                lights[L_MARGINAL], lights[L_CONDITIONAL], np.int64(lights[L_WIDTH]), np.int64(lights[L_HEIGHT]), u0, u1
            )
            ls[0], ls[1], ls[2], ls[3] = dx, dy, dz, FAR
            ls[4] = share * pdf
            ls[5] = _ONE
            return WORLD if pdf > _ZERO else NONE
    if not sample_lamp(f32_pointer(lamps + np.uint64(4 * LAMP) * np.uint64(lamp)), px, py, pz, u0, u1, ls):
        return NONE
    ls[4] *= share
    return lamp


@njit(**OPTIONS)
def emitter_share(lights, nodes, children, e, px, py, pz, nx, ny, nz):
    """Probability with which `sample_light` picks emitter e of the tree."""
    share = finite_share(lights)
    if lights[L_EMITTERS] > np.uint64(1):
        share *= tree_pdf(nodes, children, load_u64(lights[L_TRAILS], e), px, py, pz, nx, ny, nz)
    return share


@njit(**OPTIONS)
def infinite_share(lights, i):
    """Probability with which `sample_light` picks light i at infinity."""
    return (_ONE - finite_share(lights)) * (
        load_f32(lights[L_INFINITE_CDF], i + 1) - load_f32(lights[L_INFINITE_CDF], i)
    )


@njit(**OPTIONS)
def lamp_density(lights, lamps, nodes, children, lamp, px, py, pz, nx, ny, nz, dx, dy, dz, t):
    """Density per solid angle with which `sample_light` makes a direction d from p by way of a lamp that d meets at
    distance t."""
    e = np.int64(load_i32(lights[L_LAMP_EMITTER], lamp))
    if e < 0:
        return _ZERO
    k = f32_pointer(lamps + np.uint64(4 * LAMP) * np.uint64(lamp))
    if k[0] == SUN:
        share = infinite_share(lights, e)
    else:
        share = emitter_share(lights, nodes, children, e, px, py, pz, nx, ny, nz)
    return share * lamp_pdf(k, px, py, pz, dx, dy, dz, t)


@njit(**OPTIONS)
def world_density(lights, dx, dy, dz):
    """Density per solid angle with which `sample_light` makes a direction by way of the world; 0 where the world is not
    sampled."""
    if lights[L_IMAGE] == np.uint64(0):
        return _ZERO
    pdf = environment_pdf(
        lights[L_MARGINAL], lights[L_CONDITIONAL], np.int64(lights[L_WIDTH]), np.int64(lights[L_HEIGHT]), dx, dy, dz
    )
    return infinite_share(lights, np.int64(lights[L_WORLD_LIGHT])) * pdf


@njit(**OPTIONS)
def triangle_density(table, lights, nodes, children, instance, triangle, px, py, pz, nx, ny, nz, dx, dy, dz, t):
    """Density per solid angle with which `sample_light` makes a direction d from p by way of an emissive triangle that
    d meets at distance t."""
    if lights[L_INSTANCE_EMITTER] == np.uint64(0) or lights[L_EMITTERS] == np.uint64(0):
        return _ZERO
    e = np.int64(load_i32(lights[L_INSTANCE_EMITTER], instance))
    if e < 0:
        return _ZERO
    record = lights[L_EMITTER_RECORDS] + np.uint64(e) * _EMITTER_SIZE
    first = load_i64(record + _FIRST, 0)
    count = load_i64(record + _COUNT, 0)
    # Its place in the distribution: triangles are ascending there.
    low, high = np.int64(0), count
    while high - low > 1:
        middle = (low + high) >> 1
        if np.int64(load_i32(lights[L_TRIANGLES], first + middle)) <= triangle:
            low = middle
        else:
            high = middle
    if np.int64(load_i32(lights[L_TRIANGLES], first + low)) != triangle:
        return _ZERO
    p = load_f32(lights[L_CDF], first + low + 1) - load_f32(lights[L_CDF], first + low)
    _, _, _, ux, uy, uz, vx, vy, vz = triangle_edges(lights[L_MESHES], table, instance, triangle)
    cos_area = abs((uy * vz - uz * vy) * dx + (uz * vx - ux * vz) * dy + (ux * vy - uy * vx) * dz) * _HALF
    if not cos_area > _ZERO:
        return _ZERO
    return emitter_share(lights, nodes, children, e, px, py, pz, nx, ny, nz) * p * t * t / cos_area
