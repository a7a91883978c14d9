"""The union of frames: the same from frames and from chunks of them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lipac.core.culling.options import State
from lipac.core.errors import InputError
from lipac.core.files.report import save_states
from lipac.lipac_addon.farm.layout import FarmShot
from lipac.lipac_addon.farm.unite import digest_of, parts_of, unite_chunk, united
from lipac.lipac_addon.keys import KEY, Kind

NAMES = [f"object {k}" for k in range(12)]
FACES = 10


def save_frame(shot: FarmShot, frame: int, rng: np.random.Generator) -> None:
    """A frame with some of twelve objects and of a scatter's rows, of which some are kept, one or another by parts."""
    present, rows = rng.permutation(12)[: rng.integers(1, 13)], rng.permutation(30)[: rng.integers(0, 31)]
    records = np.zeros(len(present) + len(rows), KEY)
    records["path"], records["host"] = -1, -1
    records["object"][: len(present)] = present
    scatter = records[len(present) :]
    scatter["kind"], scatter["host"], scatter["object"], scatter["path"][:, 0] = Kind.GEOMETRY_NODES, 3, 5, rows
    keep = rng.random(len(records)) < 0.4
    parted = [int(k) for k in present[keep[: len(present)]] if rng.random() < 0.5]
    faces = {NAMES[k]: rng.random(FACES + (k == 7 and frame % 2)) < 0.3 for k in parted}
    names = list(rng.permutation(NAMES))
    of = np.array([names.index(name) for name in NAMES])
    records["object"] = of[records["object"]]
    scatter["host"] = of[scatter["host"]]
    shot.analysis(frame).parent.mkdir(exist_ok=True)
    state = np.where(keep, np.uint8(State.ACTIVE), np.uint8(State.CULLED))
    score, hits = np.zeros(len(keep), np.float32), np.zeros((len(keep), 5), np.int64)
    save_states(shot.analysis(frame), state, score, hits, records, names, json.dumps({"key": shot.key}), faces=faces)


def save_all(folder: Path, seed: int) -> FarmShot:
    shot, rng = FarmShot(folder, folder / "a.blend", "", 1, 10), np.random.default_rng(seed)
    for frame in shot.frames:
        save_frame(shot, frame, rng)
    return shot


def set_of(shot: FarmShot, paths: Sequence[Path]) -> tuple[str, set[tuple[Any, ...]], dict[str, list[bool]]]:
    """Its digest; what is kept, by name; and which faces."""
    together = united(shot, paths)
    records, names = together.keys.records[together.active], (*together.keys.names, None)
    kept = {(r["kind"].item(), names[r["host"]], names[r["object"]], r["path"].tobytes()) for r in records}
    return digest_of(together), kept, {name: mask.tolist() for name, mask in together.faces.items()}


@pytest.mark.parametrize("seed", range(8))
def test_chunks_give_the_set_of_their_frames(tmp_path: Path, seed: int) -> None:
    """Whatever was united before; also where instances come and go, and where a mesh changes."""
    shot = save_all(tmp_path, seed)
    frames = list(map(shot.analysis, shot.frames))
    assert parts_of(shot) == frames
    for first, last in ((1, 3), (4, 4), (5, 6), (7, 10), (2, 9)):
        unite_chunk(shot, range(first, last + 1))
    assert [path.stem for path in parts_of(shot)] == [
        "frames_0001-0003", "frame_0004", "frames_0005-0006", "frames_0007-0010"
    ]  # fmt: skip
    assert set_of(shot, parts_of(shot)) == set_of(shot, frames)
    assert set_of(shot, frames[::-1]) == set_of(shot, frames)
    assert len({set_of(shot, frames[:k])[0] for k in (1, 2, 10)}) == 3


def test_chunks_of_other_analyses_do_not_count(tmp_path: Path) -> None:
    """A frame that was analysed again, is missing, or is damaged."""
    shot = save_all(tmp_path, 0)
    unite_chunk(shot, shot.frames)
    at = shot.chunk(shot.frames).stat().st_mtime_ns
    unite_chunk(shot, shot.frames)
    assert shot.chunk(shot.frames).stat().st_mtime_ns == at
    save_frame(shot, 4, np.random.default_rng(1))
    assert parts_of(shot) == list(map(shot.analysis, shot.frames))
    unite_chunk(shot, shot.frames)
    assert parts_of(shot) == [shot.chunk(shot.frames)]
    shot.analysis(5).write_bytes(shot.analysis(5).read_bytes()[:-30])
    shot.analysis(6).unlink()
    with pytest.raises(InputError, match=r"damaged: frame_0005, frame_0006;"):
        united(shot, parts_of(shot))
