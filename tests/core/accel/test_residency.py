"""Within a budget the BLASes of the most valuable instances are there, and what is there goes only for what is clearly
worth more."""

from __future__ import annotations

import numpy as np

from lipac.core.accel.blas import BlasCache
from lipac.core.accel.residency import Residency

from .. import scenes

MESH = np.array([0, 1, 2, 2], np.int32)  # of four instances


def residency(limit: int = 0, seconds: float = 0.0) -> Residency:
    return Residency(BlasCache([scenes.sphere(12) for _ in range(3)]), seconds, limit, 2.0)


def scheduled(one: Residency, value: list[float]) -> list[bool]:
    """Which meshes have a BLAS after scheduling all instances by value."""
    one.schedule(MESH, np.ones(4, bool), np.array(value, np.float32), lambda done, of: None)
    return (one.blas.scenes != 0).tolist()


def test_without_limits_everything_is_resident() -> None:
    one = residency()
    assert not one.limited and not one.deferred
    assert scheduled(one, [1, 1, 1, 1]) == [True] * 3


def test_what_is_worth_most_is_resident_and_stays_while_others_are_worth_less_than_twice_as_much() -> None:
    one = residency()
    scheduled(one, [1, 1, 1, 1])
    each = one.blas.bytes // 3
    one = residency(limit=each + each // 2)
    assert one.limited and not one.deferred
    scheduled(one, [1, 1, 1, 1])  # how large they are is known from now on
    assert scheduled(one, [3, 1, 1, 1]) == [True, False, False]  # two users of mesh 2 are worth 2
    assert one.waiting(MESH, np.ones(4, bool)).tolist() == [1, 2, 3]
    assert one.waiting(MESH, np.array([True, True, False, False])).tolist() == [1]
    assert scheduled(one, [1.1, 1, 1, 1]) == [True, False, False]
    assert scheduled(one, [0.9, 0, 1, 1]) == [False, False, True]


def test_a_budget_of_time_defers() -> None:
    assert residency(seconds=0.001).limited
    assert residency(seconds=0.001).deferred
