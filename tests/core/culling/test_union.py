"""Sets that other frames chose: held where they surely keep the budget, refused where something is missing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lipac.core.culling.analysis import analyze
from lipac.core.culling.loop import Loop
from lipac.core.culling.options import CullOptions
from lipac.core.culling.union import Check, check, decide_closer, doubt_of, propose
from lipac.core.error_budget.budget import Budget
from lipac.core.evaluation.judge import Judge

from .test_division import SIZE as SMALL
from .test_division import terrain
from .test_loop import MIRROR, REFLECTED, SEEN, stage

OPTIONS = CullOptions(width=160, max_error=Budget(0.01, 0.05))


def checked(keep: np.ndarray, earlier: int = 0, threads: int = 0) -> Check:
    loop = Loop(stage(), replace(OPTIONS, threads=threads))
    return check(loop, keep, np.zeros(len(keep), bool), {}, earlier)


def test_what_is_shown_by_other_things_than_light_stays() -> None:
    """Whatever paths say, and a set without it does not hold."""
    scene, drawn = stage(), np.zeros(len(stage().instances), bool)
    drawn[-1] = True
    scene = replace(scene, stays=drawn)
    proposed = analyze(stage(), OPTIONS).active
    assert not proposed[-1]
    assert analyze(scene, OPTIONS).active[-1]
    met = np.zeros(len(proposed), bool)
    assert not check(Loop(scene, OPTIONS), proposed, met, {}).holds
    assert check(Loop(scene, OPTIONS), proposed | drawn, met, {}).holds


def test_what_a_frame_proposes_holds_in_it() -> None:
    """By few instances, and by an independent judge."""
    scene = stage()
    proposed = propose(Loop(scene, OPTIONS)).active
    assert proposed[[MIRROR, SEEN, REFLECTED]].all()
    assert proposed.sum() < 60
    found = checked(proposed)
    assert found.holds
    assert found.result.active.tolist() == proposed.tolist()
    assert found.result.stats["certified_worst"] <= OPTIONS.max_error.worst
    change = Judge(scene, 32).change(proposed)
    assert change.mean - 2 * change.mean_deviation <= found.result.stats["certified_mean"] <= OPTIONS.max_error.mean


@pytest.mark.parametrize("lost", [SEEN, REFLECTED])
def test_a_set_without_what_is_seen_is_refused(lost: int) -> None:
    """Directly, and in a mirror."""
    keep = propose(Loop(stage(), OPTIONS)).active
    keep[lost] = False
    found = checked(keep)
    assert not found.holds
    assert found.result.stats["certified_worst"] > OPTIONS.max_error.worst


def test_all_of_a_scene_holds_without_a_path() -> None:
    found = checked(np.ones(len(stage().instances), bool))
    assert found.holds
    assert found.result.stats["certified_worst"] == found.result.stats["certificate_paths"] == 0


def test_each_check_of_a_frame_has_other_paths_and_less_doubt() -> None:
    """The same at any number of threads."""
    keep = propose(Loop(stage(), OPTIONS)).active
    keep[REFLECTED] = False
    first, again, other = checked(keep, threads=1), checked(keep, threads=2), checked(keep, earlier=1)
    bounds = [found.result.stats["certified_worst"] for found in (first, again, other)]
    assert bounds[0] == bounds[1] != bounds[2]
    assert first.result.stats["certificate_paths"] == again.result.stats["certificate_paths"]


def test_checks_of_a_frame_share_the_doubt_of_one() -> None:
    """Also of very many, none of which is left without any that a float knows."""
    doubts = [doubt_of(earlier) for earlier in range(10_000)]
    assert 0.9999 * 0.05 < sum(doubts) <= 0.05
    assert 1 - doubts[-1] < 1


def test_closer_than_the_budget() -> None:
    result = decide_closer(Loop(stage(), OPTIONS))
    assert result.stats["certified_mean"] <= 0.5 * OPTIONS.max_error.mean
    assert result.active[[MIRROR, SEEN, REFLECTED]].all()


def faces_checked(mask: np.ndarray, mean: float = 0.05) -> Check:
    options = CullOptions(width=SMALL[0], max_error=Budget(mean, 5 * mean), parts=True)
    return check(Loop(terrain(), options), np.ones(2, bool), np.zeros(2, bool), {0: mask})


def test_faces_that_stay_are_judged_as_they_are() -> None:
    """A terrain with the faces that its own analysis keeps holds at more than its budget; without those before the
    camera it does not."""
    own = analyze(terrain(), CullOptions(width=SMALL[0], max_error=Budget(0.01, 0.05), parts=True)).faces[0]
    found = faces_checked(own)
    assert found.holds
    assert found.result.faces[0].tolist() == own.tolist()
    assert len(found.result.state) == 2
    assert not faces_checked(~own).holds


def test_what_stays_and_what_goes_of_a_mesh_do_not_coincide() -> None:
    """Both have the box of the mesh where they are strewn over it, and are placed as it is."""
    faces = len(analyze(terrain(), CullOptions(width=SMALL[0], max_error=Budget(0.01, 0.05), parts=True)).faces[0])
    found = faces_checked(np.random.default_rng(1).random(faces) < 0.5, 99.0)
    assert found.holds
    assert not found.result.warnings


def test_a_mesh_with_other_faces_is_refused() -> None:
    with pytest.raises(ValueError, match="other faces"):
        faces_checked(np.ones(7, bool))
