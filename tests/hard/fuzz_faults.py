"""Work that ends at a random moment: killed, cancelled, on a full disk, without memory. Nothing of the user's is lost,
and nothing half done counts."""

from __future__ import annotations

import hashlib
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from types import FrameType
from typing import Any

import bpy

from lipac.core.errors import InputError
from lipac.core.files.atomic import is_whole
from lipac.lipac_addon import writeback
from lipac.lipac_addon.console import muted
from lipac.lipac_addon.extract import extract_frame

from . import fuzz_blender
from .choices import Seeded
from .inside_blender import stage

WRITEBACK = str(Path(writeback.__file__).parent)
FAULTS = ("killed", "cancelled", "full disk", "no memory")
SMALL = ("--resolution", "32x18", "--samples", "1", "--paths", "2", "--quiet")
# What is begun again in a folder with two finished frames of four, or beside a file that was saved before
COMMANDS: dict[str, tuple[str, ...]] = {
    "render path": ("render", "scene.blend", "-o", "out", "--frames", "1-4", "--resume", "--engine", "path", *SMALL),
    "render cycles": ("render", "scene.blend", "-o", "cycles", "--frames", "1-2", "--engine", "cycles", *SMALL),
    "render baked": ("render", "baked.blend", "-o", "again", "--engine", "cycles", *SMALL),
    "analyze": (
        "analyze", "scene.blend", "-o", "shot", "--frames", "1-2", "--bake", "shot", "--save", "baked.blend",
        *SMALL[:2], *SMALL[4:]
    ),
}
INTERRUPTED = 130  # seconds that a command may take; of two a seed, within the limit of a child process


def run(seed: int, what: str | None = None) -> dict[str, Any]:
    """One fault; the record, as of `fuzz_render.run`. what: "apply", "restore" or one of COMMANDS, by default drawn.
    Raises AssertionError."""
    choose = Seeded(seed + 2**33)
    what = what or choose.one(("apply", "restore", *COMMANDS))
    if what in COMMANDS:
        return {"seed": seed, "features": [what, *command(choose, what)], "verdict": "held", "said": []}
    return {"seed": seed, "features": [what, interrupted(choose, what)], "verdict": "held", "said": []}


# Write-back


@contextmanager
def raising(after: int, error: type[BaseException]) -> Iterator[list[int]]:
    """Raise an error so many lines of write-back on, once; what is yielded counts them, and has their numbers behind
    the count."""
    lines = [0]

    def within(frame: FrameType, event: str, _arg: object) -> Any:
        if event == "line":
            lines[0] += 1
            lines.append(frame.f_lineno)
        if lines[0] == after:
            raise error
        return within

    sys.settrace(lambda frame, _event, _arg: within if frame.f_code.co_filename.startswith(WRITEBACK) else None)
    try:
        yield lines
    finally:
        sys.settrace(None)


def interrupted(choose: Seeded, what: str) -> str:
    """Apply or restore, ended at a random line, in a random scene with something culled before, or not. What ended
    it."""
    with muted():
        fuzz_blender.build(choose)
        bpy.context.view_layer.update()
        before = fuzz_blender.snapshot()
        try:
            extraction = extract_frame(bpy.context.scene)
        except InputError:
            return "nothing to cull"
        keys = extraction.keys
        parts: dict[str, Any] = {"levels": fuzz_blender.levels(extraction), "faces": fuzz_blender.faces(extraction)}
        one, other = (choose.numbers().random(len(keys.records)) < share for share in (0.5, 0.8))
        culled_before = what == "restore" or choose.integer(0, 1) == 1
        do: Callable[[], object] = (
            writeback.restore if what == "restore" else lambda: writeback.apply(other, keys, free=True, **parts)
        )

        def begin() -> None:
            writeback.restore()
            if culled_before:
                writeback.apply(one, keys, free=True, **parts)

        begin()
        with raising(0, KeyboardInterrupt) as lines:
            do()
        begin()
        error = choose.one((KeyboardInterrupt, MemoryError))
        with suppress(KeyboardInterrupt, MemoryError), raising(choose.integer(1, lines[0]), error):
            do()
        if not culled_before:
            _same(before, "apply is not all or nothing")
        writeback.restore()
        _same(before, "restore does not put back")
    return error.__name__


def _same(before: dict[str, Any], otherwise: str) -> None:
    after = fuzz_blender.snapshot()
    changed = sorted(name for name in before.keys() | after.keys() if before.get(name) != after.get(name))
    assert not changed, f"{otherwise}: {changed[:3]}"


# Commands


# Without what only the tests have: Numba imports SciPy where it is, whose OpenBLAS asks for memory for ever where there
# is none (Python 3.11).
_COMMAND = "import sys; sys.modules['scipy'] = None; from lipac.scripts.lipac import main; sys.exit(main(sys.argv[1:]))"


def lipac(folder: Path, *arguments: str, limit: Callable[[], None] | None = None) -> subprocess.Popen[str]:
    """A command in a folder, on one processor. limit: sets limits, within the process."""
    line = [sys.executable, "-B", "-c", _COMMAND, *arguments]
    own: dict[str, Any] = {"preexec_fn": lambda: _begin(limit)}
    return subprocess.Popen(line, cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, **own)


def _begin(limit: Callable[[], None] | None) -> None:
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if limit is not None:
        limit()


def _limited(what: int, size: int) -> Callable[[], None]:
    """Sets a limit of `resource`, in bytes; a file that grows beyond one is an error of the write, as on a full
    disk."""

    def limit() -> None:
        resource.setrlimit(what, (size, size))
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)

    return limit


