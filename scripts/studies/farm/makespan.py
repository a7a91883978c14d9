"""A shot's graph simulated from measured seconds: when it would end on so many machines, and what keeps it from ending
sooner.

Each step waits for the one before. Its tasks are handed out in order, each to the machine that is free first. A task
begins with what it takes to hand it out and to start its process, reads and writes the shared folder at what is left of
it for each, and takes for each of its frames what a frame took that was measured, drawn by chance.
"""

from __future__ import annotations

import heapq
import random
from collections.abc import Sequence
from dataclasses import dataclass, field

STEPS = ("analyze", "unite", "judge", "render", "verify", "certify")


@dataclass(frozen=True)
class Measured:
    """What was measured, in seconds.

    analyze, judge, render: of frames; verify: of verified frames. start: of a process until its first frame, by step.
    per_frame: for each frame of the shot, of the steps that are one task; "unite" of each file of states that is read,
    "look" of each frame whose file a chunk's is held against. bytes: of the files scene, culled, analysis
    and picture. ratio: of rendering in full to culled.
    """

    analyze: Sequence[float]
    judge: Sequence[float]
    render: Sequence[float]
    verify: Sequence[float]
    start: dict[str, float]
    per_frame: dict[str, float]
    bytes: dict[str, int]
    ratio: float


@dataclass(frozen=True)
class Farm:
    """handing_out: seconds from a task's end to the begin of the next one on a machine. folder, link: bytes a second
    that the shared folder gives to all, and at most to one."""

    handing_out: float = 2.0
    folder: float = 1.25e9
    link: float = 1.25e8


@dataclass
class Run:
    """Seconds of each step, in their order."""

    steps: dict[str, float] = field(default_factory=dict)

    @property
    def total(self) -> float:
        """Seconds from the first task's begin to the last one's end."""
        return sum(self.steps.values())


def chunk_of(frames: int, workers: int, most: int = 10) -> int:
    """Frames to a task: at most so many, and no fewer tasks than machines where there are frames enough."""
    return max(1, min(most, -(-frames // workers)))


def simulate(measured: Measured, frames: int, workers: int, checks: int, farm: Farm = Farm(), seed: int = 0) -> Run:
    """A shot of so many frames, of which `checks` are verified, on so many machines."""
    draw, size, per = random.Random(seed), measured.bytes, measured.per_frame
    chunk = chunk_of(frames, workers)
    parts = [min(chunk, frames - k) for k in range(0, frames, chunk)]
    written = [n + (n > 1) for n in parts]  # a chunk's union, too
    own = [sum(draw.choices(measured.analyze, k=n)) + (n > 1) * n * per["unite"] for n in parts]
    tasks = {
        "analyze": [(seconds, size["scene"] + k * size["analysis"]) for seconds, k in zip(own, written, strict=True)],
        "unite": [
            (
                per["unite"] * len(parts) + per["look"] * frames,
                size["scene"] + len(parts) * size["analysis"] + size["culled"],
            )
        ],
        "judge": [(sum(draw.choices(measured.judge, k=n)), size["scene"] + size["analysis"]) for n in parts],
        "render": [(sum(draw.choices(measured.render, k=n)), size["culled"] + n * size["picture"]) for n in parts],
        "verify": [(seconds, size["scene"] + size["culled"]) for seconds in draw.choices(measured.verify, k=checks)],
        "certify": [(per["certify"] * frames, 0)],
    }
    return Run({name: scheduled(tasks[name], measured.start[name], workers, farm) for name in STEPS})


def in_full(measured: Measured, frames: int, workers: int, farm: Farm = Farm(), seed: int = 0) -> float:
    """Seconds of the same shot rendered in full."""
    draw, chunk = random.Random(seed), chunk_of(frames, workers)
    parts = [min(chunk, frames - k) for k in range(0, frames, chunk)]
    tasks = [
        (
            measured.ratio * sum(draw.choices(measured.render, k=n)),
            measured.bytes["scene"] + n * measured.bytes["picture"],
        )
        for n in parts
    ]
    return scheduled(tasks, measured.start["render"], workers, farm)


def scheduled(tasks: Sequence[tuple[float, int]], start: float, workers: int, farm: Farm) -> float:
    """Seconds until the last of a step's tasks ends; each is its seconds and the bytes that it reads and writes. List
    scheduling (Graham 1966)."""
    rate = min(farm.link, farm.folder / min(workers, len(tasks)))
    free = [0.0] * min(workers, len(tasks))
    for seconds, size in tasks:
        heapq.heapreplace(free, free[0] + farm.handing_out + start + seconds + size / rate)
    return max(free)
