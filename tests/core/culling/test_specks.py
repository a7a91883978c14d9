"""Emitters of less than a pixel, as bright as all else in a tile: that no path from the camera met one is no evidence
that nobody sees it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from lipac.core.culling.analysis import analyze
from lipac.core.culling.certificate import Certificate
from lipac.core.culling.loop import Loop
from lipac.core.culling.options import CullOptions
from lipac.core.error_budget.budget import Budget
from lipac.core.feedback.tiles import TILES
from lipac.core.scene import model as s

from .. import scenes
from ..scenes import material

SIZE = (160, 90)
SIDE = 0.004  # of a speck, metres: 0.03 pixels at 4 metres
RADIANCE = 3000.0  # a speck brings a tile eight times the light that it has from the wall
WALL, MIRROR, GLOW = range(3)
BUDGET = Budget(0.05, 0.1)


def facing(x: float, y: float, z: float, side: float = SIDE) -> np.ndarray:
    """A square that looks along -Y."""
    return np.array([[side, 0, 0, x], [0, 0, -side, y], [0, side, 0, z]], float)


def scattered(y: float, count: int = 40, seed: int = 3) -> list[tuple[int, np.ndarray, int]]:
    rng = np.random.default_rng(seed)
    x, z = rng.uniform(-1.4, 1.4, count), rng.uniform(-0.7, 0.7, count)
    return [(0, facing(a, y, b), GLOW) for a, b in zip(x.tolist(), z.tolist(), strict=True)]


def view(placement: list[tuple[int, np.ndarray, int]], limits: s.PathLimits) -> s.Scene:
    """Before a dim sky, seen from (0, -4, 0) along +Y; a speck of a tile would break the budget."""
    materials = [
        material(base_color=0.5),
        material(s.Shader.GLOSSY, base_color=1.0, roughness=0.0),
        material(s.Shader.EMISSION, emission=RADIANCE),
    ]
    camera = scenes.look_at((0, -4, 0), (0, 0, 0))
    return scenes.build([scenes.quad()], placement, materials, camera, None, (0.2, 0.2, 0.2), SIZE, limits)


def kept(placement: list[tuple[int, np.ndarray, int]], limits: s.PathLimits, seed: int) -> np.ndarray:
    """What stays of that."""
    return analyze(view(placement, limits), CullOptions(width=SIZE[0], seed=seed, max_error=BUDGET)).active


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


def test_of_two_that_hide_the_only_speck_one_stays() -> None:
    """Squares that look like the wall behind them. Without both a speck shows that no path from the camera meets, and
    that nobody saw before."""
    wall, speck = (0, facing(0, 3, 0, 60), WALL), (0, facing(0.02, 0, 0.02), GLOW)
    squares = [(0, facing(0.02, y, 0.02, 0.06), WALL) for y in (-0.5, -1.0)]
    scene = view([wall, speck, *squares], s.PathLimits(total=0))
    options, pinned = CullOptions(width=SIZE[0], max_error=BUDGET), np.arange(4) == 1
    assert analyze(scene, options, pinned=pinned).active[2:].any()
    loop = Loop(scene, options, pinned=pinned)
    loop.run()
    for one, revealed in ((True, False), (False, True)):
        certificate = Certificate(loop, 1000, np.full(TILES, 4), BUDGET)
        keep = np.array([True, True, one, False])
        assert (certificate.judge(keep).worst > 1) == revealed
        exchanged = certificate.judge_exchanged(loop.tracer, keep, loop.tracer.build(keep), BUDGET)
        assert (exchanged.worst > 1) == revealed


@pytest.mark.parametrize("exposure", [0.1, 10.0])
def test_exposure_makes_no_speck_brighter(exposure: float) -> None:
    scene = view([(0, facing(0, 3, 0, 60), WALL), *scattered(0), *scattered(5)], s.PathLimits(total=0))
    scene = dataclasses.replace(scene, film=s.Film(*SIZE, exposure=exposure))
    active = analyze(scene, CullOptions(width=SIZE[0], max_error=BUDGET)).active
    assert active[1:41].all()
    assert not active[41:].any()
