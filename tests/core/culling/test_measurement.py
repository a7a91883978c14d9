"""What no path met in a mirror: kept where, by how often others were met, more of it is likely there."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from lipac.core.culling.analysis import analyze
from lipac.core.culling.measurement import DARKNESS, Measurement, evidence, likely_missed
from lipac.core.culling.options import CullOptions
from lipac.core.error_budget.budget import Budget
from lipac.core.feedback.tiles import TILES
from lipac.core.scene import model as s

from .. import scenes
from ..scenes import material

SIZE = (160, 90)
SHADOW_HITS = 50


def measured(mirror_hits: list[int]) -> tuple[Measurement, s.Scene]:
    """As after a trace with 16 paths per pixel, of as many specks beside a mirror, each met so often by way of it, and
    by light sampling too."""
    n = len(mirror_hits)
    placement = [(0, scenes.placed((0, 0, 0), 5), 0), *((0, scenes.placed((x, 0, 1), 0.01), 1) for x in range(n))]
    materials = [
        material(s.Shader.GLOSSY, base_color=1.0, roughness=0.0),
        material(s.Shader.EMISSION, emission=1e4),
    ]
    camera = scenes.look_at((0, -4, 2), (0, 0, 0))
    scene = scenes.build([scenes.quad()], placement, materials, camera, None, (0.2, 0.2, 0.2), SIZE)
    ids = np.arange(n + 1, dtype=np.int32)
    hits = np.zeros((n + 1, s.RAY_TYPES), np.int64)
    hits[1:, s.RayType.GLOSSY], hits[1:, s.RayType.SHADOW] = mirror_hits, SHADOW_HITS
    paths = 16 * SIZE[0] * SIZE[1] // TILES
    found: Any = SimpleNamespace(
        paths_met=lambda: hits.sum(axis=1),
        tlas=SimpleNamespace(ids=ids, entry_of=lambda _n: ids),
        emissive=ids[1:].astype(np.int64),
        samples=np.full(TILES, 16),
        weights=SimpleNamespace(total=np.full(TILES, 0.2 * paths), known=np.ones(TILES), unit=1.0),
        feedback=SimpleNamespace(hits=hits),
    )
    return cast(Measurement, found), scene


@pytest.mark.parametrize(
    ("mirror_hits", "stay"),
    [
        ([0, 1, 1, 2, 3, 5, 0], [1, 7]),  # by chance, as it seems: others may have been missed
        ([0, 9, 14, 12, 30, 10, 0], []),  # who sees one sees it often
        ([0, 0, 0, 0], []),  # no mirror shows any
    ],
)
def test_what_no_mirror_ray_met_stays_where_others_were_met_by_chance(mirror_hits: list[int], stay: list[int]) -> None:
    met, missed = evidence(*measured(mirror_hits), SIZE, Budget(0.01, 0.05))
    assert missed.tolist() == stay
    if any(mirror_hits):
        assert met[1:].tolist() == mirror_hits  # light sampling's hits are no evidence here
    else:
        assert (met[1:] == SHADOW_HITS).all()


@pytest.mark.parametrize(("mirror_hits", "stays"), [([9, 14, 12], True), ([0, 0, 0], False)])
def test_what_a_mirror_shows_may_hide_what_it_would_show(mirror_hits: list[int], stays: bool) -> None:
    """Entry 0 is met by way of a mirror: it stays where specks are met there, too."""
    found, scene = measured(mirror_hits)
    found.feedback.hits[0, s.RayType.GLOSSY] = 1
    assert evidence(found, scene, SIZE, Budget(0.01, 0.05))[1].tolist() == [0] * stays


def test_how_many_are_missed_is_no_overestimate_and_right_where_all_are_alike() -> None:
    """Of 400 things that are each met three times on average, 400 / e**3 are not: 20, by a deviation of 4.4."""
    rng = np.random.default_rng(2)
    estimates = [likely_missed(rng.poisson(3.0, 400)) for _ in range(200)]
    # its own spread over 200 runs, from its counts of once and twice (60 and 90): a quarter, 0.4 of the mean's error
    assert np.mean(estimates) == pytest.approx(400 * np.exp(-3), abs=3 * np.std(estimates) / np.sqrt(200) + 0.5)
    unlike = [likely_missed(rng.poisson(rng.choice([0.5, 8.0], 400))) for _ in range(200)]
    truth = 200 * (np.exp(-0.5) + np.exp(-8.0))
    assert np.mean(unlike) < truth


def test_nothing_goes_from_a_picture_without_light() -> None:
    """The camera is inside a box, in another one, and the sky is outside. To a black picture any light that culling
    lets in is infinitely much."""
    around, outside = scenes.placed((0, -4, 0), 2.0), scenes.placed((0, 0, 0), 20.0)
    camera = scenes.look_at((0, -4, 0), (0, 0, 0))
    for boxes, warned in (([around, outside], True), ([scenes.placed((0, 0, 0), 1.0)], False)):
        scene = scenes.build([scenes.cube()], [(0, box, 0) for box in boxes], camera=camera)
        result = analyze(scene, CullOptions(width=64))
        assert result.active.all()
        assert (result.warnings == (DARKNESS,)) == warned
