"""Run the quick tests on whatever the package index serves today, upper bounds ignored, and print one line: what moved
from the lock, and what broke.

Reports, and never fails. Where tests break, moved packages go back to their locked versions in turn: the first that
mends all failures so is named.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
VENV = ROOT / ".venv-newest"
PIP = [str(VENV / "bin" / "python"), "-m", "pip", "--disable-pip-version-check"]
MINUTES = 12


def unbounded() -> list[str]:
    """Direct requirements of the project and its tests, without their versions."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    lines = [*project["dependencies"], *extras["test"], *extras["extension"], *extras["browser"]]
    names = (re.match(r"[\w-]+", line) for line in lines)
    return sorted({match[0] for match in names if match} - {"lipac"})


def versions(script: str) -> dict[str, str]:
    """Version by normalized name, as a line of Python in the environment prints them."""
    done = subprocess.run([VENV / "bin" / "python", "-c", script], capture_output=True, text=True, check=True, cwd=ROOT)
    return dict(line.split("==") for line in done.stdout.split())


INSTALLED = """
import re
from importlib.metadata import distributions
print(*{re.sub(r"[-_.]+", "-", d.name).lower() + "==" + d.version for d in distributions()})
"""
LOCKED = """
from lipac.scripts.dev.lock import pins
print(*(f"{name}=={version}" for name, version in pins().items()))
"""


def tests(*options: str) -> tuple[int, str]:
    """Exit status of pytest on the quick tests, and its closing line."""
    command = [
        VENV / "bin" / "python",
        "-m",
        "pytest",
        "-q",
        "-m",
        "not slow and not blender",  # what touches Blender is tested on the newest by `make blender`
        "-o",
        f"cache_dir={VENV}/pytest",
        *options,
    ]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT, timeout=60 * MINUTES)
    except subprocess.TimeoutExpired:
        return 1, f"not done after {MINUTES} minutes"
    lines = (done.stdout + done.stderr).strip().splitlines() or ["no output"]
    print("\n".join(lines[-40:]), file=sys.stderr)
    return done.returncode, lines[-1].strip("= ")


def main(requirements: Sequence[str]) -> str:
    """The line. requirements: what to install beside the newest, such as numpy==2.6.0."""
    subprocess.run([sys.executable, "-m", "venv", "--clear", VENV], check=True)
    subprocess.run([*PIP, "install", "-q", "setuptools", *unbounded(), *requirements], check=True)
    subprocess.run([*PIP, "install", "-q", "--no-deps", "--no-build-isolation", "-e", str(ROOT)], check=True)
    installed, locked = versions(INSTALLED), versions(LOCKED)
    moved = {
        name: (version, installed[name]) for name, version in locked.items() if installed.get(name, version) != version
    }
    if not moved:
        return "the lock's versions, nothing moved"
    names = ", ".join(f"{name} {old} -> {new}" for name, (old, new) in moved.items())
    status, closing = tests()
    if not status:
        return f"{closing} with {names}"
    # 2: some files could not even be collected, which is quickly seen; else only what failed has to run again
    again = ("--collect-only",) if status == 2 else ("--last-failed", "--last-failed-no-failures=none", "-x")
    mended = "none of them alone"
    for name, (old, new) in sorted(moved.items(), key=lambda item: item[0] == "bpy"):  # the largest last
        if subprocess.run([*PIP, "install", "-q", "--no-deps", f"{name}=={old}"], check=False).returncode:
            continue
        if tests(*again)[0] == 0:
            mended = name
            break
        subprocess.run([*PIP, "install", "-q", "--no-deps", f"{name}=={new}"], check=False)
    return f"{closing} with {names}; {mended} at the lock's version mends it"


if __name__ == "__main__":
    try:
        print(f"packages of today: {main(sys.argv[1:])}")
    except Exception as error:
        print(f"packages of today: not tested, {error}")
