"""Levels of meshes in files, and of several frames together."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lipac.core.files.level import AnyLevel, Level, Steps, finest, level_arrays, read_levels


def level(count: int, seed: int = 0) -> Level:
    """One of so many triangles."""
    rng = np.random.default_rng(seed)
    return Level(rng.integers(0, 99, (count, 3)).astype(np.int32), rng.integers(0, 33, count).astype(np.int32))


@pytest.mark.parametrize("names", [(), ("a",), ("b", "c"), ("a", "b", "c")])
def test_files_give_back_both_kinds(names: tuple[str, ...], tmp_path: Path) -> None:
    one = level(5)
    levels: dict[str, AnyLevel] = {"a": Steps(2), "b": one, "c": one}
    chosen = {name: levels[name] for name in names}
    np.savez(tmp_path / "file.npz", **level_arrays(chosen))  # type: ignore[arg-type]
    with np.load(tmp_path / "file.npz") as data:
        found = read_levels(data)
    assert found.keys() == chosen.keys()
    if "a" in names:
        assert found["a"] == Steps(2)
    if "b" in names:
        assert found["b"] is found["c"] and isinstance(found["b"], Level)
        assert np.array_equal(found["b"].corners, one.corners) and np.array_equal(found["b"].faces, one.faces)


def test_the_finer_of_two() -> None:
    assert finest(Steps(1), Steps(3), False) == Steps(1)
    few, many = level(4), level(9)
    assert finest(few, many, False) is many and finest(many, few, False) is many
    assert finest(few, level(4), True) is few  # the same
    assert finest(few, many, True) is None  # each has the faces of its frame
    assert finest(Steps(1), few, False) is None
