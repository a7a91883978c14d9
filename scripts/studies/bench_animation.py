"""Benchmark parts of animated scenes: what culling saves over frames, how soon what appears is there, growth, rest, and memory."""

from __future__ import annotations

import dataclasses
import itertools
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.accel.region_tree import Regions
from ...core.arrays import F32
from ...core.culling.activation import LARGE
from ...core.culling.loop import Loop
from ...core.culling.options import CullOptions
from ...core.culling.result import CullingResult
from ...core.culling.shot import Shot
from ...core.error_budget.budget import Budget
from ...core.evaluation.judge import TWO_SIDED_95, Judge
from ...core.evaluation.metrics import flicker
from ...core.feedback.tiles import tile_means
from ...core.scene.change import Change
from ...core.scene.frustum import View
from ...core.scene.model import RayType, Scene
from ..evaluate import SUPPLIED
from . import compare

Mask = NDArray[np.bool_]
FIGURES, CHARACTER = 2_000, "CesiumMan.glb"
CROWD_SIZE, CROWD_FRAMES, JUDGED, JUDGE_SAMPLES = (240, 135), range(1, 13), (4, 8, 12), 64
FLY_SIZE, FLY_SAMPLES = (160, 90), 8
STARTED, CORNER = 20, 73  # frames that a loop in real time takes for its cold start, or is given; frame in which the camera turns the corner
SHARE = 1e-4  # of the paths that must meet an instance, in the loops that run in real time
BEFORE, AFTER = 10, 4  # frames for which something that appears was not there, and is looked at from then on
SIZES = (10_000, 30_000, 100_000, 300_000, 1_000_000)
GROWTH_SIZE, GROWTH_FRAMES = (320, 180), range(1, 11)
REST_FRAMES, MEMORY_FRAMES = 200, 500
PICTURE_SIZE = (640, 360)
LOOSE = CullOptions(max_error=Budget(0.02, 0.2))  # of few paths, for many frames
CAMERA_ONLY = Change(None, None, np.zeros(0, np.int32), np.zeros(0, np.int32), shading=False, camera=True)


class Footage:
    """The open file's frames as scenes. own_s: seconds of the last one's extraction without Blender's own evaluation."""

    def __init__(self, size: tuple[int, int]) -> None:
        import bpy

        from ...lipac_addon.extract import Extractor

        self.scene = bpy.context.scene
        self.scene.render.resolution_x, self.scene.render.resolution_y, self.scene.render.resolution_percentage = *size, 100
        self._extractor = Extractor(self.scene)
        self.own_s = 0.0

    def frames(self, numbers: range) -> Iterator[tuple[int, Scene, Change | None]]:
        """Each frame, and how it differs from the one before."""
        from ...lipac_addon.console import muted

        with self._extractor:
            for number in numbers:
                with muted():
                    extraction = self._extractor.frame(number)
                self.own_s = self._extractor.read_s
                yield number, extraction.scene, extraction.change


def demo(name: str, instances: int, figure: Path | None = None) -> None:
    """Replace the open file by a demo scene."""
    from ...lipac_addon.console import muted
    from ...lipac_addon.demo import build

    with muted():
        build(name, instances, 0, figure)


# Crowd: BLASes over frames


def crowd(_folder: Path) -> dict[str, Any]:
    """Figures of our own."""
    return _crowd(None)


def character(_folder: Path) -> dict[str, Any]:
    """A supplied character."""
    file = SUPPLIED / "small" / CHARACTER
    return _crowd(file) if file.exists() else {"skipped": f"{CHARACTER} is not here"}


def _crowd(figure: Path | None) -> dict[str, Any]:
    """Bytes and seconds of BLASes per frame, culled within the default budget and whole, and the error of some frames."""
    demo("crowd", FIGURES, figure)
    shots = {"culled": Shot(CullOptions()), "whole": Shot(CullOptions(policy="none"))}
    rows, errors = [], []
    for number, scene, change in Footage(CROWD_SIZE).frames(CROWD_FRAMES):
        row: dict[str, Any] = {"frame": number, "instances": len(scene.instances)}
        kept = {}
        for name, one in shots.items():
            result = one.advance(scene, change)
            names = ("active", "hitboxes", "blas_bytes", "blas_held_bytes", "blas_built", "blas_refitted")
            row[name] = {key: result.stats[key] for key in names} | {"blas_s": result.stats["blas_s"] + result.stats["refit_s"]}
            kept[name] = result.active
        if number in JUDGED:
            judge = Judge(scene, JUDGE_SAMPLES)
            error = judge.change(kept["culled"])
            floor = judge.noise_floor()["mean"]
            half = {"mean_ci": TWO_SIDED_95 * error.mean_deviation, "worst_ci": TWO_SIDED_95 * error.worst_deviation}
            errors.append({"frame": number, "mean": error.mean, "worst": error.worst, **half, "seed": floor})
            del judge
        rows.append(row)
    loop = shots["whole"].loop
    assert loop is not None
    triangles = int(loop.blas.table["triangle_count"].sum())
    return {"size": CROWD_SIZE, "figures": FIGURES, "triangles": triangles, "samples": JUDGE_SAMPLES, "frames": rows, "errors": errors}


