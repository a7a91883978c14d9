"""Benchmark on graphics cards: scenes rendered full, culled (the analysis included) and from a copy that was culled
before, each in a process of its own.

Needs no network. What is measured is kept in DIR/gpu.json, so that a call that stops in time is followed by another
that goes on; DIR/gpu.md has the tables.
"""

from __future__ import annotations

import itertools
import json
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ...core.files.atomic import replacing
from ...core.files.figures import size
from .compare import markdown
from .machine import made_by

SCENES = {"mirror-city": 1_000_000, "crowd": 2_000, "textures": 48}
FULL, CULLED, BAKED = "full", "culled", "baked"
WAYS = (FULL, CULLED, BAKED)
DEVICES = ("cuda", "optix", "eevee")
SMALL = 1_000  # instances of the scene that warms up what is compiled or loaded once
OUT_OF_TIME = "not run: no time left in this call"
TICK = 0.1  # seconds between looks at the card's memory
Row = dict[str, Any]


@dataclass(frozen=True)
class Plan:
    """What to measure. scenes: names with what `lipac demo --instances` gets; devices: of `--device`, or eevee; ways:
    of WAYS; size: width and height; limit: seconds of a measurement, making its scene included; within: of all, after
    which none begins; again: also what was measured before."""

    scenes: dict[str, int] = field(default_factory=lambda: dict(SCENES))
    devices: tuple[str, ...] = DEVICES
    samples: tuple[int, ...] = (32, 128)
    ways: tuple[str, ...] = WAYS
    size: tuple[int, int] = (1920, 1080)
    limit: float = 300.0
    within: float = 540.0
    again: bool = False

    def cases(self) -> Iterator[tuple[str, str, int, str]]:
        """Scene, device, samples and way of each measurement, those that share most next to each other."""
        return itertools.product(self.scenes, self.devices, self.samples, self.ways)


def run(folder: Path, plan: Plan) -> str:
    """Measure what is not there yet, and return the page that DIR/gpu.md then is."""
    file, end = folder / "gpu.json", time.monotonic() + plan.within
    data: Row = json.loads(file.read_text()) if file.exists() else {"measured": {}, "prepared": {}}
    data["machine"] = f"{made_by()}, {_card() or 'no NVIDIA card'}"
    for scene, device, samples, way in plan.cases():
        name = f"{scene}-{plan.scenes[scene]} {plan.size[0]}x{plan.size[1]} {device} {samples} {way}"
        if "render_s" in data["measured"].get(name, {}) and not plan.again:
            continue
        left = end - time.monotonic()
        if left <= 0:
            data["measured"].setdefault(name, {"not_run": OUT_OF_TIME})
        else:
            print(f"measuring {name}", file=sys.stderr, flush=True)
            data["measured"][name] = _measure(
                folder, plan, (scene, device, samples, way), data["prepared"], min(left, plan.limit)
            )
        _save(file, data)
    _save(file, data)
    text = page(data)
    with replacing(folder / "gpu.md") as part:
        part.write_text(text)
    return text


def _save(file: Path, data: Row) -> None:
    with replacing(file) as part:
        part.write_text(json.dumps(data, indent=1) + "\n")


def _measure(folder: Path, plan: Plan, case: tuple[str, str, int, str], prepared: Row, limit: float) -> Row:
    """One measurement, its scene made first where it is not there: figures, or `not_run` with what was in the way."""
    scene, device, samples, way = case
    end = time.monotonic() + limit
    file = folder / "gpu-scenes" / f"{scene}-{plan.scenes[scene]}.blend"
    baked = file.with_name(f"{file.stem}-culled.blend")
    warm = folder / "gpu-scenes" / f"mirror-city-{SMALL}.blend"
    how = [*(["--engine", "eevee"] if device == "eevee" else ["--device", device])]
    steps: list[tuple[str, Path | None, list[str]]] = [
        (
            f"scene {file.stem}",
            file,
            ["demo", scene, "-o", str(file), "--instances", str(plan.scenes[scene]), "--quiet"],
        ),
        (f"scene {warm.stem}", warm, ["demo", "mirror-city", "-o", str(warm), "--instances", str(SMALL), "--quiet"]),
        (
            f"warm {device}",
            None,
            [
                "render",
                str(warm),
                "-o",
                str(folder / "gpu-warm"),
                *how,
                "--samples",
                "1",
                "--resolution",
                "64x36",
                "--quiet",
            ],
        ),
    ]
    picture = ["--resolution", "{}x{}".format(*plan.size)]
    if way == BAKED:
        analysis = [
            "analyze",
            str(file),
            "-o",
            str(folder / "gpu-analysis" / file.stem),
            "--bake",
            "shot",
            "--save",
            str(baked),
            *picture,
            "--quiet",
        ]
        steps.append((f"culled {file.stem} {picture[1]}", baked, analysis))
    for name, made, arguments in steps:
        if name in prepared and (made is None or made.exists()):
            continue
        file.parent.mkdir(exist_ok=True)
        done = _lipac(arguments, end - time.monotonic())
        if "not_run" in done:
            return {"not_run": f"{name}: {done['not_run']}"}
        prepared[name] = done["wall_s"]
    out = folder / "gpu-renders"
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir()
    if way == CULLED:
        done = _lipac(
            ["render", str(file), "-o", str(out), *how, *picture, "--samples", str(samples), "--quiet"],
            end - time.monotonic(),
        )
    else:
        done = _child(
            [
                "-m",
                __name__,
                str(baked if way == BAKED else file),
                device,
                str(samples),
                *map(str, plan.size),
                str(out),
            ],
            end - time.monotonic(),
        )
    if "not_run" in done:
        return done
    report = json.loads((out / "report.json").read_text())
    frame = report["frames"][0]
    kept = {
        name: frame.get(name)
        for name in ("render_s", "first_sample_s", "device", "device_bytes", "instances", "active")
    }
    return done | kept | {"host_bytes": report["totals"]["peak_bytes"] or None}


