"""When stages of two threads were at work."""

import pytest

from lipac.lipac_addon.timeline import Timeline

STAGES = [
    ("draw", "main", 0.0, 2.0),
    ("analysis", "worker", 1.0, 6.0),
    ("draw", "main", 4.0, 5.0),
    ("trace", "worker", 6.0, 9.0),
    ("save", "main", 8.0, 10.0),
]


@pytest.mark.parametrize(("without", "seconds"), [((), 10.0), (("analysis",), 7.0), (("draw", "analysis"), 4.0)])
def test_time_of_two_threads_counts_once(without, seconds):
    """All seconds here are exact in floating point."""
    assert Timeline(0.0, STAGES).elapsed(without) == seconds


def test_overlap():
    assert Timeline(0.0, STAGES).overlap == 3.0
