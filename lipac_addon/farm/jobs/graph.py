"""The steps of a shot as data: what each runs, on what, after what, and what it needs. Those who run it are described
from this."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ..layout import SCRIPT, FarmShot
from ..verify import MENDS

FOLDER, SCENE, BLENDER, ITEMS = "<folder>", "<scene>", "<blender>", "<items>"  # in the arguments of a step
LIPAC, PLAIN = "lipac", "blender"
FRAMES, SAMPLE = "Frames", "Check"
ROOM = 1.5  # of memory asked for, over what was measured
# times what a task is expected to take until it is given up; seconds at least; seconds where nothing is known
PATIENCE, LEAST, UNKNOWN = 10.0, 3600, 24 * 3600


@dataclass(frozen=True)
class Step:
    """A step. after: names of those that must be done. program: LIPAC or PLAIN, a Blender; arguments: after it, with
    names in angle brackets to be filled in.

    items: numbers to be worked off, of what `of` says (FRAMES, SAMPLE), in chunks of so many; none: one task. timeout:
    seconds of a task. memory: bytes, 0 where nobody has measured.
    """

    name: str
    after: tuple[str, ...]
    program: str
    arguments: tuple[str, ...]
    items: tuple[int, ...] = ()
    of: str = ""
    chunk: int = 1
    timeout: int = UNKNOWN
    memory: int = 0

    def chunks(self) -> list[str]:
        """Its tasks' items, as A-B, or A."""
        parts = [self.items[k : k + self.chunk] for k in range(0, len(self.items), self.chunk)]
        return [f"{part[0]}-{part[-1]}" if len(part) > 1 else f"{part[0]}" for part in parts] or [""]

    def filled(self, values: Mapping[str, str]) -> list[str]:
        """Its arguments, with values in place of names."""
        out = []
        for argument in self.arguments:
            for name, value in values.items():
                argument = argument.replace(name, value)  # noqa: PLW2901
            out.append(argument)
        return out


@dataclass(frozen=True)
class Programs:
    """Begins of command lines: of what does a step (`children.lipac_program`), and of a Blender that runs a script
    (`children.program`)."""

    lipac: Sequence[str]
    blender: Sequence[str]


def graph(shot: FarmShot, chunk: int, programs: Programs, measured: dict[str, Any] | None = None) -> list[Step]:
    """The steps of a shot, in an order that they can be done in. chunk: frames to a task; measured: as of `measure`.
    Arguments begin with what programs have after the path."""
    took = measured or {}
    analysis, full = took.get("analysis", {}), took.get("full", {})

    def memory(*of: dict[str, Any]) -> int:
        return round(ROOM * max((one.get("peak_bytes", 0) for one in of), default=0))

    def timeout(*seconds: float | None) -> int:
        known = [s for s in seconds if s is not None]
        return max(LEAST, round(PATIENCE * sum(known))) if len(known) == len(seconds) else UNKNOWN

    decide, draw = analysis.get("seconds"), full.get("seconds")
    mending = (
        None
        if decide is None or draw is None
        else 2 * MENDS * decide * len(shot.span(1)) + draw * (len(shot.span(1)) + 2)
    )
    lipac, plain = programs.lipac[1:], programs.blender[1:]
    own, frames = ("--scene", SCENE, "--quiet"), ("--frames", ITEMS)
    script = (*plain, f"{FOLDER}/{SCRIPT}", "--", FOLDER, *frames)
    rendered, sample = timeout(_times(draw, chunk)), tuple(range(1, shot.checks + 1))
    check = (*lipac, "verify", FOLDER, "--check", ITEMS, "--blender", BLENDER, *own)
    return [
        Step(
            "analyze",
            (),
            LIPAC,
            (*lipac, "analyze", FOLDER, *frames, *own),
            shot.frames,
            FRAMES,
            chunk,
            timeout(_times(decide, chunk)),
            memory(analysis),
        ),
        Step(
            "unite",
            ("analyze",),
            LIPAC,
            (*lipac, "unite", FOLDER, *own),
            timeout=timeout(decide),
            memory=memory(analysis),
        ),
        Step(
            "judge",
            ("unite",),
            LIPAC,
            (*lipac, "judge", FOLDER, *frames, *own),
            shot.frames,
            FRAMES,
            chunk,
            timeout(_times(decide, chunk)),
            memory(analysis),
        ),
        Step("render", ("unite",), PLAIN, script, shot.frames, FRAMES, chunk, rendered, memory(full)),
        Step("verify", ("judge", "render"), LIPAC, check, sample, SAMPLE, 1, timeout(mending), memory(full, analysis)),
        Step("certify", ("verify",), LIPAC, (*lipac, "certify", FOLDER, "--quiet"), timeout=LEAST),
    ]


def _times(seconds: float | None, count: int) -> float | None:
    return None if seconds is None else seconds * count
