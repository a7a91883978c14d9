"""Traces of a frame for what is asked beside its measurement."""

from __future__ import annotations

import numpy as np
import pytest

from lipac.core.culling.analysis import analyze
from lipac.core.culling.loop import Loop
from lipac.core.culling.options import CullOptions, State
from lipac.core.culling.union import check
from lipac.core.error_budget.budget import Budget
from lipac.core.scene import model as s

from .. import scenes
from .test_budget_cases import CAMERA, material

SIZE = (96, 54)


def lanterns(clamp: float) -> s.Scene:
    """A ground with bright lanterns above, and as many so far away that they light nothing that is seen."""
    rng = np.random.default_rng(0)
    near, far = (
        rng.uniform(a, b, (12, 3)).tolist() for a, b in (((-4, 2, 2), (4, 8, 3)), ((-4, -900, 2), (4, -800, 3)))
    )
    lights = [(1, scenes.placed(place, 0.1), 1) for place in near + far]
    return scenes.build(
        [scenes.quad(), scenes.cube()],
        [(0, scenes.placed((0, 0, 0), 80.0), 0), *lights],
        [material(), material(base_color=0.0, emission=(50.0,) * 3)],
        CAMERA,
        None,
        (0.5, 0.5, 0.5),
        SIZE,
        s.PathLimits(total=1, diffuse=1, clamp_direct=clamp, clamp_indirect=clamp),
    )


@pytest.mark.parametrize(("clamp", "told"), [(0.0, False), (1000.0, False), (0.3, True)])
def test_what_clamping_takes_where_emitters_are_culled_is_said(clamp: float, told: bool) -> None:
    """No bound holds for it: fewer emitters are each picked more often, so that each contribution is smaller, and
    clamped less. What is never clamped is no matter."""
    result = analyze(lanterns(clamp), CullOptions(width=SIZE[0], max_error=Budget(0.02, 0.1)))
    culled = result.state == State.CULLED
    assert culled[13:].any() and not culled[0]
    assert any(line.startswith("clamping takes more than 2 %") for line in result.warnings) == told
    # of a set that is judged, too, in the same words: a report has them once for all frames
    loop = Loop(lanterns(clamp), CullOptions(width=SIZE[0], max_error=Budget(0.02, 0.1)))
    found = check(loop, ~culled, np.zeros(len(culled), bool), {})
    assert found.holds and [*found.result.warnings] == [line for line in result.warnings if "clamping" in line]
