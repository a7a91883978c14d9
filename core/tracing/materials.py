"""The material at a shading point: which it is, its inputs from constants and textures, its emission, its normal
map."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from ..jit.pointers import load_f32, load_i32, load_u8, load_u16, load_u32, load_u64, offset
from ..jit.sampling import INNER, normalize
from ..scene.model import BY_ANGLE, MATERIAL, Shader
from .bsdf.lobes import (
    F_N,
    F_NS,
    F_WI,
    P_ALPHA,
    P_BASE,
    P_COAT,
    P_COAT_IOR,
    P_COAT_ROUGHNESS,
    P_COAT_TINT,
    P_DIFFUSE_ROUGHNESS,
    P_IOR,
    P_METALLIC,
    P_ROUGHNESS,
    P_SPECULAR_LEVEL,
    P_SPECULAR_TINT,
    P_TRANSMISSION,
)
from .surface import MESH_SLOTS, T_BYTES, T_FLOATS, T_MATERIALS, T_SLOT_MATERIALS, T_SLOTS, T_TEXTURES, corners, uv_at
from .textures import lookup, texture_uv_map

MATERIAL_SIZE = np.uint64(MATERIAL.itemsize)
M_SHADER, M_EMISSION = offset(MATERIAL, "shader"), offset(MATERIAL, "emission")
M_MIS, M_SINGLE_SIDED = offset(MATERIAL, "mis_emission"), offset(MATERIAL, "single_sided_emission")
_BASE, _METALLIC, _ROUGHNESS = (
    offset(MATERIAL, "base_color"),
    offset(MATERIAL, "metallic"),
    offset(MATERIAL, "roughness"),
)
_DIFFUSE_ROUGHNESS, _IOR, _LEVEL = (
    offset(MATERIAL, "diffuse_roughness"),
    offset(MATERIAL, "ior"),
    offset(MATERIAL, "specular_level"),
)
_TINT, _TRANSMISSION, _ALPHA = (
    offset(MATERIAL, "specular_tint"),
    offset(MATERIAL, "transmission"),
    offset(MATERIAL, "alpha"),
)
_COAT, _COAT_ROUGHNESS = offset(MATERIAL, "coat"), offset(MATERIAL, "coat_roughness")
_COAT_IOR, _COAT_TINT, _STRENGTH = (
    offset(MATERIAL, "coat_ior"),
    offset(MATERIAL, "coat_tint"),
    offset(MATERIAL, "normal_strength"),
)
_BASE_TEXTURE, _METALLIC_TEXTURE = offset(MATERIAL, "base_color_texture"), offset(MATERIAL, "metallic_texture")
_ROUGHNESS_TEXTURE, _ALPHA_TEXTURE = offset(MATERIAL, "roughness_texture"), offset(MATERIAL, "alpha_texture")
M_EMISSION_TEXTURE, _NORMAL_TEXTURE = offset(MATERIAL, "emission_texture"), offset(MATERIAL, "normal_texture")
_TRANSMISSION_TEXTURE = offset(MATERIAL, "transmission_texture")
_METALLIC_CHANNEL, _ROUGHNESS_CHANNEL = offset(MATERIAL, "metallic_channel"), offset(MATERIAL, "roughness_channel")
_ALPHA_CHANNEL, _TRANSMISSION_CHANNEL = offset(MATERIAL, "alpha_channel"), offset(MATERIAL, "transmission_channel")
_RAYS, _PARTS, M_UNSURE = offset(MATERIAL, "rays"), offset(MATERIAL, "parts"), offset(MATERIAL, "unsure")
M_REACH = offset(MATERIAL, "reach")
_PRINCIPLED, _TRANSPARENT = np.uint32(Shader.PRINCIPLED), np.uint32(Shader.TRANSPARENT)
_MIX, _BY_RAY = np.uint32(Shader.MIX), np.uint32(Shader.BY_RAY)
_BY_ANGLE = np.uint8(BY_ANGLE)
_ZERO, _ONE, _HALF, _TWO, _THIRD, _TINY = map(np.float32, (0.0, 1.0, 0.5, 2.0, 1.0 / 3.0, 1e-30))


@njit(**INNER)
def material_of(table, mesh, instance, triangle):
    """Address of the material (scene.MATERIAL) of a triangle of an instance; mesh: address of its mesh record."""
    slots = load_u64(mesh + MESH_SLOTS, 0)
    slot = np.int64(load_i32(table[T_SLOTS], instance))
    if slots != np.uint64(0):
        slot += np.int64(load_u16(slots, triangle))
    return table[T_MATERIALS] + np.uint64(load_i32(table[T_SLOT_MATERIALS], slot)) * MATERIAL_SIZE


@njit(**INNER)
def sample_texture(table, mesh, index, triangle, b1, b2):
    """RGBA of a texture at a point of a triangle."""
    u, v = uv_at(mesh, texture_uv_map(table[T_TEXTURES], index), triangle, b1, b2)
    return lookup(table[T_TEXTURES], table[T_BYTES], table[T_FLOATS], index, u, v)


@njit(**INNER)
def sample_channel(table, mesh, index, channel, triangle, b1, b2):
    """One scalar of a texture: channel as MATERIAL says."""
    r, g, b, a = sample_texture(table, mesh, index, triangle, b1, b2)
    if channel == 0:
        return r
    if channel == 1:
        return g
    if channel == 2:
        return b
    if channel == 3:
        return a
    return (r + g + b) * _THIRD


@njit(**INNER)
def _texture_base(table, mesh, material, triangle, b1, b2, params):
    texture = load_i32(material + _BASE_TEXTURE, 0)
    if texture >= 0:
        r, g, b, _ = sample_texture(table, mesh, texture, triangle, b1, b2)
        params[P_BASE] *= r
        params[P_BASE + 1] *= g
        params[P_BASE + 2] *= b


@njit(**INNER)
def material_inputs(table, mesh, material, triangle, b1, b2, params):
    """Evaluate a material's BSDF inputs at a point of a triangle into params (lobes.P_*)."""
    for k in range(3):
        params[P_BASE + k] = load_f32(material + _BASE, k)
        params[P_SPECULAR_TINT + k] = load_f32(material + _TINT, k)
        params[P_COAT_TINT + k] = load_f32(material + _COAT_TINT, k)
    params[P_METALLIC] = load_f32(material + _METALLIC, 0)
    params[P_ROUGHNESS] = load_f32(material + _ROUGHNESS, 0)
    params[P_DIFFUSE_ROUGHNESS] = load_f32(material + _DIFFUSE_ROUGHNESS, 0)
    params[P_IOR] = load_f32(material + _IOR, 0)
    params[P_SPECULAR_LEVEL] = load_f32(material + _LEVEL, 0)
    params[P_TRANSMISSION] = load_f32(material + _TRANSMISSION, 0)
    params[P_ALPHA] = load_f32(material + _ALPHA, 0)
    params[P_COAT] = load_f32(material + _COAT, 0)
    params[P_COAT_ROUGHNESS] = load_f32(material + _COAT_ROUGHNESS, 0)
    params[P_COAT_IOR] = load_f32(material + _COAT_IOR, 0)
    if table[T_TEXTURES] == np.uint64(0):
        return
    _texture_base(table, mesh, material, triangle, b1, b2, params)
    # Four scalar sockets in one loop, so that the lookup is compiled into this function once.
    for k in range(4):
        if k == 0:
            texture, slot, channel = (
                load_i32(material + _METALLIC_TEXTURE, 0),
                P_METALLIC,
                load_u8(material + _METALLIC_CHANNEL, 0),
            )
        elif k == 1:
            texture, slot, channel = (
                load_i32(material + _ROUGHNESS_TEXTURE, 0),
                P_ROUGHNESS,
                load_u8(material + _ROUGHNESS_CHANNEL, 0),
            )
        elif k == 2:
            texture, slot, channel = (
                load_i32(material + _ALPHA_TEXTURE, 0),
                P_ALPHA,
                load_u8(material + _ALPHA_CHANNEL, 0),
            )
        else:
            texture, slot, channel = (
                load_i32(material + _TRANSMISSION_TEXTURE, 0),
                P_TRANSMISSION,
                load_u8(material + _TRANSMISSION_CHANNEL, 0),
            )
        if texture >= 0:
            params[slot] *= sample_channel(table, mesh, texture, channel, triangle, b1, b2)


