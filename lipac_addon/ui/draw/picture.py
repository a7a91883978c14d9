"""What is drawn over the picture in a viewport that looks through the camera: by how much each of its tiles may change,
and who takes the memory of a render."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import blf
import bpy
import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader

from ....core.files.figures import percent
from .boxes import HEAT
from .figures import size

if TYPE_CHECKING:
    from ....core.arrays import F32
    from ..state.results import FrameResult

COLUMNS, ROWS = 16, 9  # core.feedback.tiles, without loading the engine
WORST = 5  # tiles whose change is written into them
FAINT, DENSE = 0.05, 0.6  # opacity of a tile that does not change, and of the worst
TAKERS = 10  # lines of the list of memory
_MARGIN, _LINE, _TEXT = 20, 18, 12  # in pixels
Frame = tuple[float, float, float, float]


def camera_frame(context: bpy.types.Context) -> Frame | None:
    """Where the camera's picture is in a viewport's region: left, bottom, right, top in pixels; None where it does not
    look through the scene's camera."""
    from bpy_extras.view3d_utils import location_3d_to_region_2d

    scene, region, view = context.scene, context.region, context.region_data
    space = context.space_data
    camera = space.camera if space.use_local_camera else scene.camera
    if view.view_perspective != "CAMERA" or camera is None or camera != scene.camera or camera.type != "CAMERA":
        return None
    to_world = camera.evaluated_get(context.evaluated_depsgraph_get()).matrix_world.normalized()
    corners = [
        location_3d_to_region_2d(region, view, to_world @ corner) for corner in camera.data.view_frame(scene=scene)
    ]
    if any(corner is None for corner in corners):
        return None
    x, y = ([corner[k] for corner in corners] for k in (0, 1))
    return min(x), min(y), max(x), max(y)


def shade(tiles: F32) -> tuple[F32, F32]:
    """Colours (TILES, 4) of tiles by their change, in parts of the largest; and those parts, (TILES,)."""
    share = np.clip(np.nan_to_num(tiles) / max(float(np.nanmax(tiles)), 1e-30), 0.0, 1.0)
    at = share * (len(HEAT) - 1)
    below = np.minimum(at.astype(np.int64), len(HEAT) - 2)
    color = HEAT[below] + (HEAT[below + 1] - HEAT[below]) * (at - below)[:, None]
    return np.column_stack([color, FAINT + (DENSE - FAINT) * share]).astype(np.float32), share.astype(np.float32)


def draw_tiles(tiles: F32, frame: Frame, scale: float = 1.0) -> None:
    """Draw the tiles, (TILES,) in rows from the bottom, into a frame of the active framebuffer, in pixels."""
    left, bottom, right, top = frame
    x, y = np.linspace(left, right, COLUMNS + 1), np.linspace(bottom, top, ROWS + 1)
    colors, _ = shade(tiles)
    number = np.arange(COLUMNS * ROWS)
    column, row = number % COLUMNS, number // COLUMNS
    corners = [np.column_stack([x[column + i], y[row + j]]) for i, j in ((0, 0), (1, 0), (1, 1), (0, 1))]
    places = np.stack([corners[k] for k in (0, 1, 2, 0, 2, 3)], axis=1).reshape(-1, 2).astype(np.float32)
    shader = gpu.shader.from_builtin("SMOOTH_COLOR")
    gpu.state.blend_set("ALPHA")
    batch_for_shader(shader, "TRIS", {"pos": places, "color": np.repeat(colors, 6, axis=0)}).draw(shader)
    blf.size(0, _TEXT * scale)
    blf.color(0, 1.0, 1.0, 1.0, 1.0)
    for k in np.argsort(-np.nan_to_num(tiles))[:WORST]:
        if tiles[k] > 0:
            blf.position(0, x[column[k]] + 3 * scale, y[row[k]] + 4 * scale, 0)
            blf.draw(0, f"{percent(tiles[k])}")
    gpu.state.blend_set("NONE")


def takers(result: FrameResult) -> list[str]:
    """Lines of the list of memory: what objects, meshes and images take of a render, the largest first."""
    rows = [row for row in result.memory if row.kind in ("object", "image") and row.bytes]
    return [f"{size(row.bytes)}  {row.name.splitlines()[-1]}" for row in rows[:TAKERS]]


def draw_takers(lines: list[str], right: float, top: float, scale: float = 1.0) -> None:
    """Draw the lines on a dark ground, below and left of a corner in pixels."""
    if not lines:
        return
    blf.size(0, _TEXT * scale)
    wide = max(blf.dimensions(0, line)[0] for line in lines) + _MARGIN * scale
    low = top - (len(lines) + 0.5) * _LINE * scale
    box = np.array([(right - wide, low), (right, low), (right - wide, top), (right, top)], np.float32)
    shader = gpu.shader.from_builtin("UNIFORM_COLOR")
    gpu.state.blend_set("ALPHA")
    shader.bind()
    shader.uniform_float("color", (0.0, 0.0, 0.0, 0.6))
    batch_for_shader(shader, "TRI_STRIP", {"pos": box}).draw(shader)
    blf.color(0, 0.9, 0.9, 0.9, 1.0)
    for k, line in enumerate(lines):
        blf.position(0, right - wide + _MARGIN * scale / 2, top - (k + 1) * _LINE * scale, 0)
        blf.draw(0, line)
    gpu.state.blend_set("NONE")


def draw(context: Any, result: FrameResult) -> None:
    """Draw what the scene's settings ask for, in a viewport that looks through the camera."""
    settings = context.scene.lipac
    if not (settings.show_tiles or settings.show_memory):
        return
    frame, scale = camera_frame(context), context.preferences.system.ui_scale
    if frame is None:
        return
    if settings.show_tiles and result.tiles is not None:
        draw_tiles(result.tiles, frame, scale)
    if settings.show_memory:
        margin = _MARGIN * scale / 2
        right, top = min(frame[2], context.region.width) - margin, min(frame[3], context.region.height) - margin
        draw_takers(takers(result), right, top, scale)
