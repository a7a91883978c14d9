"""Arrays on disk: rows as they were, and what the disk does not take stays in memory."""

from __future__ import annotations

import errno
import tempfile
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from lipac.core.files.scratch import Scratch

ARRAYS: list[NDArray[Any]] = [
    np.arange(60, dtype=np.float32).reshape(10, 3, 2),
    np.arange(7, dtype=np.int32),
    np.zeros((0, 3), np.uint32),
    np.arange(40, dtype=np.uint16).reshape(10, 4)[:, ::2],
]


def test_rows_are_what_was_put() -> None:
    scratch = Scratch()
    for array, rows in [(array, scratch.put(array)) for array in ARRAYS]:
        assert rows.file is not None
        assert len(rows) == len(array)
        for part in (slice(None), slice(2, 5), slice(3, 3), slice(5, 99)):
            assert rows[part].dtype == array.dtype
            assert np.array_equal(rows[part], array[part])


def test_what_the_disk_has_no_room_for_stays_in_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    scratch = Scratch()
    first = scratch.put(ARRAYS[0])

    class Full:
        def __getattr__(self, name: str) -> Any:
            return getattr(file, name)

        def write(self, _: memoryview) -> int:
            raise OSError(errno.ENOSPC, "no space")

    file, scratch._file = scratch._file, Full()  # type: ignore[assignment]
    second = scratch.put(ARRAYS[1])
    assert second.file is None
    assert np.array_equal(first[1:4], ARRAYS[0][1:4])
    assert np.array_equal(second[1:4], ARRAYS[1][1:4])
    monkeypatch.setattr(tempfile, "TemporaryFile", lambda **_: (_ for _ in ()).throw(FileNotFoundError))
    assert np.array_equal(Scratch().put(ARRAYS[0])[:], ARRAYS[0])


def test_rows_are_read_one_after_the_other_alone() -> None:
    with pytest.raises(ValueError, match="one after the other"):
        Scratch().put(ARRAYS[0])[::2]
