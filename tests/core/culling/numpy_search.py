"""Sections 3 to 6 of docs/method.md in plain NumPy, written from that page: estimate, units, selection, search.

It is as slow as it is short, and has no part in LiPaC but to be compared with. Equation numbers are the page's.
P paths, A entries of the TLAS, U units, T tiles.
"""

import math
from dataclasses import dataclass
from statistics import NormalDist
from typing import Any

import numpy as np

T, Y = 144, np.array([0.2126, 0.7152, 0.0722])
_erfc = np.vectorize(math.erfc)
Array = Any


def rms(color: Array) -> Array:
    return np.sqrt((color**2).mean(axis=-1))


def summed(index: Array, values: Array, count: int) -> Array:
    out = np.zeros((count, *values.shape[1:]))
    np.add.at(out, index, values)
    return out


@dataclass
class Change:
    error: Array  # (T,), as average and sigma
    average: Array
    sigma: Array

    def upper_mean(self, g: float) -> float:  # eq. 9
        return self.average.mean() + NormalDist().inv_cdf(g) * math.sqrt((self.sigma**2).sum()) / T

    def upper_worst(self, g: float) -> float:  # eq. 9, by bisection
        sure, noisy = self.sigma == 0, self.sigma > 0
        low, high = max(self.error[sure].max(initial=0.0), 0.0), max((self.error + 40 * self.sigma).max(), 0.0)
        for _ in range(80):
            x = (low + high) / 2
            p = (0.5 * _erfc((self.error[noisy] - x) / self.sigma[noisy] / math.sqrt(2))).prod() if noisy.any() else 1.0
            low, high = (low, x) if p >= g else (x, high)
        return high

    def excess(self, budget: tuple[float, float], g: float) -> float:  # eq. 10
        return max(self.upper_mean((1 + g) / 2) / budget[0], self.upper_worst((1 + g) / 2) / budget[1])

    def doubtful(self, budget: tuple[float, float], g: float) -> Array:
        mean = (self.sigma**2 > (self.sigma**2).mean()) & (self.upper_mean((1 + g) / 2) > budget[0])
        return ((self.sigma > 0) & (self.error + 4 * self.sigma > budget[1])) | mean

    def may_hold(self, budget: tuple[float, float], g: float, factor: Array) -> bool:
        less = np.where(self.doubtful(budget, g), self.sigma, 0)
        sigma = np.where(less > 0, self.sigma / np.sqrt(factor), self.sigma)
        return Change(self.error - less, np.maximum(self.average - less, 0), sigma).excess(budget, g) <= 1

    def exceeded(self, budget: tuple[float, float], g: float) -> Array:  # section 7
        out = np.zeros(T, bool)
        if self.upper_mean((1 + g) / 2) <= budget[0]:
            for t in np.argsort((budget[1] - self.error) / np.maximum(self.sigma, 1e-30), kind="stable"):
                rest = Change(self.error[~out], self.average[~out], self.sigma[~out])
                if rest.upper_worst((1 + g) / 2) <= budget[1]:
                    break
                out[t] = True
        return out


