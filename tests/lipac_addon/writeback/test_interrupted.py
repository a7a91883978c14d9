"""All or nothing at each line: whatever line of what makes and removes the means an interrupt falls on, the first time
that it runs, and the last time."""

from contextlib import suppress
from pathlib import Path

import bpy
import numpy as np
import pytest

from lipac.lipac_addon import writeback
from lipac.tests.hard import fuzz_faults
from lipac.tests.lipac_addon.writeback import test_emptying as scenes

FILES = ("__init__.py", "mask.py", "marks.py", "emptying.py")


def numbered(lines):
    """Each line that ran, by the order, and its number in the file."""
    return list(enumerate(lines[1:], 1))


@pytest.mark.parametrize("what", ["apply", "restore"])
@pytest.mark.parametrize("file", FILES)
def test_each_line(file, what, new_file, census_keys, snapshot, monkeypatch):
    scenes.picked()
    scenes.link(scenes.triangle("plain"))
    keys, _ = census_keys()
    culled = (keys.records["object"] == keys.names.index("plain")) | scenes.of_unseen(keys)
    before = snapshot()
    monkeypatch.setattr(fuzz_faults, "WRITEBACK", str(Path(writeback.__file__).parent / file))

    def begin():
        writeback.restore()
        if what == "restore":
            writeback.apply(culled, keys, free=True)

    def do():
        return writeback.apply(culled, keys, free=True) if what == "apply" else writeback.restore()

    begin()
    with fuzz_faults.raising(0, KeyboardInterrupt) as lines:
        done = do()
    assert what == "restore" or (done.objects, done.hosts, done.sources) == (1, 1, 1)
    first, last = ({number: k for k, number in order} for order in (numbered(lines)[::-1], numbered(lines)))
    for line in sorted({*first.values(), *last.values()}):
        begin()
        with suppress(KeyboardInterrupt), fuzz_faults.raising(line, KeyboardInterrupt):
            do()
            assert what == "restore", "the interrupt was lost"
        if what == "apply":
            assert snapshot() == before, f"{file}, line {line} of {lines[0]}"
        writeback.restore()
        assert snapshot() == before, f"{file}, line {line} of {lines[0]}, after Restore"
    assert np.count_nonzero(culled) and len(first) > 2
    bpy.ops.wm.read_factory_settings(use_empty=True)
