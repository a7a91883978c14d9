"""Emitters of less than a pixel, as bright as all else in a tile: that no path from the camera met one is no evidence
that nobody sees it."""

from __future__ import annotations

import numpy as np
import pytest

from lipac.core.culling.analysis import analyze
from lipac.core.culling.options import CullOptions
from lipac.core.error_budget.budget import Budget
from lipac.core.scene import model as s

from .. import scenes
from ..scenes import material

SIZE = (160, 90)
SIDE = 0.004  # of a speck, metres: 0.03 pixels at 4 metres
RADIANCE = 3000.0  # a speck brings a tile eight times the light that it has from the wall
WALL, MIRROR, GLOW = range(3)


def facing(x: float, y: float, z: float, side: float = SIDE) -> np.ndarray:
    """A square that looks along -Y."""
    return np.array([[side, 0, 0, x], [0, 0, -side, y], [0, side, 0, z]], float)


def scattered(y: float, count: int = 40, seed: int = 3) -> list[tuple[int, np.ndarray, int]]:
    rng = np.random.default_rng(seed)
    x, z = rng.uniform(-1.4, 1.4, count), rng.uniform(-0.7, 0.7, count)
    return [(0, facing(a, y, b), GLOW) for a, b in zip(x.tolist(), z.tolist(), strict=True)]


def kept(placement: list[tuple[int, np.ndarray, int]], limits: s.PathLimits, seed: int) -> np.ndarray:
    """What stays before a dim sky, seen from (0, -4, 0) along +Y; a speck of a tile would break the budget."""
    materials = [
        material(base_color=0.5),
        material(s.Shader.GLOSSY, base_color=1.0, roughness=0.0),
        material(s.Shader.EMISSION, emission=RADIANCE),
    ]
    camera = scenes.look_at((0, -4, 0), (0, 0, 0))
    scene = scenes.build([scenes.quad()], placement, materials, camera, None, (0.2, 0.2, 0.2), SIZE, limits)
    return analyze(scene, CullOptions(width=SIZE[0], seed=seed, max_error=Budget(0.05, 0.1))).active


@pytest.mark.parametrize("seed", [0, 1])
def test_specks_in_view_stay_and_those_behind_a_wall_go(seed: int) -> None:
    active = kept([(0, facing(0, 3, 0, 60), WALL), *scattered(0), *scattered(5)], s.PathLimits(total=0), seed)
    assert active[1:41].all()
    assert not active[41:].any()


@pytest.mark.parametrize("seed", [0, 1])
def test_specks_that_a_mirror_shows_stay(seed: int) -> None:
    """They hang behind the camera's back and light the wall beside the mirror, by which light sampling knows them."""
    mirror, below = (0, facing(0, 0, 0, 60), MIRROR), (0, facing(0, -0.01, -0.9, 0.5), WALL)
    active = kept([mirror, below, *scattered(-4.5, 60)], s.PathLimits(total=1, glossy=1), seed)
    assert active[2:].all()
