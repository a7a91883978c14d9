"""The light tree picks lights with the probabilities that it claims, and misses none."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from lipac.core.jit.pointers import address
from lipac.core.tracing.lights.light_tree import LightBounds, build_light_tree, node_importances, sample_tree, tree_pdf

F = np.float32


def some_lights(count: int, seed: int = 0) -> LightBounds:
    rng = np.random.default_rng(seed)
    centre, half = rng.normal(size=(count, 3)) * 5, rng.random((count, 3)) * 0.2
    axis = rng.normal(size=(count, 3))
    axis /= np.linalg.norm(axis, axis=1)[:, None]
    theta_o = rng.choice(np.array([0.0, 0.4, np.pi]), count)
    return LightBounds(
        centre - half,
        centre + half,
        axis,
        theta_o,
        np.full(count, np.pi / 2),
        rng.random(count) * 3 + 0.1,
        rng.random(count) < 0.4,
    )


def points(count: int) -> np.ndarray:
    rng = np.random.default_rng(9)
    n = rng.normal(size=(count, 3))
    return np.concatenate([rng.normal(size=(count, 3)) * 6, n / np.linalg.norm(n, axis=1)[:, None]], 1).astype(
        np.float32
    )


@pytest.mark.parametrize("count", [1, 2, 3, 17, 300])
def test_probabilities_sum_to_one_or_less(count: int) -> None:
    tree = build_light_tree(some_lights(count))
    nodes = np.uint64(address(tree.nodes))
    assert len(tree.nodes) == 2 * count - 1
    assert sorted(-1 - tree.children[tree.children < 0]) == list(range(count))
    for p in points(10):
        total = sum(float(tree_pdf(nodes, tree.children, t, *p)) for t in tree.trails)
        # Less where a node's bound promised what none of its lights keeps: those picks give nothing.
        assert total <= 1 + 1e-4
        picked = [sample_tree(nodes, tree.children, F(u), *p)[0] for u in np.linspace(0, 0.999, 500)]
        assert abs(np.mean(np.array(picked) >= 0) - total) < 0.03


def test_picks_follow_their_probabilities() -> None:
    tree = build_light_tree(some_lights(30))
    nodes = np.uint64(address(tree.nodes))
    u = np.random.default_rng(1).random(20000, dtype=np.float32)
    for p in points(4):
        pdf = np.array([tree_pdf(nodes, tree.children, t, *p) for t in tree.trails], float)
        picks = [sample_tree(nodes, tree.children, x, *p) for x in u]
        assert all(i < 0 or q == pytest.approx(pdf[i], rel=1e-5) for i, q in picks[:500])
        counts = np.bincount([i if i >= 0 else 30 for i, _ in picks], minlength=31)
        expected = np.append(pdf, max(1 - pdf.sum(), 0)) * len(u)
        rare = expected < 5
        observed = np.append(counts[~rare], counts[rare].sum())
        wanted = np.append(expected[~rare], expected[rare].sum())
        wanted, observed = wanted[wanted > 0], observed[wanted > 0]
        assert stats.chisquare(observed, wanted * observed.sum() / wanted.sum()).pvalue > 1e-4


def test_every_node_bounds_its_lights() -> None:
    """A light that can send something to a point must be reachable: importance above 0 all the way down its trail."""
    b = some_lights(200, seed=3)
    tree = build_light_tree(b)
    nodes = np.uint64(address(tree.nodes))
    centre = (b.low + b.high) / 2
    for p in points(25):
        to = p[:3] - centre
        to /= np.linalg.norm(to, axis=1)[:, None]
        cos = np.einsum("ij,ij->i", to, b.axis)
        cos = np.where(b.two_sided, np.abs(cos), cos)
        shines = np.arccos(np.clip(cos, -1, 1)) < b.theta_o + b.theta_e - 0.05
        pdf = np.array([tree_pdf(nodes, tree.children, t, *p) for t in tree.trails])
        assert (pdf[shines] > 0).all()


def test_near_and_bright_lights_are_preferred() -> None:
    axis = np.tile([0.0, 0.0, -1.0], (2, 1))
    low = np.array([[-0.1, -0.1, 1.0], [9.9, -0.1, 1.0]])
    b = LightBounds(low, low + 0.2, axis, np.full(2, np.pi), np.full(2, np.pi / 2), np.ones(2), np.zeros(2, bool))
    tree = build_light_tree(b)
    near = tree_pdf(
        np.uint64(address(tree.nodes)), tree.children, tree.trails[0], *np.array([0, 0, 0, 0, 0, 1], np.float32)
    )
    assert near > 0.95
    assert node_importances(tree, (0, 0, 0), (0, 0, 1)).shape == (3,)


def test_many_lights_in_one_place() -> None:
    """Nothing tells them apart: the tree is halved, and the trails still fit."""
    b = some_lights(5000)
    same = LightBounds(np.zeros((5000, 3)), np.ones((5000, 3)), b.axis, b.theta_o, b.theta_e, b.power, b.two_sided)
    tree = build_light_tree(same)
    assert len(np.unique(tree.trails)) > 2500 and len(tree.nodes) == 9999
