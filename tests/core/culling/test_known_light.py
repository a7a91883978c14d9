"""Light of which nobody knows whether it is there: what it shades counts, and nothing is judged against it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from lipac.core.culling.analysis import analyze
from lipac.core.culling.loop import Loop
from lipac.core.culling.options import CullOptions
from lipac.core.error_budget.budget import Budget
from lipac.core.evaluation.judge import Judge
from lipac.core.scene import model as s
from lipac.core.scene.known_light import known_light

from .. import scenes
from .test_budget_cases import CAMERA, facing, material, sun

SIZE = (96, 54)
BUDGET = Budget(0.02, 0.1)


def roofed(unsure: int, glow: float = 0.0, veil: int | None = None) -> s.Scene:
    """A ground under many small roofs out of view, which a weak sky lights, and from aside a strong sun or a
    glowing wall. veil: what is not known (`Unsure`) of a clear sheet, through which the sun shines."""
    rng = np.random.default_rng(0)
    places = rng.uniform((-4, 0, 3), (4, 8, 4), (120, 3)).tolist()
    roofs = [(1, scenes.placed((x, y, z), (0.5, 0.5, 0.01)), 1) for x, y, z in places]
    panel = [(0, facing((0, 1, 0), (1, 0, 0), (-9, 4, 1.5), 20, 3), 2)] if glow else []
    materials = [material(), material(base_color=0.02), material(base_color=0.0, emission=(glow,) * 3)]
    materials[2]["unsure_emission"] = unsure
    if veil is not None:
        panel = [(0, facing((-1, 0, -0.6), (0, 1, 0), (15, 4, 9), 60, 60), 2)]
        materials[2]["shader"], materials[2]["base_color"], materials[2]["unsure"] = s.Shader.TRANSPARENT, 1, veil
    light = sun((1, 0, 0.6)) if not glow else None
    scene = scenes.build(
        [scenes.quad(), scenes.cube()],
        [(0, scenes.placed((0, 0, 0), 80.0), 0), *roofs, *panel],
        materials,
        CAMERA,
        light,
        (0.01, 0.01, 0.01),
        SIZE,
        s.PathLimits(total=1, diffuse=1),
    )
    scene.lights["unsure"] = unsure
    return scene


@pytest.mark.parametrize(
    ("glow", "veil"),
    [(0.0, None), (20.0, None), (0.0, s.Unsure.CLEAR), (0.0, s.Unsure.LIGHT)],
    ids=["lamp", "emission", "clear", "through"],
)
def test_the_budget_holds_without_it_as_with_it(glow: float, veil: int | None) -> None:
    """By 128 fresh paths per pixel through the scene with that light, and without. Were it sure, the scene without it
    would be far off."""
    scene = roofed(veil is None, glow, veil)
    dark = known_light(scene)
    assert dark is not None
    options = CullOptions(width=SIZE[0], max_error=BUDGET)
    result = analyze(scene, options)
    for judged in (scene, dark):
        change = Judge(judged, 128).change(result.active)
        assert change.mean - 2 * change.mean_deviation <= BUDGET.mean
        assert change.worst - 2 * change.worst_deviation <= BUDGET.worst
    sure = roofed(0, glow, None if veil is None else 0)
    assert known_light(sure) is None
    change = Judge(dark, 128).change(analyze(sure, options).active)
    sure_mean, sure_worst = change.mean - 2 * change.mean_deviation, change.worst - 2 * change.worst_deviation
    assert sure_mean > BUDGET.mean or sure_worst > BUDGET.worst


def test_a_reason_to_keep_all() -> None:
    """Where light paths cannot say what a picture shows, all stays, and the reason is a warning."""
    result = analyze(dataclasses.replace(roofed(0), whole="why"), CullOptions(width=SIZE[0], max_error=BUDGET))
    assert (result.active.all(), result.warnings) == (True, ("why",))


@pytest.mark.parametrize("color", [0.02, 0.8])
def test_a_shadow_catcher_shows_none_of_its_own_light(color: float) -> None:
    """Pebbles are all that is seen of a picture whose ground catches shadows, however bright that is, and of whatever
    colour they are."""
    rng = np.random.default_rng(1)
    places = rng.uniform((-2, 1, 0.05), (2, 6, 0.05), (150, 3)).tolist()
    scene = scenes.build(
        [scenes.quad(), scenes.cube()],
        [(0, scenes.placed((0, 0, 0), 80.0), 0), *((1, scenes.placed(place, 0.1), 1) for place in places)],
        [material(), material(base_color=color)],
        CAMERA,
        None,
        (1, 1, 1),
        SIZE,
        s.PathLimits(total=1, diffuse=1),
    )
    assert known_light(scene) is None
    flags = scene.instances.flags.copy()
    flags[0] |= s.InstanceFlag.SHADOW_CATCHER
    caught = dataclasses.replace(scene, instances=dataclasses.replace(scene.instances, flags=flags))
    shown, options = known_light(caught), CullOptions(width=SIZE[0], max_error=BUDGET)
    assert shown is not None
    for seen, holds in ((scene, False), (caught, True)):
        change = Judge(shown, 128).change(analyze(seen, options).active)
        assert (change.mean - 2 * change.mean_deviation <= BUDGET.mean) == holds
    loop = Loop(caught, options)
    loop.run()
    assert loop.known.mean() < 0.2
