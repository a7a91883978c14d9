"""Jobs' reports are held against their schema."""

from collections.abc import Iterator

import pytest

from ...reports import checked_reports


@pytest.fixture(autouse=True, scope="module")
def reports() -> Iterator[None]:
    """All that are written here."""
    with checked_reports():
        yield
