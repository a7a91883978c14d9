"""A tree over many lights: picks one with a probability that follows what it may send to a point.

Conty Estevez and Kulla, "Importance sampling of many lights with adaptive tree splitting", HPG 2018; the importance is
that of pbrt-v4 section 12.6.3. The tree is built level by level with NumPy.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ...arrays import F32, I32
from ...jit.pointers import address, f32_pointer
from ...jit.sampling import OPTIONS

# Node record, float32[NODE]: low, high, cone axis (3 each), cos of the cone of normals, cos of emission beyond it,
# power, two-sided.
N_LOW, N_HIGH, N_AXIS, N_COS_O, N_COS_E, N_POWER, N_TWO_SIDED = 0, 3, 6, 9, 10, 11, 12
NODE = 13
_BINS = 12
_BALANCED_DEPTH = 24  # below, nodes are halved, so that a path always fits the 64 bits of a trail
_ZERO, _ONE = np.float32(0.0), np.float32(1.0)


@dataclass(frozen=True)
class LightBounds:
    """What is known of each of E lights.

    low, high: (E, 3) box. axis: (E, 3) unit, main direction of emission; theta_o: (E,) spread of normals around it;
    theta_e: (E,) how far from a normal light is emitted; radians. power: (E,) positive. two_sided: (E,) bool. All
    float64 but the last.
    """

    low: NDArray[np.float64]
    high: NDArray[np.float64]
    axis: NDArray[np.float64]
    theta_o: NDArray[np.float64]
    theta_e: NDArray[np.float64]
    power: NDArray[np.float64]
    two_sided: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.power)


@dataclass(frozen=True)
class LightTree:
    """nodes: (2 E - 1, NODE) float32; children: (2 E - 1,) int32, index of the first of two adjacent children, or -1 -
    light for a leaf;
    trails: (E,) uint64, bit d is the turn at depth d towards a light's leaf."""

    nodes: F32
    children: I32
    trails: NDArray[np.uint64]


def _merge(b: LightBounds, start: NDArray[np.int64]) -> NDArray[np.float64]:
    """Bounds of runs of lights (already in order); start: first light of each run. (R, NODE) float64."""
    out = np.empty((len(start), NODE))
    out[:, N_LOW : N_LOW + 3] = np.minimum.reduceat(b.low, start)
    out[:, N_HIGH : N_HIGH + 3] = np.maximum.reduceat(b.high, start)
    power = np.add.reduceat(b.power, start)
    run = np.repeat(np.arange(len(start)), np.diff(np.append(start, len(b))))
    # The cone: around the mean axis (lights that shine both ways turned into one half space), as wide as the farthest
    # member needs.
    sign = np.where(b.two_sided & (np.einsum("ij,ij->i", b.axis, b.axis[start][run]) < 0), -1.0, 1.0)
    mean = np.add.reduceat(b.axis * (sign * b.power)[:, None], start)
    length = np.linalg.norm(mean, axis=1)
    axis = np.where(length[:, None] > 1e-9 * power[:, None], mean / np.maximum(length, 1e-300)[:, None], b.axis[start])
    axis /= np.linalg.norm(axis, axis=1)[:, None]
    cos = np.einsum("ij,ij->i", b.axis * sign[:, None], axis[run])
    theta_o = np.maximum.reduceat(np.arccos(np.clip(cos, -1, 1)) + b.theta_o, start)
    out[:, N_AXIS : N_AXIS + 3] = axis
    out[:, N_COS_O] = np.cos(np.minimum(theta_o, np.pi))
    out[:, N_COS_E] = np.cos(np.maximum.reduceat(b.theta_e, start))
    out[:, N_POWER] = power
    out[:, N_TWO_SIDED] = np.maximum.reduceat(b.two_sided.astype(np.float64), start)
    return out


