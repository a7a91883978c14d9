"""The functions of `import lipac`: analyse a scene, cull renders of the open file by that, take it back, render."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

from ..core.culling.options import CullOptions, State
from ..core.error_budget.budget import SPREAD, Budget
from ..core.errors import InputError
from ..core.progress import Progress, silent
from ..core.scene.model import Scene
from ..version import __version__

if TYPE_CHECKING:
    import bpy

    from ..core.culling.result import CullingResult
    from ..core.files.report import Report
    from .batch.deciding import Decided
    from .writeback import WritebackResult

_EVEN = 1.0  # spread of an error over the tiles of a picture that shows what is culled all the same


@overload
def analyze(
    scene: Scene,
    max_error: float | Budget = 0.01,
    *,
    options: CullOptions | None = None,
    frame: None = None,
    progress: Progress = silent,
) -> CullingResult: ...
@overload
def analyze(
    scene: str | Path | bpy.types.Scene | None = None,
    max_error: float | Budget = 0.01,
    *,
    options: CullOptions | None = None,
    frame: int | None = None,
    progress: Progress = silent,
) -> Decided: ...
def analyze(
    scene: Scene | str | Path | bpy.types.Scene | None = None,
    max_error: float | Budget = 0.01,
    *,
    options: CullOptions | None = None,
    frame: int | None = None,
    progress: Progress = silent,
) -> CullingResult | Decided:
    """Decide which instances of a frame light paths need.

    Parameters:
        scene: a file (.blend, .glb, .gltf, .usd*, .obj, .ply, .stl), which is opened in place of the open one; the
            open scene of Blender, or None for it; or arrays (`lipac.core.scene.model.Scene`), for which Blender is not
            loaded.
        max_error: the error budget (docs/error.md): the mean error of the picture's 16 x 9 tiles, as a share: 0.01 is
            1 %. The worst tile may change by five times as much; a `Budget` gives both bounds.
        options: all else, such as the policy, seed, threads; its own budget counts for nothing.
        frame: to analyse; None: the scene's current one.
        progress: called with a share from 0 to 1 (NaN where unknown) and a text.

    Returns states (0 culled, 1 pending, 2 active), scores, hits per ray type and figures of N instances; of a Blender
    scene also the keys that find these again. What an earlier `apply` hid is shown again before the scene is read.

    Raises `InputError` where the scene cannot be opened or rendered, MemoryError where there is not enough.
    """
    wanted = _options(max_error, options)
    if isinstance(scene, Scene):
        from ..core.culling.analysis import analyze as analyze_arrays

        return analyze_arrays(scene, wanted, progress)
    opened = _opened(scene)
    from .batch.deciding import decide_layers
    from .batch.job import Job
    from .batch.session import sessions_of

    number = opened.frame_current if frame is None else frame
    restore()
    with _frame_kept(opened):
        return decide_layers(sessions_of(Job(Path(), (number,), wanted)), number, True, progress)


def apply(analysis: Decided) -> WritebackResult:
    """Cull renders of the open file by an analysis of it, by Cycles or EEVEE, until `restore`. What an earlier call did
    is taken back first.

    Returns which instances a render no longer meets, and why others could not be removed. Nothing is written to disk;
    the viewport stays as it is. All or nothing: where something fails half-way, it raises that, and nothing is applied.

    Raises `InputError` where the open scene renders several views (Stereoscopy): one camera is analysed.
    """
    import bpy

    from .writeback import apply as write

    if bpy.context.scene.render.use_multiview:
        raise InputError("Stereoscopy renders from several cameras, of which one is analysed: switch it off")

    return write(analysis.state == State.CULLED, analysis.keys)


def restore() -> bool:
    """Take back all that `apply` did in the open file, exactly, also where the file was saved and loaded since; True
    where there was something."""
    from .writeback import restore as take_back

    return take_back()


def render(
    scene: str | Path | bpy.types.Scene | None,
    output: str | Path,
    max_error: float | Budget = 0.01,
    *,
    engine: str = "cycles",
    samples: int | None = None,
    frames: Sequence[int] = (),
    options: CullOptions | None = None,
    progress: Progress = silent,
) -> Report:
    """Analyse frames and render each culled: pictures (frame_0001.exr and .png), states, report.json and, where what
    makes pages is installed, report.html in the folder `output`.

    Parameters:
        scene, max_error, options, progress: as of `analyze`; arrays cannot be rendered to files.
        engine: cycles, eevee, hybrid (a raster with light paths) or path (the analysis' path tracer).
        samples: per pixel; None: as the scene says.
        frames: none: the scene's current one.

    Returns the report: `frames` holds the figures of each. The open file is left as it was, in Object Mode.
    Raises `InputError` where the scene cannot be rendered, or the folder not be written.
    """
    opened = _opened(scene)
    import bpy

    from ..core.files.report import Report, output_folder
    from ..page.html import missing
    from ..page.report_page import drop, write
    from .batch.engines.choices import ENGINES
    from .batch.job import Job
    from .batch.pipeline import run

    if engine not in ENGINES:
        raise InputError(f"no engine '{engine}'; choose one of {', '.join(ENGINES)}")
    wanted = _options(max_error, options, _EVEN if ENGINES[engine].shows_culled else SPREAD)
    folder = output_folder(Path(output))
    job = Job(folder, tuple(frames) or (opened.frame_current,), wanted, engine, samples, wanted.seed, wanted.threads)
    report = Report(
        bpy.data.filepath, bpy.app.version_string, __version__, wanted.policy, engine, wanted.seed, wanted.threads
    )
    drop(folder)
    with _frame_kept(opened):
        run(job, report, progress)
    if not missing():
        write(folder)
    return report


@contextmanager
def _frame_kept(scene: bpy.types.Scene) -> Iterator[None]:
    """The scene's current frame is the same after the block."""
    before = scene.frame_current, scene.frame_subframe
    try:
        yield
    finally:
        if (scene.frame_current, scene.frame_subframe) != before:
            scene.frame_set(before[0], subframe=before[1])


def _options(max_error: float | Budget, options: CullOptions | None, spread: float = SPREAD) -> CullOptions:
    from dataclasses import replace

    budget = max_error if isinstance(max_error, Budget) else Budget(max_error, spread * max_error)
    return replace(options or CullOptions(), max_error=budget)


def _opened(scene: Any) -> bpy.types.Scene:
    """The scene to look at, open."""
    from .console import muted

    with muted():
        import bpy
    from .open import leave_modes, open_scene

    if isinstance(scene, (str, Path)):
        open_scene(Path(scene))
    elif scene is not None and scene != bpy.context.scene:
        raise InputError("only the open scene, or a file, can be analysed: make it the window's scene first")
    else:
        leave_modes()
    found = bpy.context.scene
    if found.camera is None:
        raise InputError(f"scene '{found.name}' has no camera: add one and make it active")
    return found
