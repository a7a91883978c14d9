"""Live culling in the viewport, measured: `python -m lipac.scripts.studies.viewport.flight -o docs/viewport.md`.

The camera of `flythrough` drives through the city while live mode does one round a frame, at 24 frames a second by the
clock that live culling goes by. Of each frame Cycles renders what the viewport shows, once with all and once culled,
by the same random numbers. Some frames are drawn by the viewport itself, too (EEVEE, into memory). Then, in cities of
several sizes, what a change of the set costs.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ....core.arrays import F32
from ....core.evaluation.judge import picture_change
from ....core.evaluation.metrics import flicker
from ....core.feedback.tiles import tile_means
from .clock import RATE, ROUNDS, Clock, look, rounds, settle

if TYPE_CHECKING:
    from ....lipac_addon.ui.jobs.viewport_switches import OutSet

SIZE, SAMPLES = (160, 90), 8
FRAMES = (40, 110)  # with the turn around the corner, a cut away and the cut back
DRAWN = (76,)
SETTLED = 3  # successive pictures that are the same, after which all shaders are there


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, write the page, print it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, help="a Markdown file for the page")
    parser.add_argument("--instances", type=int, default=10_000, help="of the flythrough")
    parser.add_argument("--frames", type=int, nargs=2, default=FRAMES)
    parser.add_argument("--drawn", type=int, nargs="*", default=DRAWN, help="frames that the viewport draws")
    parser.add_argument("--sizes", type=int, nargs="*", default=(10_000, 100_000, 1_000_000))
    args = parser.parse_args(argv)
    from .... import register
    from .costs import costs

    register()
    found = flight(args.instances, range(args.frames[0], args.frames[1] + 1), args.drawn)
    page = "\n".join([*lines_of(found, args.instances, args.drawn), "", *costs(args.sizes), ""])
    if args.output:
        args.output.write_text(page)
    print(page)
    return 0


def by_cycles(folder: Path) -> F32:
    """(height, width, 3) float32, linear: the current frame, rendered by Cycles."""
    import bpy

    from ....lipac_addon.pictures import read_picture, saved_as

    path = folder / "frame.exr"
    bpy.context.scene.render.filepath = str(path)
    with saved_as(bpy.context.scene, ".exr"):
        bpy.ops.render.render(write_still=True)
    return np.asarray(read_picture(path)[:, :, :3], np.float32)


@contextmanager
def without(out: OutSet, places: dict[int, F32]) -> Iterator[None]:
    """Have a set out of the viewport, and for once of renders, too."""
    import bpy

    from ....lipac_addon.writeback import viewport

    layer = bpy.context.view_layer
    objects = {ob.session_uid: ob for ob in bpy.data.objects}
    for uid, gone in out.rows.items():
        viewport.mask_rows(objects[uid], gone, places[uid])
        objects[uid].modifiers[viewport.NAME].show_render = True
    eyes = [objects[uid] for uid in out.objects]
    viewport.close_eyes(layer, eyes)
    for ob in eyes:
        ob.hide_render = True
    yield
    viewport.restore()
    for ob in eyes:
        ob.hide_render = False


class Viewport:
    """A viewport in Rendered shading that looks through the camera, drawn into memory."""

    def __init__(self) -> None:
        import bpy
        import gpu

        gpu.init()
        window = bpy.context.window_manager.windows[0]
        area = next(area for area in window.screen.areas if area.type == "VIEW_3D")
        self.space = area.spaces.active
        self.region = next(region for region in area.regions if region.type == "WINDOW")
        self.space.overlay.show_overlays = False
        self.target = gpu.types.GPUOffScreen(*SIZE, format="RGBA32F")

    def picture(self) -> F32:
        """(height, width, 3) float32, linear, rows bottom up: drawn until all shaders are compiled."""
        import bpy

        scene, same = bpy.context.scene, 0
        last = np.zeros((0, 0, 3), np.float32)
        scene.render.engine = "BLENDER_EEVEE"
        try:
            while same < SETTLED:
                now = self._drawn()
                same = same + 1 if now.any() and np.array_equal(now, last) else 0
                last = now
                time.sleep(0.2)
        finally:
            scene.render.engine = "CYCLES"
        return last

    def _drawn(self) -> F32:
        import bpy
        import gpu

        layer, camera = bpy.context.view_layer, bpy.context.scene.camera
        layer.update()
        view = camera.evaluated_get(layer.depsgraph).matrix_world.inverted()
        projection = camera.calc_matrix_camera(layer.depsgraph, x=SIZE[0], y=SIZE[1])
        scene, space = bpy.context.scene, self.space
        self.target.draw_view3d(scene, layer, space, self.region, view, projection, do_color_management=False)
        with self.target.bind():
            buffer = gpu.state.active_framebuffer_get().read_color(0, 0, *SIZE, 4, 0, "FLOAT")
        return np.array(buffer.to_list(), np.float32)[:, :, :3]


@dataclass
class Flight:
    """Pictures in full and culled, by Cycles and as drawn, rows of the scatter that were there, and changes of the
    set."""

    frames: range
    full: list[F32] = field(default_factory=list)
    culled: list[F32] = field(default_factory=list)
    drawn_full: list[F32] = field(default_factory=list)
    drawn_culled: list[F32] = field(default_factory=list)
    counts: list[int] = field(default_factory=list)
    changes: int = 0


def flight(instances: int, frames: range, drawn: Sequence[int]) -> Flight:
    """Fly with live culling, then take the pictures, in full and without what was out. drawn: frames that the viewport
    draws, too."""
    import bpy

    from ....lipac_addon.demo import build

    build("flythrough", instances)
    scene, out = bpy.context.scene, Flight(frames)
    render = scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = *SIZE, 100
    scene.cycles.samples, scene.cycles.use_denoising, scene.cycles.use_adaptive_sampling = SAMPLES, False, False
    scene.cycles.seed, scene.cycles.use_animated_seed = 0, False
    look()
    viewport = Viewport() if drawn else None
    sets = flown(out)
    with tempfile.TemporaryDirectory() as folder:
        for frame, (gone, places) in zip(frames, sets, strict=True):
            scene.frame_set(frame)
            for pictures, shown, what in (
                (out.full, out.drawn_full, (type(gone)(frozenset(), {}), places)),
                (out.culled, out.drawn_culled, (gone, places)),
            ):
                with without(*what):
                    pictures.append(by_cycles(Path(folder)))
                    if viewport is not None and frame in drawn:
                        shown.append(viewport.picture())
    return out


def flown(out: Flight) -> list[tuple[OutSet, dict[int, F32]]]:
    """What was out of the viewport in each frame, and where the rows of its hosts were."""
    import bpy

    from ....lipac_addon.ui.jobs import live

    scene, sets = bpy.context.scene, []
    scene.frame_set(out.frames[0])
    scene.lipac.cull_viewport = True
    with Clock() as clock:
        live.start()
        settle(clock)
        assert live.current is not None
        switches = live.current.culling.switches
        before = clock.changes
        for frame in out.frames:
            scene.frame_set(frame)
            bpy.context.view_layer.update()
            rounds(ROUNDS)
            clock.go(1 / RATE)
            out.counts.append(rows())
            sets.append((switches.out, dict(switches._places)))
        out.changes = clock.changes - before
        live.stop()
    return sets


def lines_of(found: Flight, instances: int, drawn: Sequence[int]) -> list[str]:
    """What came of a flight."""
    from ..machine import made_by

    frames, full, culled = found.frames, found.full, found.culled
    errors = np.array([picture_change(a, b) for a, b in zip(full, culled, strict=True)])
    tiles = [[tile_means(p).reshape(1, -1, 1).repeat(3, axis=2) for p in pictures] for pictures in (full, culled)]
    light = np.mean([tile.mean() for tile in tiles[0]])
    error = np.mean([np.abs(b - a).mean() for a, b in zip(*tiles, strict=True)]) / light
    own = np.mean([np.abs(b - a).mean() for a, b in itertools.pairwise(full)]) / np.mean(full)
    mean, worst = errors[:, 0], errors[:, 1]
    table = [
        ("rows of the scatter in the viewport, mean over frames", f"{np.mean(found.counts):.0f} of {instances:,}"),
        ("changes of the set", f"{found.changes} in {len(frames)} frames"),
        ("change of the picture, mean over tiles: mean over frames, median, most", three(mean)),
        ("worst tile: mean over frames, median, most", three(worst)),
        ("error: the same as a share of the mean of all pictures", pc(float(error))),
        ("flicker, tiles", pc(flicker(*tiles))),
        ("flicker, pixels", pc(flicker(full, culled))),
        ("the picture's own change from frame to frame, pixels", pc(float(own))),
    ]
    for k, frame in enumerate(drawn):
        change = picture_change(found.drawn_full[k], found.drawn_culled[k])
        table.append(
            (f"frame {frame} as drawn by EEVEE: change, mean over tiles; worst tile", "; ".join(map(pc, change)))
        )
    greatest = ", ".join(f"{frames[k]} ({pc(mean[k])})" for k in np.argsort(mean)[::-1][:5])
    return [
        "# Live culling in the viewport, measured",
        "",
        f"`python -m lipac.scripts.studies.viewport.flight`: {made_by()}. Frames {frames[0]} to {frames[-1]} of "
        f"`flythrough`, {instances:,} instances, {ROUNDS} round of live mode a frame, {RATE:.0f} frames a second by "
        f"its clock; Cycles, {SIZE[0]} x {SIZE[1]}, {SAMPLES} samples, with the same random numbers.",
        "",
        "| | |",
        "|---|---:|",
        *(f"| {name} | {value} |" for name, value in table),
        "",
        f"Frames of the greatest change: {greatest}.",
        "Error and flicker as in [animation.md](animation.md#flythrough-in-real-time).",
    ]


def three(values: NDArray[np.float64]) -> str:
    """Mean, median and most."""
    return "; ".join(pc(float(v)) for v in (values.mean(), np.median(values), values.max()))


def pc(share: float) -> str:
    """A share in percent."""
    return f"{100 * share:.3g} %"


def rows() -> int:
    """Rows of the city's scatter that the viewport has."""
    import bpy

    layer = bpy.context.view_layer
    geometry = bpy.data.objects["City"].evaluated_get(layer.depsgraph).evaluated_geometry()
    return len(geometry.instances_pointcloud().points)


if __name__ == "__main__":
    sys.exit(main())
