"""The pixel filter is sampled by its own shape."""

from __future__ import annotations

import numpy as np
import pytest

from lipac.core.errors import InputError
from lipac.core.scene import model as s
from lipac.core.scene.film import FILTER_SIZE, Picture, filter_offset, filter_offsets


@pytest.mark.parametrize(
    ("name", "width", "radius"), [("BOX", 1.5, 0.5), ("BLACKMAN_HARRIS", 1.5, 1.5), ("GAUSSIAN", 1.5, 2.25)]
)
def test_offsets_are_symmetric_and_bounded(name: str, width: float, radius: float) -> None:
    table = filter_offsets(s.Film(1, 1, name, width))
    assert table[0] == pytest.approx(-radius, abs=2e-3 * radius) and table[-1] == pytest.approx(
        radius, abs=2e-3 * radius
    )
    assert table + table[::-1] == pytest.approx(0.0, abs=1e-5)
    assert (np.diff(table) >= 0).all()


def test_blackman_harris_has_the_variance_of_its_window() -> None:
    x = np.linspace(-1.5, 1.5, 20001)
    a = 2 * np.pi * (x / 3 + 0.5)
    f = 0.35875 - 0.48829 * np.cos(a) + 0.14128 * np.cos(2 * a) - 0.01168 * np.cos(3 * a)
    table = filter_offsets(s.Film(1, 1))
    table = table.astype(float)
    centre = (table[1:] + table[:-1]) / 2  # linear between entries: add the variance within an interval
    variance = (centre**2 + np.diff(table) ** 2 / 12).mean()
    # 1024 intervals, linear within: the outermost spread a little
    assert variance == pytest.approx((x**2 * f).sum() / f.sum(), rel=5e-3)


def test_lookup_interpolates() -> None:
    table = filter_offsets(s.Film(1, 1))
    u = np.float32(100.25 / FILTER_SIZE)
    assert filter_offset(table, u) == pytest.approx(0.75 * table[100] + 0.25 * table[101], abs=1e-6)


def test_unknown_filter() -> None:
    with pytest.raises(InputError, match="pixel filter 'SINC'"):
        filter_offsets(s.Film(1, 1, "SINC"))


def test_mean_divides_by_samples() -> None:
    assert Picture(np.full((1, 1, 4), 6, np.float32), 3, 3, 3).mean.max() == 2
