"""How a script of this folder runs when Blender, or Python, is given its path: `blender -b FILE -P scripts/render.py --
ARGS`.

Its package is then not imported as such. It may be loaded already, as an installed package or an enabled extension;
else it is loaded from the folder above.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def package() -> str:
    """Name of the package that these files belong to, imported."""
    init = ROOT / "__init__.py"
    for name, module in list(sys.modules.items()):
        if getattr(module, "__file__", None) and Path(str(module.__file__)).resolve() == init:
            return name
    spec = importlib.util.spec_from_file_location("lipac", init, submodule_search_locations=[str(ROOT)])
    assert spec is not None and spec.loader is not None
    module = sys.modules["lipac"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return "lipac"


def run(command: str) -> int:
    """Run a command with the arguments after `--`, or all of them where there is none; the exit status."""
    arguments = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
    try:
        main = importlib.import_module(f"{package()}.scripts.lipac").main
    except ImportError as error:
        print(
            f"lipac: {error}; enable the LiPaC extension, or install its dependencies into this Python", file=sys.stderr
        )
        return 2
    return int(main([command, *arguments]))
