"""Every hard case that is quick holds. `make accuracy` runs all of them and writes docs/accuracy.md."""

from __future__ import annotations

import pytest

from . import cameras, counters, light, meshes, places, rays, transforms
from .case import CASES, Case

MODULES = (places, transforms, meshes, rays, light, counters, cameras)


def test_every_module_has_cases() -> None:
    assert {case.function.__module__ for case in CASES} >= {module.__name__ for module in MODULES}


@pytest.mark.parametrize(
    "case",
    [c for c in CASES if not c.slow and c.function.__module__ in {m.__name__ for m in MODULES}],
    ids=lambda c: f"{c.group}: {c.name}",
)
def test_holds(case: Case) -> None:
    figures = case.figures()
    assert figures
    broken = [f"{f.stressed}: {f.measure} {f.figure:.4g}, limit {f.limit:.4g}" for f in figures if not f.holds]
    assert not broken, "\n".join(broken)
