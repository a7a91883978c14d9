"""Benchmark parts of animated scenes: what culling saves over frames, how soon what appears is there, growth, rest, and
memory."""

from __future__ import annotations

import itertools
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ....core.culling.options import CullOptions
from ....core.culling.shot import Shot
from ....core.error_budget.budget import Budget
from ....core.evaluation.judge import TWO_SIDED_95, Judge
from ....core.scene.change import Change
from ....core.scene.model import Scene
from .. import compare
from ..pictures.strips import save, strip
from ..supplied import SUPPLIED
from .footage import Footage, demo

Mask = NDArray[np.bool_]
FIGURES, CHARACTER = 2_000, "CesiumMan.glb"
CROWD_SIZE, CROWD_FRAMES, JUDGED, JUDGE_SAMPLES = (240, 135), range(1, 13), (4, 8, 12), 64
SIZES = (10_000, 30_000, 100_000, 300_000, 1_000_000)
GROWTH_SIZE, GROWTH_FRAMES = (320, 180), range(1, 11)
REST_FRAMES, MEMORY_FRAMES = 200, 500
REST_SIZE = (160, 90)
PICTURE_SIZE = (640, 360)
DEMO_LABELS = ("as it is rendered when culled", "what is kept for that, from outside")
LOOSE = CullOptions(max_error=Budget(0.02, 0.2))  # of few paths, for many frames
CAMERA_ONLY = Change(None, None, np.zeros(0, np.int32), np.zeros(0, np.int32), shading=False, camera=True)


# Crowd: BLASes over frames


def crowd(_folder: Path) -> dict[str, Any]:
    """Figures of our own."""
    return _crowd(None)


def character(_folder: Path) -> dict[str, Any]:
    """A supplied character."""
    file = SUPPLIED / "small" / CHARACTER
    return _crowd(file) if file.exists() else {"skipped": f"{CHARACTER} is not here"}


def _crowd(figure: Path | None) -> dict[str, Any]:
    """Bytes and seconds of BLASes per frame, culled within the default budget and whole, and the error of some
    frames."""
    demo("crowd", FIGURES, figure)
    shots = {"culled": Shot(CullOptions()), "whole": Shot(CullOptions(policy="none"))}
    rows, errors = [], []
    for number, scene, change in Footage(CROWD_SIZE).frames(CROWD_FRAMES):
        row: dict[str, Any] = {"frame": number, "instances": len(scene.instances)}
        kept = {}
        for name, one in shots.items():
            result = one.advance(scene, change)
            names = ("active", "hitboxes", "blas_bytes", "blas_held_bytes", "blas_built", "blas_refitted")
            row[name] = {key: result.stats[key] for key in names} | {
                "blas_s": result.stats["blas_s"] + result.stats["refit_s"]
            }
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
    return {
        "size": CROWD_SIZE,
        "figures": FIGURES,
        "triangles": triangles,
        "samples": JUDGE_SAMPLES,
        "frames": rows,
        "errors": errors,
    }


# Growth: the same picture in ever larger cities


def growth(_folder: Path) -> dict[str, Any]:
    """Cities of SIZES before a camera that moves sideways: seconds of settled frames by step, without Blender's
    evaluation, and what a cold start builds.

    The cities' frames take turns, so that what else the machine does meets all of them.
    """
    cities = [City(count) for count in SIZES]
    for k in range(len(GROWTH_FRAMES)):
        for city in cities:
            city.advance(k)
    return {
        "size": GROWTH_SIZE,
        "cities": [{"instances": len(c.scenes[0].instances), "cold": c.cold, "frames": c.rows} for c in cities],
    }


class City:
    """A city's frames, and the loops through them: culled within the default budget, and whole. rows: the figures of
    each frame; cold: of the cold start."""

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
            # none changes; the file is closed soon
            meshes = self.scenes[0].meshes if self.scenes else [scene.meshes[k] for k in range(len(scene.meshes))]
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
            row = {
                key: result.stats[key]
                for key in ("build_s", "trace_s", "feedback_s", "active", "hitboxes", "iterations")
            }
            self.rows[k][name] = row | {"advance_s": time.perf_counter() - start}
            if name == "culled" and k == 0:
                loop = one.loop
                assert loop is not None and loop.activation.known is not None
                asked, met = np.flatnonzero(loop.activation.known), result.hits.sum(axis=1)
                self.cold = {
                    "asked": len(asked),
                    "met": int((met[asked] > 0).sum()),
                    "active": row["active"],
                    "rounds": row["iterations"],
                }
                self.cold |= {"meshes": len(loop.blas)}


# Rest and memory


def rest(_folder: Path) -> dict[str, Any]:
    """A million instances, and 200 frames in which nothing changes though each says that the camera did: what changes
    in the states."""
    demo("mirror-city", SIZES[-1])
    _, scene, _ = next(Footage(REST_SIZE).frames(range(1, 2)))
    one = Shot(LOOSE)
    out: dict[str, Any] = {
        "instances": len(scene.instances),
        "active": [],
        "hitboxes": [],
        "changes": [],
        "built": [],
        "rounds": [],
    }
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
    """500 frames there and back of the crowd and of the flythrough by the steps of `lipac analyze --warm`: memory of
    the process after each."""
    return {
        name: _memory(folder, name, count, last)
        for name, count, last in (("crowd", 100, 48), ("flythrough", 2_000, 120))
    }


def _memory(folder: Path, name: str, count: int, last: int) -> dict[str, Any]:
    from ....core.files.report import Report
    from ....lipac_addon.batch.frame import run_frame
    from ....lipac_addon.batch.job import Job
    from ....lipac_addon.batch.session import Session

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
    """A picture of either demo as culled, by Cycles, and its TLAS from above: folder/crowd.jpg,
    folder/flythrough.jpg."""
    from ....core.files.atomic import replacing

    for name, count, frame in (("crowd", FIGURES, 24), ("flythrough", 20_000, 84)):
        scene, out = folder / f"{name}.blend", folder / f"picture-{name}"
        compare.lipac("demo", name, "-o", scene, "--instances", str(count))
        where = ("--frames", str(frame), "--resolution", "{}x{}".format(*PICTURE_SIZE))
        compare.lipac("render", scene, "-o", out, "--cull", "light-paths", *where, "--samples", "32")
        shown = compare.pictures(folder, out.name)[1][..., :3]
        tlas = compare.tlas_of(scene, out / "states" / f"frame_{frame:04}.npz", frame, PICTURE_SIZE)
        with replacing(folder / f"{name}.jpg") as part:
            save(strip([(np.clip(shown, 0, 1) * 255 + 0.5).astype(np.uint8), tlas], DEMO_LABELS), part)
    return {}
