"""The overlay: which boxes, in which colour, in how many draw calls; pixels of an offscreen picture where Blender can
draw without a window."""

from itertools import pairwise
from types import SimpleNamespace

import bpy
import gpu
import numpy as np
import pytest
from mathutils import Matrix

from lipac.lipac_addon.ui.draw import overlay
from lipac.lipac_addon.ui.draw.boxes import COLORS, HEAT, KINDS, ROW, boxes_of, color_of
from lipac.lipac_addon.ui.state import results

from ...conftest import need_graphics

SIZE = 128


A, P, C = results.ACTIVE, results.PENDING, results.CULLED


def result_of(bounds, regions, state, origin=(0.0, 0.0, 0.0), hits=None):
    arrays = {"bounds": np.array(bounds, np.float32), "regions": np.array(regions, np.float32).reshape(-1, 2, 3)}
    hits = np.zeros((len(bounds), 5), np.int64) if hits is None else np.array(hits)
    return SimpleNamespace(**arrays, state=np.array(state, np.uint8), origin=np.array(origin), hits=hits)


def unit_box(x, y, z=0.0, size=1.0):
    return [(x, y, z), (x + size, y + size, z + size)]


def test_boxes_kind_by_kind():
    bounds = [unit_box(k, 0) for k in range(4)] + [[(np.nan,) * 3] * 2, [(1, 1, 1), (0, 0, 0)]]
    boxes = boxes_of(result_of(bounds, [unit_box(9, 9)], [A, C, A, P, C, C]))
    assert boxes.ranges == ((0, 2), (2, 1), (3, 1), (4, 1))  # what has no extent is not drawn
    lows = boxes.texels.reshape(-1, 2, 4)[:5, 0, 0].tolist()
    assert lows == [0.0, 2.0, 3.0, 9.0, 1.0]
    assert boxes.texels.shape == (1, 2 * ROW, 4)


def test_regions_are_told_from_the_heat_map():
    ramp = np.concatenate([np.linspace(a, b, 20) for a, b in pairwise(HEAT)])
    assert np.linalg.norm(ramp - color_of("regions", heat_map=True), axis=1).min() > 0.5
    assert color_of("regions") == COLORS["regions"]


@pytest.mark.parametrize("count", [0, 1, ROW, ROW + 1])
def test_rows_of_the_texture(count):
    boxes = boxes_of(result_of(np.zeros((count, 2, 3)), [], np.full(count, A)))
    assert boxes.texels.shape[0] == max(1, -(-count // ROW))
    assert boxes.ranges[0] == (0, count)


def test_colours_are_told_apart_by_the_colour_blind():
    """By Machado, Oliveira and Fernandes' matrices (2009, severity 1) for protanopia and deuteranopia, in linear
    light."""
    matrices = (
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
    )
    for matrix in (np.eye(3), *map(np.array, matrices)):
        seen = [lab(matrix @ [overlay._to_linear(x) for x in COLORS[kind]]) for kind in KINDS]
        # CIE 1976; 2.3 is a just noticeable difference
        assert min(np.linalg.norm(a - b) for i, a in enumerate(seen) for b in seen[:i]) > 40


def lab(linear):
    """CIELAB (D65) of linear Rec.709."""
    xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]) @ linear
    t = np.maximum(xyz, 0.0) / (0.9505, 1.0, 1.089)
    f = np.where(t > 0.008856, np.cbrt(t), 7.787 * t + 16 / 116)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def test_filters_freeze_and_legend(analyzed):
    settings, result = analyzed.lipac, results.at(analyzed)
    assert overlay.shown(settings) == ("active", "pending", "regions")
    settings.show_culled, settings.show_active = True, False
    assert overlay.shown(settings) == ("pending", "regions", "culled")
    assert overlay.legend_of(result, KINDS)[0] == ("active", "active: 6 instances")
    assert overlay.source(analyzed) is result
    settings.freeze = True
    analyzed.frame_set(5)
    bpy.ops.lipac.analyze()
    assert overlay.source(analyzed) is result
    settings.freeze = False
    assert overlay.source(analyzed) is results.at(analyzed) is not result
    analyzed.frame_set(6)
    assert overlay.source(analyzed) is None


