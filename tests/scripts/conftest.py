"""Commands' reports are held against their schema."""

from collections.abc import Iterator

import pytest

from ..reports import checked_reports

HAND_MADE = ("test_report.py",)  # of reports that nobody would write


@pytest.fixture(autouse=True)
def reports(request: pytest.FixtureRequest) -> Iterator[None]:
    """Those that are written in this process."""
    if request.path.name in HAND_MADE:
        yield
        return
    with checked_reports():
        yield
