"""Native code that crashes is told in one line, with a status, by `lipac` too; Python's own handlers come back."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from lipac.scripts.command.last_words import last_words

from ...hard.inside_blender import stage
from ...processes import INTERRUPTIBLE, saved

pytestmark = pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
SEGFAULT, ABORT = "import ctypes; ctypes.string_at(0)", "import os; os.abort()"
THREAD = "import threading, ctypes; t = threading.Thread(target=ctypes.string_at, args=(0,)); t.start(); t.join()"


def process(code: str, *arguments: str, **options: Any) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, timeout=300, check=False, **options
    )


# The tests' own: Numba imports it where it is installed, and its OpenBLAS asks for memory for ever where there is none
# (Python 3.11).
WITHOUT_SCIPY = "import sys; sys.modules['scipy'] = None"
EXIT = "import ctypes; ctypes.CDLL(None).exit(1)"  # as OpenBLAS does where it gets no memory


@pytest.mark.parametrize("crash", [SEGFAULT, ABORT, THREAD, EXIT])
def test_a_crash_is_a_line_and_a_status(crash: str) -> None:
    """Also where Blender's chatter is muted, and the innermost block's."""
    code = f"""
from lipac.scripts.command.last_words import last_words
from lipac.lipac_addon.console import muted
with last_words("outer", 1):
    with last_words("of the file, ä", 2), muted():
        print("chatter")
        {crash}
"""
    done = process(code)
    assert (done.returncode, done.stderr, done.stdout) == (2, "of the file, ä\n", "")


def test_after_a_block_it_is_as_before() -> None:
    code = f"""
from lipac.scripts.command.last_words import last_words
with last_words("outer", 3):
    with last_words("inner", 2):
        pass
    {{}}
{SEGFAULT}
"""
    assert process(code.format("pass")).returncode == -signal.SIGSEGV
    done = process(code.format(SEGFAULT))
    assert (done.returncode, done.stderr) == (3, "outer\n")
    with last_words("here", 1):
        assert signal.getsignal(signal.SIGSEGV) is not None


def test_a_crash_at_the_end_changes_nothing() -> None:
    """Blender's own end crashes where memory is short: what was said, and the status, stay."""
    code = f"""
import sys, atexit
from lipac.scripts.command.last_words import nothing_more
def crash():
    {SEGFAULT}
if len(sys.argv) > 1:
    atexit.register(crash)
print("written", end="")
print("said", end="", file=sys.stderr)
nothing_more(2)
print("not said", file=sys.stderr)
sys.exit(2)
"""
    for arguments in ((), ("crash",)):
        done = process(code, *arguments)
        assert (done.returncode, done.stdout if not arguments else "written", done.stderr) == (2, "written", "said")


@pytest.fixture(scope="module")
def stage_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return saved(stage, tmp_path_factory.mktemp("scene") / "stage.blend")


COMMAND = """
import sys
from lipac.lipac_addon import open as opening
from lipac.scripts.lipac import main
{}
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.parametrize("cull", ["none", "light-paths"])
def test_a_reader_that_crashes(cull: str, stage_file: Path, tmp_path: Path) -> None:
    """As Blender's does on some damaged files: unusable input."""
    crash = "opening._check_files = lambda: __import__('ctypes').string_at(0)"
    done = process(COMMAND.format(crash), "render", str(stage_file), "-o", str(tmp_path), "--cull", cull, "--quiet")
    assert done.returncode == 2
    assert (
        done.stderr.startswith(f"lipac render: cannot read {stage_file}: its reader crashed")
        and done.stderr.count("\n") == 1
    )


@pytest.mark.skipif(sys.platform != "linux", reason="address space that can be limited")
@pytest.mark.parametrize("space", [0.6e9, 0.9e9, 1.2e9, 1.5e9, 1.8e9])
def test_too_little_memory(space: float, stage_file: Path, tmp_path: Path) -> None:
    """From what loads no library to what starts rendering: one line that says memory, and status 1; where the file
    cannot be read for it, 2."""
    import resource

    options = ["render", str(stage_file), "-o", str(tmp_path), "--resolution", "32x18", "--samples", "1", "--quiet"]
    limit: dict[str, Any] = {"preexec_fn": lambda: resource.setrlimit(resource.RLIMIT_AS, (int(space), int(space)))}
    done = process(
        f"{WITHOUT_SCIPY}; from lipac.scripts.lipac import main; import sys; sys.exit(main())",
        *options,
        **limit,
    )
    if done.returncode == 0:
        pytest.skip("it is enough")
    assert done.returncode in (1, 2), (done.returncode, done.stderr)
    assert done.stderr.count("\n") == 1 and "memory" in done.stderr, done.stderr


def test_ctrl_c_while_something_is_imported(tmp_path: Path) -> None:
    """What is being imported makes another error of it."""
    code = """
import importlib, os, signal, sys
from lipac.scripts import lipac
def broken(*_):
    try:
        os.kill(os.getpid(), signal.SIGINT)
        sum(range(10**6))
    except KeyboardInterrupt:
        raise ImportError("IMPORTANT: PLEASE READ THIS")
importlib.import_module = broken
sys.exit(lipac.main(["render"]))
"""
    done = process(code, **INTERRUPTIBLE)
    assert (done.returncode, done.stderr) == (130, "lipac render: stopped; finished frames and their report are kept\n")
