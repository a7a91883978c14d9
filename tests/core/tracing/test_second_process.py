"""Two processes share the compiling."""

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

# Analyses a tiny scene, and prints what it compiled for that.
ANALYSIS = """
import json, sys
import lipac.core
from numba.core import event
compiled = []
class Listener(event.Listener):
    def on_start(self, event):
        function = event.data["dispatcher"].py_func
        compiled.append(function.__module__ + "." + function.__qualname__)
    def on_end(self, event):
        pass
event.register("numba:compile", Listener())
from lipac.core.culling.analysis import analyze
from lipac.core.culling.options import CullOptions
from tests.core.scenes import build, cube, placed
analyze(build([cube()], [(0, placed((x, 0, 0)), 0) for x in range(-40, 40)]), CullOptions(width=16, paths=1))
print(json.dumps(compiled))
"""


def _compiled(cache: Path) -> list[str]:
    """What an analysis in a process of its own compiles, of ours."""
    environment = os.environ | {"LIPAC_CACHE_DIR": str(cache)}
    root = Path(__file__).parents[3]
    out = subprocess.run(
        [sys.executable, "-c", ANALYSIS], cwd=root, env=environment, capture_output=True, text=True, check=True
    ).stdout
    return [name for name in json.loads(out.splitlines()[-1]) if name.startswith("lipac.")]


def test_what_the_worker_compiled_is_loaded_and_nothing_is_compiled_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LIPAC_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(sys, "path", [*sys.path, Path("of an add-on")])  # importing leaves these out
    worker = second_process.start_worker()
    assert worker is not None
    assert worker.wait() == 0
    names = {path.name.split("-")[0] for path in tmp_path.rglob("*.nbi")}
    done = {
        "setup.bsdf_setup", "sample.bsdf_sample", "evaluate.bsdf_eval", "direct_light.add_direct_light",
        "light_sampling.sample_light"
    }
    assert done <= names

    first = _compiled(tmp_path)
    assert "lipac.core.tracing.tile_kernel.trace_tiles" in first
    # or the worker's signatures are not the kernel's
    assert not {name.removeprefix("lipac.core.") for name in first} & names
    # numba numbers a function's variants: were there two, each process could take the same number for another one. And
    # each takes its time.
    assert len(list(tmp_path.rglob("*.nbc"))) == len(list(tmp_path.rglob("*.nbi")))
    assert _compiled(tmp_path) == []


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