@njit(**INNER)
def material_alpha(table, mesh, material, triangle, b1, b2, params):
    """Only what a shadow ray needs: base colour and alpha into params."""
    for k in range(3):
        params[P_BASE + k] = load_f32(material + _BASE, k)
    params[P_ALPHA] = load_f32(material + _ALPHA, 0)
    if table[T_TEXTURES] == np.uint64(0):
        return
    _texture_base(table, mesh, material, triangle, b1, b2, params)
    texture = load_i32(material + _ALPHA_TEXTURE, 0)
    if texture >= 0:
        params[P_ALPHA] *= sample_channel(table, mesh, texture, load_u8(material + _ALPHA_CHANNEL, 0), triangle, b1, b2)


@njit(**INNER)
def composed(material):
    """Whether a material consists of others: `part_of` tells which one counts."""
    return load_u32(material + M_SHADER, 0) >= _MIX


@njit(**INNER)
def _cosine(frame):
    """Of the angle between a ray and the smooth normal."""
    x, y, z = frame[F_WI], frame[F_WI + 1], frame[F_WI + 2]
    d = x * frame[F_NS] + y * frame[F_NS + 1] + z * frame[F_NS + 2]
    return abs(d) / math.sqrt(max(x * x + y * y + z * z, _TINY))


@njit(**INNER)
def part_of(table, mesh, material, triangle, b1, b2, frame, view, u):
    """Address of the material that counts at a point of a composed one. frame: there, after `face`; view: ray type, or
    `LIGHT_VIEW`, plus VIEWS where seen from its back; u: a uniform number, that picks the parts of a MIX by their
    shares."""
    while True:
        shader = load_u32(material + M_SHADER, 0)
        if shader == _BY_RAY:
            second = (np.int64(load_u16(material + _RAYS, 0)) >> view) & 1
        elif shader == _MIX:
            share = load_f32(material + _ALPHA, 0)
            texture = load_i32(material + _ALPHA_TEXTURE, 0)
            channel = load_u8(material + _ALPHA_CHANNEL, 0)
            if texture >= 0 and table[T_TEXTURES] != np.uint64(0):
                if channel == _BY_ANGLE:
                    u0 = _cosine(frame)
                    share *= lookup(table[T_TEXTURES], table[T_BYTES], table[T_FLOATS], texture, u0, _HALF)[0]
                else:
                    share *= sample_channel(table, mesh, texture, channel, triangle, b1, b2)
            share = min(max(share, _ZERO), _ONE)
            second = np.int64(u < share)
            u = u / share if u < share else (u - share) / (_ONE - share)  # u is below 1
        else:
            return material
        material = table[T_MATERIALS] + np.uint64(load_i32(material + _PARTS, second)) * MATERIAL_SIZE


