"""Arrays that wait on disk until somebody needs some of their rows."""

from __future__ import annotations

import os
import tempfile
from dataclasses import dataclass
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Rows:
    """An array of a `Scratch`, of which slices are read. start: where it begins in the file; like: it, without rows; or
    it itself, where there is no file."""

    file: IO[bytes] | None
    start: int
    count: int
    like: NDArray[Any]

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, rows: slice) -> NDArray[Any]:
        """Some of its rows, one after the other. Raises ValueError for others."""
        first, end, step = rows.indices(self.count)
        if step != 1:
            raise ValueError("rows are read one after the other")
        if self.file is None or end <= first:
            return self.like[rows] if self.file is None else self.like
        out = np.empty((end - first, *self.like.shape[1:]), self.like.dtype)
        self.file.seek(self.start + first * (out.nbytes // len(out)))
        view = memoryview(out).cast("B")
        while view:
            read = self.file.readinto(view)  # type: ignore[attr-defined]
            if not read:
                raise OSError("a temporary file of LiPaC has lost what was written to it")
            view = view[read:]
        return out


class Scratch:
    """A file of arrays that is gone with it, and with the process. What the disk has no room for stays in memory. Not
    to be asked by two threads at once."""

    def __init__(self) -> None:
        self._file: IO[bytes] | None = None
        self._end = 0

    def put(self, array: NDArray[Any]) -> Rows:
        """Keep an array of one or more dimensions."""
        array = np.ascontiguousarray(array)
        try:
            if self._file is None:
                self._file = tempfile.TemporaryFile(buffering=0, dir=_folder())  # noqa: SIM115 as long as this
            self._file.seek(self._end)
            view = memoryview(array).cast("B") if array.size else memoryview(b"")
            while view:
                view = view[self._file.write(view) :]
        except OSError:
            return Rows(None, 0, len(array), array)
        start, self._end = self._end, self._end + array.nbytes
        return Rows(self._file, start, len(array), array[:0].copy())


def _folder() -> str | None:
    """Where temporary files lie on a disk: many a system has the usual folder in memory. What the user says goes."""
    return "/var/tmp" if "TMPDIR" not in os.environ and os.access("/var/tmp", os.W_OK) else None
