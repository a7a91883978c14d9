"""Live culling in the viewport, measured: `python -m lipac.scripts.studies.viewport.flight -o docs/viewport.md`.

The camera of `flythrough` drives through the city while live mode does one round a frame, at 24 frames a second by the
clock that live culling goes by. Of each frame Cycles renders what the viewport shows, once with all and once culled,
by the same random numbers. Some frames are drawn by the viewport itself, too (EEVEE, into memory): it takes OpenGL, and
seconds for each picture where that is software; with a graphics card `--drawn-every 1` draws all of them. Then, in
cities and view layers of several sizes, what a change of the set costs.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
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
from .drawn import Viewport

if TYPE_CHECKING:
    from ....lipac_addon.ui.jobs.viewport_switches import OutSet

SIZE, SAMPLES = (160, 90), 8
FRAMES = (40, 110)  # with the turn around the corner, a cut away and the cut back
DRAWN_EVERY, CUTS = 5, (91, 103)  # frames that the viewport draws, too, and the first ones after a cut


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, write the page, print it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, help="a Markdown file for the page")
    parser.add_argument("--instances", type=int, default=10_000, help="of the flythrough")
    parser.add_argument("--frames", type=int, nargs=2, default=FRAMES)
    parser.add_argument(
        "--drawn-every", type=int, default=DRAWN_EVERY, help="every so many frames are drawn by the viewport (0: none)"
    )
    parser.add_argument("--sizes", type=int, nargs="*", default=(10_000, 100_000, 1_000_000))
    args = parser.parse_args(argv)
    from .... import register
    from .costs import costs

    register()
    frames = range(args.frames[0], args.frames[1] + 1)
    drawn = [f for f in frames if args.drawn_every and ((f - frames[0]) % args.drawn_every == 0 or f in CUTS)]
    found = flight(args.instances, frames, drawn)
    page = "\n".join([*lines_of(found, args.instances, drawn), "", *costs(args.sizes), ""])
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
    viewport = Viewport(SIZE) if drawn else None
    sets = dict(zip(frames, flown(out), strict=True))
    with tempfile.TemporaryDirectory() as folder:
        for frame in frames:
            out.full.append(taken(frame, None, lambda: by_cycles(Path(folder))))
            out.culled.append(taken(frame, sets[frame], lambda: by_cycles(Path(folder))))
    for frame in drawn:
        assert viewport is not None
        out.drawn_full.append(taken(frame, None, viewport.picture))
        out.drawn_culled.append(taken(frame, sets[frame], viewport.picture))
    return out


def taken(frame: int, out: tuple[OutSet, dict[int, F32]] | None, picture: Callable[[], F32]) -> F32:
    """A picture of a frame, without what is out, None: of all of it."""
    import bpy

    bpy.context.scene.frame_set(frame)
    if out is None:
        return picture()
    with without(*out):
        return picture()


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
    if drawn:
        seen = np.array([picture_change(a, b) for a, b in zip(found.drawn_full, found.drawn_culled, strict=True)])
        table += [
            (f"{len(drawn)} frames drawn by EEVEE: change, mean over tiles: mean, median, most", three(seen[:, 0])),
            (f"the same: worst tile; most in frame {drawn[int(seen[:, 1].argmax())]}", three(seen[:, 1])),
            ("the same: frames without any change", f"{np.count_nonzero(seen[:, 1] == 0)} of {len(drawn)}"),
        ]
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