@njit(**INNER)
def emission(table, mesh, material, triangle, b1, b2, back):
    """Radiance that a surface emits at a point, before alpha and coat: 3 float32. back: seen from its back."""
    r, g, b = load_f32(material + M_EMISSION, 0), load_f32(material + M_EMISSION, 1), load_f32(material + M_EMISSION, 2)
    if back and load_u8(material + M_SINGLE_SIDED, 0) != 0:
        return _ZERO, _ZERO, _ZERO
    if r == _ZERO and g == _ZERO and b == _ZERO:
        return r, g, b
    texture = load_i32(material + M_EMISSION_TEXTURE, 0)
    if texture >= 0 and table[T_TEXTURES] != np.uint64(0):
        tr, tg, tb, _ = sample_texture(table, mesh, texture, triangle, b1, b2)
        r *= tr
        g *= tg
        b *= tb
    return r, g, b


@njit(**INNER)
def emits(material):
    """Whether a material emits anywhere."""
    return (
        load_f32(material + M_EMISSION, 0) > _ZERO
        or load_f32(material + M_EMISSION, 1) > _ZERO
        or load_f32(material + M_EMISSION, 2) > _ZERO
    )


@njit(**INNER)
def transmits_shadow(material):
    """Whether a shadow ray may pass a material at all."""
    shader = load_u32(material + M_SHADER, 0)
    if shader == _TRANSPARENT or shader >= _MIX:
        return True
    return shader == _PRINCIPLED and (
        load_f32(material + _ALPHA, 0) < _ONE or load_i32(material + _ALPHA_TEXTURE, 0) >= 0
    )


