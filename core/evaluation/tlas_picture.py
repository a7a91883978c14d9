"""A picture of the TLAS seen from outside: active geometry shaded, hitboxes of what is culled as glass boxes with
edges, the camera's view as lines."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numba import carray, cfunc, njit, types

from ..accel.blas import BlasCache
from ..accel.embree import DIR, NG, ORG, RAY, TFAR, intersect, intersect_with, occluded, set_ray
from ..accel.hitboxes import Hitboxes
from ..accel.tlas import Tlas, hit_instance
from ..arrays import F32, F64, U8
from ..jit.atomics import pointer
from ..scene.model import Camera, Scene
from ..threads import processors

# Okabe and Ito's colours, told apart by colour-blind people: sRGB.
ACTIVE = (0.90, 0.60, 0.00)
BACKDROP = (0.80, 0.80, 0.80)
HITBOX = (0.00, 0.45, 0.70)
VIEW = (0.84, 0.37, 0.00)
PAPER = (1.0, 1.0, 1.0)

_FILL, _EDGE_FRONT, _EDGE_BACK = 0.02, 0.75, 0.3  # opacity
_BAND = 16  # rows per job
_SAMPLES = 2  # per pixel and axis


@dataclass(frozen=True)
class Viewpoint:
    """An orthographic view: center (3,), unit vectors right, up, forward (3,), `width` in metres, `reach` metres before
    and behind the center."""

    center: F64
    right: F64
    up: F64
    forward: F64
    width: float
    reach: float


def viewpoint(
    scene: Scene,
    active: np.ndarray,
    aspect: float,
    turn: float = math.radians(-40.0),
    height: float = math.radians(42.0),
) -> Viewpoint:
    """A view from above that frames the active instances and their surroundings; `turn` is measured from where the
    camera looks, `height` is its elevation."""
    to_world = scene.camera.to_world
    box = (
        scene.instances.bounds[active].astype(np.float64)
        if active.any()
        else np.stack([to_world[:, 3] - 1, to_world[:, 3] + 1])[None]
    )
    middle = box.mean(axis=1)
    low, high = np.percentile(middle, 2, axis=0), np.percentile(middle, 98, axis=0)
    far = to_world[:, 3] - 0.25 * float((high - low).max()) * to_world[:, 2]  # where the lines of the camera's view end
    low, high = np.minimum(np.minimum(low, to_world[:, 3]), far), np.maximum(np.maximum(high, to_world[:, 3]), far)
    extent = high - low + np.median(box[:, 1] - box[:, 0], axis=0)
    view = -to_world[:, 2]
    azimuth = math.atan2(view[1], view[0]) + turn
    forward = np.array([math.cos(height) * math.cos(azimuth), math.cos(height) * math.sin(azimuth), -math.sin(height)])
    right = np.array([math.sin(azimuth), -math.cos(azimuth), 0.0])
    up = np.cross(right, forward)
    width = 1.35 * max(float(np.abs(right) @ extent), float(np.abs(up) @ extent) * aspect, 1e-3)
    whole = (
        scene.instances.bounds[np.isfinite(scene.instances.bounds).all(axis=(1, 2))].astype(np.float64).reshape(-1, 3)
    )
    reach = float(np.abs((whole - (low + high) / 2) @ forward).max(initial=width)) + width
    return Viewpoint((low + high) / 2, right, up, forward, width, min(reach, 8.0 * width))


# Words of a query: int64[_QUERY], what Embree takes for an RTCRayQueryContext and, after it, RTCIntersectArguments.
_THROUGH, _LINE, _ARGUMENTS, _QUERY = 1, 2, 3, 8


@cfunc(types.void(types.CPointer(types.uintp)), cache=True)
def _look_through(arguments):
    # RTCIntersectFunctionNArguments, as in core.accel.hitboxes. All boxes have one colour, so the light that they let
    # through is a product in any order.
    prim = np.int64(arguments[2] & np.uintp(0xFFFFFFFF))
    box = carray(pointer(arguments[1]), (6 * (prim + 1),), np.float32)
    ray = carray(pointer(arguments[4]), (12,), np.float32)
    context = carray(pointer(arguments[3]), (_QUERY,), np.float64)
    near, far = 0.0, float(ray[TFAR])
    leave = far
    for axis in range(3):
        org, direction = float(ray[ORG + axis]), float(ray[DIR + axis])
        if abs(direction) > 1e-12:
            a, b = (box[6 * prim + axis] - org) / direction, (box[6 * prim + 3 + axis] - org) / direction
            near, leave = max(near, min(a, b)), min(leave, max(a, b))
        elif org < box[6 * prim + axis] or org > box[6 * prim + 3 + axis]:
            return
    if near > leave:
        return
    for side in range(2):
        t = near if side == 0 else leave
        if t >= far * (1.0 - 1e-5):
            break  # the back face lies behind geometry, or on it as the foot of a house does
        near_faces = 0
        for axis in range(3):
            at = ray[ORG + axis] + t * ray[DIR + axis]
            if min(at - box[6 * prim + axis], box[6 * prim + 3 + axis] - at) < context[_LINE]:
                near_faces += 1
        cover = _FILL
        if near_faces >= 2:
            cover = _EDGE_FRONT if side == 0 else _EDGE_BACK
        context[_THROUGH] *= 1.0 - cover


@njit(nogil=True, cache=True, error_model="numpy")
def _draw(tlas, ids, first, transform, tint, boxes, frame, light, colors, line, far, pixel, row, out):
    """Fill out (rows, columns, 3) float32 from picture row `row` on, counted from the top; frame: (4, 3) upper left
    corner, right, up, forward."""
    ray = np.empty(RAY, np.float32)
    query = np.zeros(_QUERY, np.int64)
    query[0] = -1
    query[_ARGUMENTS] = -4294967296  # no flags; every feature
    query[_ARGUMENTS + 1] = query.ctypes.data
    view = query.view(np.float64)
    view[_LINE] = line
    for y in range(out.shape[0]):
        for x in range(out.shape[1]):
            a, b = (x + 0.5) * pixel, (row + y + 0.5) * pixel
            o0 = frame[0, 0] + a * frame[1, 0] - b * frame[2, 0]
            o1 = frame[0, 1] + a * frame[1, 1] - b * frame[2, 1]
            o2 = frame[0, 2] + a * frame[1, 2] - b * frame[2, 2]
            d0, d1, d2 = frame[3, 0], frame[3, 1], frame[3, 2]
            r, g, bl = colors[1, 0], colors[1, 1], colors[1, 2]
            end = far
            set_ray(ray, o0, o1, o2, d0, d1, d2, 0.0, far, 0xFFFFFFFF)
            if intersect(tlas, ray):
                end = ray[TFAR]
                i = hit_instance(ids, first, ray)
                m = transform[i]
                n0, n1, n2 = ray[NG], ray[NG + 1], ray[NG + 2]
                # Normals go by the cofactors of the linear part, which need no inverse and bear a singular one.
                w0 = (
                    (m[1, 1] * m[2, 2] - m[1, 2] * m[2, 1]) * n0
                    + (m[1, 2] * m[2, 0] - m[1, 0] * m[2, 2]) * n1
                    + (m[1, 0] * m[2, 1] - m[1, 1] * m[2, 0]) * n2
                )
                w1 = (
                    (m[2, 1] * m[0, 2] - m[2, 2] * m[0, 1]) * n0
                    + (m[2, 2] * m[0, 0] - m[2, 0] * m[0, 2]) * n1
                    + (m[2, 0] * m[0, 1] - m[2, 1] * m[0, 0]) * n2
                )
                w2 = (
                    (m[0, 1] * m[1, 2] - m[0, 2] * m[1, 1]) * n0
                    + (m[0, 2] * m[1, 0] - m[0, 0] * m[1, 2]) * n1
                    + (m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0]) * n2
                )
                length = math.sqrt(w0 * w0 + w1 * w1 + w2 * w2)
                if length > 0.0:
                    side = -1.0 if w0 * d0 + w1 * d1 + w2 * d2 > 0.0 else 1.0
                    w0, w1, w2 = w0 * side / length, w1 * side / length, w2 * side / length
                sun = max(w0 * light[0] + w1 * light[1] + w2 * light[2], 0.0)
                lift = 4.0 * pixel
                h0, h1, h2 = o0 + end * d0 + lift * w0, o1 + end * d1 + lift * w1, o2 + end * d2 + lift * w2
                set_ray(ray, h0, h1, h2, light[0], light[1], light[2], 0.0, far, 0xFFFFFFFF)
                if sun > 0.0 and occluded(tlas, ray):
                    sun = 0.0
                shade = 0.42 + 0.12 * w2 + 0.46 * sun
                r, g, bl = tint[i, 0] * shade, tint[i, 1] * shade, tint[i, 2] * shade
            through = 1.0
            if boxes != 0:
                view[_THROUGH] = 1.0
                set_ray(ray, o0, o1, o2, d0, d1, d2, 0.0, end, 0xFFFFFFFF)
                intersect_with(boxes, ray, np.uint64(query.ctypes.data + 8 * _ARGUMENTS))
                through = view[_THROUGH]
            out[y, x, 0] = (1.0 - through) * colors[0, 0] + through * r
            out[y, x, 1] = (1.0 - through) * colors[0, 1] + through * g
            out[y, x, 2] = (1.0 - through) * colors[0, 2] + through * bl


def render(
    scene: Scene, active: np.ndarray, boxes: F32, view: Viewpoint, width: int, height: int, threads: int = 0
) -> F32:
    """Active instances (N,) bool of a scene and boxes (H, 2, 3) float32, world, seen from `view`: (height, width, 3)
    float32, sRGB, rows from the top."""
    cache = BlasCache(scene.meshes)
    cache.need(scene.instances.mesh[active])
    tlas = Tlas(scene.instances, cache, active)
    extent = np.sort((scene.instances.bounds[:, 1] - scene.instances.bounds[:, 0]), axis=1)[:, 1:]  # the two long sides
    tint = np.where((extent > view.width).all(axis=1)[:, None], BACKDROP, ACTIVE).astype(np.float32)
    hitboxes = Hitboxes(boxes, crossing=_look_through.address)
    w, h = width * _SAMPLES, height * _SAMPLES
    pixel = view.width / w
    corner = view.center - view.forward * view.reach - view.right * (w * pixel / 2) + view.up * (h * pixel / 2)
    frame = np.stack([corner, view.right, view.up, view.forward])
    light = view.right * -0.55 + np.array([0.0, 0.0, 1.0]) - view.forward * 0.25
    light /= np.linalg.norm(light)
    colors = np.array([HITBOX, PAPER])
    picture = np.empty((h, w, 3), np.float32)
    line, far = 0.7 * view.width / width, 2.0 * view.reach

    def band(row: int) -> None:
        part = picture[row : row + _BAND]
        _draw(
            tlas.handle, tlas.ids, tlas.first, scene.instances.transform, tint, hitboxes.handle, frame, light, colors,
            line, far, pixel, row, part
        )

    with ThreadPoolExecutor(threads or processors()) as pool:
        list(pool.map(band, range(0, h, _BAND)))
    return picture.reshape(height, _SAMPLES, width, _SAMPLES, 3).mean(axis=(1, 3))


def _frustum(camera: Camera, length: float) -> F64:
    """Line segments (8, 2, 3) of what the camera sees, `length` metres far."""
    left, right, bottom, top = camera.frame
    plane = np.array([[left, bottom], [right, bottom], [right, top], [left, top]], float)
    far = np.column_stack([plane * (1.0 if camera.orthographic else length), np.full(4, -length)])
    near = np.column_stack([plane * (1.0 if camera.orthographic else 0.0), np.zeros(4)])
    far, near = (p @ camera.to_world[:, :3].T + camera.to_world[:, 3] for p in (far, near))
    return np.concatenate([np.stack([near, far], 1), np.stack([far, np.roll(far, -1, axis=0)], 1)])


def tlas_picture(
    scene: Scene, active: np.ndarray, boxes: F32, size: tuple[int, int] = (960, 540), threads: int = 0
) -> U8:
    """The picture with the camera's view and a legend: (height, width, 3) uint8, sRGB, rows from the top.

    scene: a frame; active: (N,) bool; boxes: (H, 2, 3) float32 world boxes of the hitboxes; size: width and height in
    pixels; threads: 0 for all.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    width, height = size
    view = viewpoint(scene, active, width / height)
    picture = render(scene, active, boxes, view, width, height, threads)
    figure = Figure(figsize=(width / 100, height / 100), dpi=100)
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.imshow(np.clip(picture, 0, 1), extent=(0, width, height, 0), interpolation="nearest")
    lines = (_frustum(scene.camera, 0.15 * view.width) - view.center) @ np.stack([view.right, -view.up], 1) * (
        width / view.width
    ) + (width / 2, height / 2)
    axes.add_collection(LineCollection(list(lines), colors=[VIEW], linewidths=2.0))
    axes.set(xlim=(0, width), ylim=(height, 0))
    axes.axis("off")
    handles = [
        Patch(color=ACTIVE, label=f"active: {int(active.sum()):,} of {len(active):,} instances"),
        Patch(
            facecolor=(*HITBOX, 0.25),
            edgecolor=HITBOX,
            label=f"culled: {int((~active).sum()):,}, in {len(boxes):,} hitboxes",
        ),
        Line2D([], [], color=VIEW, lw=2, label="what the camera sees"),
    ]
    axes.legend(handles=handles, loc="lower left", framealpha=0.9, fontsize=11)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
