"""The native libraries that the extension brings: are they there?"""

from __future__ import annotations

from functools import cache
from importlib.util import find_spec

NEEDED = ("numba", "llvmlite", "embreex")
REINSTALL = "install the LiPaC zip made for this platform and Blender version"


@cache
def missing() -> tuple[str, ...]:
    """Names of the libraries that Python cannot find; nothing is loaded."""
    return tuple(name for name in NEEDED if find_spec(name) is None)