@njit(**INNER)
def attenuates_emission(material):
    """Whether alpha or coat lie over a material's emission."""
    if load_u32(material + M_SHADER, 0) != _PRINCIPLED:
        return False
    return (
        load_f32(material + _ALPHA, 0) < _ONE
        or load_i32(material + _ALPHA_TEXTURE, 0) >= 0
        or load_f32(material + _COAT, 0) > _ZERO
    )


@njit(**INNER)
def apply_normal_map(table, mesh, m, material, triangle, b1, b2, back, frame):
    """Bend frame[F_N] by the material's tangent-space normal map. m: address of the instance's transform.

    The tangent is that of the triangle's own UV gradient, made orthogonal to the interpolated normal.
    """
    texture = load_i32(material + _NORMAL_TEXTURE, 0)
    if texture < 0 or table[T_TEXTURES] == np.uint64(0):
        return
    uv_map = texture_uv_map(table[T_TEXTURES], texture)
    u0, v0 = uv_at(mesh, uv_map, triangle, _ZERO, _ZERO)
    u1, v1 = uv_at(mesh, uv_map, triangle, _ONE, _ZERO)
    u2, v2 = uv_at(mesh, uv_map, triangle, _ZERO, _ONE)
    du1, dv1, du2, dv2 = u1 - u0, v1 - v0, u2 - u0, v2 - v0
    area = du1 * dv2 - du2 * dv1
    if area == _ZERO:
        return
    ax, ay, az, bx, by, bz, cx, cy, cz = corners(mesh, triangle)
    s = _ONE if area > _ZERO else -_ONE
    ox = s * (dv2 * (bx - ax) - dv1 * (cx - ax))
    oy = s * (dv2 * (by - ay) - dv1 * (cy - ay))
    oz = s * (dv2 * (bz - az) - dv1 * (cz - az))
    tx = load_f32(m, 0) * ox + load_f32(m, 1) * oy + load_f32(m, 2) * oz
    ty = load_f32(m, 4) * ox + load_f32(m, 5) * oy + load_f32(m, 6) * oz
    tz = load_f32(m, 8) * ox + load_f32(m, 9) * oy + load_f32(m, 10) * oz
    det = (
        load_f32(m, 0) * (load_f32(m, 5) * load_f32(m, 10) - load_f32(m, 6) * load_f32(m, 9))
        - load_f32(m, 1) * (load_f32(m, 4) * load_f32(m, 10) - load_f32(m, 6) * load_f32(m, 8))
        + load_f32(m, 2) * (load_f32(m, 4) * load_f32(m, 9) - load_f32(m, 5) * load_f32(m, 8))
    )
    if det < _ZERO:
        s = -s  # a mirrored instance turns the handedness of its tangent space
    f = -_ONE if back else _ONE  # the map is defined about the outward normal
    nx, ny, nz = f * frame[F_NS], f * frame[F_NS + 1], f * frame[F_NS + 2]
    d = tx * nx + ty * ny + tz * nz
    tx, ty, tz, _ = normalize(tx - d * nx, ty - d * ny, tz - d * nz)
    qx, qy, qz = s * (ny * tz - nz * ty), s * (nz * tx - nx * tz), s * (nx * ty - ny * tx)
    r, g, b, _ = sample_texture(table, mesh, texture, triangle, b1, b2)
    strength = load_f32(material + _STRENGTH, 0)
    mx, my, mz = _TWO * r - _ONE, _TWO * g - _ONE, _TWO * b - _ONE
    wx, wy, wz, length = normalize(
        mx * tx + my * qx + mz * nx, mx * ty + my * qy + mz * ny, mx * tz + my * qz + mz * nz
    )
    if not length > _ZERO:
        return
    if strength != _ONE:
        k = max(strength, _ZERO)
        wx, wy, wz, length = normalize(nx + k * (wx - nx), ny + k * (wy - ny), nz + k * (wz - nz))
        if not length > _ZERO:
            return
    frame[F_N] = f * wx
    frame[F_N + 1] = f * wy
    frame[F_N + 2] = f * wz
