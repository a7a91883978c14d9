"""What a command is to do with the open file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import bpy

from ...core.culling.options import CullOptions
from ...core.culling.policies import NOTHING
from ...core.errors import Cancelled
from ...core.files.atomic import is_whole
from .ahead import Ahead
from .engines.as_scene import files_of
from .engines.choices import AS_SET, BLENDER_ENGINES, ENGINES, DeviceChoice
from .engines.hybrid_frame import HybridOptions

FRAME, SHOT = "frame", "shot"
Cancel = Callable[[], bool]


def never() -> bool:
    """The `cancelled` of work that goes on to its end."""
    return False


def check(cancelled: Cancel) -> None:
    """Raise Cancelled where it says so."""
    if cancelled():
        raise Cancelled


@dataclass(frozen=True)
class Job:
    """What to do with the open file. engine: one of `choices.ENGINES`, or "" to analyse only; samples: None as in the
    scene; threads: 0 for all.

    hybrid: for the engine of that name. bake: FRAME, each frame by itself, or SHOT, in all frames what any of them
    needs. save: where to save the .blend with the set of the shot baked in. resume: leave frames alone that the folder
    has already. warm: a frame begins with what the one before it needed, and keeps what that kept as long as it is
    worth something (hysteresis); else frames decide by themselves, and ranges can be split. shot: the frames that a set
    is for, where `frames` are a part of them; other processes may do other parts into the same folder. verify: how many
    crops to render full as well, to state the error that was measured (`verify`). enforce: where that breaks the
    budget, analyse again with a tighter one, and in the end keep everything. device: where Cycles renders. as_scene: by
    the engine that the open scene is set to, which `engine` names, to its own files, all of its output included. ahead:
    arguments of `lipac analyze` that decide the same in a process of its own, where that is to go on while frames are
    rendered; none: it is not. texture_cache: for Cycles, the folder of Blender's files of tiles of images
    (`texture_cache`); None: as the scene is set. process: bytes of the process that renders, before it does, where its
    memory is limited (`CullOptions.memory`); 0: not known. if_it_pays: where culling can save nothing of what Cycles
    takes on the CPU for a frame, render it whole, without an analysis (`memory.stakes`). begun: the process that
    analyses ahead, where it runs already.
    """

    folder: Path
    frames: tuple[int, ...]
    options: CullOptions
    engine: str = ""
    samples: int | None = None
    seed: int = 0
    threads: int = 0
    hybrid: HybridOptions = field(default_factory=HybridOptions)
    bake: str = FRAME
    save: Path | None = None
    resume: bool = False
    warm: bool = False
    shot: tuple[int, ...] = ()
    verify: int = 0
    enforce: bool = False
    device: DeviceChoice = AS_SET
    as_scene: bool = False
    ahead: tuple[str, ...] = ()
    texture_cache: Path | None = None
    process: int = 0
    if_it_pays: bool = False
    begun: Ahead | None = None

    def analysing(self, frames: Sequence[int]) -> Ahead:
        """The process that analyses ahead."""
        return self.begun or Ahead(self.ahead, frames)

    def stem(self, frame: int) -> Path:
        """A frame's pictures, without their endings."""
        return self.folder / f"frame_{frame:04}"

    def states(self, frame: int) -> Path:
        """A frame's states."""
        return self.folder / "states" / f"frame_{frame:04}.npz"

    def analysis(self, frame: int, kind: str = "") -> Path:
        """What was found out about a frame of a shot: what it needs by itself, or of another kind."""
        return self.folder / "analysis" / f"frame_{frame:04}{kind and '_' + kind}.npz"

    def pictures(self, frame: int) -> list[Path]:
        """All pictures of a frame."""
        if self.as_scene:
            return files_of(bpy.context.scene, frame)
        endings = ENGINES[self.engine].endings if self.engine else ()
        return [self.folder / f"{self.stem(frame).name}{ending}" for ending in endings]

    def is_finished(self, frame: int) -> bool:
        """Whether the folder has all files of a frame, each of them whole."""
        return all(is_whole(path) for path in (self.states(frame), *self.pictures(frame)))

    @property
    def whole(self) -> bool:
        """Whether Blender renders its scene as it is, so that there is nothing to analyse."""
        return self.options.policy == NOTHING and self.engine in BLENDER_ENGINES
