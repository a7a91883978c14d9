"""The blocks of README and docs that install, update and remove, in order, in a clone of the repository with a home of
its own."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

import lipac

from .pages import ROOT, blocks

pytestmark = pytest.mark.slow
MARK = f"{Path(__file__).relative_to(ROOT)}: in a checkout of its own"
INSTALL, UPDATE, REMOVE = [block.text for block in blocks(ROOT / "docs" / "install.md") if block.reason == MARK]
(FIRST,) = [block.text for block in blocks(ROOT / "README.md") if block.reason == MARK]


def test_install_update_remove(tmp_path: Path) -> None:
    """What is installed here is found there, too, so that pip has nothing to load but what the lock has anew."""
    if not (ROOT / ".git").exists() or not shutil.which("git"):
        pytest.skip("not a checkout")
    home, origin, clone = tmp_path / "home", tmp_path / "origin", tmp_path / "lipac"
    kernels = home / ".cache" / "lipac"
    kernels.mkdir(parents=True)
    (home / ".gitconfig").write_text("[safe]\ndirectory = *\n[user]\nname = me\nemail = me@example.org\n")
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("LIPAC", "XDG", "MAKE"))}
    environment |= {"HOME": str(home)}
    # of its own branch, whatever this checkout stands at
    git = f"git init -q -b main {origin} && git archive HEAD | tar -xf - -C {origin} && cd {origin} && git add -A && "
    git += f"git commit -q -m all && git clone -q {origin} {clone}"
    subprocess.run(["sh", "-c", git], check=True, cwd=ROOT, env=environment)
    subprocess.run([sys.executable, "-m", "venv", str(clone / ".venv")], check=True)
    (site,) = (clone / ".venv" / "lib").glob("python*/site-packages")
    (site / "here.pth").write_text(sysconfig.get_paths()["purelib"] + "\n")

    def run(block: str) -> str:
        done = subprocess.run(
            ["sh", "-e"], input=block, capture_output=True, text=True, check=False, cwd=clone, env=environment
        )
        assert done.returncode == 0, block + done.stdout + done.stderr
        return done.stdout

    run(FIRST)
    version = run(INSTALL).splitlines()[-1]
    assert version == lipac.__version__
    assert (clone / ".venv" / ".installed").exists()
    run(UPDATE)
    assert run(".venv/bin/lipac --version\n").strip() == version
    run(REMOVE)
    assert not kernels.exists()
    assert not (clone / ".venv").exists()
    assert (clone / "README.md").exists()
