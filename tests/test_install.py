"""The installation itself: the package imports, its native libraries load, core/ is free of bpy."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

import lipac

ROOT = Path(lipac.__file__).parent


@pytest.mark.smoke
def test_core_imports_without_bpy() -> None:
    modules = [f"lipac.core.{path.stem}" for path in sorted((ROOT / "core").glob("*.py"))]
    code = f"import importlib, sys; [importlib.import_module(m) for m in {modules!r}]; sys.exit('bpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_core_never_mentions_bpy_in_an_import() -> None:
    for path in (ROOT / "core").glob("**/*.py"):
        assert not re.search(r"^\s*(import|from)\s+bpy", path.read_text(), re.MULTILINE), path


@pytest.mark.smoke
def test_command_is_installed() -> None:
    command = Path(sys.executable).parent / "lipac"
    done = subprocess.run([command, "--help"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    for name in ("demo", "analyze", "render"):
        assert name in done.stdout
