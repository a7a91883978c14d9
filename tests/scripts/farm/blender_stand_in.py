"""Python with the module bpy in the place of Blender, for what Flamenco's workers ask of it: FILE --python-exit-code 1
--python SCRIPT -- ARGUMENTS."""

import runpy
import sys
from pathlib import Path

import bpy

file, *given = sys.argv[1 : sys.argv.index("--")]
options = dict(zip(given[::2], given[1::2], strict=True))
assert options.keys() == {"--python-exit-code", "--python"}, options
bpy.ops.wm.open_mainfile(filepath=file)
sys.path.insert(0, str(Path(options["--python"]).parent))
runpy.run_path(options["--python"], run_name="__main__")
