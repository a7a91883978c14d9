"""Progress of long work: a callback that the work calls, and a terminal line with the time left.

Work takes `progress: Progress` and calls it as often as it likes, `progress(fraction, what)`: fraction in [0, 1] of the
whole work, NaN where that is not known, what in a few words.
It never prints by itself.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import TextIO

Progress = Callable[[float, str], None]
"""`progress(fraction, what)`: how much of the work is done, 0 to 1, and what is being done."""


def silent(fraction: float, what: str) -> None:
    """A `Progress` that shows nothing."""


def part(progress: Progress, low: float, high: float, prefix: str = "") -> Progress:
    """A `Progress` for a part of the work: its 0 to 1 is low to high of the whole; `prefix` goes before what it
    says."""
    return lambda fraction, what: progress(low + (high - low) * fraction, prefix + what)


def clock(seconds: float) -> str:
    """Seconds as people read them: 0.4 s, 12 s, 3:07, 1:02:03."""
    if seconds < 10:
        return f"{seconds:.1f} s"
    if seconds < 60:
        return f"{seconds:.0f} s"
    minutes, s = divmod(round(seconds), 60)
    hours, m = divmod(minutes, 60)
    return f"{hours}:{m:02}:{s:02}" if hours else f"{m}:{s:02}"


class Pace:
    """How long work takes, in words: the time left is extrapolated from the fraction done since it was first known."""

    def __init__(self, now: float) -> None:
        """now: seconds of whatever clock."""
        self.start = now
        self.first: float | None = None

    def words(self, fraction: float, now: float) -> str:
        """Time spent and, where it can be told, time left: `12 s, 40 s left`. fraction: NaN where it is not known."""
        if self.first is None and not math.isnan(fraction):
            self.start, self.first = now, fraction
        spent, done = now - self.start, fraction - (self.first or 0.0)
        left = f", {clock(spent * (1.0 - fraction) / done)} left" if done > 0.01 and spent > 1.0 else ""
        return clock(spent) + left


class Terminal:
    """A `Progress` that writes to a text stream: one line that is rewritten on a terminal, a line every few seconds
    into a file or pipe.

    `close()` (or leaving the `with` block) clears the line. Nothing is written any more once the stream has refused it:
    its reader has gone, or its disk is full.
    """

    def __init__(self, stream: TextIO, now: Callable[[], float] = time.monotonic) -> None:
        """stream: where to write, flushed after each line; now: the clock in seconds."""
        self.stream = stream
        self.now = now
        self.rewrite = stream.isatty()
        self.interval = 0.1 if self.rewrite else 5.0
        self.pace = Pace(now())
        self.last = self.pace.start if not self.rewrite else -1e9
        self.width = 0
        self.lost = False

    def __call__(self, fraction: float, what: str) -> None:
        now = self.now()
        self.pace.words(fraction, now)
        if self.lost or now - self.last < self.interval:
            return
        self.last = now
        self._write(self.line(fraction, what, now))

    def line(self, fraction: float, what: str, now: float) -> str:
        """The text of one update: percentage, what is done, time spent and time left."""
        times = self.pace.words(fraction, now)
        if math.isnan(fraction):
            return f"      {what} ({times})"
        return f"{100 * min(max(fraction, 0.0), 1.0):3.0f} % {what} ({times})"

    def _write(self, text: str) -> None:
        self._put("\r" + text.ljust(self.width) if self.rewrite else text + "\n")
        self.width = len(text)

    def _put(self, text: str) -> None:
        try:
            self.stream.write(text)
            self.stream.flush()
        except (OSError, ValueError):
            self.lost = True

    def close(self) -> None:
        """Clear the line that is being rewritten."""
        if self.rewrite and self.width and not self.lost:
            self._put("\r" + " " * self.width + "\r")
            self.width = 0

    def __enter__(self) -> Terminal:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()
