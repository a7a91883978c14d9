"""Markers that follow from where a test is; what several workers share (`make test`, pytest-xdist)."""

import os
import subprocess
import sys

import pytest

SLOW = ("scripts", "hard", "raster")  # processes of their own, millions of rays, EEVEE without a graphics card


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests of lipac_addon/ as `blender`, those of SLOW as `slow`; workers take slow files first, so that
    they end together."""
    for item in items:
        folders = item.path.relative_to(item.config.rootpath).parts[:-1]
        if "lipac_addon" in folders:
            item.add_marker("blender")
        if any(name in folders for name in SLOW):
            item.add_marker("slow")
    if "PYTEST_XDIST_WORKER" in os.environ:
        items.sort(key=lambda item: item.get_closest_marker("slow") is None)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_setupnodes() -> None:
    """Compile kernels before workers begin: all of them would compile the same at the same time."""
    code = "from lipac.lipac_addon.family_trial import warm; warm()"
    subprocess.run([sys.executable, "-c", code], stdout=subprocess.DEVNULL, check=False)  # tests tell why
