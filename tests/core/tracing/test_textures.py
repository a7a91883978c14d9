"""Texture lookups against NumPy."""

from __future__ import annotations

import numpy as np
import pytest

from lipac.core.jit.pointers import address
from lipac.core.scene import model as s
from lipac.core.tracing.textures import lookup

F = np.float32
WIDTH, HEIGHT = 5, 3
IMAGE = np.random.default_rng(3).random((HEIGHT, WIDTH, 4)).astype(np.float32)


class Lookup:
    """One texture as kernels see it; keeps its arrays alive."""

    def __init__(self, floats: bool = True, **fields: object) -> None:
        self.record = np.zeros(1, s.TEXTURE)
        r = self.record[0]
        r["width"], r["height"], r["is_float"], r["uv_matrix"] = WIDTH, HEIGHT, floats, np.eye(3)[:2]
        for name, value in fields.items():
            r[name] = value
        self.bytes = np.round(IMAGE * 255).astype(np.uint8)
        self.floats = IMAGE.copy()

    def __call__(self, u: float, v: float) -> np.ndarray:
        return np.array(lookup(*(np.uint64(address(a)) for a in (self.record, self.bytes, self.floats)), 0, F(u), F(v)))


def pixel(x: int, y: int, extension: s.Extension, image: np.ndarray) -> np.ndarray:
    """A pixel of the endless plane that an extension makes of an image."""
    if extension == s.Extension.CLIP and not (0 <= x < WIDTH and 0 <= y < HEIGHT):
        return np.zeros(4)
    if extension == s.Extension.MIRROR:
        x, y = (k % (2 * n) if k % (2 * n) < n else 2 * n - 1 - k % (2 * n) for k, n in ((x, WIDTH), (y, HEIGHT)))
    if extension == s.Extension.EXTEND:
        x, y = min(max(x, 0), WIDTH - 1), min(max(y, 0), HEIGHT - 1)
    return image[y % HEIGHT, x % WIDTH]


@pytest.mark.parametrize("extension", list(s.Extension))
@pytest.mark.parametrize("floats", [True, False])
def test_bilinear(extension: s.Extension, floats: bool) -> None:
    texture = Lookup(floats, extension=extension)
    image = IMAGE.astype(float) if floats else texture.bytes / 255
    for u, v in np.random.default_rng(4).uniform(-2.5, 3.5, (200, 2)).astype(np.float32):
        x, y = float(u) * WIDTH - 0.5, float(v) * HEIGHT - 0.5
        i, j = int(np.floor(x)), int(np.floor(y))
        fx, fy = x - i, y - j
        expected = sum(
            (fx if a else 1 - fx) * (fy if b else 1 - fy) * pixel(i + a, j + b, extension, image)
            for a in (0, 1)
            for b in (0, 1)
        )
        # float32 coordinates of up to 20 pixels: 2e-6 of a pixel, times a slope of at most 1
        assert texture(u, v) == pytest.approx(expected, abs=1e-5)


def test_closest() -> None:
    assert Lookup(closest=1)(0.5, 0.9) == pytest.approx(IMAGE[2, 2], abs=1e-6)
    assert Lookup(closest=1, extension=s.Extension.CLIP)(1.2, 0.5) == pytest.approx(0.0)


def test_srgb_is_decoded_after_interpolation_and_alpha_is_not() -> None:
    texture = Lookup(False, srgb=1, extension=s.Extension.EXTEND)
    mixed = (texture.bytes[0, 0] / 255 + texture.bytes[0, 1] / 255) / 2
    r, g, b = np.where(mixed[:3] < 0.04045, mixed[:3] / 12.92, ((mixed[:3] + 0.055) / 1.055) ** 2.4)
    assert texture(1.0 / WIDTH, 0.5 / HEIGHT) == pytest.approx([r, g, b, mixed[3]], abs=1e-5)


def test_the_uv_matrix_is_applied_first() -> None:
    moved = Lookup(uv_matrix=[[0, 2, 0.1], [1, 0, 0.3]])
    assert moved(0.2, 0.3) == pytest.approx(Lookup()(0.7, 0.5), abs=1e-5)


def test_bad_coordinates_read_somewhere() -> None:
    assert np.isfinite(Lookup()(np.nan, np.inf)).all()