@cache
def ready() -> tuple[Path, dict[str, float], dict[str, bytes]]:
    """A folder with a scene, two frames of it, a baked copy, and files of the user's; how long each command takes; the
    pictures of all four frames."""
    folder = Path(tempfile.mkdtemp(prefix="lipac-faults"))
    with muted():
        scene = stage()
        for k, ob in enumerate(ob for ob in scene.objects if ob.type == "MESH" and ob.data.name == "cube"):
            ob.keyframe_insert("location", frame=1)
            ob.location.z += 64.0 * k
            ob.keyframe_insert("location", frame=4)
        bpy.ops.wm.save_as_mainfile(filepath=str(folder / "scene.blend"))
        bpy.ops.wm.read_factory_settings(use_empty=True)
    seconds, pictures = {}, {}
    work = folder / "work"
    _lay_out(folder, work, finished=False)
    for name in ("analyze", "render path", "render cycles", "render baked"):
        start = time.monotonic()
        assert lipac(work, *COMMANDS[name]).wait() == 0, name
        seconds[name] = time.monotonic() - start
    pictures = {path.name: path.read_bytes() for path in sorted((work / "out").glob("*.exr"))}
    assert len(pictures) == 4
    shutil.copy(work / "baked.blend", folder / "baked.blend")
    _lay_out(folder, work, finished=False)
    two = ["1-2" if word == "1-4" else word for word in COMMANDS["render path"]]
    assert lipac(work, *two).wait() == 0
    shutil.copytree(work / "out", folder / "out")
    return folder, seconds, pictures


def _lay_out(folder: Path, work: Path, finished: bool = True) -> None:
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir()
    for name in ("scene.blend", *(["baked.blend"] if finished else [])):
        shutil.copy(folder / name, work)
    if finished:
        shutil.copytree(folder / "out", work / "out")
    for name in (
        "notes.txt", "out/notes.txt", "out/.lipac/mine", "out/frame_0003.txt", "out/.frame_0003.mine.part",
        "cycles/frame_0009.png"
    ):
        (work / name).parent.mkdir(parents=True, exist_ok=True)
        (work / name).write_text("of the user's")


def _digests(work: Path) -> dict[str, str]:
    return {
        str(path.relative_to(work)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(work.rglob("*"))
        if path.is_file()
    }


def command(choose: Seeded, what: str) -> list[str]:
    """One of COMMANDS, and a fault at a random moment of it; what that was. One time in four it is begun anew, and has
    to come to its end."""
    folder, seconds, pictures = ready()
    work, fault = folder / "work", choose.one(FAULTS)
    _lay_out(folder, work)
    before, moment = _digests(work), choose.numbers().uniform(0.1, 1.0) * seconds[what]
    limit = None
    if fault == "full disk":
        limit = _limited(resource.RLIMIT_FSIZE, round(10 ** choose.numbers().uniform(2, 5)))
    elif fault == "no memory":
        limit = _limited(resource.RLIMIT_AS, round(choose.numbers().uniform(0.5e9, 3e9)))
    process = lipac(work, *COMMANDS[what], limit=limit)
    if fault in ("killed", "cancelled"):
        with suppress(subprocess.TimeoutExpired):
            process.wait(moment)
        process.send_signal(signal.SIGKILL if fault == "killed" else signal.SIGINT)
    lines = words(process, f"{what}, {fault}").strip().splitlines()
    _check_left(work, what, before)
    allowed = {"killed": (0, -9), "cancelled": (0, 130, -2), "full disk": (0, 1, 2)}.get(fault)
    assert allowed is None or process.returncode in allowed, (
        f"{what}, {fault}: status {process.returncode}: {lines[-1:]}"
    )
    assert fault != "full disk" or process.returncode == 0 or len(lines) == 1, (
        f"{what}, {fault}: {len(lines)} lines: {lines[-2:]}"
    )
    if choose.integer(0, 3) == 3:
        again = lipac(work, *COMMANDS[what])
        said = words(again, f"{what}, {fault}, and once more")
        assert again.returncode == 0, f"{what}, {fault}, and once more: status {again.returncode}: {said[-300:]}"
        _check_left(work, what, before)
        if what == "render path":
            assert {path.name: path.read_bytes() for path in sorted((work / "out").glob("*.exr"))} == pictures, (
                "other pictures than without a fault"
            )
        return [fault, "and resumed"]
    return [fault]


def words(process: subprocess.Popen[str], what: str) -> str:
    """What a command has said on stderr when it has ended. Raises AssertionError where it does not end; then it is
    ended."""
    try:
        return process.communicate(timeout=INTERRUPTED)[1]
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        raise AssertionError(f"{what}: does not end within {INTERRUPTED} s") from None


def _check_left(work: Path, what: str, before: dict[str, str]) -> None:
    """What was there is as it was, but for what the command is to write; what there is of that is whole."""
    after = _digests(work)
    # a page is of the report beside it, or not there
    resumed = {"out/report.json", "out/report.html", "out/memory.csv"}
    own = resumed if what == "render path" else {"baked.blend"} if what == "analyze" else set()
    changed = [name for name, digest in before.items() if after.get(name) != digest and name not in own]
    assert not changed, f"{what}: changed or lost: {changed}"
    for name in after:
        path = work / name
        if (
            name not in before
            and path.suffix in (".exr", ".png", ".npz", ".blend", ".json")
            and ".part" not in path.name
            and ".new" not in path.name
        ):
            assert is_whole(path), f"{what}: {name} is half a file"
    assert is_whole(work / "baked.blend"), "the baked file is no file any more"
    if what == "render path":
        frames = {frame["frame"] for frame in json.loads((work / "out" / "report.json").read_text())["frames"]}
        assert {1, 2} <= frames, f"the report forgot frames: {frames}"


if os.name == "nt":
    raise ImportError("these faults are those of POSIX")
