"""The engine and the native libraries that the extension brings: are they there? Loaded on another thread, for it takes
seconds."""

from __future__ import annotations

from collections.abc import Callable, Generator
from functools import cache
from importlib.util import find_spec

from ....core.errors import InputError
from .background import in_thread

NEEDED = ("numba", "llvmlite", "embreex")
REINSTALL = "install the LiPaC zip made for this platform and Blender version"
LOADING = "loading; the first time, kernels are compiled, which takes a minute"


@cache
def missing() -> tuple[str, ...]:
    """Names of the libraries that Python cannot find; nothing is loaded."""
    return tuple(name for name in NEEDED if find_spec(name) is None)


def obstacle() -> str:
    """Why nothing can be analysed on this machine, "" where it can."""
    return f"missing: {', '.join(missing())}; {REINSTALL}" if missing() else ""


def load(cancel: Callable[[], None], kernels: bool = False) -> Generator[None, None, None]:
    """Load the engine in a thread; cancel as of `in_thread`. kernels: at once, so that what Blender takes with them can
    be told. Raises InputError where a library cannot be loaded."""
    try:
        yield from in_thread(_import_all if kernels else _import, cancel)
    except (ImportError, OSError) as error:
        raise InputError(f"LiPaC's libraries cannot be loaded ({error}): {REINSTALL}") from error


def _import() -> None:
    from ....core.culling import shot  # noqa: F401


def _import_all() -> None:
    from ....core import warmup

    warmup.load()
