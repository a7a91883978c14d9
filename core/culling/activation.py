"""Which instances are active, and how feedback changes that: requests, emitters that contribute, what comes into view,
and what paths no longer need."""

from __future__ import annotations

import numpy as np

from ..accel.region_tree import FANOUT, Cut, Regions
from ..arrays import F32, F64, I32, I64
from ..error_budget.budget import Budget
from ..feedback.hits import Feedback
from ..feedback.tiles import DARK
from ..scene.bounds import existing
from ..scene.change import Change
from ..scene.film import LUMINANCE
from ..scene.frustum import View
from ..scene.model import RayType, Scene
from ..tracing.seen_emitters import SeenEmitters
from .measurement import Measurement

COLD_HITS = 7  # detection limit: segments of one round that must cross a box before it is opened
SETTLED = 0.02  # requests per path at which coarse rounds end
GROWTH = 1.05  # per round at most, of the value of an instance that waits for its BLAS
LARGE = 0.05  # of the picture's width: what comes into view this large is activated before it is asked for
UNASKED = 0.02  # of the budget: what small emitters that the camera sees may bring a tile together, and stay unasked


class Activation:
    """The activation of a scene's instances, from round to round and from frame to frame.

    exists, pinned: (N,) bool. active: (N,) bool, instances that are, or are to be, in the TLAS. kept: (N,) bool, what
    the last decision kept. known: (N,) bool, instances that the last measurement had in its TLAS, None where there was
    none. value: (N,) float32, share of the paths that met an instance, or requested it, when that was last known.
    regions: the region tree, whose cut stands in for all others.
    """

    def __init__(self, scene: Scene, pinned: np.ndarray | None = None) -> None:
        """Everything is culled, but pinned, (N,) bool, and what stays in any case."""
        count = len(scene.instances)
        self.active, self.kept, self.value = np.zeros(count, bool), np.zeros(count, bool), np.zeros(count, np.float32)
        self.known: np.ndarray | None = None
        self.exists = existing(scene.instances.bounds)
        self.regions = Regions(scene.instances.bounds, np.flatnonzero(self.exists))
        self._shown = np.zeros(0, np.int32)  # large instances in view
        self._requests: tuple[Cut, I64] | None = None  # boxes of the last round, and how often they were crossed
        self._opened: list[np.ndarray] = []  # instances that are active for a witness alone
        self._pin(_either(pinned, scene.stays))

    def __len__(self) -> int:
        return len(self.active)

    def advance(self, scene: Scene, change: Change, pinned: np.ndarray | None) -> None:
        """Go on to the next frame: what was active and kept is so again."""
        self._requests, self._opened = None, []
        if not change.still:
            self.regions.pass_frame()
        if change.previous is None:
            self._move(scene.instances.bounds, change.moved)
        else:
            self._carry(scene.instances.bounds, change.previous)
        self._pin(_either(pinned, scene.stays))

    def divide(self, scene: Scene) -> None:
        """Go on with the scene after meshes were divided: parts are instances behind the others, and what was divided
        exists no more."""
        count = len(self.active)
        self._carry(
            scene.instances.bounds,
            np.append(np.arange(count, dtype=np.int32), np.full(len(scene.instances) - count, -1, np.int32)),
        )
        self._pin(np.append(self.pinned, np.zeros(len(scene.instances) - count, bool)))

    def _pin(self, pinned: np.ndarray | None) -> None:
        self.pinned = np.zeros(len(self.active), bool) if pinned is None else pinned & self.exists
        self.active |= self.pinned

    def _move(self, bounds: F32, moved: np.ndarray | None) -> None:
        """Follow motion, (N,) bool, of the same instances."""
        rows = np.zeros(0, np.int64) if moved is None else np.flatnonzero(moved)
        exist = existing(bounds[rows])
        if (exist != self.exists[rows]).any():
            self.exists = self.exists.copy()
            self.exists[rows] = exist
            self.active &= self.exists
            self.regions = self.regions.renewed(bounds, np.flatnonzero(self.exists))
            return
        self.regions.move(rows[exist], bounds)
        if len(rows) and self.regions.decayed:
            self.regions = self.regions.renewed(bounds, np.flatnonzero(self.exists))

    def _carry(self, bounds: F32, previous: I32) -> None:
        """Follow instances to their new rows: (N,) int32 row of the frame before, -1 for new ones."""
        self.exists = existing(bounds)
        shown = np.zeros(len(self.active), bool)
        shown[self._shown] = True
        known = np.flatnonzero(previous >= 0)

        def carried(old: np.ndarray) -> np.ndarray:
            new = np.zeros(len(previous), old.dtype)
            new[known] = old[previous[known]]
            return new

        self.active, self.kept, self.value = carried(self.active) & self.exists, carried(self.kept), carried(self.value)
        self.known = None if self.known is None else carried(self.known)
        self._shown = np.flatnonzero(carried(shown)).astype(np.int32)
        self.regions = self.regions.renewed(bounds, np.flatnonzero(self.exists), previous)

    def activate(self, instances: np.ndarray) -> None:
        """Have a set of instances, (N,) bool, active."""
        self.active |= instances

    def activate_alone(self, instances: np.ndarray) -> None:
        """Have a set of instances, (N,) bool, active, and no other: what a rule keeps does not depend on the last
        frame."""
        self.active = instances.copy()

    def activate_for_witness(self, instances: np.ndarray) -> None:
        """Have a set of instances, (N,) bool, active until the next decision, unless a measurement finds out about
        them."""
        self._opened.append(np.flatnonzero(instances & ~self.active))
        self.active |= instances

    def activate_newly_visible(self, scene: Scene, first: bool) -> None:
        """Activate large instances that have come into view since the last frame: the first frame with them is to show
        them (latency mitigation)."""
        shown = self.regions.in_view(View.of(scene.camera), LARGE)
        shown = np.sort(shown[(scene.instances.flags[shown] & (1 << RayType.CAMERA)) != 0])
        if not first:
            new = np.setdiff1d(shown, self._shown, assume_unique=True)
            new = new[~self.active[new]]
            self.active[new], self.value[new] = True, LARGE**2
        self._shown = shown

    def open_requested_boxes(self, cut: Cut, feedback: Feedback, emissive: I64) -> tuple[float, bool]:
        """Open the boxes that paths asked for, activate instances met before they were active. Returns how many
        segments per path asked, and whether most of what they crossed is crossed by chance (`_detection_limit`)."""
        crossings = feedback.boxes.sum(axis=1)
        enough = _detection_limit(crossings, feedback.paths)
        asked = np.flatnonzero(crossings >= enough)
        leaves = asked[cut.level[asked] == 0]
        single = self.regions.order[cut.index[leaves]]
        crossed = (crossings[leaves] / max(feedback.paths, 1)).astype(np.float32)
        waits = self.active[single]  # for its BLAS: what paths met of it before says more than what crosses its box now
        self.value[single] = np.where(waits, np.minimum(GROWTH * self.value[single], crossed), crossed)
        asked = np.setdiff1d(asked, leaves[waits], assume_unique=True)
        self.regions.split_nodes(cut, asked, crossings[asked] // enough)
        self.active[self.regions.instances_of(cut, asked)] = True
        # emitters that lit a path are known before their boxes are crossed
        self.active[emissive[feedback.hits[emissive].sum(axis=1) >= COLD_HITS]] = True
        self._requests = (cut, crossings)
        return float(crossings[asked].sum()) / max(feedback.paths, 1), enough == 1

    def activate_contributing_emitters(self, cut: Cut, feedback: Feedback, emissive: I64) -> None:
        """Activate every emitter that lit a path, or whose own box a path crossed: few paths may carry much of a tile's
        light."""
        if len(emissive):
            crossed = np.flatnonzero((cut.level == 0) & feedback.boxes.any(axis=1))
            lit = feedback.hits[emissive].any(axis=1) | np.isin(emissive, self.regions.order[cut.index[crossed]])
            self.active[emissive[lit]] = True

    def activate_seen_emitters(self, seen: SeenEmitters, light: F64, budget: Budget) -> bool:
        """Activate small emitters that the camera sees, but those that together bring little to each tile. light: (T,)
        mean luminance of each. Returns whether there was any to activate."""
        share = seen.color @ LUMINANCE / np.maximum(light, max(DARK * float(light.mean()), 1e-30))[seen.tile]
        rows = seen.instance[_all_but(share, seen.tile, UNASKED * min(budget.mean, budget.worst))]
        new = np.unique(rows[~self.active[rows]])
        self.active[new] = True
        return bool(len(new))

    def open_crossed_boxes(self, cut: Cut, feedback: Feedback, emissive: I64) -> bool:
        """Open every box of a cut that a path of a witness crossed, and activate emitters that lit one. Returns whether
        there was any."""
        crossings = feedback.boxes.sum(axis=1)
        asked = np.flatnonzero(crossings)
        rows = np.concatenate(
            [self.regions.order[cut.index[asked[cut.level[asked] == 0]]], emissive[feedback.hits[emissive].any(axis=1)]]
        )
        rows = rows[~self.active[rows]]
        self._opened.append(rows)
        self.active[rows] = True
        # an eighth more of all that is built again for it
        affordable = (len(cut) + int(self.active.sum())) // FANOUT // max(len(asked), 1)
        self.regions.split_nodes(cut, asked, np.maximum(crossings[asked], max(affordable, FANOUT)))
        return bool(len(asked) or len(rows))

    def release(self, measured: Measurement) -> None:
        """Cull instances that no path met, and merge regions whose parts none requested."""
        ids, met = measured.tlas.ids, measured.met
        self.known = np.zeros(len(self.active), bool)
        self.known[ids] = True
        for opened in self._opened:  # unless a measurement has found out about them since
            self.active[opened[~(self.kept | self.known)[opened]]] = False
        self.value[ids] = met[ids] / max(measured.feedback.paths, 1)
        unmet = ids[(met[ids] == 0) & ~self.kept[ids]]
        self.active[self.regions.release(unmet)] = False
        if self._requests is not None:
            self.regions.close(np.flatnonzero(self.active), *self._requests)


def _detection_limit(crossings: I64, paths: int) -> int:
    """How often a box must be crossed to be opened: COLD_HITS times; once, where most crossings are of boxes that fewer
    paths cross than that."""
    often = int(crossings[crossings >= COLD_HITS].sum())
    seldom = int(crossings.sum()) - often
    return 1 if seldom > often and seldom > SETTLED * paths else COLD_HITS


def _all_but(share: F64, tile: I32, tolerated: float) -> np.ndarray:
    """(S,) bool: all but the least shares, (S,), of each tile, (S,): as many as are within what is tolerated."""
    order = np.lexsort((share, tile))
    upto = np.cumsum(share[order])
    starts = np.unique(tile[order], return_index=True)[1]
    before = np.repeat(np.append(0, upto)[starts], np.diff(np.append(starts, len(order))))
    out = np.zeros(len(share), bool)
    out[order] = upto - before > tolerated
    return out


def _either(a: np.ndarray | None, b: np.ndarray | None) -> np.ndarray | None:
    """What one of two masks names, where there is any."""
    return b if a is None else a if b is None else a | b
