"""Markers that follow from where a test is: what lies under lipac_addon/ touches Blender."""

import pytest


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests of lipac_addon/ as `blender`."""
    for item in items:
        if "lipac_addon" in item.path.relative_to(item.config.rootpath).parts:
            item.add_marker("blender")
