"""Pictures of the documentation from what `make demo` left: `python -m lipac.scripts.dev.demo_pictures out/demo` writes
report.jpg, culled.jpg and tlas.png into docs/pictures.

Needs a Chromium, and Playwright: pip install 'lipac[browser]'.
"""

from __future__ import annotations

import argparse
import io
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..studies.pictures.strips import save
from .browser import open_browser

WIDTH = 1100  # of the window, pixels
END = "What it took, and what it saved"  # the heading that the picture ends above


def main(argv: Sequence[str] | None = None) -> int:
    """Take the pictures; returns the exit status."""
    from PIL import Image

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="with report.html, culled.png and tlas.png")
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/pictures"))
    args = parser.parse_args(argv)
    for name, kind in (("culled", "jpg"), ("tlas", "png")):
        with Image.open(args.folder / f"{name}.png") as picture:
            save(np.asarray(picture.convert("RGB")), args.output / f"{name}.{kind}")
    with open_browser() as browser:
        page = browser.new_page(viewport={"width": WIDTH, "height": 800})
        page.goto((args.folder / "report.html").resolve().as_uri())
        below = page.locator("section", has=page.get_by_role("heading", name=END)).bounding_box()
        if below is None:
            raise SystemExit(f"{args.folder}/report.html has no part {END!r}: is it of a full render, too?")
        clip = {"x": 0.0, "y": 0.0, "width": float(WIDTH), "height": below["y"] - 10}
        taken = page.screenshot(full_page=True, clip=clip)  # type: ignore[arg-type]
    with Image.open(io.BytesIO(taken)) as picture:
        save(np.asarray(picture.convert("RGB")), args.output / "report.jpg")
    return 0


if __name__ == "__main__":
    sys.exit(main())
