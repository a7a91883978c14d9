"""The installation itself: the package imports, its native libraries load, core/ is free of bpy."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import pytest
from packaging.utils import canonicalize_name

import lipac
from lipac.scripts.dev.lock import LOCK, pins

ROOT = Path(lipac.__file__).parent


@pytest.mark.smoke
def test_core_and_page_import_without_bpy() -> None:
    modules = [
        ".".join(("lipac", *path.relative_to(ROOT).with_suffix("").parts)).removesuffix(".__init__")
        for folder in ("core", "page")
        for path in sorted((ROOT / folder).rglob("*.py"))
    ]
    assert "lipac.core.tracing.bsdf.lobes" in modules
    code = f"import importlib, sys; [importlib.import_module(m) for m in {modules!r}]; sys.exit('bpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_core_and_page_never_mention_bpy_in_an_import() -> None:
    for path in (*(ROOT / "core").glob("**/*.py"), *(ROOT / "page").glob("**/*.py")):
        assert not re.search(r"^\s*(import|from)\s+bpy", path.read_text(), re.MULTILINE), path


def test_every_room_is_packed() -> None:
    """By pip; the extension's zip takes whole folders."""
    tops = [ROOT / name for name in ("core", "page", "lipac_addon", "scripts")]
    rooms = {
        ".".join(("lipac", *path.parent.relative_to(ROOT).parts)) for top in tops for path in top.rglob("__init__.py")
    }
    assert set(tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]) == rooms | {
        "lipac"
    }


@pytest.mark.smoke
def test_command_is_installed() -> None:
    command = Path(sys.executable).parent / "lipac"
    done = subprocess.run([command, "--help"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    for name in ("demo", "analyze", "render"):
        assert name in done.stdout


def test_what_is_installed_is_what_the_lock_says() -> None:
    prefix = Path(sys.prefix)
    if not (prefix / ".installed-test").exists() or (prefix / ".another-blender").exists():
        pytest.skip("not installed by make, or with a Blender on purpose that the lock does not name")
    installed = {canonicalize_name(d.name): d.version for d in metadata.distributions()}
    assert {name: version for name, version in installed.items() if name not in ("lipac", "pip")} == pins()


def test_the_lock_is_one_for_every_python_and_names_no_place() -> None:
    assert pins({"python_full_version": "3.11.9"})["bpy"].startswith("5.0.")
    assert pins({"python_full_version": "3.13.0"})["bpy"].startswith("5.2.")
    assert "colorama" in pins({"sys_platform": "win32"}), "the lock lacks what only other platforms need"
    for path in LOCK.parent.glob("requirements*.txt"):
        assert not re.search(r"://|--(index|extra|find)|@ ", path.read_text()), path
        tested = LOCK.read_text()
        assert all(pin in tested for pin in re.findall(r"^[\w.-]+==\S+", path.read_text(), re.MULTILINE)), (
            "the two locks differ: make lock"
        )
