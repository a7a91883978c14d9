"""What lies where paths meet a surface: in its plane, which of the two a renderer shows is chance, so both stay, and it
is said; around it, where its shader asks for that."""

from __future__ import annotations

import numpy as np
import pytest

from lipac.core.culling.analysis import analyze
from lipac.core.culling.options import CullOptions
from lipac.core.culling.result import CullingResult
from lipac.core.error_budget.budget import Budget
from lipac.core.scene import model as s

from .. import scenes
from ..scenes import material

SIZE = (160, 90)
WALL, DECAL = range(2)


def turned(angle: float) -> np.ndarray:
    """About an axis that is none of the coordinates'."""
    a, b = np.cos(angle), np.sin(angle)
    around_z = np.array([[a, -b, 0], [b, a, 0], [0, 0, 1.0]])
    around_x = np.array([[1.0, 0, 0], [0, a, -b], [0, b, a]])
    return around_z @ around_x


def analysed(gap: float, angle: float, distance: float = 7.0, reach: float = 0.0) -> CullingResult:
    """A wall, and a decal of the same colour on it, a gap behind its surface; seen straight on, under a white sky.

    reach: within which the wall asks what is around it.
    """
    turn = turned(angle)

    def facing(x: float, y: float, side: float) -> np.ndarray:
        square = np.array([[side, 0, 0, x], [0, 0, -side, y], [0, side, 0, 0]], float)
        return turn @ square

    placement = [(0, facing(0, distance, 12), WALL), (0, facing(0.31, distance + gap, 1.7), DECAL)]
    camera = scenes.look_at((0, 0, 0), tuple((turn @ [0, 1, 0]).tolist()))
    grey = [material(base_color=0.5), material(base_color=0.5)]
    grey[0]["reach"] = reach
    scene = scenes.build([scenes.quad()], placement, grey, camera, None, (1, 1, 1), SIZE, s.PathLimits(total=2))
    return analyze(scene, CullOptions(width=SIZE[0], max_error=Budget(0.05, 0.2)))


@pytest.mark.parametrize("angle", [0.0, 0.7])
@pytest.mark.parametrize("gap", [0.0, 4e-7])
def test_a_decal_in_the_plane_of_its_wall_stays_and_it_is_said(gap: float, angle: float) -> None:
    result = analysed(gap, angle)
    assert result.active.all()
    assert any("in one place" in line for line in result.warnings)


def test_floors_at_zero_are_in_one_place_and_one_a_millimetre_below_is_not() -> None:
    """They are exactly flat, with no error of rounding across."""
    camera, grey = scenes.look_at((0, -6, 3), (0, 0, 0)), [material(base_color=0.5)]
    for depth, stay in ((0.0, True), (1e-3, False)):
        floors = [(0, scenes.placed((0, 0, 0), 30.0), 0), (0, scenes.placed((0.3, 0.2, -depth), 1.7), 0)]
        scene = scenes.build([scenes.quad()], floors, grey, camera, None, (1, 1, 1), SIZE, s.PathLimits(total=2))
        result = analyze(scene, CullOptions(width=SIZE[0], max_error=Budget(0.05, 0.2)))
        assert result.active.all() == stay == any("in one place" in line for line in result.warnings)


@pytest.mark.parametrize("angle", [0.0, 0.7])
def test_a_decal_behind_its_wall_goes_and_nothing_is_said(angle: float) -> None:
    """At a distance that is no rounding error: a millimetre."""
    result = analysed(1e-3, angle)
    assert result.active.tolist() == [True, False]
    assert not result.warnings


@pytest.mark.parametrize(("reach", "stays"), [(2.0, True), (0.5, False)])
def test_what_is_within_reach_of_a_surface_that_looks_around_stays(reach: float, stays: bool) -> None:
    result = analysed(1.0, 0.7, reach=reach)
    assert (bool(result.active[DECAL]), result.warnings) == (stays, ())


def test_surfaces_that_cross_are_not_in_one_place() -> None:
    """They share a line, which many paths come near to where there are many: blades on a lawn."""
    rng = np.random.default_rng(5)
    blades = []
    for x, y in rng.uniform(-2, 2, (400, 2)):
        blades.append((0, np.array([[0.05, 0, 0, x], [0, 0, -0.05, y], [0, 0.3, 0, 0]], float), 1))
    ground = (0, np.array([[9.0, 0, 0, 0], [0, 9, 0, 0], [0, 0, 1, 0]]), 0)
    scene = scenes.build(
        [scenes.quad()],
        [ground, *blades],
        [material(base_color=0.5), material(base_color=0.3)],
        scenes.look_at((0, -4, 3), (0, 0, 0)),
        None,
        (1, 1, 1),
        SIZE,
        s.PathLimits(total=2),
    )
    result = analyze(scene, CullOptions(width=SIZE[0], max_error=Budget(0.05, 0.2)))
    assert not result.warnings
