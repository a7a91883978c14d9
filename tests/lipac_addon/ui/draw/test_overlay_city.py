"""The picture of the TLAS: the demo city's overlay, frozen, seen from outside over the viewport, and what of it is
where."""

import bpy
import numpy as np
import pytest

from lipac.lipac_addon.demo import mirror_city
from lipac.lipac_addon.ui.draw import overlay
from lipac.lipac_addon.ui.draw.boxes import COLORS, CORNERS, EDGES
from lipac.lipac_addon.ui.state import results
from lipac.scripts.dev.guide_pictures import outside, overlay_picture

from ...conftest import need_graphics

WIDTH, HEIGHT = 480, 270
# Which state's colour there is more of in each part of the picture, from the top: a(ctive), r(egions), nothing.
EXPECTED = """
...rrrrrarrrrrrrrrrrrrrrrrrrrrrr
rrrrrrrrrraarrrrrrrrrrrrrrrrrrrr
rrrrrrraaaaaarrrrrrrrrrrrrrrrrrr
rrrrrrrrraaaaarrrrrrrrrrrrrrrrrr
rrrrrrarrraaaarrrrrrrrrrrrrrrrrr
rrrrr.aaaaaaaaaaarrrrrrrrrrrrrrr
rrrrrrraaaaaaaaaaarrrrrrrrrrrrrr
rrrrrrrraraaaaaaaarrrrrrrrrrrrrr
rrrrrrrrraaaaaaaaaaaaarrrrrrrrrr
rrrrrrrrrraaarraaaaaaarrrrrrrrrr
rrrrrrrrrrrrraraaaaaaaarrrrrrrrr
rrrrrrrrrrr.aaarraaaaaaaarrrrrrr
rrrrrrrrrrr.rrrrrraaaaaaarrrrrrr
rrrrrrrrrrrrrraaarraaaaaaaaarrrr
rrrrrrrrrrrrrrraarrrraaaaaaarrrr
...............rrarrrraraaaraarr
..............rr.aaarrraaaaaaaar
..............rrr.aaarrrraaaaaar
"""


@pytest.fixture(scope="module")
def city():
    """The result of the city, frozen, and the picture: (HEIGHT, WIDTH, 3) uint8, rows from the top."""
    import lipac

    need_graphics()
    lipac.register()
    try:
        mirror_city.build(1500, 0)
        scene = bpy.context.scene
        scene.lipac.width = 120
        bpy.ops.lipac.analyze()
        scene.lipac.freeze = True
        analysed = results.at(scene)
        scene.frame_set(2)  # the frozen state stays where the scene goes on
        result = overlay.source(scene)
        assert result is analysed
        yield result, overlay_picture(result, WIDTH, HEIGHT, opacity=1.0)[::-1]
    finally:
        lipac.unregister()
        bpy.ops.wm.read_factory_settings(use_empty=True)


def is_colour(picture, kind):
    """(H, W) bool, but for the legend's corner."""
    found = np.abs(picture.astype(float) - np.array(COLORS[kind]) * 255).max(axis=2) <= 2
    found[HEIGHT - 50 :, :220] = False
    return found


def outline(boxes):
    """(H, W) bool: pixels within one of an edge of boxes (n, 2, 3) in the world, by projecting points on all edges in
    double precision."""
    view, projection = (np.array(m, np.float64) for m in outside(WIDTH / HEIGHT))
    corners = np.where(CORNERS[None] > 0, boxes[:, 1, None], boxes[:, 0, None]).astype(np.float64)
    t = np.linspace(0, 1, 400)[:, None]
    ends = corners[:, EDGES]  # (n, 12, 2, 3)
    points = (ends[:, :, 0, None] * (1 - t) + ends[:, :, 1, None] * t).reshape(-1, 3)
    clip = np.column_stack([points, np.ones(len(points))]) @ (projection @ view).T
    clip = clip[clip[:, 3] > 1.0]
    x, y = ((clip[:, k] / clip[:, 3] * 0.5 + 0.5) * size for k, size in ((0, WIDTH), (1, HEIGHT)))
    hit = np.zeros((HEIGHT + 2, WIDTH + 2), bool)
    inside = (x >= -1) & (x < WIDTH + 1) & (y >= -1) & (y < HEIGHT + 1)
    hit[np.floor(y[inside]).astype(int) + 1, np.floor(x[inside]).astype(int) + 1] = True
    wide = sum(np.roll(hit, (dy, dx), (0, 1)) for dy in (-1, 0, 1) for dx in (-1, 0, 1)) > 0
    return wide[1:-1, 1:-1][::-1]


def test_colours_lie_on_the_boxes_of_their_state(city):
    result, picture = city
    bounds = result.bounds.astype(np.float64) + result.origin
    for kind, boxes in (
        ("active", bounds[result.state == results.ACTIVE]),
        ("regions", result.regions + result.origin),
    ):
        seen = is_colour(picture, kind)
        assert seen.sum() > 1000
        assert not (seen & ~outline(boxes)).any(), kind
    # Regions are drawn after the active ones: of these all is seen that no region covers
    alone = outline(bounds[result.state == results.ACTIVE][:40]) & ~outline(result.regions + result.origin)
    # an edge takes one or two of the three pixels
    assert (is_colour(picture, "active") & alone).sum() > 0.25 * alone.sum()


def test_what_is_where(city):
    """Compared with what was looked at and stored: the street that the mirror shows is active, all else is regions."""
    _, picture = city
    rows, columns = 18, 32
    colours = {
        kind: is_colour(picture, kind)[:270, :480].reshape(rows, 15, columns, 15).sum(axis=(1, 3))
        for kind in ("active", "regions")
    }
    most = np.where(colours["active"] > colours["regions"], "a", "r")
    most[(colours["active"] + colours["regions"]) < 3] = "."
    found = ["".join(row) for row in most]
    expected = EXPECTED.split()
    pairs = [(a, b) for x, y in zip(found, expected, strict=True) for a, b in zip(x, y, strict=True)]
    both, either = (
        sum(test(a == "a", b == "a") for a, b in pairs) for test in (lambda a, b: a and b, lambda a, b: a or b)
    )
    assert sum(a == b for a, b in pairs) >= 0.85 * rows * columns, "\n".join(found)
    assert both >= 0.6 * either, "\n".join(found)