def main(arguments: Sequence[str]) -> int:
    """What a child does that renders a file as it is: FILE DEVICE SAMPLES WIDTH HEIGHT DIR. Returns the exit status."""
    import bpy

    from ...core.errors import InputError
    from ...core.files.usage import peak_memory
    from ...lipac_addon.batch.engines.blender import render_blender
    from ...lipac_addon.batch.engines.choices import AS_SET, DeviceChoice
    from ...lipac_addon.open import open_scene

    file, device, samples, width, height, out = arguments
    eevee = device == "eevee"
    try:
        open_scene(Path(file))
        render = bpy.context.scene.render
        render.resolution_x, render.resolution_y, render.resolution_percentage = int(width), int(height), 100
        where = AS_SET if eevee else DeviceChoice.parse(device)
        rendered = render_blender("eevee" if eevee else "cycles", Path(out) / "frame", int(samples), device=where)
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    report = {"frames": [rendered.entry()], "totals": {"peak_bytes": peak_memory()}}
    (Path(out) / "report.json").write_text(json.dumps(report))
    return 0


def _lipac(arguments: Sequence[str], limit: float) -> Row:
    """`lipac ARGUMENTS`, as `_child`."""
    return _child(["-m", "lipac.scripts.lipac", *arguments], limit)


def _child(arguments: Sequence[str], limit: float) -> Row:
    """Python with arguments, in a fresh process: its seconds, and bytes that were taken on the card meanwhile; or
    `not_run`."""
    before, most, done = _card_bytes(), [0], threading.Event()

    def watch() -> None:
        while before is not None and not done.wait(TICK):
            most[0] = max(most[0], _card_bytes() or 0)

    start = time.perf_counter()
    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        ended = subprocess.run(
            [sys.executable, *arguments],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            check=False,
            timeout=max(limit, 1.0),
        )
    except subprocess.TimeoutExpired:
        return {"not_run": f"ended after {max(limit, 1.0):.0f} s"}
    finally:
        done.set()
        watcher.join()
    if ended.returncode:
        lines = ended.stderr.strip().splitlines()
        return {"not_run": lines[-1] if lines else f"status {ended.returncode}"}
    return {
        "wall_s": time.perf_counter() - start,
        "card_bytes": max(most[0] - before, 0) or None if before is not None else None,
    }


def _nvidia(*what: str) -> list[str]:
    """What nvidia-smi says of all cards, a line each; nothing where it is not there."""
    program = shutil.which("nvidia-smi")
    if program is None:
        return []
    done = subprocess.run(
        [program, f"--query-gpu={','.join(what)}", "--format=csv,noheader,nounits"],
        capture_output=True,
        text=True,
        check=False,
    )
    return done.stdout.strip().splitlines() if done.returncode == 0 else []


def _card() -> str:
    return ", ".join(
        f"{name} (driver {driver.strip()})"
        for name, _, driver in (line.partition(",") for line in _nvidia("name", "driver_version"))
    )


def _card_bytes() -> int | None:
    """Memory in use on all cards together; None where nobody says."""
    used = [int(line) for line in _nvidia("memory.used") if line.strip().isdecimal()]
    return sum(used) << 20 if used else None


def page(data: Row) -> str:
    """The tables: one per scene and size, a row for each device, number of samples and way; then what was not run, and
    why."""
    rows: dict[str, list[tuple[str, ...]]] = {}
    missing = []
    for name, one in data["measured"].items():
        scene, picture, device, samples, way = name.split(" ")
        if "not_run" in one:
            missing.append(f"- {name}: {one['not_run']}")
            continue
        full = data["measured"].get(f"{scene} {picture} {device} {samples} {FULL}", {})
        times = [
            f" ({full[key] / one[key]:.2g} times)" if way != FULL and full.get(key) else ""
            for key in ("wall_s", "render_s")
        ]
        first = "unknown" if one["first_sample_s"] is None else f"{one['first_sample_s']:.2f}"
        memory = [
            "unknown" if one[key] is None else size(one[key]) for key in ("device_bytes", "card_bytes", "host_bytes")
        ]
        seconds = (f"{one['wall_s']:.2f}{times[0]}", f"{one['render_s']:.2f}{times[1]}", first)
        kept = "" if one["active"] is None else f"{one['active']:,} of {one['instances']:,}"
        rows.setdefault(f"{scene}, {picture}", []).append(
            (f"{device}, {samples} samples, {way}", kept, *seconds, *memory)
        )
    head = (
        "",
        "instances kept",
        "process, s",
        "render, s",
        "first sample, s",
        "device memory (Cycles)",
        "on the card",
        "host memory",
    )
    out = [f"`lipac bench --only gpu`: {data['machine']}.", ""]
    for scene, lines in rows.items():
        out += [f"### {scene}", "", markdown([head, *lines]), ""]
    analyses = [
        f"{name.removeprefix('culled ')}: {seconds:.1f} s"
        for name, seconds in data["prepared"].items()
        if name.startswith("culled ")
    ]
    if analyses:
        out += [
            f"Rows `{BAKED}` render a copy that `lipac analyze --bake shot --save` made before: {'; '.join(analyses)}.",
            "",
        ]
    if missing:
        out += ["Not run:", "", *missing, ""]
    return "\n".join(out)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
