"""What the open file asks of its renders."""

from __future__ import annotations

import bpy

from ...depsgraph import rendered_layers
from .choices import BLENDER_ENGINES

HYBRID_SAMPLES = 64  # at most, where nobody says: the rest is the denoiser's


def samples_of(scene: bpy.types.Scene, engine: str) -> int:
    """Samples per pixel that the scene asks of an engine of `ENGINES`."""
    if engine == "eevee":
        return int(scene.eevee.taa_render_samples)
    return min(scene.cycles.samples, HYBRID_SAMPLES) if engine == "hybrid" else int(scene.cycles.samples)


def left_out(scene: bpy.types.Scene, engine: str) -> list[str]:
    """What the scene asks of its renders and an engine of `ENGINES`, or "" for none, leaves out, a line each."""
    out, render = [], scene.render
    if render.use_border and engine:
        out.append("render region: the whole picture is rendered")
    if render.use_multiview and engine:
        out.append("stereo: one view is rendered, by the camera itself")
    if render.use_freestyle and engine in BLENDER_ENGINES:
        out.append("Freestyle: lines of what is culled are not drawn")
    if engine == "eevee" and any(ob.type == "LIGHT" and ob.data.type == "SUN" and not ob.hide_render for ob in scene.objects):
        out.append(
            "EEVEE's sun: its shadows are as fine as what casts them is wide, so single pixels at their edges may differ from a render with nothing culled"
        )
    if engine in BLENDER_ENGINES and len(used := rendered_layers(scene)) > 1 and not (render.use_compositing and scene.compositing_node_group):
        out.append(f"view layers: the picture is of '{used[0]}', of {len(used)} that were analysed")
    if engine in ("hybrid", "path"):
        if len(used := rendered_layers(scene)) > 1:
            out.append(f"view layers: '{used[0]}' alone is rendered, of {len(used)}")
        if render.use_freestyle:
            out.append("Freestyle: no lines are drawn")
        if render.use_motion_blur:
            out.append("motion blur: pictures are of one moment")
        if render.use_compositing and scene.compositing_node_group is not None:
            out.append("compositing: pictures are as they come out of the engine")
    return out
