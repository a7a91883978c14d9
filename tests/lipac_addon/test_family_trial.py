"""The judge of `family` scenes: by Cycles' own pictures of what is culled and of what is not."""

from __future__ import annotations

import bpy
import numpy as np
import pytest

from lipac.core.evaluation.paired import Range
from lipac.lipac_addon import family_trial, writeback
from lipac.lipac_addon.console import muted
from lipac.lipac_addon.extract import extract_frame


@pytest.mark.parametrize(
    ("times", "word"),
    [
        ((0, 0, 0), "held"),
        ((0.2, 0.5, 1.0), "held"),
        ((0.9, 1.1, 1.2), "open"),
        ((0.5, 0.9, 3.0), "open"),
        ((1.1, 1.5, 4.0), "broken"),
        ((2.1, 3, 4), "twice"),
    ],
)
def test_a_verdict_is_what_is_sure(times: tuple[float, float, float], word: str) -> None:
    assert family_trial.verdict(Range(*times)) == word


@pytest.mark.parametrize(("seen", "mean", "word"), [(True, 1e-4, "twice"), (True, 0.5, "held"), (False, 0.01, "held")])
def test_culling_is_judged_and_taken_back(boxes: bpy.types.Scene, seen: bool, mean: float, word: str) -> None:
    """Cubes before the wall or behind it are taken out; the second seed of the judge is another picture of the same
    scene."""
    with muted():
        extraction = extract_frame(boxes)
    behind = extraction.scene.instances.bounds[:, 0, 1] + extraction.scene.origin[1] > 7
    small = np.ptp(extraction.scene.instances.bounds, axis=1).max(axis=1) < 2
    culled = small & (behind != seen)
    assert culled.sum() == 4
    done = []

    def apply() -> None:
        with muted():
            writeback.apply(culled, extraction.keys)
        done.append(sum(ob.hide_render for ob in boxes.objects))

    result = family_trial.judged(apply, mean, 5 * mean, 16, 0, 77)
    assert result["verdict"] == word
    assert set(done) == {4}
    assert not any(ob.hide_render for ob in boxes.objects)
    if seen:
        assert result["changes"]["luminance"]["worst"]["low"] > 0.05
    else:
        assert result["changes"]["luminance"]["worst"]["value"] < 0.01
