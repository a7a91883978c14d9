"""Pictures inside a page: as data URIs, and what is drawn over them by tile."""

from __future__ import annotations

import base64
import io
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..core.arrays import F32, U8
from ..core.feedback.picture_change import tile_changes
from ..core.feedback.tiles import COLUMNS, ROWS

if TYPE_CHECKING:
    from PIL.Image import Image

WIDEST = 1280  # pixels of a picture in a page
SMALL = 640  # of one that something is drawn over
STEPS = (0.1, 0.25, 0.5, 0.75, 1.0)  # of the bound of a tile: where its colour changes


@dataclass(frozen=True)
class Embedded:
    """A picture as a page holds it. uri: of its data; width, height: in pixels; of: those of the file."""

    uri: str
    width: int
    height: int
    of: tuple[int, int]

    @property
    def scaled(self) -> bool:
        """Whether it has fewer pixels than the file."""
        return (self.width, self.height) != self.of


@dataclass(frozen=True)
class Tile:
    """A tile of a picture: its column and row from the upper left corner; change: relative; step: of STEPS that it
    reaches."""

    column: int
    row: int
    change: float
    step: int


def opened(path: Path) -> Image | None:
    """A picture in RGB; None where there is none, or none that can be read."""
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(path) as file:
            return file.convert("RGB")
    except (OSError, UnidentifiedImageError, Image.DecompressionBombError):
        return None


def embed(picture: Image) -> Embedded:
    """A picture for a page, without loss; what is wider than WIDEST becomes smaller."""
    return _embedded(picture, WIDEST, "PNG")


def backdrop(picture: Image) -> Embedded:
    """A picture to draw over: small, grey and dark."""
    return _embedded(picture.convert("L").point(lambda value: int(0.6 * value)), SMALL, "JPEG")


def embed_pixels(pixels: U8) -> Embedded:
    """A picture (H, W, 3), rows from the top, for a page."""
    from PIL import Image

    return embed(Image.fromarray(np.ascontiguousarray(pixels)))


def _embedded(picture: Image, widest: int, kind: str) -> Embedded:
    of = picture.size
    if picture.width > widest:
        picture = picture.resize((widest, max(round(picture.height * widest / picture.width), 1)))
    data = io.BytesIO()
    picture.save(data, kind, **({"quality": 80} if kind == "JPEG" else {}))
    uri = f"data:image/{kind.lower()};base64,{base64.b64encode(data.getbuffer()).decode()}"
    return Embedded(uri, picture.width, picture.height, of)


def changes_of(full: Path, culled: Path) -> F32 | None:
    """By how much the tiles of two pictures in OpenEXR differ, (ROWS, COLUMNS), rows bottom up, noise included; None
    where they cannot be compared."""
    a, b = _linear(full), _linear(culled)
    if a is None or b is None or a.shape != b.shape:
        return None
    return tile_changes(a, b).astype(np.float32).reshape(ROWS, COLUMNS)


def _linear(path: Path) -> F32 | None:
    """A picture in OpenEXR, (H, W, 3 or 4), rows bottom up; None where there is none, or none that can be read."""
    import OpenEXR

    if not path.is_file():
        return None
    try:
        with OpenEXR.File(str(path)) as file:
            channels = file.channels()
            pixels = next((channels[name].pixels for name in ("RGB", "RGBA") if name in channels), None)
    except (OSError, RuntimeError, ValueError):
        return None
    return None if pixels is None else np.asarray(pixels[::-1], np.float32)


def tiles(changes: F32 | None, bound: float) -> list[Tile]:
    """What is known of the tiles: changes (ROWS, COLUMNS), rows bottom up as in Blender, NaN where a tile was not
    looked at, None where none was; bound: of each."""
    if changes is None:
        return []
    found = np.argwhere(np.isfinite(changes))
    steps = np.searchsorted(np.array(STEPS) * bound, changes, side="left")
    return [Tile(int(c), int(ROWS - 1 - r), float(changes[r, c]), int(steps[r, c])) for r, c in found]


def of_crops(crops: list[list[int]], changes: list[list[float]], grid: tuple[int, int]) -> F32:
    """Changes (ROWS, COLUMNS) as `tiles` takes them, from those of crops: columns and rows of a grid (across, up), and
    of each its tiles row by row."""
    out = np.full((ROWS, COLUMNS), np.nan, np.float32)
    across, up = COLUMNS // grid[0], ROWS // grid[1]
    for (x, y), values in zip(crops, changes, strict=True):
        out[y * up : (y + 1) * up, x * across : (x + 1) * across] = np.reshape(values, (up, across))
    return out


def flip_map(full: Image, culled: Image) -> tuple[U8, float] | None:
    """FLIP of two pictures as displayed, in the Magma colours that it is published with: (H, W, 3), rows from the top;
    and its mean. None where their sizes differ."""
    from matplotlib import colormaps

    from ..core.evaluation.metrics import flip

    if full.size != culled.size:
        return None
    difference, mean = flip(*(np.asarray(picture, np.float32) / 255 for picture in (full, culled)))
    return colormaps["magma"](difference, bytes=True)[..., :3], mean
