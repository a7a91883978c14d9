"""Blender in: what a render of a scene would see, as the arrays of `core.scene.model`.

    extraction = extract_frame(bpy.context.scene, frame)      # render visibility, render modifiers; baked world
    extraction.scene, extraction.keys, extraction.warnings

Many frames, of which only what changes is read: `Extractor`. In steps: `extract_world` (may render, so before), then
`with_render_depsgraph(scene, frame, lambda graph: extract(graph, world))`.

Read in the order of use: `depsgraph` (a graph in render mode), `graph` (its objects, with `geometry`), `instances`
(what they place), `shading` (materials), `scene` (all together), `session` (over frames).
"""

from ..depsgraph import with_render_depsgraph
from .camera import add_framing_camera, frame_camera
from .scene import Extraction, extract
from .session import Extractor, extract_frame
from .world import ExtractedWorld, extract_world

__all__ = [
    "ExtractedWorld", "Extraction", "Extractor", "add_framing_camera", "extract", "extract_frame", "extract_world",
    "frame_camera", "with_render_depsgraph"
]
