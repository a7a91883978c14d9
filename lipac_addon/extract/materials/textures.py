"""Images -> the pixel pools and TEXTURE records of the core."""

from __future__ import annotations

import hashlib
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ....core.arrays import F32, U8
from ....core.scene.images import Alpha, texels
from ....core.scene.model import TEXTURE, Extension, Textures
from ...images import as_found

MAGENTA = (1.0, 0.0, 1.0, 1.0)  # what Cycles shows for an image that it cannot load
EXTENSIONS = {
    "REPEAT": Extension.REPEAT,
    "EXTEND": Extension.EXTEND,
    "CLIP": Extension.CLIP,
    "MIRROR": Extension.MIRROR,
}
ENCODED = {"sRGB"}  # color spaces of byte images that the sampler decodes
LINEAR = {"Linear Rec.709", "Linear", "scene_linear", "Non-Color", "Raw", "Generic Data"}


@dataclass(frozen=True)
class ImageUse:
    """An image as a node samples it. source: index of its pixels in the table; matrix: the 2x3 of
    `TEXTURE["uv_matrix"]`, row by row; angle: looked up by the angle at which a ray meets the surface (`BY_ANGLE`)."""

    source: int
    uv_map: int = 0
    matrix: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)
    extension: int = int(Extension.REPEAT)
    closest: bool = False
    angle: bool = False


@dataclass
class Pixels:
    """(H, W, 4) uint8 or float32, rows bottom up; srgb: encoded; lines: what Blender shows differently; exact: False
    where it may show another picture; reduced: each is the mean of several of the image's."""

    data: U8 | F32
    srgb: bool
    lines: tuple[str, ...] = ()
    exact: bool = True
    reduced: bool = False


def _is_there(image: Any) -> bool:
    """Whether the file of an image exists."""
    return len(image.packed_files) > 0 or Path(bpy.path.abspath(image.filepath, library=image.library)).is_file()


def _magenta(line: str) -> Pixels:
    return Pixels(np.full((1, 1, 4), MAGENTA, np.float32), False, (line,))


def srgb_to_linear(value: NDArray[Any]) -> F32:
    """IEC 61966-2-1."""
    value = value.astype(np.float32)
    return np.where(value <= 0.04045, value / 12.92, ((np.maximum(value, 0.04045) + 0.055) / 1.055) ** 2.4).astype(
        np.float32
    )


