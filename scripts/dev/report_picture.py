"""docs/pictures/report.jpg, from what `make demo` left: `python -m lipac.scripts.dev.report_picture out/demo`.

Needs a Chromium, and Playwright: pip install 'lipac[browser]'.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from .browser import open_browser

WIDTH = 1100  # of the window, pixels
END = "What it took, and what it saved"  # the heading that the picture ends above


def main(argv: Sequence[str] | None = None) -> int:
    """Take the picture; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="with report.html")
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/pictures/report.jpg"))
    args = parser.parse_args(argv)
    with open_browser() as browser:
        page = browser.new_page(viewport={"width": WIDTH, "height": 800})
        page.goto((args.folder / "report.html").resolve().as_uri())
        below = page.locator("section", has=page.get_by_role("heading", name=END)).bounding_box()
        if below is None:
            raise SystemExit(f"{args.folder}/report.html has no part {END!r}: is it of a full render, too?")
        clip = {"x": 0.0, "y": 0.0, "width": float(WIDTH), "height": below["y"] - 10}
        page.screenshot(path=args.output, type="jpeg", quality=90, full_page=True, clip=clip)  # type: ignore[arg-type]
    return 0


if __name__ == "__main__":
    sys.exit(main())
