"""Pictures that are transparent, or smaller than their tiles."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from lipac.core.culling.analysis import analyze
from lipac.core.culling.options import CullOptions
from lipac.core.error_budget.budget import Budget
from lipac.core.feedback.tiles import TILES, tiles_of
from lipac.core.scene import model as s

from .. import scenes
from ..scenes import material
from .test_budget_cases import facing

SIZE = (96, 54)
STRIPES = 16


def strip(x: float, width: float, y: float = 0.0) -> np.ndarray:
    return facing((1, 0, 0), (0, -1, 0), (x, y, 0), width, 3.0)


@pytest.mark.parametrize("color", [0.0, 0.005])
def test_what_is_dark_before_a_transparent_film_stays(color: float) -> None:
    """Stripes, white and black by turns, all over the picture; without the black ones half of it would be transparent,
    and no darker."""
    step = 4 / STRIPES
    stripes = [(0, strip(step * (k / 2 + 0.25) - 2, step / 2), k % 2) for k in range(2 * STRIPES)]
    materials = [material(base_color=0.8), material(base_color=color)]
    camera = scenes.look_at((0, -4, 0), (0, 0, 0))
    scene = scenes.build([scenes.quad()], stripes, materials, camera, size=SIZE, limits=s.PathLimits(total=0))
    scene = dataclasses.replace(scene, film=s.Film(*SIZE, transparent=True))
    assert analyze(scene, CullOptions(width=SIZE[0])).active.all()


@pytest.mark.parametrize("size", [(240, 5), (4, 240), (8, 8), (1, 1)])
def test_a_picture_smaller_than_its_tiles_is_culled(size: tuple[int, int]) -> None:
    """What no path can meet goes, and specks of a wall's own colour, though paths meet them."""
    wall, speck = (
        facing((1, 0, 0), (0, -1, 0), (0, 0, 0), 90, 90),
        facing((1, 0, 0), (0, -1, 0), (0, -0.1, 0), 0.3, 0.3),
    )
    behind = [(1, scenes.placed((x, 5, 0)), 0) for x in range(3)]
    aspect = size[0] / size[1]
    camera = scenes.look_at((0, -4, 0), (0, 0, 0), 0.5 * min(aspect, 1.0), aspect)
    scene = scenes.build(
        [scenes.quad(), scenes.cube()],
        [(0, wall, 0), (0, speck, 0), *behind],
        [material()],
        camera,
        size=size,
        limits=s.PathLimits(total=0),
    )
    options = CullOptions(max_error=Budget(0.1, 0.5))
    width, height = options.picture_size(scene.film)
    assert (np.bincount(tiles_of(height, width).ravel(), minlength=TILES) > 0).all()
    result = analyze(scene, options)
    assert result.active.tolist() == [True, False, False, False, False]