class TextureTable:
    """Collects the images that materials use; each is read once."""

    def __init__(self, report: Any, known: dict[tuple[str, bool], Pixels] | None = None) -> None:
        """known: pixels by name of the image and whether colour is multiplied by alpha; what is read is added."""
        self.report = report  # callback(line): something that Blender shows differently
        self._pixels = {} if known is None else known
        self.uv_maps = [""]
        self.sources: list[Pixels] = []
        self._known: dict[tuple[str, bool], int] = {}
        self._made: dict[tuple[tuple[int, ...], bytes], int] = {}
        self._uses: dict[ImageUse, int] = {}
        self._space: F32 = np.zeros(0, np.float32)

    def uv_map(self, name: str) -> int:
        """Index into `Scene.uv_maps`."""
        if name not in self.uv_maps:
            self.uv_maps.append(name)
        return self.uv_maps.index(name)

    def image(self, image: Any, associate: bool) -> int:
        """Index of an image's pixels. associate: colour is to be multiplied by alpha (Cycles does where nothing reads
        the alpha of a node)."""
        key = ("", False) if image is None else (image.original.name_full, associate)
        if key not in self._known:
            self._known[key] = len(self.sources)
            pixels = self._pixels.get(key)
            if pixels is None:
                with nullcontext() if image is None else as_found(image.original):
                    pixels = self._read(None if image is None else image.original, associate)
                self._pixels[key] = pixels
            for line in pixels.lines:
                self.report(line)
            self.sources.append(pixels)
        return self._known[key]

    def _values(self, image: Any) -> F32:
        """All channels of all pixels of an image, valid until the next call."""
        if len(self._space) < len(image.pixels):
            self._space = np.empty(len(image.pixels), np.float32)
        values = self._space[: len(image.pixels)]
        image.pixels.foreach_get(values)
        return values

    def _read(self, image: Any, associate: bool) -> Pixels:
        if image is None:
            return _magenta("an image texture node has no image: magenta, as in Cycles")
        width, height = image.size  # loads the file
        exact = image.source not in {"TILED", "SEQUENCE", "MOVIE"}
        if width * height == 0 and (not exact or _is_there(image)):
            # of a sequence Blender asks for picture 0, which most do not have; of files with layers, for a pass
            line = f"image {image.name!r} could not be read, it may show anything"
            return Pixels(np.full((1, 1, 4), 0.5, np.float32), False, (line,), False)
        if width == 0 or height == 0 or len(image.pixels) < width * height * image.channels:
            return _magenta(f"image {image.name!r} is missing ({image.filepath or 'no file'}): magenta, as in Cycles")
        lines = []
        if not exact:
            lines.append(f"image {image.name!r}: of {image.source.lower()} images only the first picture is used")
        space = image.colorspace_settings.name
        if space not in LINEAR and space not in ENCODED:
            lines.append(
                f"image {image.name!r}: color space {space!r} is read as {'linear' if image.is_float else 'sRGB'}"
            )
        straight = image.alpha_mode == "STRAIGHT" and not image.colorspace_settings.is_data
        alpha = Alpha.MULTIPLIED if associate and straight else Alpha.KEPT
        alpha = Alpha.IGNORED if image.alpha_mode == "NONE" else alpha
        srgb = not image.is_float and space not in LINEAR
        data = texels(self._values(image), height, width, alpha, image.is_float, srgb)
        return Pixels(data, srgb, tuple(lines), exact, reduced=data.shape[:2] != (height, width))

    def add(self, data: F32) -> int:
        """Index of pixels made here, the same for the same ones: (H, W, 4) float32, linear."""
        data = np.ascontiguousarray(data, np.float32)
        key = data.shape, hashlib.sha256(data).digest()
        if key not in self._made:
            self._made[key] = len(self.sources)
            self.sources.append(Pixels(data, False))
        return self._made[key]

    def linear(self, use: ImageUse) -> F32:
        """(H, W, 4) linear pixels of an image."""
        pixels = self.sources[use.source]
        if pixels.data.dtype != np.uint8:
            return pixels.data.astype(np.float32)
        out = pixels.data.astype(np.float32) / 255.0
        if pixels.srgb:
            out[:, :, :3] = srgb_to_linear(np.arange(256) / 255.0)[pixels.data[:, :, :3]]
        return out

    def derive(self, use: ImageUse, data: F32) -> ImageUse:
        """The same lookup into other pixels."""
        return replace(use, source=self.add(data))

    def index(self, use: ImageUse) -> int:
        """Index into `Textures.records`."""
        return self._uses.setdefault(use, len(self._uses))

    def use(self, index: int) -> ImageUse:
        """What an index of `Textures.records` stands for."""
        return list(self._uses)[index]

    def build(self) -> Textures:
        """Pools with every image that a record refers to, once."""
        records = np.zeros(len(self._uses), TEXTURE)
        offsets: dict[int, int] = {}
        pools: dict[bool, list[NDArray[Any]]] = {False: [], True: []}
        sizes = {False: 0, True: 0}
        for record, use in zip(records, self._uses, strict=True):
            pixels = self.sources[use.source]
            floats = pixels.data.dtype != np.uint8
            if use.source not in offsets:
                offsets[use.source] = sizes[floats]
                sizes[floats] += pixels.data.size
                pools[floats].append(pixels.data.ravel())
            record["offset"], record["is_float"], record["srgb"] = offsets[use.source], floats, pixels.srgb
            record["height"], record["width"] = pixels.data.shape[:2]
            record["extension"], record["closest"], record["uv_map"] = use.extension, use.closest, use.uv_map
            record["uv_matrix"] = np.reshape(use.matrix, (2, 3))
        return Textures(
            records,
            np.concatenate([np.zeros(0, np.uint8), *pools[False]]),
            np.concatenate([np.zeros(0, np.float32), *pools[True]]),
        )