# Flythrough: latency, states, flicker


@dataclass
class Run:
    """One loop over the frames of a shot: states (N,) bool, pictures, figures."""

    shot: Shot
    states: list[Mask] = field(default_factory=list)
    pictures: list[F32] = field(default_factory=list)
    rows: list[CullingResult] = field(default_factory=list)


@dataclass(frozen=True)
class Appearance:
    """An instance that comes into sight in a frame (both are indices)."""

    frame: int
    instance: int


def appearances(met: NDArray[np.int64], least: int) -> list[Appearance]:
    """Which instances come into sight and when, from how many paths met them, (F, N): least or more in a frame and in most of the AFTER that begin with it,
    none in the BEFORE before it."""
    seen, out = met >= least, []
    for f in range(BEFORE, len(met) - AFTER):
        new = seen[f] & (met[f - BEFORE : f] == 0).all(axis=0) & (seen[f : f + AFTER].sum(axis=0) >= AFTER - 1)
        out += [Appearance(f, int(i)) for i in np.flatnonzero(new)]
    return out


def latencies(found: list[Appearance], states: NDArray[np.bool_]) -> dict[str, Any]:
    """Frames from appearance to activation, from states (F, N): how many took 0, 1, 2 ... frames; `before`: were active in the frame before already;
    `never`: were not in what is left of the shot."""
    counts: list[int] = []
    before = never = 0
    for a in found:
        active = np.flatnonzero(states[a.frame :, a.instance])
        if states[a.frame - 1, a.instance]:
            before += 1
        elif not len(active):
            never += 1
        else:
            counts += [0] * (int(active[0]) + 1 - len(counts))
            counts[int(active[0])] += 1
    return {"before": before, "frames": counts, "never": never}


def state_changes(states: NDArray[np.bool_]) -> dict[str, float]:
    """Per instance that is ever active and 100 frames, from states (F, N): how often they change, and how often a change is undone within BEFORE frames."""
    ever = max(int(states.any(axis=0).sum()), 1)
    flips = states[1:] != states[:-1]
    last = np.full(states.shape[1], -BEFORE - 1)
    undone = 0
    for f, now in enumerate(flips):
        undone += int((now & (f - last <= BEFORE)).sum())
        last[now] = f
    scale = 100 / (ever * max(len(flips), 1))
    return {"changes": float(flips.sum()) * scale, "undone": undone * scale, "ever": ever}


def flythrough(_folder: Path) -> dict[str, Any]:
    """Loops that run in real time, one round per frame and by counts: with all there is, without mitigation, without hysteresis.

    They start STARTED frames before the corner.
    """
    base = CullOptions(min_share=SHARE, max_iterations=1, width=FLY_SIZE[0])
    runs = {"as it is": base, "no mitigation": replace(base, mitigation=False), "no hysteresis": replace(base, hysteresis=1.0)}
    return _fly(runs, first=CORNER - STARTED, started=STARTED)


def shot(_folder: Path) -> dict[str, Any]:
    """Loops that work on each frame until it is at rest, within the default budget, as `--warm` does: with and without hysteresis, and frames by themselves.

    From the corner on.
    """
    runs = {"warm": CullOptions(), "warm, no hysteresis": CullOptions(hysteresis=1.0), "frames by themselves": CullOptions()}
    return _fly(runs, {"frames by themselves"}, first=CORNER)


