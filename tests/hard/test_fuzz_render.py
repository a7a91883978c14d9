"""Generated files with what people's files have in them go through the commands: fifty here; `python -m
lipac.scripts.dev.fuzz render` does any number."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lipac.core.culling.options import DEFAULT_BUDGET
from lipac.scripts.dev import fuzz

from .features import FEATURES
from .fuzz_render import build, drawn, judge
from .later_features import LATER, SINCE

FIRST = 10**6  # seeds other than those of recorded runs
EVERY = 5  # one of so many is rendered and verified, the others are analysed


@pytest.fixture(scope="module")
def check() -> Iterator[Callable[[range], list[dict[str, Any]]]]:
    """The records of some seeds, by two processes at a time: most of what they do, Blender does by one thread."""
    with (
        fuzz.in_children("render", 1, EVERY) as a,
        fuzz.in_children("render", 1, EVERY) as b,
        ThreadPoolExecutor(2) as pool,
    ):

        def of(seeds: range) -> list[dict[str, Any]]:
            halves = pool.map(lambda do, part: [do(seed) for seed in part], (a, b), (seeds[::2], seeds[1::2]))
            return [record for half in halves for record in half]

        yield of


def test_files(check: Callable[[range], list[dict[str, Any]]]) -> None:
    """25 seeds: no crash, nothing hangs, the open file is put back, files are as they were, and where the budget
    is broken, that is told."""
    found = check(range(FIRST, FIRST + 25))
    assert len(found) == 25
    assert [scene for scene in found if "failed" in scene] == []
    assert [scene["said"] for scene in found if scene["verdict"] == "refused"] == []
    rendered = [scene for scene in found if scene["seed"] % EVERY == 0]
    assert len(rendered) == 5
    assert all(scene["finite"] and scene["mean"] >= 0 for scene in rendered)


def test_every_feature_is_drawn() -> None:
    assert {name for seed in range(SINCE) for name in drawn(seed)} == set(FEATURES)
    assert {name for seed in range(SINCE, 2000) for name in drawn(seed)} == {*FEATURES, *LATER}


def test_a_seed_is_a_file(tmp_path: Path) -> None:
    for name in "ab":
        (tmp_path / name).mkdir()
        assert build(3, tmp_path / name / "scene.blend") == drawn(3)
    a, b = ((tmp_path / name / "scene.blend").stat().st_size for name in "ab")
    assert abs(a - b) < 0.02 * a  # addresses in memory are in it, and compress as they will


def test_the_judge_sees_what_is_gone() -> None:
    """A tenth of the light in one tile is gone in one picture of a pair: 0.7 % in the mean, 10 % in the worst tile.
    Noise alone is no change."""
    rng = np.random.default_rng(0)
    full = np.ones((36, 64, 4), np.float32)
    culled = full.copy()
    culled[4:8, 4:8, :3] = 0.9
    found = judge(full, culled)
    assert found.worst == pytest.approx(0.1, rel=1e-3)
    assert found.mean == pytest.approx(0.1 / 144, rel=1e-3)
    assert found.breaks(DEFAULT_BUDGET)
    noisy = [(full * rng.uniform(0.5, 1.5, (36, 64, 1))).astype(np.float32) for _ in range(2)]
    assert not judge(*noisy).breaks(DEFAULT_BUDGET)
