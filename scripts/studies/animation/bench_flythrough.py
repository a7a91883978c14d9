"""Benchmark of the flythrough, in real time and as a shot: how soon what comes into sight is there, how often states
change, flicker."""

from __future__ import annotations

import dataclasses
import itertools
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ....core.accel.region_tree import Regions
from ....core.arrays import F32
from ....core.culling.activation import LARGE
from ....core.culling.loop import Loop
from ....core.culling.options import CullOptions
from ....core.culling.result import CullingResult
from ....core.culling.shot import Shot
from ....core.evaluation.metrics import flicker
from ....core.feedback.tiles import tile_means
from ....core.scene.frustum import View
from ....core.scene.model import RayType
from .footage import Footage, demo

Mask = NDArray[np.bool_]
FLY_SIZE, FLY_SAMPLES = (160, 90), 8
# frames that a loop in real time takes for its cold start, or is given; frame in which the camera turns the corner
STARTED, CORNER = 20, 73
SHARE = 1e-4  # of the paths that must meet an instance, in the loops that run in real time
BEFORE, AFTER = 10, 4  # frames for which something that appears was not there, and is looked at from then on


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
    """Which instances come into sight and when, from how many paths met them, (F, N): least or more in a frame and in
    most of the AFTER that begin with it, none in the BEFORE before it."""
    seen, out = met >= least, []
    for f in range(BEFORE, len(met) - AFTER):
        new = seen[f] & (met[f - BEFORE : f] == 0).all(axis=0) & (seen[f : f + AFTER].sum(axis=0) >= AFTER - 1)
        out += [Appearance(f, int(i)) for i in np.flatnonzero(new)]
    return out


def latencies(found: list[Appearance], states: NDArray[np.bool_]) -> dict[str, Any]:
    """Frames from appearance to activation, from states (F, N): how many took 0, 1, 2 ... frames; `before`: were active
    in the frame before already; `never`: were not in what is left of the shot."""
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
    """Per instance that is ever active and 100 frames, from states (F, N): how often they change, and how often a
    change is undone within BEFORE frames."""
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
    """Loops that run in real time, one round per frame and by counts: with all there is, without mitigation, without
    hysteresis.

    They start STARTED frames before the corner.
    """
    base = CullOptions(min_share=SHARE, max_iterations=1, width=FLY_SIZE[0])
    runs = {
        "as it is": base,
        "no mitigation": replace(base, mitigation=False),
        "no hysteresis": replace(base, hysteresis=1.0),
    }
    return _fly(runs, first=CORNER - STARTED, started=STARTED)


def shot(_folder: Path) -> dict[str, Any]:
    """Loops that work on each frame until it is at rest, within the default budget, as `--warm` does: with and without
    hysteresis, and frames by themselves.

    From the corner on.
    """
    runs = {
        "warm": CullOptions(),
        "warm, no hysteresis": CullOptions(hysteresis=1.0),
        "frames by themselves": CullOptions(),
    }
    return _fly(runs, {"frames by themselves"}, first=CORNER)


def _fly(
    options: dict[str, CullOptions],
    independent: set[str] | frozenset[str] = frozenset(),
    first: int = 1,
    started: int = 0,
) -> dict[str, Any]:
    """Run loops side by side through the flythrough from frame first on, beside the whole scene, which says what is in
    sight, and how each picture should be.

    started: frames that do not count.
    """
    from ....lipac_addon.demo import flythrough as scene_of
    from ....lipac_addon.demo.mirror_city import DEFAULT_INSTANCES

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
    out: dict[str, Any] = {
        "size": FLY_SIZE,
        "frames": [first, scene_of.FRAMES],
        "cuts": [scene_of.CUT + 1, scene_of.BACK + 1],
    }
    out |= {"started": started, "own_change": _own_change(pictures)}
    return out | {"runs": {name: _figures(run, pictures, found, started) for name, run in runs.items()}}


def _mask(regions: Regions, view: View, share: float) -> Mask:
    out = np.zeros(len(regions.place), bool)
    out[regions.in_view(view, share)] = True
    return out


def _sorted(
    direct: NDArray[np.int64], reflected: NDArray[np.int64], large: Mask, least: int
) -> dict[str, list[Appearance]]:
    """Appearances by how they come into sight."""
    seen = appearances(direct, least)
    return {
        "seen directly, large": [a for a in seen if large[a.frame, a.instance]],
        "seen directly, smaller": [a for a in seen if not large[a.frame, a.instance]],
        "seen in reflections alone": [a for a in appearances(reflected, least) if not direct[a.frame, a.instance]],
    }


def _own_change(pictures: list[F32]) -> float:
    """Mean change from frame to frame, relative to the mean."""
    return float(
        np.mean([np.abs(b - a).mean() for a, b in itertools.pairwise(pictures)]) / np.mean([p.mean() for p in pictures])
    )


def _figures(run: Run, whole: list[F32], found: dict[str, list[Appearance]], started: int) -> dict[str, Any]:
    states = np.stack(run.states)
    ours, right = run.pictures[started:], whole[started:]

    def tiled(pictures: list[F32]) -> list[NDArray[np.float64]]:
        return [tile_means(p).reshape(1, -1, 1).repeat(3, axis=2) for p in pictures]

    light = np.mean([tile_means(p).mean() for p in whole])
    error = [
        float(np.abs(tile_means(b) - tile_means(a)).mean() / light) for a, b in zip(whole, run.pictures, strict=True)
    ]
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