def _cost(bounds: NDArray[np.float64]) -> NDArray[np.float64]:
    """Surface area orientation heuristic of merged bounds, (..., NODE) -> (...)."""
    size = bounds[..., N_HIGH : N_HIGH + 3] - bounds[..., N_LOW : N_LOW + 3]
    size = np.maximum(size, 1e-6 * (1e-30 + size.max(axis=-1, keepdims=True)))
    area = size[..., 0] * size[..., 1] + size[..., 1] * size[..., 2] + size[..., 2] * size[..., 0]
    o = np.arccos(np.clip(bounds[..., N_COS_O], -1, 1))
    w = np.minimum(o + np.arccos(np.clip(bounds[..., N_COS_E], -1, 1)), np.pi)
    orientation = 2 * np.pi * (1 - np.cos(o)) + np.pi / 2 * (
        2 * w * np.sin(o) - np.cos(o - 2 * w) - 2 * o * np.sin(o) + np.cos(o)
    )
    return bounds[..., N_POWER] * area * orientation


def _take(b: LightBounds, order: NDArray[np.int64]) -> LightBounds:
    return LightBounds(
        b.low[order], b.high[order], b.axis[order], b.theta_o[order], b.theta_e[order], b.power[order],
        b.two_sided[order]
    )


def build_light_tree(bounds: LightBounds) -> LightTree:
    """Build the tree; every leaf holds one light. Needs at least one."""
    count = len(bounds)
    nodes = np.zeros((2 * count - 1, NODE))
    children = np.zeros(2 * count - 1, np.int32)
    trails = np.zeros(count, np.uint64)
    centre = (bounds.low + bounds.high) / 2
    order = np.arange(count)
    node_of = np.zeros(1, np.int64)  # runs of `order` that still make nodes of this level, and the nodes they make
    start = np.zeros(1, np.int64)
    end = np.full(1, count, np.int64)
    used, depth = 1, 0
    while len(node_of):
        # Lights of finished leaves drop out: compact what is left.
        size = end - start
        member = (
            np.concatenate([order[a:e] for a, e in zip(start, end, strict=True)])
            if len(start) > 1
            else order[start[0] : end[0]]
        )
        start = np.concatenate([[0], np.cumsum(size)[:-1]])
        nodes[node_of] = _merge(_take(bounds, member), start)
        leaf = size == 1
        children[node_of[leaf]] = -1 - member[start[leaf]]
        if leaf.all():
            break
        inner = np.repeat(~leaf, size)
        member, node_of, size = member[inner], node_of[~leaf], size[~leaf]
        start = np.concatenate([[0], np.cumsum(size)[:-1]])
        run = np.repeat(np.arange(len(size)), size)
        c = centre[member]
        low, high = np.minimum.reduceat(c, start), np.maximum.reduceat(c, start)
        axis = np.argmax(high - low, axis=1)
        rows = np.arange(len(size))
        extent = np.maximum((high - low)[rows, axis], 1e-300)
        place = (c[np.arange(len(member)), axis[run]] - low[rows, axis][run]) / extent[run]
        by_place = np.lexsort((place, run))
        member, place = member[by_place], place[by_place]
        left = _split_sizes(
            bounds, member, run, np.minimum((place * _BINS).astype(np.int64), _BINS - 1), size, start, depth
        )
        right = np.arange(len(member)) - start[run] >= left[run]
        trails[member] |= right.astype(np.uint64) << np.uint64(depth)
        first = used + 2 * rows
        children[node_of] = first
        used += 2 * len(rows)
        order = member
        node_of = np.stack([first, first + 1], 1).ravel()
        start, end = np.stack([start, start + left], 1).ravel(), np.stack([start + left, start + size], 1).ravel()
        depth += 1
    return LightTree(nodes.astype(np.float32), children, trails)


