"""What live culling costs the main thread: the second table of docs/viewport.md, for `flight`."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Sequence

import numpy as np

from .clock import Clock, look, settle

INTERVAL = 0.04  # seconds between ticks, as of live mode


def costs(sizes: Sequence[int]) -> list[str]:
    """The lines about what a change of the set costs."""
    import bpy

    from ....lipac_addon.demo import build
    from ....lipac_addon.ui.jobs import live

    lines = [
        "What a change of the set costs the main thread: Blender evaluates the scatter anew, as after any edit of it.",
        "While nothing changes, [live.md](live.md) holds. After a change nothing changes for four times as long.",
        "",
        "Deciding what the set is to be is spread over ticks, and beyond 20,000 instances arrays are a thread's; of it",
        "what the main thread computes, where the others are by the clock.",
        "",
        "| instances, the least of several | scatter evaluated in full | one change of the set | deciding it, most of "
        "a tick | all ticks of it |",
        "|---:|---:|---:|---:|---:|",
    ]
    for size in sizes:
        build("mirror-city", size)
        scene, layer = bpy.context.scene, bpy.context.view_layer
        layer.update()
        city = bpy.data.objects["City"]
        plain = [timed(lambda: (city.update_tag(refresh={"DATA"}), layer.update())) for _ in range(5)]  # noqa: B023
        look()
        scene.lipac.cull_viewport = True
        with Clock() as clock:
            live.start()
            settle(clock)
            assert live.current is not None
            culling = live.current.culling
            result = culling._result
            assert result is not None
            out = culling.switches.out
            fewer = type(out)(
                out.objects, {uid: gone & (np.arange(len(gone)) % 2 == 0) for uid, gone in out.rows.items()}
            )
            changed = [
                timed(lambda: culling.switches.change(layer, wanted, lambda uid: culling._places_of(result, uid)))  # noqa: B023
                for wanted in (fewer, out) * 3
            ]
            decided = [steps(culling._decide(scene, result)) for _ in range(5)]
            live.stop()
        took = plain, changed, [max(one) for one in decided], [sum(one) for one in decided]
        ms = [f"{1000 * min(each):.0f} ms" if each is not took[2] else f"{1000 * min(each):.1f} ms" for each in took]
        lines.append(f"| {size:,} | {' | '.join(ms)} |")
    return lines


def steps(work: Generator[None, None, object]) -> list[float]:
    """Seconds that the main thread computes in the steps of a generator; it does nothing between them."""
    took = []
    while True:
        start = time.thread_time()
        ended = next(work, None) is None and getattr(work, "gi_frame", None) is None
        took.append(time.thread_time() - start)
        if ended:
            return took
        time.sleep(INTERVAL)


def timed(work: Callable[[], object]) -> float:
    """Seconds that work takes."""
    start = time.perf_counter()
    work()
    return time.perf_counter() - start
