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


def left_out(scene: bpy.types.Scene, engine: str, as_scene: bool = False) -> list[str]:
    """What the scene asks of its renders and an engine of `ENGINES`, or "" for none, leaves out, a line each. as_scene:
    as of `Job`."""
    out, render = [], scene.render
    if render.use_border and engine and not as_scene:
        out.append("render region: the whole picture is rendered")
    if render.use_multiview and engine and not as_scene:
        out.append("stereo: one view is rendered, by the camera itself")
    if engine and not as_scene and (lost := _unwritten(scene)):
        way = "; --as-scene writes all of it" if engine in BLENDER_ENGINES and not render.is_movie_format else ""
        out.append(f"output: pictures are .exr and .png; left out: {', '.join(lost)}{way}")
    if engine == "eevee" and any(
        ob.type == "LIGHT" and ob.data.type == "SUN" and not ob.hide_render for ob in scene.objects
    ):
        out.append(
            "EEVEE's sun: its shadows are as fine as what casts them is wide, so single pixels at their edges may "
            "differ from a render with nothing culled"
        )
    if (
        engine in BLENDER_ENGINES
        and not as_scene
        and len(used := rendered_layers(scene)) > 1
        and not (render.use_compositing and scene.compositing_node_group)
    ):
        out.append(f"view layers: the picture is of '{used[0]}', of {len(used)} that were analysed")
    if engine and engine not in BLENDER_ENGINES:
        if len(used := rendered_layers(scene)) > 1:
            out.append(f"view layers: '{used[0]}' alone is rendered, of {len(used)}")
        if render.use_freestyle:
            out.append("Freestyle: no lines are drawn")
        if render.use_motion_blur:
            out.append("motion blur: pictures are of one moment")
        if render.use_compositing and scene.compositing_node_group is not None:
            out.append("compositing: pictures are as they come out of the engine")
    return out


def _unwritten(scene: bpy.types.Scene) -> list[str]:
    """What a render of the scene by Blender would write, or show, that pictures without it lack."""
    render, out = scene.render, []
    if render.image_settings.file_format == "OPEN_EXR_MULTILAYER":
        out.append("passes in multilayer OpenEXR")
    if render.is_movie_format:
        out.append("the film")
    tree = scene.compositing_node_group if render.use_compositing else None
    outputs = [node for node in tree.nodes if node.type == "OUTPUT_FILE" and not node.mute] if tree is not None else []
    if outputs:
        out.append(f"{len(outputs)} File Output node{'s' if len(outputs) > 1 else ''} of the compositor")
    if render.use_sequencer and scene.sequence_editor is not None and len(scene.sequence_editor.strips_all):
        out.append("the sequencer's picture")
    if render.use_stamp:
        out.append("text burnt into the picture")
    if render.image_settings.color_management == "OVERRIDE":
        out.append("colour management of its own for files")
    return out
