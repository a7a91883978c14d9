"""Pictures side by side, with what each shows written above it; saved small."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

BAR = 26  # pixels above each picture
GAP = 4  # between pictures
LARGEST = 300_000  # bytes of a picture of the documentation

Picture = NDArray[np.uint8]


def strip(pictures: Sequence[Picture], labels: Sequence[str]) -> Picture:
    """Pictures (H, W, 3) uint8 of one height, rows from the top, in a row under their labels."""
    from matplotlib import font_manager
    from PIL import Image, ImageDraw, ImageFont

    height, widths = pictures[0].shape[0], [picture.shape[1] for picture in pictures]
    sheet = Image.new("RGB", (sum(widths) + GAP * (len(widths) - 1), height + BAR), "white")
    pen, x = ImageDraw.Draw(sheet), 0
    for picture, label, width in zip(pictures, labels, widths, strict=True):
        size = 15
        while True:
            font = ImageFont.truetype(font_manager.findfont("DejaVu Sans"), size)
            if pen.textlength(label, font) <= width - 4 or size <= 7:
                break
            size -= 1
        pen.text((x + width / 2, BAR / 2), label, fill="black", font=font, anchor="mm")
        sheet.paste(Image.fromarray(np.ascontiguousarray(picture)), (x, BAR))
        x += width + GAP
    return np.asarray(sheet)


def save(picture: Picture, path: Path) -> None:
    """Save a picture (H, W, 3) uint8, rows from the top: .png without loss where LARGEST allows that, else with 256
    colours; .jpg as good as LARGEST allows."""
    from PIL import Image

    image = Image.fromarray(np.ascontiguousarray(picture))
    if path.suffix == ".png":
        image.save(path, optimize=True)
        if path.stat().st_size > LARGEST:
            image.quantize(256).save(path, optimize=True)
        return
    for quality in (92, 85, 75, 70, 60):
        image.save(path, quality=quality, optimize=True, progressive=True)
        if path.stat().st_size <= LARGEST:
            return
