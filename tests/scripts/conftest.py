"""Commands' reports are held against their schema."""

from collections.abc import Iterator

import pytest

from ..reports import checked_reports


@pytest.fixture(autouse=True, scope="package")
def reports() -> Iterator[None]:
    """Those that are written in this process."""
    with checked_reports():
        yield
