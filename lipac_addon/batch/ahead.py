"""Analysis in a process of its own, which goes on with the next frames while one is rendered here. It may begin before
Blender is loaded, which is not loaded here."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...core.errors import Cancelled, InputError
from ...core.files.atomic import replacing
from ...core.files.memory_table import MemoryRow, read_rows
from ...core.files.report import UNREADABLE, States, load_states

TICK = 0.02  # seconds between looks at what the process has done
# What the process runs: the command line. Where whoever waits for it is killed, its input ends: so does it then, and
# with it the folder.
_CHILD = """
import os, shutil, sys, threading
def end():
    os.read(0, 1)
    shutil.rmtree(sys.argv[sys.argv.index("-o") + 1], ignore_errors=True)
    os._exit(1)
threading.Thread(target=end, daemon=True).start()
from lipac.scripts.lipac import main
sys.exit(main())
"""


@dataclass(frozen=True)
class Said:
    """What the process has said so far. entries: for the report, by frame; approximated, warnings, memory: of its
    report; peak: bytes of memory that it took at most."""

    entries: dict[int, dict[str, Any]]
    approximated: tuple[str, ...]
    warnings: tuple[str, ...]
    memory: list[MemoryRow]
    peak: int


@dataclass(frozen=True)
class Analysed:
    """What the process says of a frame. said: of all frames so far."""

    states: States
    entry: dict[str, Any]
    said: Said


class Ahead:
    """`lipac analyze` over frames, in order, into a folder that goes with it. Whoever takes a frame waits until it is
    done. folder: that it writes to."""

    def __init__(self, arguments: Sequence[str], frames: Sequence[int]) -> None:
        """arguments: of `lipac analyze`, without frames and folder. frames: the first and the last count; those between
        are analysed, too."""
        self._folder = tempfile.TemporaryDirectory(prefix="lipac")
        self.folder = Path(self._folder.name)
        self._errors = self.folder / "errors.txt"
        where = ["-o", self._folder.name, f"--frames={frames[0]}-{frames[-1]}", "--quiet"]
        # -P: whatever lies in the current folder is no module of Python's
        command = [sys.executable, "-P", "-c", _CHILD, "analyze", *arguments, *where]
        with self._errors.open("wb") as errors:
            self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=errors)

    def __enter__(self) -> Ahead:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def wait(self, cancelled: Callable[[], bool]) -> None:
        """Wait until the process has ended, and with it what it takes."""
        while self._process.poll() is None:
            _pause(cancelled)

    def close(self) -> None:
        """End the process, and remove what it has left."""
        self._process.kill()
        self._process.wait()
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._folder.cleanup()

    def take(
        self, frame: int, path: Path, cancelled: Callable[[], bool], tell: Callable[[], None] | None = None
    ) -> Analysed:
        """What was decided on a frame, once; its states are then at path. `wait_s` of its entry: seconds that it was
        waited for. tell: called again and again meanwhile.

        Raises InputError where the process has ended without it, Cancelled.
        """
        start = time.perf_counter()
        while True:
            ended = self.has_ended()  # asked first: what it wrote before it ended is there then
            found = self._found(frame, path)
            if found is not None:
                found.entry["wait_s"] = time.perf_counter() - start
                return found
            if tell is not None:
                tell()
            self.go_on(ended, f"frame {frame}", cancelled)

    def has_ended(self) -> bool:
        """Whether the process has."""
        return self._process.poll() is not None

    def go_on(self, ended: bool, what: str, cancelled: Callable[[], bool]) -> None:
        """Wait for a moment. what: that is waited for. Raises InputError where the process has ended without it,
        Cancelled."""
        if ended:
            raise InputError(self._last_words(what))
        _pause(cancelled)

    def said(self) -> Said | None:
        """What its report says; None: nothing yet."""
        try:
            report = json.loads((self.folder / "report.json").read_text())
        except (OSError, ValueError):
            return None
        return Said(
            {entry["frame"]: entry for entry in report["frames"]},
            tuple(report["approximated"]),
            tuple(report["warnings"]),
            read_rows(self.folder),
            report["totals"]["peak_bytes"],
        )

    def _found(self, frame: int, path: Path) -> Analysed | None:
        states = self.folder / "states" / f"frame_{frame:04}.npz"
        said = self.said() if states.exists() else None
        if said is None or frame not in said.entries:
            return None
        try:
            read = load_states(states)
        except UNREADABLE:
            return None
        with replacing(path) as part:
            shutil.copyfile(states, part)
        states.unlink()
        return Analysed(read, said.entries[frame] | {"analysis_peak_bytes": said.peak}, said)

    def _last_words(self, what: str) -> str:
        lines = self._errors.read_text(errors="replace").strip().splitlines()
        return (
            lines[-1].removeprefix("lipac analyze: ")
            if lines
            else f"the analysis of {what} ended with status {self._process.returncode}"
        )


def _pause(cancelled: Callable[[], bool]) -> None:
    """A moment. Raises Cancelled."""
    if cancelled():
        raise Cancelled
    time.sleep(TICK)
