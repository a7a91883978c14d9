"""Compiled kernels are kept per user and per state of the sources."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

import lipac.core
from lipac.core import kernel_cache

PROBE = "import lipac.core, numba; print(numba.config.CACHE_DIR)"


def test_numba_uses_the_folder_whether_imported_before_or_after(tmp_path: Path) -> None:
    environment = {**os.environ, "LIPAC_CACHE_DIR": str(tmp_path)}
    environment.pop("NUMBA_CACHE_DIR", None)
    for code in (PROBE, "import numba; " + PROBE):
        out = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True).stdout.strip()
        assert Path(out).parent == tmp_path
        assert Path(out).is_dir()


def test_changed_sources_use_another_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    copy = tmp_path / "core"
    copy.mkdir()
    for path in Path(lipac.core.__file__).parent.glob("*.py"):
        shutil.copy(path, copy)
    monkeypatch.setenv("NUMBA_CACHE_DIR", os.environ.get("NUMBA_CACHE_DIR", ""))
    from numba.core import config

    monkeypatch.setattr(config, "CACHE_DIR", getattr(config, "CACHE_DIR"))  # noqa: B009
    monkeypatch.setattr(kernel_cache, "__file__", str(copy / "kernel_cache.py"))
    before = kernel_cache.use(tmp_path / "cache")
    (copy / "bsdf.py").write_text((copy / "bsdf.py").read_text() + "\n")
    after = kernel_cache.use(tmp_path / "cache")
    assert before
    assert after
    assert before != after
    os.utime(before, (time.time() - 1e7,) * 2)
    kernel_cache.use(tmp_path / "cache")
    assert not before.exists()  # long unused
    assert after.exists()


def test_what_kernels_do_not_use_is_no_source_of_theirs() -> None:
    names = {path.stem for path in kernel_cache.kernel_sources(Path(lipac.core.__file__).parent)}
    assert {"path_kernel", "bsdf", "feedback", "scene", "blas"} <= names  # feedback has no kernel, but constants of kernels
    assert not {"loop", "analysis", "culling", "report"} & names


def test_a_folder_that_cannot_be_written_is_no_error(tmp_path: Path) -> None:
    blocker = tmp_path / "file"
    blocker.write_text("")
    assert kernel_cache.use(blocker / "below") is None
