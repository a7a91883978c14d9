"""Counts of a trace."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lipac.core.feedback.hits import Feedback, sparse_zeros


def _resident() -> int:
    """Bytes of this process in memory."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


def test_sparse_zeros_are_zeros() -> None:
    for shape in ((0, 5), (3, 5)):
        zeros = sparse_zeros(shape)
        assert zeros.shape == shape
        assert zeros.dtype == np.int64
        assert not zeros.any()
        zeros += 2
        assert (zeros == 2).all()


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="needs /proc")
def test_hits_take_memory_where_something_was_met() -> None:
    """500 of 5 million instances, evenly spread: 500 pages of 4 kB. Pages of 2 MB would be all 200 MB."""
    before = _resident()
    feedback = Feedback.zeros(5_000_000)
    feedback.hits[::10_000] += 1
    assert _resident() - before < 20e6
    assert feedback.hits[::10_000].sum() == 2500