def _fly(options: dict[str, CullOptions], independent: set[str] | frozenset[str] = frozenset(), first: int = 1, started: int = 0) -> dict[str, Any]:
    """Run loops side by side through the flythrough from frame first on, beside the whole scene, which says what is in sight, and how each picture should be.

    started: frames that do not count.
    """
    from ...lipac_addon.demo import flythrough as scene_of
    from ...lipac_addon.demo.mirror_city import DEFAULT_INSTANCES

    demo("flythrough", DEFAULT_INSTANCES)
    runs = {name: Run(Shot(o, independent=name in independent)) for name, o in options.items()}
    whole: Loop | None = None
    direct, reflected, large, pictures = [], [], [], []
    for number, scene, change in Footage(FLY_SIZE).frames(range(first, scene_of.FRAMES + 1)):
        if whole is None or change is None:
            whole = Loop(scene, CullOptions(width=FLY_SIZE[0]))
        else:
            whole.advance(scene, change)
        sample = whole.tracer.next_sample
        feedback, picture = whole.tracer.trace(whole.tracer.build(whole.activation.exists), FLY_SAMPLES)
        view, regions = View.of(scene.camera), whole.activation.regions
        in_view = _mask(regions, view, 0.0)
        direct.append(feedback.hits[:, RayType.CAMERA])
        reflected.append(np.where(in_view, 0, feedback.hits[:, RayType.GLOSSY]))
        large.append(_mask(regions, view, LARGE))
        pictures.append(picture[..., :3])
        for run in runs.values():
            result = run.shot.advance(scene, change)
            run.states.append(result.active)
            run.rows.append(dataclasses.replace(result, built=None))
            run.pictures.append(whole.tracer.trace_again(result.active, sample, FLY_SAMPLES)[..., :3])
        if number % 20 == 0:
            print(f"  frame {number}", flush=True)
    paths = FLY_SIZE[0] * FLY_SIZE[1] * FLY_SAMPLES
    found = _sorted(np.stack(direct), np.stack(reflected), np.stack(large), max(int(SHARE * paths), 1))
    out: dict[str, Any] = {"size": FLY_SIZE, "frames": [first, scene_of.FRAMES], "cuts": [scene_of.CUT + 1, scene_of.BACK + 1]}
    out |= {"started": started, "own_change": _own_change(pictures)}
    return out | {"runs": {name: _figures(run, pictures, found, started) for name, run in runs.items()}}


def _mask(regions: Regions, view: View, share: float) -> Mask:
    out = np.zeros(len(regions.place), bool)
    out[regions.in_view(view, share)] = True
    return out


def _sorted(direct: NDArray[np.int64], reflected: NDArray[np.int64], large: Mask, least: int) -> dict[str, list[Appearance]]:
    """Appearances by how they come into sight."""
    seen = appearances(direct, least)
    return {
        "seen directly, large": [a for a in seen if large[a.frame, a.instance]],
        "seen directly, smaller": [a for a in seen if not large[a.frame, a.instance]],
        "seen in reflections alone": [a for a in appearances(reflected, least) if not direct[a.frame, a.instance]],
    }


def _own_change(pictures: list[F32]) -> float:
    """Mean change from frame to frame, relative to the mean."""
    return float(np.mean([np.abs(b - a).mean() for a, b in itertools.pairwise(pictures)]) / np.mean([p.mean() for p in pictures]))


def _figures(run: Run, whole: list[F32], found: dict[str, list[Appearance]], started: int) -> dict[str, Any]:
    states = np.stack(run.states)
    ours, right = run.pictures[started:], whole[started:]

    def tiled(pictures: list[F32]) -> list[NDArray[np.float64]]:
        return [tile_means(p).reshape(1, -1, 1).repeat(3, axis=2) for p in pictures]

    light = np.mean([tile_means(p).mean() for p in whole])
    error = [float(np.abs(tile_means(b) - tile_means(a)).mean() / light) for a, b in zip(whole, run.pictures, strict=True)]
    return {
        "latency": {name: latencies([a for a in those if a.frame >= started], states) for name, those in found.items()},
        "states": state_changes(states[started:]),
        "flicker": flicker(right, ours),
        "flicker_tiles": flicker(tiled(right), tiled(ours)),
        "error": error,
        "active": [int(s.sum()) for s in run.states],
        "hitboxes": [int(r.stats["hitboxes"]) for r in run.rows],
        "iterations": [int(r.stats["iterations"]) for r in run.rows],
    }


# Growth: the same picture in ever larger cities


def growth(_folder: Path) -> dict[str, Any]:
    """Cities of SIZES before a camera that moves sideways: seconds of settled frames by step, without Blender's evaluation, and what a cold start builds.

    The cities' frames take turns, so that what else the machine does meets all of them.
    """
    cities = [City(count) for count in SIZES]
    for k in range(len(GROWTH_FRAMES)):
        for city in cities:
            city.advance(k)
    return {"size": GROWTH_SIZE, "cities": [{"instances": len(c.scenes[0].instances), "cold": c.cold, "frames": c.rows} for c in cities]}


