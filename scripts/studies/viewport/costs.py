"""What live culling costs the main thread: the last tables of docs/viewport.md, for `flight`."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from .clock import Clock, look, settle

if TYPE_CHECKING:
    from ....lipac_addon.ui.jobs.viewport_culling import ViewportCulling
    from ....lipac_addon.ui.jobs.viewport_switches import OutSet

INTERVAL = 0.04  # seconds between ticks, as of live mode
REPEATS = 9
FEW, EYES = 100, (1_000, 3_000, 10_000)  # every so many of the rows come back; objects of a view layer


SCATTERS = f"""\
## What a change of the set costs

Processor time of the main thread in the tick that makes the change, the least of {REPEATS}. Blender evaluates a
scatter as a whole whenever a row of it comes or goes, as it does after any edit; the second column is that alone, with
nothing culled. While the set does not change, the figures of [live.md](live.md) hold. After a change, nothing changes
again for four times as long as it took.

| instances | Blender evaluates the scatter | 1 % of the rows go | 1 % come back | half come back | the first change \
| a tick that decides, at most |
|---:|---:|---:|---:|---:|---:|---:|"""
LAYERS = """
The goal is 8 ms a tick at 100,000 instances. The first change of a scatter also makes its mask, for which Blender sorts
its data-blocks anew. Scatters of more than 100,000 rows in all change one after the other, in ticks of their own.

Objects are hidden by their eyes in the view layer. When one of these changes, Blender evaluates the whole layer, and it
walks over the layer for each. The number of eyes in a tick is limited so that the walks take no longer than that; what
comes back is shown first, the largest in view before the others.

| objects | a tick that closes one eye | of it evaluating the layer | eyes in a tick, at most \
| a tick that closes so many |
|---:|---:|---:|---:|---:|"""


def costs(sizes: Sequence[int]) -> list[str]:
    """The lines about what a change of the set costs."""
    return [SCATTERS, *map(of_a_scatter, sizes), LAYERS, *map(of_objects, EYES)]


def of_a_scatter(size: int) -> str:
    """A row of the first table, for the city with so many instances."""
    import bpy

    from ....lipac_addon.demo import build
    from ....lipac_addon.ui.jobs import live

    build("mirror-city", size)
    scene, layer = bpy.context.scene, bpy.context.view_layer
    layer.update()
    city = bpy.data.objects["City"]
    plain = [computed(lambda: (city.update_tag(refresh={"DATA"}), layer.update())) for _ in range(REPEATS)]
    look()
    scene.lipac.cull_viewport = True
    with Clock() as clock:
        live.start()
        settle(clock)
        assert live.current is not None
        culling = live.current.culling
        assert culling._result is not None
        out = culling.switches.out
        few, half = (with_back(out, every) for every in (FEW, 2))
        pairs = [(changing(culling, few), changing(culling, out)) for _ in range(REPEATS)]
        halves = [(changing(culling, half), changing(culling, out))[0] for _ in range(REPEATS)]
        first = []
        for _ in range(REPEATS):
            culling.switches.all_back(layer)
            first.append(changing(culling, out))
        decided = [max(steps(culling._decide(scene, culling._result))) for _ in range(REPEATS)]
        live.stop()
    back, gone = zip(*pairs, strict=True)
    return f"| {size:,} | " + " | ".join(ms(each) for each in (plain, gone, back, halves, first, decided)) + " |"


def of_objects(count: int) -> str:
    """A row of the second table, for a layer of so many triangles."""
    import bpy

    from ....lipac_addon.ui.jobs.viewport_culling import PART
    from ....lipac_addon.writeback import viewport

    bpy.ops.wm.read_factory_settings(use_empty=True)
    mesh, layer = bpy.data.meshes.new("triangle"), bpy.context.view_layer
    mesh.from_pydata([(0, 0, 0), (1, 0, 0), (0, 1, 0)], [], [(0, 1, 2)])
    for k in range(count):
        ob = bpy.data.objects.new("triangle", mesh)
        ob.location.x = k
        bpy.context.scene.collection.objects.link(ob)
    layer.update()
    eyes, took = min(PART // count, count), {}
    for many in (1, eyes):
        chosen, found = list(layer.objects)[:many], []
        for _ in range(REPEATS):
            closing = computed(lambda: viewport.close_eyes(layer, chosen))  # noqa: B023
            found.append((closing, computed(layer.update)))
            viewport.open_eyes(layer, chosen)
            layer.update()
        took[many] = [a + b for a, b in found], [b for _, b in found]
    return f"| {count:,} | {ms(took[1][0])} | {ms(took[1][1])} | {eyes:,} | {ms(took[eyes][0])} |"


def with_back(out: OutSet, every: int) -> OutSet:
    """The same set, but for every so many of the rows that are out."""
    rows = {uid: gone.copy() for uid, gone in out.rows.items()}
    for gone in rows.values():
        gone[np.flatnonzero(gone)[::every]] = False
    return type(out)(out.objects, rows)


def changing(culling: ViewportCulling, wanted: OutSet) -> float:
    """Seconds that a change of the set to another takes."""
    import bpy

    from ....lipac_addon.ui.jobs.viewport_culling import places_of

    result, layer = culling._result, bpy.context.view_layer
    assert result is not None
    return computed(lambda: culling.switches.change(layer, wanted, lambda uid: places_of(culling._places, result, uid)))


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


def computed(work: Callable[[], object]) -> float:
    """Seconds that the main thread computes for some work."""
    start = time.thread_time()
    work()
    return time.thread_time() - start


def ms(seconds: Sequence[float]) -> str:
    """The least, in milliseconds: what else a machine does only ever makes one longer."""
    return f"{1000 * min(seconds):.1f} ms"
