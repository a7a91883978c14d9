"""How long EEVEE takes in the viewport, in full and with live culling:
`python -m lipac.scripts.studies.viewport.speed -o speed.md`, on a machine with a graphics card.

The mirror city, drawn into memory at 1920 x 1080. A change of the scene: the scatter is tagged, as by an edit of it;
until the picture is there. A frame: the camera has moved a little.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from .clock import Clock, look, settle
from .drawn import Viewport

SIZE = (1920, 1080)
CHANGES, FRAMES = 5, 24
STEP = 0.02  # metres that the camera moves from frame to frame


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, write the table, print it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, help="a Markdown file for the table")
    parser.add_argument("--sizes", type=int, nargs="*", default=(100_000, 1_000_000))
    parser.add_argument("--size", type=int, nargs=2, default=SIZE, metavar=("WIDTH", "HEIGHT"))
    args = parser.parse_args(argv)
    from .... import register

    register()
    page = "\n".join(lines_of([measured(count, tuple(args.size)) for count in args.sizes], tuple(args.size)))
    if args.output:
        args.output.write_text(page)
    print(page)
    return 0


def measured(count: int, size: tuple[int, int]) -> dict[str, float]:
    """Seconds, medians: of a change and of a frame, in full and culled; rows that are there then."""
    import bpy

    from ....lipac_addon.demo import build
    from ....lipac_addon.ui.jobs import live

    build("mirror-city", count)
    scene, layer = bpy.context.scene, bpy.context.view_layer
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = *size, 100
    layer.update()
    look()
    viewport = Viewport(size)
    viewport.draw()
    time.sleep(5.0)  # for the threads that compile shaders
    out: dict[str, float] = {"instances": count}
    out["change, full"], out["frame, full"] = seconds(viewport)
    scene.lipac.cull_viewport = True
    with Clock() as clock:
        live.start()
        settle(clock)
        assert live.current is not None
        out["out"] = sum(int(gone.sum()) for gone in live.current.culling.switches.out.rows.values())
        out["change, culled"], out["frame, culled"] = seconds(viewport)
        live.stop()
    scene.lipac.cull_viewport = False
    return out


def seconds(viewport: Viewport) -> tuple[float, float]:
    """Medians: from an edit of the scatter to the picture; of a frame."""
    import bpy

    city, camera = bpy.data.objects["City"], bpy.context.scene.camera
    viewport.draw()

    def edit() -> None:
        city.update_tag(refresh={"DATA"})
        viewport.draw()

    def move() -> None:
        camera.location.x += STEP
        viewport.draw()

    change = statistics.median(took(edit) for _ in range(CHANGES))
    frame = statistics.median(took(move) for _ in range(FRAMES))
    camera.location.x -= FRAMES * STEP
    return change, frame


def took(work: Callable[[], None]) -> float:
    """Seconds of the clock."""
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def lines_of(rows: Sequence[dict[str, float]], size: tuple[int, int]) -> list[str]:
    """The table, in Markdown."""
    import bpy
    import gpu

    from ..machine import made_by

    def pair(row: dict[str, float], what: str) -> str:
        full, culled = row[f"{what}, full"], row[f"{what}, culled"]
        return f"{1000 * full:.1f} ms | {1000 * culled:.1f} ms | {full / culled:.1f}"

    return [
        f"`python -m lipac.scripts.studies.viewport.speed`: {made_by()}, {gpu.platform.renderer_get()}, "
        f"{gpu.platform.backend_type_get()}. Mirror city, {size[0]} x {size[1]}, EEVEE with "
        f"{bpy.context.scene.eevee.taa_samples} samples in the viewport; medians.",
        "",
        "| instances | out of the viewport | from an edit to the picture, full | culled | times "
        "| a frame, full | culled | times |",
        "|---:|---:|---:|---:|---:|---:|---:|---:|",
        *(
            f"| {row['instances']:,.0f} | {row['out']:,.0f} | {pair(row, 'change')} | {pair(row, 'frame')} |"
            for row in rows
        ),
        "",
    ]


if __name__ == "__main__":
    sys.exit(main())