@pytest.fixture
def canvas(ui):
    """Draws with a function into a SIZE x SIZE picture; returns it, (SIZE, SIZE, 4) uint8, rows bottom up."""
    need_graphics()
    offscreen = gpu.types.GPUOffScreen(SIZE, SIZE, format="RGBA8")

    def run(draw):
        with offscreen.bind():
            frame = gpu.state.active_framebuffer_get()
            frame.clear(color=(0.0, 0.0, 0.0, 1.0), depth=1.0)
            draw()
            return np.array(frame.read_color(0, 0, SIZE, SIZE, 4, 0, "UBYTE").to_list(), np.uint8)

    yield run
    overlay.forget()
    offscreen.free()


def colour(kind, opacity=1.0, heat_map=False):
    return np.round(np.array(color_of(kind, heat_map)) * 255 * opacity)


def counts(picture, heat_map=False):
    """Pixels of each kind's colour."""
    return {
        kind: int((np.abs(picture[..., :3] - colour(kind, heat_map=heat_map)).max(axis=2) <= 1.0).sum())
        for kind in KINDS
    }


# From above, orthographic: 8 metres fill the picture, so a metre is 16 pixels.
ABOVE = Matrix(((0.25, 0, 0, -1), (0, 0.25, 0, -1), (0, 0, -0.05, 0), (0, 0, 0, 1)))
FOUR = ([unit_box(1, 1), unit_box(5, 1), unit_box(5, 5)], [unit_box(1, 5, size=2.0)], [A, C, P])


def test_pixels_carry_the_colour_of_their_state(canvas):
    picture = canvas(lambda: overlay.draw_boxes(result_of(*FOUR), KINDS, 1.0, ABOVE))
    # The outline of a box of n pixels has about 4 n; a pixel more or less per side is the rasterizer's choice.
    for kind, pixels in (("active", 64), ("culled", 64), ("pending", 64), ("regions", 128)):
        assert abs(counts(picture)[kind] - pixels) <= 8
    rows, columns = np.nonzero(np.abs(picture[..., :3] - colour("active")).max(axis=2) <= 1)
    assert (rows.min(), columns.min()) >= (15, 15)
    assert (rows.max(), columns.max()) <= (33, 33)


def test_filter_and_opacity(canvas):
    half = canvas(lambda: overlay.draw_boxes(result_of(*FOUR), ("culled",), 0.5, ABOVE))
    assert counts(half) == dict.fromkeys(KINDS, 0)
    # from above, the edges of lid and floor lie on one another
    twice = np.abs(half[..., :3] - colour("culled", 0.75)).max(axis=2) <= 2.0
    assert abs(twice.sum() - 64) <= 8


@pytest.mark.parametrize("in_front", [True, False])
def test_behind_geometry(canvas, in_front):
    def draw():
        gpu.state.active_framebuffer_get().clear(depth=0.0)  # as if a wall stood before all
        overlay.draw_boxes(result_of(*FOUR), KINDS, 1.0, ABOVE, in_front)

    assert (counts(canvas(draw))["active"] > 0) == in_front


def test_heat_map(canvas):
    """Four boxes side by side, met by no path, some, most, and a region, which has its own colour."""
    hits = np.zeros((3, 5), np.int64)
    hits[1, 0], hits[2, :2] = 99, (5000, 4999)
    result = result_of([unit_box(0.5 + 2 * k, 1) for k in range(3)], [unit_box(1, 5, size=2.0)], [C, A, A], hits=hits)
    picture = canvas(lambda: overlay.draw_boxes(result, KINDS, 1.0, ABOVE, heat_map=True))
    ramp = HEAT[3] + (HEAT[4] - HEAT[3]) * 0.5  # log 100 is half of log 10,000
    for k, color in enumerate((HEAT[0], ramp, HEAT[-1])):
        part = picture[:48, 32 * k : 32 * (k + 1), :3]
        assert abs((np.abs(part - np.round(255 * color)).max(axis=2) <= 2).sum() - 64) <= 8, k
    assert abs(counts(picture, heat_map=True)["regions"] - 128) <= 8
    assert boxes_of(result).hottest == 9999


