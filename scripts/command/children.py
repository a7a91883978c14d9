"""Child processes that work off seeds, and may crash or hang: that is what a record then says."""

from __future__ import annotations

import json
import os
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

START_LIMIT = 600.0  # seconds for a process to be ready; the first one may have to compile the kernels
MARK = "lipac-child "  # before what a child process has to say


class Child:
    """A process that does one seed after the other. Raises RuntimeError where it does not start."""

    def __init__(self, command: Sequence[str], given: dict[str, Any], threads: int, limit: float) -> None:
        """command: what calls `serve`; given: its last argument, as JSON; threads: of numerical libraries; limit:
        seconds for a seed."""
        self.limit, self.done = limit, 0
        limited = {
            name: str(threads)
            for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
        }
        self._log: list[str] = []
        pipe, environment = subprocess.PIPE, os.environ | limited
        self.process = subprocess.Popen(
            [*command, json.dumps(given)], stdin=pipe, stdout=pipe, stderr=pipe, text=True, env=environment
        )
        self._errors = threading.Thread(target=self._read_errors, daemon=True)
        self._errors.start()
        if (answer := self._answer(START_LIMIT)) is None or answer.get("ready") is not True:
            self.end()
            raise RuntimeError(f"a process for scenes does not start: {self._last_words()}")

    def do(self, seed: int) -> dict[str, Any]:
        """The record of a seed: with `failed` where the process crashed, hung or could not do it."""
        assert self.process.stdin is not None
        self.done += 1
        try:
            print(seed, file=self.process.stdin, flush=True)
            answer = self._answer(self.limit)
        except BrokenPipeError:
            answer = None
        if answer is not None:
            return answer
        hung = self.process.poll() is None
        self.end()
        words = self._last_words()
        return {
            "seed": seed,
            "failed": f"over {self.limit:g} s" if hung else f"crashed with status {self.process.returncode}: {words}",
        }

    @property
    def alive(self) -> bool:
        """Whether it can do another one."""
        return self.process.poll() is None

    def end(self) -> None:
        """End the process."""
        if self.alive:
            self.process.kill()
        self.process.wait()

    def _answer(self, limit: float) -> dict[str, Any] | None:
        """What it says next, None where it ends, or says nothing within so many seconds: then it is still alive."""
        said: queue.Queue[str] = queue.Queue()
        stdout = self.process.stdout
        assert stdout is not None

        def listen() -> None:
            line = "."
            while line and not line.startswith(MARK):
                line = stdout.readline()
            said.put(line)

        threading.Thread(target=listen, daemon=True).start()
        try:
            line = said.get(timeout=limit)
        except queue.Empty:
            return None
        if not line:
            self.process.wait()
        return json.loads(line[len(MARK) :]) if line else None

    def _read_errors(self) -> None:
        assert self.process.stderr is not None
        for line in self.process.stderr:
            self._log = [*self._log[-4:], line.strip()]

    def _last_words(self) -> str:
        """The last lines on stderr of a process that has ended."""
        self._errors.join(1.0)  # not for ever: a process that it started may hold the stream
        return " | ".join(self._log)[-300:]


def serve(prepare: Callable[[], Callable[[int], dict[str, Any]]]) -> None:
    """What a child process does: a seed from each line of stdin, its record to stdout. prepare: imports what it needs,
    and returns what does a seed."""
    out = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what Blender prints is not for whoever listens

    def say(what: dict[str, Any]) -> None:
        print(MARK + json.dumps(what, default=float), file=out, flush=True)

    do = prepare()
    say({"ready": True})
    for line in sys.stdin:
        seed, start, cpu = int(line), time.perf_counter(), time.process_time()
        try:
            record = do(seed)
        except Exception as error:  # anything: the record says what
            record = {"seed": seed, "failed": f"{type(error).__name__}: {error}"}
        say(record | {"seconds": time.perf_counter() - start, "cpu_s": time.process_time() - cpu})
