"""mirror-city, checked instance by instance against a brute-force list: who is met by any of 1,000 paths per pixel."""

from __future__ import annotations

import pytest

from lipac.core.culling.analysis import by_budget
from lipac.core.culling.loop import Loop
from lipac.core.culling.options import CullOptions
from lipac.core.culling.result import CullingResult
from lipac.core.error_budget.budget import Budget
from lipac.core.feedback.hits import Feedback
from lipac.core.scene.model import RayType

States = tuple[CullingResult, CullingResult, Feedback]
PATHS = 1000
ANALYSIS = 128  # what dark tiles of 9 pixels need, to tell what they see from what is near it


@pytest.fixture(scope="module")
def states() -> States:
    """The analyses of a small city at budgets of 1 % and of nothing, and the brute-force counts. The measured paths are
    among the brute-force ones."""
    import bpy

    from lipac.lipac_addon import demo
    from lipac.lipac_addon.extract import extract_frame

    bpy.ops.wm.read_factory_settings(use_empty=True)
    demo.build("mirror-city", 2000, 0)
    render = bpy.context.scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = 48, 27, 100
    scene = extract_frame(bpy.context.scene, 1).scene
    loop = Loop(scene, CullOptions(width=48, paths=ANALYSIS))
    loop.run()
    measured = loop.measure()  # anew, by the first samples of the brute-force run
    result = by_budget(loop, measured, Budget(0.01, 0.05))
    everything = by_budget(loop, measured, Budget(0.0, 0.0))
    brute = Loop(scene, CullOptions(width=48))
    brute.tracer.next_sample = 0
    feedback, _ = brute.tracer.trace(brute.tracer.build(brute.activation.exists), PATHS)
    return result, everything, feedback


def test_what_shows_nowhere_is_culled(states: States) -> None:
    result, _, brute = states
    met = brute.hits.sum(axis=1)
    assert (met == 0).sum() > 1000  # most of the city
    # What no path meets stays only with its region, where that was met too thinly to be told apart from it.
    assert (result.active & (met == 0)).sum() <= 0.05 * (met == 0).sum()
    assert result.active.sum() < 0.2 * len(met)


def test_what_paths_need_is_active(states: States) -> None:
    _, result, brute = states
    met = brute.hits.sum(axis=1)
    # Met by a share p of paths, an instance escapes the 128 paths of 48 x 27 pixels with probability (1 - p)**165888:
    # below 1e-6 from this share on.
    sure = met >= brute.paths * (1 - 1e-6 ** (1 / (ANALYSIS * 48 * 27)))
    assert sure.sum() > 30
    assert result.active[sure].all()


def test_what_only_the_mirror_shows_is_active(states: States) -> None:
    _, result, brute = states
    camera, glossy = brute.hits[:, RayType.CAMERA], brute.hits[:, RayType.GLOSSY]
    mirrored = (camera == 0) & (glossy > 500)
    assert mirrored.sum() > 5
    assert result.active[mirrored].all()
