"""Compiled kernels are kept per user and per state of the sources."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import pytest

import lipac.core
from lipac.core.jit import kernel_cache

PROBE = "import lipac.core, numba; print(numba.config.CACHE_DIR)"


def test_numba_uses_the_folder_whether_imported_before_or_after(tmp_path: Path) -> None:
    environment = {**os.environ, "LIPAC_CACHE_DIR": str(tmp_path)}
    environment.pop("NUMBA_CACHE_DIR", None)
    for code in (PROBE, "import numba; " + PROBE):
        out = subprocess.run(
            [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
        ).stdout.strip()
        assert Path(out).parent == tmp_path
        assert Path(out).is_dir()


def test_changed_sources_use_another_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    copy = tmp_path / "core"
    shutil.copytree(Path(lipac.core.__file__).parent, copy, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setenv("NUMBA_CACHE_DIR", os.environ.get("NUMBA_CACHE_DIR", ""))
    from numba.core import config

    monkeypatch.setattr(config, "CACHE_DIR", getattr(config, "CACHE_DIR"))  # noqa: B009
    monkeypatch.setattr(kernel_cache, "__file__", str(copy / "jit" / "kernel_cache.py"))
    before = kernel_cache.use(tmp_path / "cache")
    changed = copy / "tracing" / "bsdf" / "sample.py"
    changed.write_text(changed.read_text() + "\n")
    after = kernel_cache.use(tmp_path / "cache")
    assert before
    assert after
    assert before != after
    os.utime(before, (time.time() - 1e7,) * 2)
    kernel_cache.use(tmp_path / "cache")
    assert not before.exists()  # long unused
    assert after.exists()


def test_what_kernels_do_not_use_is_no_source_of_theirs() -> None:
    core = Path(lipac.core.__file__).parent
    names = {path.relative_to(core).as_posix() for path in kernel_cache.kernel_sources(core)}
    kernels = {
        "tracing/path_kernel.py", "tracing/bsdf/sample.py", "tracing/lights/light_tree.py", "accel/hitboxes.py",
        "jit/sampling.py"
    }
    # these have no kernel, but constants of kernels
    assert kernels | {"feedback/hits.py", "scene/model.py", "scene/mesh.py"} <= names
    assert not {"culling/loop.py", "culling/analysis.py", "culling/options.py", "files/report.py"} & names


@pytest.fixture
def cache_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    """Puts back what `use` sets."""
    from numba.core import config

    for name in ("NUMBA_CACHE_DIR", "LIPAC_CACHE_DIR"):
        monkeypatch.setenv(name, os.environ.get(name, ""))
    monkeypatch.setattr(config, "CACHE_DIR", getattr(config, "CACHE_DIR"))  # noqa: B009


def test_the_same_sources_elsewhere_are_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cache_settings: None
) -> None:
    """Kernels of an older layout are never taken for current ones: not where the same text lies in one folder, nor
    under another name."""
    core = Path(lipac.core.__file__).parent
    flat, renamed = tmp_path / "flat", tmp_path / "renamed"
    (flat / "jit").mkdir(parents=True)
    for path in core.rglob("*.py"):
        shutil.copy(path, flat / path.name)
    shutil.copytree(core, renamed, ignore=shutil.ignore_patterns("__pycache__"))
    (renamed / "tracing").rename(renamed / "trace")
    used = set()
    for layout in (core, flat, renamed):
        monkeypatch.setattr(kernel_cache, "__file__", str(layout / "jit" / "kernel_cache.py"))
        used.add(kernel_cache.use(tmp_path / "cache"))
    assert len(used) == 3


def test_where_nothing_can_be_written_kernels_are_kept_for_this_process(tmp_path: Path, cache_settings: None) -> None:
    blocker = tmp_path / "file"
    blocker.write_text("")
    found = kernel_cache.use(blocker / "below")
    assert found is not None
    assert found.parent.parent == Path(tempfile.gettempdir())
    assert Path(os.environ["LIPAC_CACHE_DIR"]) == found.parent  # for the second process
    shutil.rmtree(found.parent)


def test_only_folders_with_our_mark_are_removed(tmp_path: Path, cache_settings: None) -> None:
    """By age, and by the button of the preferences: not what the user has given such a name, nor what a link leads
    to."""
    old = kernel_cache.use(tmp_path)
    assert old is not None
    name = "kernels-3.11-0123456789ab"
    old.rename(tmp_path / name)
    users = ["kernels-of-my-own", "kernels-3.11-aaaaaaaaaaaa", "kernels-3.11-bbbbbbbbbbbb"]
    (tmp_path / "elsewhere").mkdir()
    shutil.copytree(tmp_path / name, tmp_path / "elsewhere" / "kernels-3.11-bbbbbbbbbbbb")
    for user in users[:2]:
        (tmp_path / user).mkdir()
        (tmp_path / user / "precious").write_text("mine")
    (tmp_path / users[2]).symlink_to(tmp_path / "elsewhere" / users[2])
    for path in tmp_path.iterdir():
        os.utime(path, (time.time() - 1e7,) * 2)
    new = kernel_cache.use(tmp_path)
    assert new is not None
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted([*users, "elsewhere", new.name])
    assert kernel_cache.own_folders(tmp_path) == [new]
    assert (tmp_path / "elsewhere" / users[2]).is_dir()


@pytest.mark.parametrize(
    ("variables", "where"), [({"XDG_CACHE_HOME": ""}, ".cache/lipac"), ({"XDG_CACHE_HOME": "relative"}, ".cache/lipac")]
)
@pytest.mark.skipif(sys.platform != "linux", reason="XDG")
def test_users_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, variables: dict[str, str], where: str) -> None:
    """An empty or relative XDG_CACHE_HOME counts as none (XDG Base Directory Specification)."""
    monkeypatch.delenv("LIPAC_CACHE_DIR", raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    assert kernel_cache.user_cache() == tmp_path / where


SUM = """
import json, sys
from lipac.core.jit import healing, kernel_cache
import importlib.util
def total():  # as in a process of its own: the module is another one each time, and looks at the files anew
    spec = importlib.util.spec_from_file_location("kernel", sys.argv[1])
    module = sys.modules["kernel"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return f"{module.total(4)} {sum(module.total.stats.cache_hits.values())}"
print(total(), total(), sep=",", flush=True)
for line in sys.stdin:  # paths to damage, and by what
    path, damaged = json.loads(line)
    with open(path, "wb") as file:
        file.write(bytes.fromhex(damaged))
    print(total(), total(), sep=",", flush=True)
"""
KERNEL = (
    "from numba import njit\n@njit(cache=True)\ndef total(n):\n    s = 0\n    for k in range(n):\n        s += "
    "k\n    return s\n"
)


@pytest.mark.slow
def test_damaged_kernels_are_compiled_again(tmp_path: Path) -> None:
    """Cut off, empty, with other bytes in it, or without its index; and where nothing can be kept it works all the
    same."""
    (tmp_path / "kernel.py").write_text(KERNEL)
    environment = {**os.environ, "LIPAC_CACHE_DIR": str(tmp_path / "cache")}

    def full_disk() -> None:
        import resource

        resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)

    def run(damages: list[tuple[Path, bytes]], limit: Callable[[], None] | None = None) -> list[str]:
        done = subprocess.run(
            [sys.executable, "-B", "-c", SUM, str(tmp_path / "kernel.py")],
            input="".join(json.dumps([str(path), damaged.hex()]) + "\n" for path, damaged in damages),
            env=environment,
            preexec_fn=limit,
            capture_output=True,
            text=True,
            check=True,
        )
        return done.stdout.split("\n")[:-1]

    assert run([]) == ["6 0,6 1"]
    assert run([]) == ["6 1,6 1"]
    files = [path for ending in ("nbc", "nbi") for path in (tmp_path / "cache").rglob(f"kernel.total*.{ending}")]
    assert len(files) == 2
    damages = []
    for path in files:
        data = path.read_bytes()
        changed = bytearray(data)
        changed[len(data) // 2] ^= 0x55
        for damaged in (b"", data[: len(data) // 2], bytes(changed) if path.suffix == ".nbc" else b"anything"):
            damages.append((path, damaged))
    assert run(damages) == ["6 1,6 1", *["6 0,6 1"] * len(damages)]
    if sys.platform != "win32":
        shutil.rmtree(tmp_path / "cache")
        assert run([], full_disk) == ["6 0,6 0"]
