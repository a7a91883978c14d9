"""What ran when, on which thread."""

from __future__ import annotations

import time
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any


@dataclass
class Timeline:
    """What ran when, in seconds since the frame began: (stage, thread, start, end)."""

    began: float = field(default_factory=time.perf_counter)
    stages: list[tuple[str, str, float, float]] = field(default_factory=list)

    @contextmanager
    def stage(self, name: str, thread: str = "main") -> Iterator[None]:
        """Times a block."""
        start = time.perf_counter() - self.began
        try:
            yield
        finally:
            self.stages.append((name, thread, start, time.perf_counter() - self.began))

    @property
    def overlap(self) -> float:
        """Seconds in which both threads were at work: what overlapping saved."""
        main, worker = ([(a, b) for _, t, a, b in self.stages if (t == "main") == wanted] for wanted in (True, False))
        return sum(max(min(b, d) - max(a, c), 0.0) for a, b in main for c, d in worker)

    @property
    def seconds(self) -> dict[str, float]:
        """By stage."""
        out: dict[str, float] = {}
        for name, _, start, end in self.stages:
            out[name] = out.get(name, 0.0) + end - start
        return out

    def elapsed(self, without: Collection[str] = ()) -> float:
        """Seconds in which at least one stage was at work that `without` does not name."""
        total, until = 0.0, 0.0
        for start, end in sorted((a, b) for name, _, a, b in self.stages if name not in without):
            total += max(end - max(start, until), 0.0)
            until = max(until, end)
        return total

    def summary(self) -> list[dict[str, Any]]:
        """For the report, by start; stages of one name that follow each other on a thread are one."""
        merged: list[dict[str, Any]] = []
        last: dict[str, dict[str, Any]] = {}
        for name, thread, start, end in sorted(self.stages, key=lambda s: s[2]):
            before = last.get(thread)
            if before and before["stage"] == name:
                before["end_s"] = end
            else:
                last[thread] = {"stage": name, "thread": thread, "start_s": start, "end_s": end}
                merged.append(last[thread])
        return merged
