"""Markers that follow from where a test is."""

import pytest

SLOW = ("scripts", "hard", "raster")  # processes of their own, millions of rays, EEVEE without a graphics card


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests of lipac_addon/ as `blender`, those of SLOW as `slow`."""
    for item in items:
        folders = item.path.relative_to(item.config.rootpath).parts[:-1]
        if "lipac_addon" in folders:
            item.add_marker("blender")
        if any(name in folders for name in SLOW):
            item.add_marker("slow")
