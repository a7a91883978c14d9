"""Witnesses: paths that took no part in choosing what is culled, through the full scene as far as they need it."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..accel.hitboxes import Hitboxes
from ..arrays import F64, I64
from ..error_budget.budget import Budget
from ..feedback.hits import Weights
from ..feedback.path_log import RECORD, PathLog, renumber
from ..feedback.tiles import TILES, tiles_of
from ..progress import Progress, silent
from .frame_tracer import places

if TYPE_CHECKING:
    from ..accel.tlas import Tlas
    from .loop import Loop

OPENINGS = 16  # rounds of opening boxes at most, each a level or two deeper


@dataclass(frozen=True)
class Witness:
    """Paths that chose nothing, through the full scene as far as they need it: what each met, and the number of its
    first sample.

    light: (T,) float64 luminance of all paths of each tile. unknown: (T,) float64, that of what they carry through
    boxes that were not opened: it may be lost, or other light in its place.
    """

    tlas: Tlas
    log: PathLog
    first_sample: int
    light: F64
    unknown: F64


def trace_witness(
    loop: Loop, first_sample: int, only: NDArray[np.uint8], tolerated: Budget, progress: Progress = silent
) -> Witness:
    """Trace through the full scene those of S paths per pixel that only, (H, W, S), marks. first_sample: the number of
    the first; no path that chose a set may have one of these numbers.

    Boxes that paths cross are opened, and these paths traced again, until the light that is carried through boxes that
    are not opened is within tolerated; where builds are limited, none is opened.
    """
    log, prepared = PathLog.zeros(*only.shape, backdrop=loop.backdrop), loop.tracer.prepared
    tile = tiles_of(*only.shape[:2]).ravel()
    samples = np.maximum(
        np.bincount(tile, only.sum(axis=2).ravel(), TILES) / np.maximum(np.bincount(tile, minlength=TILES), 1), 1.0
    )
    records = log.records.reshape(-1, RECORD)
    before: Tlas | None = None
    light: I64 = np.zeros(0, np.int64)
    for k in range(OPENINGS):
        progress(1 - 0.6**k, "paths that chose nothing")
        tlas = loop.tracer.build(loop.activation.active)
        if before is not None:
            renumber(records, 1 - only.reshape(-1), places(tlas.ids, before.ids))
        cut, boxes = loop.boxes(tlas)
        log.clear(only)
        weights = dataclasses.replace(Weights.zeros(1, loop.ambient, first=len(tlas)), known=loop.known)
        feedback, _ = loop.tracer.count(prepared, tlas, only.shape[2], first_sample, boxes, weights, log=log, only=only)
        light = light if k else weights.total
        unknown = dataclasses.replace(weights, total=light).relative(samples)[0]  # of tiles without paths 0
        within = unknown.mean() <= tolerated.mean and unknown.max() <= tolerated.worst
        if within or loop.limited or not loop.activation.open_crossed_boxes(cut, feedback, prepared.emissive):
            break
        only, before = log.affected(np.zeros(len(tlas), bool)), tlas
    return Witness(
        tlas,
        log,
        first_sample,
        np.asarray(light * weights.unit, np.float64),
        np.asarray(weights.light[0] * weights.unit, np.float64),
    )


def first_part(loop: Loop) -> int:
    """Row of the first part of a divided mesh."""
    return loop.division.first if loop.division else len(loop.activation)


class Staying:
    """A set that stays, as far as paths need it: parts of meshes that none has asked for yet are boxes."""

    def __init__(self, loop: Loop, keep: np.ndarray) -> None:
        """keep: (N,) bool."""
        self._loop, self.keep = loop, keep
        self._build()

    def _build(self) -> None:
        loop, there = self._loop, self.keep.copy()
        there[first_part(loop) :] &= loop.activation.active[first_part(loop) :]
        self._waiting = np.flatnonzero(self.keep & ~there)
        self.tlas = loop.tracer.build(there)
        self._boxes = Hitboxes(loop.scene.instances.bounds[self._waiting], loop.device) if len(self._waiting) else None

    def trace(self, witness: Witness, only: NDArray[np.uint8], log: PathLog) -> None:
        """Trace again paths of a witness, those that only, (H, W, S), marks, with nothing else in the scene, as
        `FrameTracer.trace_without`; parts whose boxes they cross are there from then on."""
        while True:
            self._loop.tracer.trace_without(
                witness.tlas, witness.first_sample, self.keep, self.tlas, only, log, self._boxes
            )
            crossed = np.zeros(0, bool) if self._boxes is None else self._boxes.counters.any(axis=1)
            if not crossed.any():
                return
            opened = np.zeros_like(self.keep)
            opened[self._waiting[crossed]] = True
            self._loop.include(opened)
            only = log.affected(np.zeros(len(witness.tlas), bool), only)
            self._build()
