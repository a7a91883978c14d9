"""What live mode and the overlay cost Blender's main thread: `python -m lipac.scripts.studies.bench_live -o
docs/live.md`.

The demo city of 100,000 instances, whose camera, an object, and then the scatter as a whole are moved again and again;
of each edit the longest tick counts. Time is what the thread computed, and beside it what passed, which on a busy
machine is more.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

Took = tuple[float, float]  # seconds of the thread, and of the clock

COUNT = 100_000
REPEATS = 40
TICK_MS, REBUILD_MS = 8.0, 50.0  # bounds


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, write the table, print it; 1 where a bound does not hold."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, help="a Markdown file for the table")
    parser.add_argument("--instances", type=int, default=COUNT)
    parser.add_argument("--repeats", type=int, default=REPEATS)
    args = parser.parse_args(argv)
    from ... import register
    from ...lipac_addon.demo import build

    register()
    build("mirror-city", args.instances)
    times = ticks(args.repeats) | rebuilds(args.repeats)
    table = report(times, args.instances)
    if args.output:
        args.output.write_text(table)
    print(table)
    medians = {name: statistics.median(thread for thread, _ in took) * 1000 for name, took in times.items()}
    return int(medians["camera"] > TICK_MS or medians["object"] > TICK_MS or medians.get("overlay", 0.0) > REBUILD_MS)


def now() -> Took:
    """The thread's clock and the wall's."""
    return time.thread_time(), time.perf_counter()


def since(start: Took) -> Took:
    """What passed on both."""
    thread, wall = now()
    return thread - start[0], wall - start[1]


def ticks(repeats: int) -> dict[str, list[Took]]:
    """Seconds of the ticks that read the scene, by what was edited before, and of all ticks meanwhile."""
    import bpy

    from ...lipac_addon.ui.jobs import live

    scene, layer = bpy.context.scene, bpy.context.view_layer
    city, tower = bpy.data.objects["City"], bpy.data.objects["Clock tower"]
    live.start()
    all_ticks: list[Took] = []
    first = _rounds(all_ticks)

    def moved(ob: Any) -> Callable[[], None]:
        return lambda: setattr(ob, "location", (ob.location[0] + 0.01, *ob.location[1:]))

    times: dict[str, list[Took]] = {"first": [max(first)]}
    for name, edit, count in (
        ("camera", moved(scene.camera), repeats),
        ("object", moved(tower), repeats),
        ("scatter", moved(city), max(3, repeats // 8)),
    ):
        times[name] = []
        for _ in range(count):
            edit()
            layer.update()  # Blender's own work after an edit
            times[name].append(max(_rounds(all_ticks, 1)))
    times["all"] = all_ticks
    live.stop()
    return times


def _rounds(all_ticks: list[Took], count: int = 10_000) -> list[Took]:
    """Tick until live mode rests, or so many rounds are done; seconds of the ticks."""
    from ...lipac_addon.ui.jobs import live

    took: list[Took] = []
    rounds = None
    while True:
        start = now()
        live.tick()
        took.append(since(start))
        current = live.current
        if current is None or current.error:
            raise SystemExit(f"live mode: {current.error if current else 'switched off'}")
        rounds = current.rounds if rounds is None else rounds
        if current.resting or current.rounds >= rounds + count:
            all_ticks += took
            return took
        time.sleep(0.005)


def rebuilds(repeats: int) -> dict[str, list[Took]]:
    """Seconds to lay out a box for every instance and send them to the graphics card; nothing where Blender cannot draw
    without a window."""
    import bpy
    import gpu

    from ...lipac_addon.ui.draw import overlay
    from ...lipac_addon.ui.state import results

    if not hasattr(gpu, "init"):
        return {}
    gpu.init()
    bpy.context.scene.lipac.policy = "distance"
    bpy.ops.lipac.analyze()
    result = results.at(bpy.context.scene)
    assert result is not None
    took = []
    for _ in range(repeats):
        overlay.forget()
        start = now()
        overlay.upload(result)
        took.append(since(start))
    return {"overlay": took}


def report(times: dict[str, list[Took]], count: int) -> str:
    """The table, as a page."""
    from .machine import stamp

    what = {
        "camera": ("tick that reads the scene after the camera moved", f"<= {TICK_MS:g} ms"),
        "object": ("the same after an object moved", f"<= {TICK_MS:g} ms"),
        "scatter": ("the same after all instances moved", ""),
        "first": ("the first one: everything is read", ""),
        "all": ("all ticks, also those that wait", ""),
        "overlay": (f"overlay: {count:,} boxes laid out and sent to the graphics card", f"< {REBUILD_MS:g} ms"),
    }
    rows = []
    for name, (text, bound) in what.items():
        if name in times:
            thread, wall = (statistics.median(t[k] for t in times[name]) * 1000 for k in (0, 1))
            rows.append(f"| {text} | {thread:.2f} ms | {wall:.2f} ms | {bound} |")
    head = f"{stamp('python -m lipac.scripts.studies.bench_live')} The demo city, {count:,} instances."
    return "\n".join(
        [
            "# Live mode, measured",
            "",
            head,
            "",
            "| median | main thread computes | clock | bound |",
            "|---|---:|---:|---:|",
            *rows,
            "",
        ]
    )


if __name__ == "__main__":
    sys.exit(main())
