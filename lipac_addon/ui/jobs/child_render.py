"""Renders a frame of a .blend in a Blender of its own, and prints what that took: `blender -b -P child_render.py --
FILE SCENE FRAME OUT.exr`.

A script, not a module: the Blender that runs it need not have the add-on.
"""

import json
import os
import runpy
import sys
import threading
import time
from pathlib import Path

import bpy

if __name__ == "__main__":  # who waits for it keeps its input open; where that has ended, however, so does this
    threading.Thread(target=lambda: (os.read(0, 1), os._exit(1)), daemon=True).start()
blend, name, frame, out = sys.argv[sys.argv.index("--") + 1 :]
bpy.ops.wm.open_mainfile(filepath=blend, load_ui=False, use_scripts=False)
scene = bpy.data.scenes[name]
bpy.context.window.scene = scene
render = scene.render
render.use_compositing = render.use_sequencer = False  # no file outputs of the user's
render.image_settings.media_type = "IMAGE"
render.image_settings.file_format, render.image_settings.color_depth = "OPEN_EXR", "32"
render.use_file_extension, render.filepath = True, out
scene.frame_set(int(frame))
start = time.perf_counter()
bpy.ops.render.render(write_still=True, scene=name)
seconds = time.perf_counter() - start
usage = runpy.run_path(str(Path(__file__).resolve().parents[3] / "core" / "files" / "usage.py"))
print("LIPAC", json.dumps({"seconds": seconds, "peak_bytes": usage["peak_memory"]()}), flush=True)
