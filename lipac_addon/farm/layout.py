"""A shot on a shared folder: what is asked, and which file holds what."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ...core.culling.options import CullOptions
from ...core.error_budget.budget import Budget
from ...core.errors import InputError
from ...core.files.atomic import is_whole, replacing
from ...core.files.shell import quoted

SCHEMA = 1
JOB = "job.json"
SCRIPT = "render/render_frames.py"


@dataclass(frozen=True)
class FarmShot:
    """What is asked of a shot. folder: where all of it lies; scene: the file, which each machine may see elsewhere.
    These two are no part of `key`.

    digest: SHA-256 of the scene and what it links. first, last: frames. mean, worst: the error budget. paths: per pixel
    of an analysis, 0: as many as the budget needs. resolution, samples: None as in the scene. checks: so many frames
    are verified, in so many crops of the picture each. ending: of pictures.
    """

    folder: Path
    scene: Path
    digest: str
    first: int
    last: int
    mean: float = 0.01
    worst: float = 0.05
    paths: int = 0
    seed: int = 0
    resolution: tuple[int, int] | None = None
    samples: int | None = None
    checks: int = 2
    crops: int = 2
    ending: str = ".png"
    schema: int = field(default=SCHEMA, init=False)

    @cached_property
    def key(self) -> str:
        """What all results depend on, as a hash."""
        return hashlib.sha256(json.dumps(self._asked, sort_keys=True).encode()).hexdigest()

    @property
    def _asked(self) -> dict[str, Any]:
        return {name: value for name, value in dataclasses.asdict(self).items() if name not in ("folder", "scene")}

    @property
    def frames(self) -> tuple[int, ...]:
        """All of them."""
        return tuple(range(self.first, self.last + 1))

    @property
    def budget(self) -> Budget:
        """How much pictures may change."""
        return Budget(self.mean, self.worst)

    def options(self, threads: int = 0) -> CullOptions:
        """Of the analysis."""
        return CullOptions(max_error=self.budget, paths=self.paths, seed=self.seed, threads=threads)

    def save(self) -> None:
        """As job.json."""
        self.folder.mkdir(parents=True, exist_ok=True)
        scene, folder = self.scene.resolve(), self.folder.resolve()  # ".." leads out of what a link points to
        way = os.path.relpath(scene, folder) if scene.anchor == folder.anchor else str(scene)
        write_json(self.folder / JOB, self._asked | {"scene": way, "key": self.key})

    @staticmethod
    def load(folder: Path, scene: Path | None = None) -> FarmShot:
        """From a folder. scene: where this machine sees it, if elsewhere. Raises InputError."""
        try:
            data = json.loads((folder / JOB).read_text())
            names = {f.name for f in dataclasses.fields(FarmShot) if f.init} - {"folder"}
            if data["schema"] != SCHEMA:
                raise ValueError
            given = {name: data[name] for name in names} | {"folder": Path(os.path.abspath(folder))}
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise InputError(
                f"{folder} holds no shot that this version knows; write one by lipac farm SCENE -o {quoted(folder)}"
            ) from error
        found = folder.resolve() / given["scene"]
        given["scene"] = Path(os.path.abspath(scene)) if scene else found.resolve()
        given["resolution"] = None if given["resolution"] is None else tuple(given["resolution"])
        return FarmShot(**given)

    # The sample that is verified

    def span(self, check: int) -> tuple[int, ...]:
        """Frames that one of the sample stands for: the range in so many parts of a size. check: from 1."""
        return tuple(int(frame) for frame in np.array_split(np.array(self.frames), self.checks)[check - 1])

    def checked(self, check: int) -> int:
        """The frame that is looked at for a span: any of it, by the seed."""
        return int(np.random.default_rng([self.seed, check]).choice(self.span(check)))

    # Files

    def analysis(self, frame: int) -> Path:
        """What a frame needs."""
        return self.folder / "analysis" / f"frame_{frame:04}.npz"

    def chunk(self, frames: Sequence[int]) -> Path:
        """What frames that were analysed together need together."""
        return self.folder / "analysis" / f"frames_{frames[0]:04}-{frames[-1]:04}.npz"

    @property
    def culled(self) -> Path:
        """The scene with the set of the shot."""
        return self.folder / "shot.blend"

    @property
    def united(self) -> Path:
        """Which set that is."""
        return self.folder / "shot.json"

    @property
    def set(self) -> Path:
        """The set itself, as a file of states."""
        return self.folder / "shot.npz"

    def judged(self, frame: int) -> Path:
        """Whether that set keeps the budget in a frame."""
        return self.folder / "judged" / f"frame_{frame:04}.json"

    def picture(self, frame: int) -> Path:
        """Of a frame, as it is delivered."""
        return self.folder / "pictures" / f"frame_{frame:04}{self.ending}"

    def rendered(self, frame: int) -> Path:
        """What its render took."""
        return self.folder / "pictures" / f"frame_{frame:04}.json"

    def verified(self, check: int) -> Path:
        """What was found in a frame of the sample."""
        return self.folder / "verified" / f"frame_{self.checked(check):04}.json"

    def mended(self, check: int, attempt: int) -> Path:
        """The scene with a larger set for a span."""
        span = self.span(check)
        return self.folder / "mended" / f"{span[0]:04}-{span[-1]:04}_{attempt}.blend"


def read_json(path: Path, **wanted: object) -> dict[str, Any] | None:
    """A JSON object, where it is whole and has these values; else None."""
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError):
        return None
    return (
        found if isinstance(found, dict) and all(found.get(name) == value for name, value in wanted.items()) else None
    )


def write_json(path: Path, data: dict[str, Any]) -> None:
    """Put a JSON object in place."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as part:
        part.write_text(json.dumps(data, indent=1, default=float) + "\n")


def rendered_from(shot: FarmShot, frame: int, chosen: str) -> str | None:
    """What a frame's picture was mended by, "" where it was not; None where there is no picture that is whole, of this
    job, and from this set."""
    note, picture = read_json(shot.rendered(frame), key=shot.key, set=chosen), shot.picture(frame)
    return (
        str(note["mended"])
        if note is not None and is_whole(picture) and picture.stat().st_size == note["bytes"]
        else None
    )