def _split_sizes(
    bounds: LightBounds,
    member: NDArray[np.int64],
    run: NDArray[np.int64],
    bins: NDArray[np.int64],
    size: NDArray[np.int64],
    start: NDArray[np.int64],
    depth: int,
) -> NDArray[np.int64]:
    """How many lights of each run go left: the cheapest of the bin borders, or half where they tell nothing apart."""
    half = size // 2
    if depth >= _BALANCED_DEPTH:
        return half
    cell = run * _BINS + bins
    firsts = np.flatnonzero(np.append(True, cell[1:] != cell[:-1]))
    # Where a bin begins, both sides of a split there are runs of cells: merge prefix and suffix by walking the bins
    # once.
    best = np.full(len(size), np.inf)
    choice = half.copy()
    cells = cell[firsts]
    merged = _merge(_take(bounds, member), firsts)
    table = np.full((len(size), _BINS), -1, np.int64)
    table[cells // _BINS, cells % _BINS] = np.arange(len(firsts))
    prefix, suffix = _accumulate(merged, table), _accumulate(merged, table[:, ::-1])[:, ::-1]
    begin = np.zeros((len(size), _BINS + 1), np.int64)
    counts = np.bincount(cell, minlength=len(size) * _BINS).reshape(len(size), _BINS)
    begin[:, 1:] = np.cumsum(counts, 1)
    for b in range(1, _BINS):
        cost = _cost(prefix[:, b - 1]) + _cost(suffix[:, b])
        valid = (begin[:, b] > 0) & (begin[:, b] < size) & (cost < best)
        best[valid] = cost[valid]
        choice[valid] = begin[valid, b]
    return choice


def _accumulate(merged: NDArray[np.float64], table: NDArray[np.int64]) -> NDArray[np.float64]:
    """Running union over the columns of table (rows: runs; entries: index into merged or -1). (R, bins, NODE)."""
    out = np.zeros((*table.shape, NODE))
    state = np.zeros((len(table), NODE))
    some = np.zeros(len(table), bool)
    for k in range(table.shape[1]):
        has = table[:, k] >= 0
        new = merged[table[:, k]]
        join = has & some
        union = _union(state, new)
        state = np.where(join[:, None], union, np.where((has & ~some)[:, None], new, state))
        some |= has
        out[:, k] = state
    return out


def _union(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Bounds of two bounds, row by row; the cone is around the power-weighted mean axis (good enough to choose a
    split)."""
    out = np.empty_like(a)
    out[:, N_LOW : N_LOW + 3] = np.minimum(a[:, N_LOW : N_LOW + 3], b[:, N_LOW : N_LOW + 3])
    out[:, N_HIGH : N_HIGH + 3] = np.maximum(a[:, N_HIGH : N_HIGH + 3], b[:, N_HIGH : N_HIGH + 3])
    out[:, N_POWER] = a[:, N_POWER] + b[:, N_POWER]
    axis_a, axis_b = a[:, N_AXIS : N_AXIS + 3], b[:, N_AXIS : N_AXIS + 3]
    axis_b = np.where(((b[:, N_TWO_SIDED] > 0) & (np.einsum("ij,ij->i", axis_a, axis_b) < 0))[:, None], -axis_b, axis_b)
    axis = axis_a * a[:, N_POWER, None] + axis_b * b[:, N_POWER, None]
    length = np.linalg.norm(axis, axis=1)[:, None]
    axis = np.where(length > 0, axis / np.maximum(length, 1e-300), axis_a)
    theta = np.maximum(
        np.arccos(np.clip(np.einsum("ij,ij->i", axis, axis_a), -1, 1)) + np.arccos(np.clip(a[:, N_COS_O], -1, 1)),
        np.arccos(np.clip(np.einsum("ij,ij->i", axis, axis_b), -1, 1)) + np.arccos(np.clip(b[:, N_COS_O], -1, 1)),
    )
    out[:, N_AXIS : N_AXIS + 3] = axis
    out[:, N_COS_O] = np.cos(np.minimum(theta, np.pi))
    out[:, N_COS_E] = np.minimum(a[:, N_COS_E], b[:, N_COS_E])
    out[:, N_TWO_SIDED] = np.maximum(a[:, N_TWO_SIDED], b[:, N_TWO_SIDED])
    return out


@njit(**OPTIONS)
def _cos_minus(sin_a, cos_a, sin_b, cos_b):
    """cos(max(0, a - b))."""
    return _ONE if cos_a > cos_b else cos_a * cos_b + sin_a * sin_b


@njit(**OPTIONS)
def node_importance(nodes, i, px, py, pz, nx, ny, nz):
    """Bound of what a node may send to point p with normal n (either side of it), up to a factor: never 0 where it
    sends something. nodes: their address."""
    n = f32_pointer(nodes + np.uint64(4 * NODE) * np.uint64(i))
    lx, ly, lz = n[0], n[1], n[2]
    hx, hy, hz = n[3], n[4], n[5]
    half = np.float32(0.5)
    dx, dy, dz = px - (lx + hx) * half, py - (ly + hy) * half, pz - (lz + hz) * half
    r2 = np.float32(0.25) * ((hx - lx) * (hx - lx) + (hy - ly) * (hy - ly) + (hz - lz) * (hz - lz))
    d2 = dx * dx + dy * dy + dz * dz
    inside = d2 <= r2
    inv = _ONE / math.sqrt(max(d2, np.float32(1e-30)))
    dx *= inv
    dy *= inv
    dz *= inv
    if inside:
        sin_b = _ZERO
        cos_b = -_ONE
    else:
        sin_b = math.sqrt(r2 / d2)
        cos_b = math.sqrt(max(_ONE - r2 / d2, _ZERO))
    cos_w = n[6] * dx + n[7] * dy + n[8] * dz
    if n[12] != _ZERO:
        cos_w = abs(cos_w)
    sin_w = math.sqrt(max(_ONE - cos_w * cos_w, _ZERO))
    cos_o = n[9]
    sin_o = math.sqrt(max(_ONE - cos_o * cos_o, _ZERO))
    cos_x = _cos_minus(sin_w, cos_w, sin_o, cos_o)
    sin_x = math.sqrt(max(_ONE - cos_x * cos_x, _ZERO))
    cos_p = _cos_minus(sin_x, cos_x, sin_b, cos_b)
    cos_i = abs(nx * dx + ny * dy + nz * dz)
    sin_i = math.sqrt(max(_ONE - cos_i * cos_i, _ZERO))
    cos_i = _cos_minus(sin_i, cos_i, sin_b, cos_b)
    # A rounding below the horizon must not hide a light: keep a little where the bound says zero by a hair.
    if cos_p <= n[10] - np.float32(1e-4):
        return _ZERO
    return n[11] * max(cos_p, np.float32(1e-3)) * max(cos_i, np.float32(1e-3)) / max(d2, max(r2, np.float32(1e-30)))


@njit(**OPTIONS)
def sample_tree(nodes, children, u, px, py, pz, nx, ny, nz):
    """Pick a light for a point with one uniform number: (light, probability); light -1 where none sends anything.
    nodes: address; children: pointer."""
    i = np.int64(0)
    p = _ONE
    while children[i] >= 0:
        a = np.int64(children[i])
        wa = node_importance(nodes, a, px, py, pz, nx, ny, nz)
        wb = node_importance(nodes, a + 1, px, py, pz, nx, ny, nz)
        total = wa + wb
        if not total > _ZERO:
            return np.int64(-1), _ZERO
        pa = wa / total
        if u < pa:
            u = min(u / pa, np.float32(1.0 - 2.0**-24))
            p *= pa
            i = a
        else:
            pb = _ONE - pa
            u = min((u - pa) / max(pb, np.float32(1e-30)), np.float32(1.0 - 2.0**-24))
            p *= pb
            i = a + 1
    return np.int64(-1) - np.int64(children[i]), p


@njit(**OPTIONS)
def tree_pdf(nodes, children, trail, px, py, pz, nx, ny, nz):
    """Probability with which `sample_tree` picks the light of this trail (uint64)."""
    i = np.int64(0)
    p = _ONE
    while children[i] >= 0:
        a = np.int64(children[i])
        wa = node_importance(nodes, a, px, py, pz, nx, ny, nz)
        wb = node_importance(nodes, a + 1, px, py, pz, nx, ny, nz)
        total = wa + wb
        if not total > _ZERO:
            return _ZERO
        pa = wa / total
        if trail & np.uint64(1):
            p *= _ONE - pa
            i = a + 1
        else:
            p *= pa
            i = a
        trail >>= np.uint64(1)
    return p


def node_importances(tree: LightTree, point: Any, normal: Any) -> F32:
    """Importance of every node for one point, for tests and plots."""
    p, n = np.asarray(point, np.float32), np.asarray(normal, np.float32)
    return np.array(
        [node_importance(np.uint64(address(tree.nodes)), i, *p, *n) for i in range(len(tree.nodes))], np.float32
    )
