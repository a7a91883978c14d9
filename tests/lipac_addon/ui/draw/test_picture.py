"""Over the picture in the camera's view: tiles where they are in it, the worst the brightest; who takes the memory."""

from types import SimpleNamespace

import bpy
import gpu
import numpy as np
import pytest
from mathutils import Matrix

from lipac.lipac_addon.ui.draw import overlay, picture
from lipac.lipac_addon.ui.draw.boxes import HEAT
from lipac.lipac_addon.ui.state import results

from ...conftest import need_graphics

SIZE = 144
PIXELS = Matrix(((2 / SIZE, 0, 0, -1), (0, 2 / SIZE, 0, -1), (0, 0, -1, 0), (0, 0, 0, 1)))


@pytest.fixture
def canvas(ui):
    """Draws in pixels into a black SIZE x SIZE picture; returns it, (SIZE, SIZE, 3) uint8, rows bottom up."""
    need_graphics()
    offscreen = gpu.types.GPUOffScreen(SIZE, SIZE, format="RGBA8")

    def run(draw):
        with offscreen.bind(), gpu.matrix.push_pop(), gpu.matrix.push_pop_projection():
            gpu.matrix.load_matrix(Matrix.Identity(4))
            gpu.matrix.load_projection_matrix(PIXELS)
            frame = gpu.state.active_framebuffer_get()
            frame.clear(color=(0.0, 0.0, 0.0, 1.0))
            draw()
            return np.array(frame.read_color(0, 0, SIZE, SIZE, 4, 0, "UBYTE").to_list(), np.uint8)[..., :3]

    yield run
    offscreen.free()


def test_tiles_lie_where_they_are_in_the_picture(canvas):
    """The worst is that of column 2, row 1 from the bottom: there, and as bright as the map's end."""
    tiles = np.zeros(144, np.float32)
    tiles[1 * 16 + 2] = 0.04
    seen = canvas(lambda: picture.draw_tiles(tiles, (0.0, 0.0, SIZE, SIZE))).astype(int)
    alike = np.abs(seen[16:32, 18:27] - np.round(255 * picture.DENSE * HEAT[-1])).max(axis=2) <= 2
    assert alike.mean() > 0.5  # the rest is the figure
    rest = np.ones((SIZE, SIZE), bool)
    rest[16:32, 18:] = False  # the figure may be wider than the tile
    assert seen[rest].max() <= 255 * picture.FAINT


def test_tiles_that_do_not_change_are_no_tiles_that_do():
    color, share = picture.shade(np.zeros(144, np.float32))
    assert not share.any() and np.allclose(color[:, 3], picture.FAINT)


def test_the_list_of_memory(canvas, analyzed):
    rows = results.at(analyzed).memory
    lines = picture.takers(results.at(analyzed))
    assert 0 < len(lines) <= picture.TAKERS
    largest = max((row for row in rows if row.kind in ("object", "image")), key=lambda row: row.bytes)
    assert lines[0].endswith(largest.name)
    seen = canvas(lambda: picture.draw_takers(lines, SIZE, SIZE))
    assert seen[SIZE // 2 :].max() > 200 and not seen[0].any()


def test_the_frame_of_the_camera_in_the_viewport(analyzed):
    """In a region of 400 x 300 pixels the picture, as wide as the view, lies in the middle."""
    bpy.context.view_layer.update()
    camera, render = analyzed.camera, analyzed.render
    graph = bpy.context.evaluated_depsgraph_get()
    wide = camera.calc_matrix_camera(graph, x=render.resolution_x, y=render.resolution_y)
    aspect = render.resolution_x / render.resolution_y
    up = Matrix.Diagonal((1, 400 / aspect / 300, 1, 1))  # the region is higher than the picture
    view = SimpleNamespace(
        view_perspective="CAMERA", perspective_matrix=up @ wide @ camera.matrix_world.normalized().inverted()
    )
    context = SimpleNamespace(
        scene=analyzed,
        region=SimpleNamespace(width=400, height=300),
        region_data=view,
        space_data=SimpleNamespace(use_local_camera=False, camera=None),
        evaluated_depsgraph_get=lambda: graph,
    )
    half = 200 / aspect
    assert picture.camera_frame(context) == pytest.approx((0, 150 - half, 400, 150 + half), abs=0.5)
    view.view_perspective = "PERSP"
    assert picture.camera_frame(context) is None


def test_tiles_are_drawn_by_their_switch_and_in_the_cameras_view_alone(analyzed, monkeypatch):
    drawn = []
    monkeypatch.setattr(picture, "draw_tiles", lambda *_: drawn.append("tiles"))
    monkeypatch.setattr(picture, "draw_takers", lambda *_: drawn.append("memory"))
    assert results.at(analyzed).tiles is None  # by distance nothing is certified
    analyzed.lipac.policy = "light-paths"
    bpy.ops.lipac.analyze()
    result = results.at(analyzed)
    assert result.tiles.shape == (144,)
    assert float(result.tiles.max()) <= result.stats["certified_worst"] + 1e-6
    context = SimpleNamespace(
        scene=analyzed,
        preferences=SimpleNamespace(system=SimpleNamespace(ui_scale=1.0)),
        region=SimpleNamespace(width=9, height=9),
    )
    frame = (0.0, 0.0, 9.0, 9.0)
    for tiles, memory, seen in ((False, False, []), (True, False, ["tiles"]), (True, True, ["tiles", "memory"])):
        analyzed.lipac.show_tiles, analyzed.lipac.show_memory = tiles, memory
        for where in (frame, None):
            monkeypatch.setattr(picture, "camera_frame", lambda _, where=where: where)
            drawn.clear()
            picture.draw(context, result)
            assert drawn == (seen if where else [])


def test_the_overlay_draws_it(analyzed, monkeypatch):
    """With the legend, after all boxes."""
    calls = []
    monkeypatch.setattr(overlay, "draw_legend", lambda *_: None)
    monkeypatch.setattr(picture, "draw", lambda *_: calls.append("picture"))
    analyzed.lipac.show_overlay = True
    area = next(a for a in bpy.context.screen.areas if a.type == "VIEW_3D")
    region = next(r for r in area.regions if r.type == "WINDOW")
    with bpy.context.temp_override(area=area, region=region):
        overlay._draw_pixels()
    assert calls == ["picture"]