class City:
    """A city's frames, and the loops through them: culled within the default budget, and whole. rows: the figures of each frame; cold: of the cold start."""

    def __init__(self, count: int) -> None:
        print(f"  {count:,} instances", flush=True)
        demo("mirror-city", count)
        footage = Footage(GROWTH_SIZE)
        camera = footage.scene.camera
        for number in GROWTH_FRAMES:
            camera.keyframe_insert("location", frame=number)
            camera.location.x += 0.05
        self.scenes: list[Scene] = []
        self.changes: list[Change | None] = []
        self.rows: list[dict[str, Any]] = []
        for number, scene, change in footage.frames(GROWTH_FRAMES):
            meshes = self.scenes[0].meshes if self.scenes else [scene.meshes[k] for k in range(len(scene.meshes))]  # none changes; the file is closed soon
            self.scenes.append(replace(scene, meshes=meshes))
            self.changes.append(change)
            self.rows.append({"frame": number, "read_s": footage.own_s})
        self.shots = {"culled": Shot(CullOptions()), "whole": Shot(CullOptions(policy="none"))}
        self.cold: dict[str, Any] = {}

    def advance(self, k: int) -> None:
        """Frame k of both loops."""
        for name, one in self.shots.items():
            start = time.perf_counter()
            result = one.advance(self.scenes[k], self.changes[k])
            row = {key: result.stats[key] for key in ("build_s", "trace_s", "feedback_s", "active", "hitboxes", "iterations")}
            self.rows[k][name] = row | {"advance_s": time.perf_counter() - start}
            if name == "culled" and k == 0:
                loop = one.loop
                assert loop is not None and loop.activation.known is not None
                asked, met = np.flatnonzero(loop.activation.known), result.hits.sum(axis=1)
                self.cold = {"asked": len(asked), "met": int((met[asked] > 0).sum()), "active": row["active"], "rounds": row["iterations"]}
                self.cold |= {"meshes": len(loop.blas)}


# Rest and memory


def rest(_folder: Path) -> dict[str, Any]:
    """A million instances, and 200 frames in which nothing changes though each says that the camera did: what changes in the states."""
    demo("mirror-city", SIZES[-1])
    _, scene, _ = next(Footage(FLY_SIZE).frames(range(1, 2)))
    one = Shot(LOOSE)
    out: dict[str, Any] = {"instances": len(scene.instances), "active": [], "hitboxes": [], "changes": [], "built": [], "rounds": []}
    before: Mask | None = None
    for k in range(REST_FRAMES + 1):
        result = one.advance(scene, CAMERA_ONLY if k else None)
        out["active"].append(int(result.stats["active"]))
        out["hitboxes"].append(int(result.stats["hitboxes"]))
        out["built"].append(int(result.stats["blas_built"]))
        out["rounds"].append(int(result.stats["iterations"]))
        if before is not None:
            out["changes"].append(int((result.active != before).sum()))
        before = result.active
    return out


def memory(folder: Path) -> dict[str, Any]:
    """500 frames there and back of the crowd and of the flythrough by the steps of `lipac analyze --warm`: memory of the process after each."""
    return {name: _memory(folder, name, count, last) for name, count, last in (("crowd", 100, 48), ("flythrough", 2_000, 120))}


def _memory(folder: Path, name: str, count: int, last: int) -> dict[str, Any]:
    from ...core.files.report import Report
    from ...lipac_addon.batch.pipeline import Job, Session, run_frame

    demo(name, count)
    Footage((96, 54))
    there = list(range(1, last + 1))
    numbers = tuple(itertools.islice(itertools.cycle([*there, *there[-2:0:-1]]), MEMORY_FRAMES))
    job = Job(folder / f"memory-{name}", numbers, LOOSE, warm=True)
    (job.folder / "states").mkdir(parents=True, exist_ok=True)
    report = Report(name, "", "", "light-paths", "", 0, 0)
    resident, blas = [], []
    with Session(job) as session:
        for k, number in enumerate(numbers):
            run_frame([session], number, report, last=False)
            resident.append(_resident())
            blas.append(int(report.frames[-1]["blas_held_bytes"]))
            if k % 100 == 99:
                print(f"  {name}, frame {k + 1}", flush=True)
    return {"instances": report.frames[-1]["instances"], "resident": resident, "blas": blas}


def _resident() -> int:
    """Bytes of this process in memory; 0 where the system does not tell."""
    path = Path("/proc/self/statm")
    return int(path.read_text().split()[1]) * 4096 if path.exists() else 0


def pictures(folder: Path) -> dict[str, Any]:
    """A picture of either demo as culled, by Cycles, and its TLAS from above: folder/crowd.png, folder/flythrough.png."""
    from matplotlib.image import imsave

    from ...core.files.atomic import replacing

    for name, count, frame in (("crowd", FIGURES, 24), ("flythrough", 20_000, 84)):
        scene, out = folder / f"{name}.blend", folder / f"picture-{name}"
        compare.lipac("demo", name, "-o", scene, "--instances", str(count))
        where = ("--frames", str(frame), "--resolution", "{}x{}".format(*PICTURE_SIZE))
        compare.lipac("render", scene, "-o", out, *where, "--samples", "32")
        shown = compare.pictures(folder, out.name)[1][..., :3]
        tlas = compare.tlas_of(scene, out / "states" / f"frame_{frame:04}.npz", frame, PICTURE_SIZE)
        with replacing(folder / f"{name}.png") as part:
            imsave(part, np.concatenate([(np.clip(shown, 0, 1) * 255 + 0.5).astype(np.uint8), tlas], axis=1))
    return {}
