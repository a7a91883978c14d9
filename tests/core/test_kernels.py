"""Compiling is said, and nothing else meanwhile."""

from __future__ import annotations

import math

import numba

from lipac.core.kernels import telling


def test_compiling_is_said_and_nothing_else_meanwhile():
    said = []

    @numba.njit
    def inner(x):
        return x + 1

    @numba.njit
    def outer(x):
        return inner(x) * 2

    with telling(lambda fraction, what: said.append((fraction, what))) as progress:
        progress(0.5, "tracing")
        assert outer(3) == 8
        progress(0.6, "building")
    outer(3.0)  # outside: not told
    assert said[0] == (0.5, "tracing")
    assert said[-1] == (0.6, "building")
    assert len(said) == 4
    assert all(math.isnan(fraction) and what.startswith("compiling kernels") for fraction, what in said[1:-1])
