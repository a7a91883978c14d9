"""A baked shot is judged in all of its frames, and what does not hold has consequences."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import bpy
import pytest

from lipac.core.culling import union
from lipac.core.culling.union import Check
from lipac.lipac_addon.ui.jobs.analysis import AnalysisJob
from lipac.lipac_addon.ui.state import results

pytestmark = pytest.mark.slow


@pytest.fixture
def shot(scene: Any) -> Any:
    """Three frames, decided by light paths, in each of which another box is there."""
    scene.lipac.policy, scene.lipac.width = "light-paths", 64
    scene.frame_start, scene.frame_end = 1, 3
    for frame in (1, 2, 3):
        for number in (1, 2, 3):
            ob = bpy.data.objects[f"box{number}"]
            ob.location.y = 0.0 if frame == number else 500.0
            ob.keyframe_insert("location", frame=frame)
    return scene


def baked(scene: Any) -> AnalysisJob:
    job = AnalysisJob(scene, range(1, 4), bake=True)
    job.run()
    assert not job.error
    return job


def judged(monkeypatch: pytest.MonkeyPatch, holds: Any) -> list[int]:
    """Has holds(calls so far) say whether a set does; the sets that each call's frame had judged before."""
    calls: list[int] = []
    check = union.check

    def said(loop: Any, keep: Any, met: Any, faces: Any, earlier: int, *more: Any) -> Check:
        found = check(loop, keep, met, faces, earlier, *more)
        calls.append(earlier)
        return replace(found, holds=found.holds and holds(len(calls)))

    monkeypatch.setattr(union, "check", said)
    return calls


def test_each_frame_has_a_certificate_of_the_shots_set(shot: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = judged(monkeypatch, lambda _: True)
    job = baked(shot)
    assert job.baked is not None and job.baked[0] < job.baked[1]
    frames = results.of(shot)
    assert sorted(frames) == [1, 2, 3] and calls[:3] == [0, 0, 0]
    for frame in frames.values():
        assert 0 <= frame.stats["certified_mean"] <= shot.lipac.max_error
        assert not any("not certified" in line for line in frame.warnings)


def test_a_frame_in_which_it_does_not_hold_is_analysed_closer(shot: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    closer = []
    decide = union.decide_closer

    def counted(*given: Any) -> Any:
        closer.append(1)
        return decide(*given)

    monkeypatch.setattr(union, "decide_closer", counted)
    calls = judged(monkeypatch, lambda call: call != 2)
    baked(shot)
    assert len(closer) >= 1
    assert calls[:6] == [0, 0, 0, 1, 1, 1]
    assert not any("not certified" in line for frame in results.of(shot).values() for line in frame.warnings)


def test_where_nothing_helps_all_stays_and_that_is_said(shot: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = judged(monkeypatch, lambda _: False)
    job = baked(shot)
    assert calls == [0, 0, 0, 1, 1, 1, 2, 2, 2]
    assert job.baked is not None and job.baked[0] == job.baked[1]
    for frame in results.of(shot).values():
        assert frame.warnings[0].startswith("What is baked is not certified in frames 1, 2, 3")
