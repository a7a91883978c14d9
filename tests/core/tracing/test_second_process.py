"""Two processes share the compiling. That what one has compiled is what the other loads, and that nothing is compiled
again, is tested where all is compiled: tests/scripts/dev/test_make_extension.py."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from numba.core import event

from lipac.core.tracing import second_process

pytestmark = pytest.mark.slow


def test_the_worker_ends_when_nobody_holds_its_input(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LIPAC_CACHE_DIR", str(tmp_path))
    worker = second_process.start_worker()
    assert worker is not None
    assert worker.stdin is not None
    worker.stdin.close()  # as when this process ends, in whatever way
    worker.wait(timeout=60)
    assert not list(tmp_path.rglob("sample.bsdf_sample-*.nbi"))


def test_the_worker_needs_nothing_of_the_packages_around_the_engine(tmp_path: Path) -> None:
    worker_ran = "print(sys.modules[given['root'] + '.core.tracing.second_process']._ROOT, 'bpy' in sys.modules)"
    code = second_process._WORKER.replace(".compile_part()", ".__name__") + worker_ran
    given = {"path": sys.path, "root": "of.some.extension", "folder": str(Path(second_process.__file__).parents[2])}
    environment = os.environ | {"LIPAC_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, "-I", "-c", code]
    worker = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment, text=True)
    assert worker.stdin is not None
    assert worker.stdout is not None
    worker.stdin.write(json.dumps(given) + "\n")
    worker.stdin.flush()
    assert worker.stdout.read().split() == ["of.some.extension", "False"]
    worker.stdin.close()
    assert worker.wait() == 0


@pytest.mark.parametrize("executable", ["", "/opt/blender/blender", "/no/such/python"])
def test_without_a_python_to_run_there_is_no_worker(executable: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", executable)
    assert second_process.start_worker() is None


def test_the_first_of_our_kernels_starts_one_worker(monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[bool] = []
    monkeypatch.setattr(second_process, "start_worker", lambda: started.append(True))
    listener = second_process._FirstCompilation()

    def compile_of(module: str) -> int:
        dispatcher = SimpleNamespace(py_func=SimpleNamespace(__module__=module))
        listener.on_start(event.Event("numba:compile", event.EventStatus.START, {"dispatcher": dispatcher}))
        return len(started)

    assert [
        compile_of(module) for module in ("somebody.elses", "lipac.core.scene.bounds", "lipac.core.scene.placing")
    ] == [0, 1, 1]
