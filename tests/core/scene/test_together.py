"""Instances that lie exactly where another does stay or go together."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from lipac.core.culling.analysis import analyze
from lipac.core.culling.options import CullOptions
from lipac.core.error_budget.budget import Budget
from lipac.core.scene.together import Removal, Twins

from .. import scenes


def test_against_a_plain_search() -> None:
    """Groups of boxes that are the same to the last bit, with zeros of either sign; what is a bit elsewhere is
    another."""
    rng = np.random.default_rng(0)
    some = rng.integers(-1, 2, (40, 2, 3)).astype(np.float32)
    boxes = some[rng.integers(0, 40, 500)]
    boxes = np.where(rng.random(boxes.shape) < 0.5, boxes, boxes + np.float32(0) * -boxes).astype(np.float32)
    boxes[::7] = np.nextafter(boxes[::7], np.float32(9))
    twins = Twins()
    for share in (0.0, 0.02, 0.5, 1.0):
        keep = rng.random(500) < share
        rows = [tuple((box + 0.0).ravel().tolist()) for box in boxes]
        wanted = {row for row, kept in zip(rows, keep, strict=True) if kept}
        assert twins.joined(boxes, keep).tolist() == [row in wanted for row in rows]
    assert twins.joined(boxes[:3] + 100, np.zeros(3, bool)).tolist() == [False] * 3  # others than before


def test_both_of_two_coincident_things_stay() -> None:
    """Light paths meet one of them; a third stands where nothing is seen, with its twin."""
    seen, unseen = scenes.placed((0, 0, 0.5)), scenes.placed((0, 0, -5))
    placement = [(1, scenes.placed((0, 0, 0), 40.0), 0), (0, seen, 0), (2, seen, 0), (0, unseen, 0), (0, unseen, 0)]
    scene = scenes.build([scenes.cube(), scenes.quad(), scenes.cube()], placement)
    assert analyze(scene, CullOptions()).active.tolist() == [True, True, True, False, False]


def test_what_is_placed_alike_is_told_from_what_crosses() -> None:
    """Two upright cards that cross have one box; a card and its copy, which any mesh may be, lie in one place."""
    turn = np.array([[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0]], np.float32)
    cards = [scenes.placed((x, 0, 0)) for x in (0, 0, 5, 9)]
    scene = scenes.build([scenes.cube(), scenes.cube()], [(k % 2, place, 0) for k, place in enumerate([*cards, turn])])
    assert Twins().rows(scene.instances.bounds, scene.instances.transform).tolist() == [0, 1]


@pytest.mark.parametrize("copies", [1, 2])
def test_what_lies_in_one_place_stays_where_paths_meet_it(copies: int) -> None:
    """Small dark things on a ground go; with a copy of each in its place they stay, and a warning says why."""
    places = [scenes.placed((0.7 * k - 2, 0.5 * (k % 3), 0.2), 0.2) for k in range(8)]
    scene = scenes.build(
        [scenes.cube(), scenes.quad()], [(1, scenes.placed((0, 0, 0), 40.0), 0), *((0, p, 0) for p in places * copies)]
    )
    result = analyze(scene, CullOptions(max_error=Budget(0.1, 0.9)))
    assert result.active.all() == (copies > 1) and result.active[0]
    assert any(line.startswith("surfaces of several objects") for line in result.warnings) == (copies > 1)


@pytest.mark.parametrize("owners", [(0, 0), (0, 1)])
def test_parts_of_one_mesh_lie_side_by_side(owners: tuple[int, int]) -> None:
    """What stays of a mesh and what goes of it have the same box; parts of a copy of it lie in its place."""
    places = [scenes.placed((9.0 * k, 0, 0)) for k in (0, 1, 2, 2)]
    scene = scenes.build([scenes.cube()], [(0, place, 0) for place in places])
    twins = Twins()
    assert twins.rows(scene.instances.bounds, scene.instances.transform).tolist() == [2, 3]
    twins.divide(2, np.array(owners))
    rows = twins.rows(scene.instances.bounds, scene.instances.transform)
    assert rows.tolist() == ([] if owners[0] == owners[1] else [2, 3])


@pytest.mark.parametrize("behind", [1, 2])
def test_what_hides_surfaces_that_share_a_plane_stays(behind: int) -> None:
    """Cards before larger ones that look alike go; where two of those lie in one plane, what a renderer shows of them
    without the card before them nobody knows, so that it stays."""

    def card(x: float, y: float, size: float) -> np.ndarray:
        return np.array([[size, 0, 0, x], [0, 0, -1, y], [0, size, 0, 1]], np.float32)

    cards = [card(x, -0.1, 0.8) for x in (-3, -1, 1, 3)]
    larger = [card(x + 0.04 * k, 0, 1.2) for x in (-3, -1, 1, 3) for k in range(behind)]
    placement = [*((0, place, 0) for place in (*cards, *larger)), (0, card(0, 3, 40), 1)]
    colors = [scenes.material(base_color=0.5), scenes.material(base_color=0.05)]
    scene = scenes.build([scenes.quad()], placement, colors, camera=scenes.look_at((0, -8, 1), (0, 0, 1)))
    stays = analyze(scene, CullOptions(max_error=Budget(0.05, 0.5))).active
    assert stays[4:].all() and stays[:4].tolist() == [behind > 1] * 4


def test_what_is_taken_out_together_against_a_plain_search() -> None:
    """An instance stays where it is to, or where something of each of its groups is; those in no group go alone."""
    rng = np.random.default_rng(1)
    for groups_of_each in (1, 2):
        rows = np.sort(rng.choice(60, 40, replace=False))
        groups = rng.integers(-1, 8, (groups_of_each, 40)).astype(np.int32)
        groups[0, groups.max(axis=0) < 0] = 0
        for share in (0.0, 0.05, 0.3, 1.0):
            keep = rng.random(60) < share
            live = {g for row, of in zip(rows, groups.T, strict=True) if keep[row] for g in of.tolist() if g >= 0}
            wanted = keep.copy()
            for row, of in zip(rows, groups.T, strict=True):
                wanted[row] |= all(g in live for g in of.tolist() if g >= 0)
            assert Removal(rows, groups).staying(keep).tolist() == wanted.tolist()


@pytest.mark.parametrize("paired", [False, True])
def test_a_set_is_judged_with_what_cannot_be_taken_out(paired: bool) -> None:
    """Screens of their wall's colour, and bright cards that nothing but these hide: both may go. Where each hidden card
    is taken out with one in view alone, it stays, and so does its screen, for the picture would show it."""

    def card(x: float, y: float, z: float, size: float) -> np.ndarray:
        return np.array([[size, 0, 0, x], [0, 0, -1, y], [0, size, 0, z]], np.float32)

    columns = (-3, -1, 1, 3)
    screens, hidden = ([card(x, y, 0.3, size) for x in columns] for y, size in ((0, 1.0), (0.5, 0.6)))
    seen = [card(x, 0, 1.9, 0.6) for x in columns]
    placement = [*((0, p, 0) for p in screens), *((0, p, 1) for p in (*hidden, *seen)), (0, card(0, 3, 0, 40), 0)]
    colors = [scenes.material(base_color=0.05), scenes.material(base_color=0.8)]
    scene = scenes.build([scenes.quad()], placement, colors, camera=scenes.look_at((0, -8, 1), (0, 0, 1)))
    if paired:
        pairs = np.tile(np.arange(4, dtype=np.int32), 2)[None]
        scene = dataclasses.replace(scene, removal=Removal(np.arange(4, 12), pairs))
    stays = analyze(scene, CullOptions(max_error=Budget(0.05, 0.5))).active
    assert stays[8:].all()
    assert stays[:8].all() if paired else not stays[4:8].any() and not stays[:4].all()