def test_far_from_the_origin(canvas):
    there = (1e6, -2e6, 0.0)
    matrix = np.array(ABOVE, np.float64) @ np.array(
        [[1, 0, 0, -there[0]], [0, 1, 0, -there[1]], [0, 0, 1, 0], [0, 0, 0, 1]], np.float64
    )
    here = canvas(lambda: overlay.draw_boxes(result_of(*FOUR), KINDS, 1.0, ABOVE))
    far = canvas(lambda: overlay.draw_boxes(result_of(*FOUR, origin=there), KINDS, 1.0, matrix))
    np.testing.assert_array_equal(here, far)


def test_the_viewports_switch_of_all_overlays_counts(canvas, analyzed):
    area = next(a for a in bpy.context.screen.areas if a.type == "VIEW_3D")
    switch, region = area.spaces.active.overlay, next(r for r in area.regions if r.type == "WINDOW")
    analyzed.lipac.show_overlay = True
    analyzed.lipac.in_front = True
    for on in (True, False):
        switch.show_overlays = on
        with bpy.context.temp_override(area=area, region=region):
            seen = [canvas(draw)[..., :3].any() for draw in (overlay._draw_view, overlay._draw_pixels)]
        assert seen[0] == on
        assert seen == [on, on]
    switch.show_overlays = True


def test_draw_calls_are_constant_and_boxes_are_sent_once(canvas):
    bounds = np.random.default_rng(0).uniform(0, 8, (20_000, 1, 3)) + np.array([[0.0] * 3, [0.1] * 3])
    result = result_of(bounds, bounds[:500], np.arange(20_000) % 3)
    before, calls = overlay.uploads, []
    for _ in range(3):
        picture = canvas(lambda: calls.append(overlay.draw_boxes(result, KINDS, 1.0, ABOVE)))
    assert calls == [4, 4, 4]
    assert overlay.uploads == before + 1
    assert counts(picture)["culled"] > 1000  # all rows of the texture are reached


def test_legend_is_in_the_colours_of_the_boxes(canvas):
    result = result_of(*FOUR)

    def draw():
        with gpu.matrix.push_pop(), gpu.matrix.push_pop_projection():
            gpu.matrix.load_matrix(Matrix.Identity(4))
            gpu.matrix.load_projection_matrix(
                Matrix(((2 / SIZE, 0, 0, -1), (0, 2 / SIZE, 0, -1), (0, 0, -1, 0), (0, 0, 0, 1)))
            )
            overlay.draw_legend(result, ("active", "culled"))

    found = counts(canvas(draw))
    assert found["active"] == found["culled"] == 144  # swatches of 12 x 12
    assert found["regions"] == 0


def test_legend_of_the_heat_map(canvas):
    result = result_of(*FOUR)

    def draw():
        overlay.upload(result)
        with gpu.matrix.push_pop(), gpu.matrix.push_pop_projection():
            gpu.matrix.load_matrix(Matrix.Identity(4))
            gpu.matrix.load_projection_matrix(
                Matrix(((2 / SIZE, 0, 0, -1), (0, 2 / SIZE, 0, -1), (0, 0, -1, 0), (0, 0, 0, 1)))
            )
            overlay.draw_legend(result, KINDS, heat_map=True)

    picture = canvas(draw)
    swatches = counts(picture[:, :33], heat_map=True)  # the text beside them is grey, too
    assert [swatches[kind] for kind in ("active", "culled", "regions")] == [0, 0, 144]
    bar = picture[46, 20:140, :3].astype(float)  # the line above the regions' swatch
    luminance = bar @ (0.2126, 0.7152, 0.0722)
    assert (np.diff(luminance) >= -1).all()
    assert luminance[-1] - luminance[0] > 90
