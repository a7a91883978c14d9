"""Random scenes of Blender's own, and its hard cases."""

from __future__ import annotations

import bpy
import numpy as np
import pytest

from . import fuzz_blender, inside_blender
from .case import CASES, Case
from .choices import Seeded
from .test_cases import test_holds as holds


@pytest.fixture(autouse=True)
def empty_afterwards():
    """The next test starts from an empty file."""
    yield
    bpy.ops.wm.read_factory_settings(use_empty=True)


@pytest.mark.parametrize("case", [c for c in CASES if c.group == inside_blender.GROUP], ids=lambda c: c.name)
def test_case(case: Case) -> None:
    holds(case)


@pytest.mark.parametrize("block", range(5))
def test_random_scenes_of_blender(block: int) -> None:
    """Ten seeds each, other than those of recorded runs."""
    for seed in range(10**6 + 10 * block, 10**6 + 10 * (block + 1)):
        with np.errstate(all="ignore"):
            fuzz_blender.check(Seeded(seed), seed)
