"""The overlay: boxes of the analysed instances in the 3D viewport, with a legend.

One shader, one batch of a cube's twelve edges, one texture with all boxes, made anew only for another result: a draw
call for each kind that is shown.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import blf
import bpy
import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader
from mathutils import Matrix

from ..state import results
from ..state.results import FrameResult
from . import picture
from .boxes import CORNERS, EDGES, HEAT, KINDS, ROW, STATES, Boxes, boxes_of, color_of

_VERTEX = """
void main()
{
  int box = first + gl_InstanceID;
  ivec2 at = ivec2(2 * (box % row), box / row);
  vec4 low = texelFetch(boxes, at, 0);
  vec3 high = texelFetch(boxes, at + ivec2(1, 0), 0).xyz;
  heat = low.w;
  gl_Position = view_projection * vec4(mix(low.xyz, high, corner), 1.0);
}
"""
_FRAGMENT = """
void main()
{
  float steps = float(textureSize(colors, 0).x - 1);
  float at = heat * steps;
  int below = int(at);
  vec3 cool = texelFetch(colors, ivec2(below, 0), 0).rgb;
  vec3 warm = texelFetch(colors, ivec2(min(below + 1, int(steps)), 0), 0).rgb;
  vec3 hot = mix(cool, warm, at - float(below));
  result = vec4(use_heat == 1 && heat >= 0.0 ? hot : color.rgb, color.a);
}
"""
_MARGIN, _LINE, _SWATCH, _TEXT, _RAMP = 20, 20, 12, 12, 120  # of the legend, in pixels


@dataclass
class _Drawn:
    """What is on the graphics card for one result."""

    result: FrameResult
    boxes: Boxes
    texture: Any


_shader: Any = None
_batch: Any = None
_heat: dict[bool, Any] = {}  # colours of the heat map as textures, by whether they are linear
_drawn: _Drawn | None = None
_handles: list[Any] = []
uploads = 0  # how often boxes were sent to the graphics card


def _make_shader() -> Any:
    info = gpu.types.GPUShaderCreateInfo()
    info.push_constant("MAT4", "view_projection")
    info.push_constant("VEC4", "color")
    info.push_constant("INT", "first")
    info.push_constant("INT", "row")
    info.push_constant("INT", "use_heat")
    info.sampler(0, "FLOAT_2D", "boxes")
    info.sampler(1, "FLOAT_2D", "colors")
    info.vertex_in(0, "VEC3", "corner")
    between = gpu.types.GPUStageInterfaceInfo("lipac_boxes")
    between.flat("FLOAT", "heat")
    info.vertex_out(between)
    info.fragment_out(0, "VEC4", "result")
    info.vertex_source(_VERTEX)
    info.fragment_source(_FRAGMENT)
    return gpu.shader.create_from_info(info)


def upload(result: FrameResult) -> _Drawn:
    """The boxes of a result on the graphics card: made where they are not there."""
    global _shader, _batch, _drawn, uploads  # noqa: PLW0603
    if _shader is None:
        _shader = _make_shader()
        _batch = batch_for_shader(_shader, "LINES", {"corner": CORNERS}, indices=EDGES)
        for linear in (False, True):
            colors = np.ones((len(HEAT), 4), np.float32)
            colors[:, :3] = [[_to_linear(x) for x in color] for color in HEAT] if linear else HEAT
            _heat[linear] = gpu.types.GPUTexture(
                (len(HEAT), 1), format="RGBA32F", data=gpu.types.Buffer("FLOAT", colors.size, colors.ravel())
            )
    if _drawn is None or _drawn.result is not result:
        boxes = boxes_of(result)
        rows, columns, _ = boxes.texels.shape
        data = gpu.types.Buffer("FLOAT", boxes.texels.size, boxes.texels.ravel())
        _drawn = _Drawn(result, boxes, gpu.types.GPUTexture((columns, rows), format="RGBA32F", data=data))
        uploads += 1
    return _drawn


def _to_linear(value: float) -> float:
    """sRGB to linear, 0 to 1 (IEC 61966-2-1)."""
    return value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4


def shown(settings: Any) -> tuple[str, ...]:
    """Kinds of boxes that the settings ask for."""
    return tuple(kind for kind in KINDS if getattr(settings, f"show_{kind}"))


def source(scene: bpy.types.Scene) -> FrameResult | None:
    """The result to draw for a scene: the frozen one, else what live mode found, else that of the current frame."""
    frozen = results.frozen.get(scene.session_uid) if scene.lipac.freeze else None
    return frozen or results.shown(scene)


def forget() -> None:
    """Let go of what was drawn."""
    global _drawn  # noqa: PLW0603
    _drawn = None


def draw_boxes(
    result: FrameResult,
    kinds: tuple[str, ...],
    opacity: float,
    view_projection: Any,
    in_front: bool = False,
    encodes: bool = False,
    heat_map: bool = False,
) -> int:
    """Draw boxes into the active framebuffer; returns the number of draw calls.

    view_projection: (4, 4), of the world. in_front: also what geometry hides. encodes: the framebuffer turns linear
    colours into sRGB, as a viewport's does. heat_map: instances in the colours of HEAT.
    """
    drawn = upload(result)
    matrix = np.array(view_projection, np.float64)
    # in double precision: far from the world's origin single is not enough
    matrix[:, 3] += matrix[:, :3] @ drawn.boxes.origin
    gpu.state.blend_set("ALPHA")
    gpu.state.depth_test_set("NONE" if in_front else "LESS_EQUAL")
    gpu.state.depth_mask_set(False)
    calls = 0
    try:
        _shader.bind()
        _shader.uniform_float("view_projection", Matrix(matrix.tolist()))
        _shader.uniform_int("row", ROW)
        _shader.uniform_int("use_heat", int(heat_map))
        _shader.uniform_sampler("boxes", drawn.texture)
        _shader.uniform_sampler("colors", _heat[encodes])
        for kind, (first, count) in zip(KINDS, drawn.boxes.ranges, strict=True):
            if kind in kinds and count:
                _shader.uniform_int("first", first)
                plain = color_of(kind, heat_map)
                color = [_to_linear(x) for x in plain] if encodes else plain
                _shader.uniform_float("color", (*color, opacity))
                _batch.draw_instanced(_shader, instance_count=count)
                calls += 1
    finally:
        gpu.state.blend_set("NONE")
        gpu.state.depth_test_set("NONE")
        gpu.state.depth_mask_set(False)
    return calls


def legend_of(result: FrameResult, kinds: tuple[str, ...]) -> list[tuple[str, str]]:
    """Lines of the legend: kind and text."""
    counts = np.bincount(result.state, minlength=len(STATES))
    texts = {
        "active": f"active: {counts[STATES['active']]:,} instances",
        "pending": f"pending: {counts[STATES['pending']]:,} instances that are being built",
        "regions": f"regions that stand in for what is culled: {len(result.regions):,}",
        "culled": f"culled: {counts[STATES['culled']]:,} instances",
    }
    return [(kind, texts[kind]) for kind in KINDS if kind in kinds and (kind != "pending" or counts[STATES["pending"]])]


def draw_legend(result: FrameResult, kinds: tuple[str, ...], scale: float = 1.0, heat_map: bool = False) -> None:
    """Draw the legend into the lower left corner of the active framebuffer, in pixels."""
    x, y, side = _MARGIN * scale, _MARGIN * scale, _SWATCH * scale
    lines = [(kind, text) for kind, text in legend_of(result, kinds) if not heat_map or kind == "regions"]
    rows: list[tuple[float, Any, str]] = [
        (side, [color_of(kind, heat_map)] * 2, text) for kind, text in reversed(lines)
    ]
    if heat_map:
        rows.append((_RAMP * scale, HEAT, f"light paths that meet an instance: 0 to {upload(result).boxes.hottest:,}"))
    blf.size(0, _TEXT * scale)
    wide = max((width + side + blf.dimensions(0, text)[0] for width, _, text in rows), default=0.0)
    gpu.state.blend_set("ALPHA")
    _bar(x - side / 2, y - side / 2, wide + side, len(rows) * _LINE * scale, [(0.0, 0.0, 0.0)] * 2, 0.6)
    for k, (width, colors, text) in enumerate(rows):
        at = y + k * _LINE * scale
        _bar(x, at, width, side, colors)
        blf.color(0, 0.9, 0.9, 0.9, 1.0)
        blf.position(0, x + width + side / 2, at + 0.1 * side, 0)
        blf.draw(0, text)
    gpu.state.blend_set("NONE")


def _bar(x: float, y: float, width: float, height: float, colors: Any, opacity: float = 1.0) -> None:
    """A rectangle in colours from left to right."""
    at = np.repeat(np.linspace(x, x + width, len(colors)), 2)
    corners = np.column_stack([at, np.tile([y, y + height], len(colors))]).astype(np.float32)
    shades = np.repeat(np.column_stack([colors, np.full(len(colors), opacity)]), 2, axis=0).astype(np.float32)
    shader = gpu.shader.from_builtin("SMOOTH_COLOR")
    batch_for_shader(shader, "TRI_STRIP", {"pos": corners, "color": shades}).draw(shader)


def _wanted(context: bpy.types.Context) -> FrameResult | None:
    """What to draw in a viewport: nothing where its own switch of all overlays is off."""
    return (
        source(context.scene) if context.scene.lipac.show_overlay and context.space_data.overlay.show_overlays else None
    )


def _draw_view() -> None:
    context = bpy.context
    result, settings = _wanted(context), context.scene.lipac
    if result is not None:
        matrix = context.region_data.perspective_matrix
        draw_boxes(
            result,
            shown(settings),
            settings.opacity,
            matrix,
            settings.in_front,
            encodes=True,
            heat_map=settings.heat_map,
        )


def _draw_pixels() -> None:
    context = bpy.context
    result, settings = _wanted(context), context.scene.lipac
    if result is not None:
        draw_legend(result, shown(settings), context.preferences.system.ui_scale, settings.heat_map)
        picture.draw(context, result)


def register() -> None:
    """Add the draw handlers."""
    for draw, when in ((_draw_view, "POST_VIEW"), (_draw_pixels, "POST_PIXEL")):
        _handles.append(bpy.types.SpaceView3D.draw_handler_add(draw, (), "WINDOW", when))


def unregister() -> None:
    """Remove them, and let go of what is on the graphics card."""
    global _shader, _batch  # noqa: PLW0603
    while _handles:
        bpy.types.SpaceView3D.draw_handler_remove(_handles.pop(), "WINDOW")
    forget()
    _shader = _batch = None
    _heat.clear()
