"""Primary rays of perspective and orthographic cameras with depth of field, as Cycles makes them
(kernel/camera/camera.h)."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from ..arrays import F32, F64
from ..jit.sampling import OPTIONS, disk, normalize
from .model import Camera

CAMERA = 32
_TO_WORLD, _FRAME, _ORTHO, _NEAR, _FAR, _APERTURE, _FOCUS, _BLADES, _ROTATION, _RATIO = (
    0, 12, 16, 17, 18, 19, 20, 21, 22, 23
)
_ONE, _ZERO = np.float32(1.0), np.float32(0.0)
_TWO_PI = np.float32(2 * math.pi)


def camera_constants(camera: Camera) -> F32:
    """float32[CAMERA] that `camera_ray` reads."""
    c = np.zeros(CAMERA, np.float32)
    to_world = np.array(camera.to_world, np.float64)
    to_world[:, :3] /= np.linalg.norm(to_world[:, :3], axis=0)  # a scaled camera sees what an unscaled one sees
    c[:12] = to_world.ravel()
    c[_FRAME : _FRAME + 4] = camera.frame
    c[_ORTHO] = camera.orthographic
    c[_NEAR], c[_FAR] = camera.clip_start, min(camera.clip_end, 1e30)
    c[_APERTURE], c[_FOCUS] = camera.aperture, camera.focus
    c[_BLADES] = camera.blades if camera.blades >= 3 else 0
    c[_ROTATION], c[_RATIO] = camera.blade_rotation, 1.0 / camera.aperture_ratio
    return c


def projection(camera: Camera) -> tuple[F64, F64]:
    """What a raster needs to see what rays of a pinhole camera meet: (4, 4) float64 world to clip space (OpenGL's), and
    (4,) float64, the plane that gives a world point's distance along the view, 0 at the camera and 1 at the far end."""
    axes = camera.to_world[:, :3] / np.linalg.norm(camera.to_world[:, :3], axis=0)
    view = np.eye(4)
    view[:3, :3], view[:3, 3] = axes.T, -axes.T @ camera.to_world[:, 3]
    left, right, bottom, top = camera.frame
    near, far = max(camera.clip_start, 1e-4 if not camera.orthographic else 0.0), min(camera.clip_end, 1e6)
    clip = np.zeros((4, 4))
    clip[0, 0], clip[1, 1] = 2 / (right - left), 2 / (top - bottom)
    if camera.orthographic:
        clip[0, 3], clip[1, 3] = -(right + left) / (right - left), -(top + bottom) / (top - bottom)
        clip[2, 2], clip[2, 3], clip[3, 3] = -2 / (far - near), -(far + near) / (far - near), 1.0
    else:
        clip[0, 2], clip[1, 2] = (right + left) / (right - left), (top + bottom) / (top - bottom)
        clip[2, 2], clip[2, 3], clip[3, 2] = -(far + near) / (far - near), -2 * far * near / (far - near), -1.0
    return clip @ view, -view[2] / far


@njit(**OPTIONS)
def aperture_point(c, u0, u1):
    """Point of the unit aperture: a disk or a regular polygon (blades), squeezed by the aperture ratio."""
    blades = c[21]
    if blades == _ZERO:
        x, y = disk(u0, u1)
    else:
        # One of the polygon's triangles, then uniform within it.
        corner = math.floor(u0 * blades)
        u = math.sqrt(u0 * blades - corner)
        v = u1 * u
        angle = math.pi / blades
        px = (u - v + v) * math.cos(angle)
        py = (v + v - u) * math.sin(angle)
        turn = c[22] + corner * 2.0 * angle
        cr = math.cos(turn)
        sr = math.sin(turn)
        x = np.float32(cr * px - sr * py)
        y = np.float32(sr * px + cr * py)
    return x * c[23], y


@njit(**OPTIONS)
def camera_ray(c, u, v, lens0, lens1):
    """Ray through the point (u, v) in [0, 1]^2 of the picture, v upward.

    c: `camera_constants`; lens0, lens1: uniform numbers. Returns origin, unit direction and length (clipping applied):
    7 float32, world space.
    """
    x = c[12] + (c[13] - c[12]) * u
    y = c[14] + (c[15] - c[14]) * v
    near = c[17]
    length = c[18] - near
    ox = _ZERO
    oy = _ZERO
    oz = _ZERO
    if c[16] != _ZERO:
        ox = x
        oy = y
        dx = _ZERO
        dy = _ZERO
        dz = -_ONE
        if c[19] > _ZERO:
            lx, ly = aperture_point(c, lens0, lens1)
            lx *= c[19]
            ly *= c[19]
            dx, dy, dz, _ = normalize(-lx, -ly, -c[20])
            ox += lx
            oy += ly
            near = near / -dz
    else:
        dx, dy, dz, slant = normalize(x, y, -_ONE)
        near *= slant
        length *= slant
        if c[19] > _ZERO:
            lx, ly = aperture_point(c, lens0, lens1)
            ox = lx * c[19]
            oy = ly * c[19]
            dx, dy, dz, _ = normalize(x * c[20] - ox, y * c[20] - oy, -c[20])
    ox += dx * near
    oy += dy * near
    oz += dz * near
    wx = c[0] * ox + c[1] * oy + c[2] * oz + c[3]
    wy = c[4] * ox + c[5] * oy + c[6] * oz + c[7]
    wz = c[8] * ox + c[9] * oy + c[10] * oz + c[11]
    ex, ey, ez, _ = normalize(
        c[0] * dx + c[1] * dy + c[2] * dz, c[4] * dx + c[5] * dy + c[6] * dz, c[8] * dx + c[9] * dy + c[10] * dz
    )
    return wx, wy, wz, ex, ey, ez, length
