"""Pixels that paths look up: the file's own where it is small, means of light where it is large."""

from __future__ import annotations

import numpy as np
import pytest

from lipac.core.scene.images import Alpha, texels


@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("srgb", [False, True])
def test_a_small_image_keeps_its_bytes(channels: int, srgb: bool) -> None:
    stored = np.random.default_rng(0).integers(0, 256, (5, 7, channels))
    found = texels((stored / 255).astype(np.float32).ravel(), 5, 7, Alpha.KEPT, False, srgb)
    assert found.dtype == np.uint8
    assert (found[..., : min(channels, 3)] == stored[..., :3]).all()
    assert (found[..., :3] == stored[..., :1]).all() or channels > 1
    assert (found[..., 3] == (stored[..., 3] if channels == 4 else 255)).all()


def test_a_large_image_becomes_means_of_light() -> None:
    """A board of black and white shines half as bright as white: that is 188 in sRGB, and 128 where bytes are data."""
    board = (np.indices((64, 64)).sum(axis=0) % 2).astype(np.float32).ravel()
    assert (texels(board, 64, 64, Alpha.KEPT, False, True, largest=16)[..., :3] == 188).all()
    assert (texels(board, 64, 64, Alpha.KEPT, False, False, largest=16)[..., :3] == 128).all()
    found = texels(board * 6, 64, 64, Alpha.KEPT, True, False, largest=16)
    assert found.dtype == np.float32
    assert (found == np.array([3, 3, 3, 1], np.float32)).all()


def test_boxes_part_an_image_whose_size_is_no_multiple() -> None:
    """Rows 0, 1 and rows 2 to 4 of five; on several threads as on one."""
    rows = np.repeat(np.arange(5, dtype=np.float32), 3)
    assert texels(rows, 5, 3, Alpha.KEPT, True, False, largest=2)[:, 0, 0].tolist() == [0.5, 3.0]
    wide = np.random.default_rng(1).random(700 * 900 * 4, np.float32)
    found = texels(wide, 700, 900, Alpha.KEPT, True, False, largest=300)
    boxes = wide.reshape(700, 300, 3, 4).mean(axis=2, dtype=np.float64)
    edges = np.arange(301) * 700 // 300
    means = np.add.reduceat(boxes, edges[:-1], axis=0) / np.diff(edges)[:, None, None]
    assert np.abs(found - means).max() < 1e-6  # float32's rounding


def test_alpha() -> None:
    one = np.array([0.8, 0.4, 0.2, 0.5], np.float32)
    stored = np.rint(one * 255) / 255
    assert (texels(one, 1, 1, Alpha.IGNORED, False, True)[0, 0] == [204, 102, 51, 255]).all()
    multiplied = texels(stored.astype(np.float32), 1, 1, Alpha.MULTIPLIED, False, True)[0, 0]
    assert (multiplied == np.rint([*stored[:3] * stored[3] * 255, 128])).all()
    assert np.allclose(texels(one, 1, 1, Alpha.MULTIPLIED, True, False)[0, 0], [0.4, 0.2, 0.1, 0.5])
