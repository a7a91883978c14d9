"""Work that ends at a random moment: a few here; `python -m lipac.scripts.dev.fuzz faults` does as many as wanted."""

from __future__ import annotations

import subprocess
import sys

import bpy
import pytest

from lipac.lipac_addon import writeback

if sys.platform == "win32":
    pytest.skip("faults of POSIX", allow_module_level=True)

from . import fuzz_faults
from .choices import Seeded

FIRST = 10**6  # seeds other than those of recorded runs


@pytest.mark.parametrize("what", ["apply", "restore"])
def test_write_back_is_interrupted(what: str) -> None:
    ended = [fuzz_faults.run(seed, what)["features"][1] for seed in range(FIRST, FIRST + 20)]
    assert {"KeyboardInterrupt", "MemoryError"} <= set(ended)
    bpy.ops.wm.read_factory_settings(use_empty=True)


def test_an_apply_that_leaves_something_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """The check itself: without what takes back a failed apply, objects stay hidden."""
    monkeypatch.setattr(writeback, "restore", lambda in_render=False: False)
    with pytest.raises(AssertionError, match=r"all or nothing|does not put back"):
        for seed in range(FIRST, FIRST + 10):
            fuzz_faults.run(seed, "apply")
    bpy.ops.wm.read_factory_settings(use_empty=True)


def test_a_command_that_does_not_end_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fuzz_faults, "INTERRUPTED", 0.1)
    process = subprocess.Popen([sys.executable, "-c", "while True: pass"], stderr=subprocess.PIPE, text=True)
    with pytest.raises(AssertionError, match="does not end"):
        fuzz_faults.words(process, "it")
    assert process.poll() is not None


@pytest.mark.parametrize("what", fuzz_faults.COMMANDS)
def test_commands_end_early(what: str) -> None:
    """One of each fault; half of them in each kind of render."""
    seeds = (seed for seed in range(FIRST, FIRST + 1000))
    killed, cancelled, disk, memory = fuzz_faults.FAULTS
    halves = {
        "render cycles": (cancelled, disk), "render path": (cancelled, disk), "render baked": (killed, memory)
    }  # fmt: skip
    left = set(halves.get(what, fuzz_faults.FAULTS))
    while left:
        seed = next(seeds)
        if (fault := Seeded(seed + 2**33).one(fuzz_faults.FAULTS)) in left:
            left.remove(fault)
            assert fault in fuzz_faults.run(seed, what)["features"]