@dataclass
class Paths:
    """P paths of a trace: pixel and index in it, light (P, 3), records (P, 16)."""

    size: tuple[int, int]
    pixel: Array
    k: Array
    light: Array
    record: Array

    def __post_init__(self) -> None:
        w, h = self.size
        x, y = np.arange(w * h) % w, np.arange(w * h) // w
        self.pixel_tile, block = 9 * y // h * 16 + 16 * x // w, (y // 3) * w + x // 3
        keys, self.block = np.unique(block * T + self.pixel_tile, return_inverse=True)
        self.block_tile, self.half = keys % T, (x[self.pixel] + y[self.pixel] + self.k) % 2
        self.tile = self.pixel_tile[self.pixel]
        self.n = np.maximum(np.bincount(self.tile, minlength=T), 1)
        light = summed(self.tile, np.maximum(self.light.astype(float), 0), T)  # less than nothing before a clear film
        self.lum, self.bright = (
            self.n * np.maximum(s / self.n, 0.01 * (s / self.n).mean()) for s in (light @ Y, rms(light))
        )  # eq. 3

    def change(self, d: Array, owed: Array) -> Change:
        if not d.any():
            return Change(owed, owed, np.zeros(T))
        lum, color = d @ Y / self.lum[self.tile], d / self.bright[self.tile][:, None]
        whole = np.maximum(np.abs(summed(self.tile, lum, T)), rms(summed(self.tile, color, T)))  # eq. 4
        s0, s1 = (
            summed(self.block[self.pixel[self.half == h]], color[self.half == h], len(self.block_tile)) for h in (0, 1)
        )
        product, both = (s0 * s1).mean(axis=1), (rms(s0) > 0) & (rms(s1) > 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            f = summed(self.block_tile[both], (product * (1 / rms(s0) + 1 / rms(s1)))[both], T)  # eq. 5
        squares = 4 * summed(self.block_tile, product, T) * np.bincount(self.block_tile[both], minlength=T)
        plain = rms(s0 + s1)
        g = np.minimum(summed(self.block_tile[both], plain[both], T), np.sqrt(np.maximum(squares, 0)))
        g += summed(self.block_tile[~both], plain[~both], T)
        s, pixels = self.n / np.bincount(self.pixel_tile, minlength=T), self.size[0] * self.size[1]

        def variance(each: Array, norm: Any) -> Array:  # eq. 7
            squares, strata = (
                summed(self.tile, norm(each), T),
                summed(self.pixel_tile, norm(summed(self.pixel, each, pixels)), T),
            )
            return np.where(s > 1, (squares - strata / s) * s / np.maximum(s - 1, 1), squares)

        v = np.maximum(variance(lum, np.square), variance(color, lambda c: (c**2).mean(axis=1)))
        sigma = np.sqrt(np.maximum(v, 0) + 1.0 / self.n**2)  # eq. 8
        most = f + 0.6 * np.maximum(np.sqrt(np.bincount(self.block_tile, minlength=T)) - 5, 0) * sigma
        f = np.maximum(f, np.minimum(g, most))
        return Change(np.maximum(whole, f) + owed, np.maximum(whole, g) + owed, sigma)  # eq. 6

    def affected(self, cull: Array) -> Array:  # (P,); number A stands for what is not built
        held = (np.append(cull, True)[self.record[:, 1:]]) & (np.arange(15) < self.record[:, :1])
        return held.any(axis=1) | (self.record[:, 0] == 16)


def curve(boxes: Array) -> Array:  # section 4: the order of boxes (N, 2, 3) by extended Morton codes
    center, size = (boxes[:, 0] + boxes[:, 1]) / 2, (boxes[:, 1] - boxes[:, 0]).max(axis=1)
    cell = np.minimum((center - center.min(axis=0)) * (2**16 / np.ptp(center, axis=0).max()), 2**16 - 1).astype(
        np.int64
    )
    code = sum((cell[:, axis] >> bit & 1) << (3 * bit + axis) for axis in range(3) for bit in range(16))
    rank = sum((size <= size.max() / 4**r).astype(np.int64) for r in range(1, 8))
    return np.argsort(code | rank << 48, kind="stable")


class Units:
    """Section 4. ids: (A,) instance of each entry; met: (A,) paths; w: (A, T); mesh, bytes_of: (A,) of its BLAS."""

    def __init__(self, boxes: Array, ids: Array, met: Array, w: Array, mesh: Array, bytes_of: Array) -> None:
        self.mesh, self.bytes_of, self.ids, self.order = mesh, bytes_of, ids, curve(boxes)
        place, pinned = np.argsort(self.order), (w > 50).any(axis=1)
        single, region = pinned | (met >= 8), place[ids] // 8
        thin = ~single & (met > 0)
        hits, formed = np.bincount(region[thin], met[thin], -(-len(boxes) // 8)), []
        while True:
            formed.append(hits >= 8 if len(hits) > 1 else np.ones(1, bool))
            if len(hits) == 1:
                break
            hits = np.where(formed[-1], 0, hits)
            hits = np.pad(hits, (0, -len(hits) % 8)).reshape(-1, 8).sum(axis=1)
        pool, pools = np.array([-1]), 0
        for forms in reversed(formed):
            pool = np.where(forms, pools + np.cumsum(forms) - 1, np.repeat(pool, 8)[: len(forms)])
            pools += int(forms.sum())
        self.pool_of, unmet = pool[np.arange(len(boxes)) // 8], (met == 0) & ~single  # by place along the curve
        self.of = np.where(single, np.cumsum(single) - 1, single.sum() + pool[region] + pools * unmet)
        self.first = int(single.sum()) + pools  # of the unmet units
        self.worth = summed(self.of, w, self.first + pools)
        self.worth += summed(self.of[once := thin & (met == 1)] + pools, w[once], self.first + pools)
        self.worth[self.of[pinned]] = np.inf
        known = np.bincount(pool[region[~unmet]], minlength=pools)
        self.members = np.concatenate(
            [np.bincount(self.of[~unmet], minlength=self.first), np.bincount(self.pool_of, minlength=pools) - known]
        )

    def saved(self, stay: Array) -> Array:  # section 5; stay: (U,)
        left = stay[self.of]
        users = np.bincount(self.mesh[left], minlength=self.mesh.max() + 1)
        out = np.bincount(self.of[left], 150 + self.bytes_of[left] / users[self.mesh[left]], len(self.worth))
        out[self.first :] = 150 * self.members[self.first :]
        return np.maximum(out, 1)

    def gain(self, before: Array, after: Array) -> float:  # section 6
        met = np.where(np.arange(len(self.worth)) < self.first, self.members, 0)
        each = met, self.saved(~before)
        return max(of[after & ~before].sum() / max(of[~before].sum(), 1) for of in each)

    def owed(self, cull: Array) -> Array:
        return self.worth[self.first :][cull[self.first :]].sum(axis=0)

    def kept(self, cull: Array) -> Array:  # (N,) instances
        out = np.zeros(len(self.order), bool)
        out[self.order] = ~cull[self.first + self.pool_of]
        out[self.ids] = ~cull[self.of]
        return out


def select(w: Array, saved: Array, mean: float, tiles: Array) -> Array:  # section 5
    cull, sums = np.zeros(len(w), bool), np.zeros(T)
    for u in np.argsort(w.sum(axis=1) / saved, kind="stable"):
        if (sums + w[u] <= tiles).all() and sums.sum() + w[u].sum() <= mean * T:
            cull[u], sums = True, sums + w[u]
    return cull


class Trials:
    """Paths, and what they are with the last accepted set culled.

    retrace: (cull (A,), paths (P,)) -> light and records, valid for those paths.
    """

    def __init__(self, paths: Paths, entries: int, retrace: Any) -> None:
        self.full, self.at, self.after, self.retrace = paths, paths, paths, retrace
        self.culled = self.cull = np.zeros(entries, bool)

    def propose(self, cull: Array) -> int:
        if (cull == self.cull).all() and self.after is not self.full:  # traced already
            return 0
        self.cull, self.affected = cull, self.at.affected(cull & ~self.culled)
        return int(self.affected.sum())

    def trace(self, owed: Array) -> Change:
        light, record = self.retrace(self.cull, self.affected)
        light = np.where(self.affected[:, None], light, self.at.light)
        self.after = Paths(
            self.full.size,
            self.full.pixel,
            self.full.k,
            light,
            np.where(self.affected[:, None], record, self.at.record),
        )
        return self.full.change((light - self.full.light).astype(float), owed)

    def accept(self) -> None:
        self.at, self.culled = self.after, self.cull


def search(
    units: Units, trials: Trials, budget: tuple[float, float]
) -> tuple[list[tuple[Array, Change]], int]:  # section 6
    u, worth, traced, doubts = len(units.worth), units.worth.copy(), 0, 0
    first, paths = units.first, trials.full

    def attempt(cull: Array, since: Array) -> Change | None:
        nonlocal traced, doubts
        count = trials.propose(cull[units.of])
        if traced + count > int(1.4 * len(paths.pixel)):
            return None
        traced += count
        change = trials.trace(units.owed(cull))
        if change.excess(budget, 0.8) <= 1:
            trials.accept()
            return change
        doubts += change.may_hold(budget, 0.8, np.full(T, 4.0))
        new = np.append(np.where(np.arange(u) >= first, False, cull & ~since)[units.of], False)
        sums, squares = np.zeros((2, u, T))
        for p in np.flatnonzero(trials.affected):
            blamed = [e for e in trials.at.record[p, 1 : 1 + min(trials.at.record[p, 0], 15)] if new[e]]
            if blamed:
                step, t = (trials.after.light[p] - trials.at.light[p]).astype(float), paths.tile[p]
                r, c = step @ Y / paths.lum[t], rms(step) / paths.bright[t]
                sums[units.of[blamed[0]], t] += r if abs(r) >= c else c
                squares[units.of[blamed[0]], t] += max(abs(r), c) ** 2
        known = cull & ~since & (np.arange(u) < first)
        worth[known] = np.abs(sums[known]) + 2 * np.sqrt(squares[known])
        return None

    sets = [(np.zeros(u, bool), Change(*np.zeros((3, T))))]
    for share in (0.1, 0.3):
        cull = sets[-1][0].copy()
        cull[:first] |= worth[:first].sum(axis=1) == 0
        cull[first:] |= select(
            worth[first:], units.saved(np.ones(u, bool))[first:], share * budget[0], share * budget[1]
        )
        change = attempt(cull, sets[-1][0])
        if change is not None and (cull != sets[-1][0]).any():
            sets.append((cull, change))
    share, failed, tried = 0.5, 0, {cull.tobytes() for cull, _ in sets}
    for _ in range(64):
        last, change = sets[-1]
        if failed == 5 or doubts >= 64 or last.all():
            break
        mean = share * max(0.95 * budget[0] - change.average.mean(), 0.05 * budget[0])
        tiles = share * np.maximum(0.95 * budget[1] - change.error - 2 * change.sigma, 0.05 * budget[1])
        for _ in range(20):
            cull = last.copy()
            cull[~last] = select(worth[~last], units.saved(~last)[~last], mean, tiles)
            if cull.tobytes() not in tried and units.gain(last, cull) >= 0.001:
                break
            mean, tiles = 1.5 * mean, 1.5 * tiles
        else:
            break
        tried.add(cull.tobytes())
        found = attempt(cull, last)
        if found is None:
            share, failed = share / 2, failed + 1
        else:
            sets.append((cull, found))
            share, failed = min(2 * share, 0.5), 0
    return sets, traced
