"""A folder as lipac render leaves it, of pictures that we know, and what an HTML page holds."""

from __future__ import annotations

from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from lipac.core.culling.options import State
from lipac.core.feedback.tiles import COLUMNS, ROWS, TILES
from lipac.core.files.report import Report

VOID = {"meta", "link", "img", "input", "br"}
SIZE = (160, 90)
FULL, CULLED = (200, 60, 40), (40, 90, 200)  # colours of the pictures


@dataclass
class Element:
    """An HTML element: its tag, attributes, and the text in it."""

    tag: str
    attributes: dict[str, str]
    text: str = ""


@dataclass
class Page(HTMLParser):
    """All elements of a page; AssertionError where it is not well-formed: a tag that is not closed, or closes
    another."""

    elements: list[Element] = field(default_factory=list)
    _open: list[Element] = field(default_factory=list)

    def __post_init__(self) -> None:
        super().__init__()

    @staticmethod
    def of(text: str) -> Page:
        page = Page()
        page.feed(text)
        page.close()
        assert not page._open, [one.tag for one in page._open]
        return page

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        assert len(dict(attrs)) == len(attrs), (tag, attrs)
        one = Element(tag, {name: value or "" for name, value in attrs})
        self.elements.append(one)
        if tag not in VOID:
            self._open.append(one)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append(Element(tag, {name: value or "" for name, value in attrs}))

    def handle_endtag(self, tag: str) -> None:
        assert self._open and self._open.pop().tag == tag, tag

    def handle_data(self, data: str) -> None:
        for one in self._open:
            one.text += data

    def all(self, tag: str, kind: str = "") -> list[Element]:
        """Elements of a tag, and of a class."""
        return [
            e for e in self.elements if e.tag == tag and (not kind or kind in e.attributes.get("class", "").split())
        ]


def frame(number: int = 1, **figures: Any) -> dict[str, Any]:
    """A frame's entry, all of it within the budget."""
    known = {"instances": 4000, "active": 317, "culled": 3683, "hitboxes": 12, "blas_bytes": 51234, "tlas_bytes": 4321}
    seconds = {
        "sync_s": 0.31,
        "build_s": 0.12,
        "trace_s": 1.7,
        "feedback_s": 0.04,
        "writeback_s": 0.02,
        "render_s": 7.3,
    }
    error = {"certified_mean": 0.0061, "certified_worst": 0.0433, "confidence": 0.95}
    error |= {"unknown_mean": 4.4e-5, "unknown_worst": 0.0019}
    return {
        "frame": number,
        **known,
        **seconds,
        **error,
        "device": "CPU: a processor",
        "device_bytes": 11534336,
        **figures,
    }


def report(
    *frames: dict[str, Any], policy: str = "light-paths", scene: str = "/films/a street.blend", **more: Any
) -> Report:
    """A report of these frames."""
    options = {"max_error": {"mean": 0.01, "worst": 0.05}, "resolution": [*SIZE, 100], "samples": 24, "min_share": None}
    made = Report(scene, "5.2.3 LTS", "0.1.0", policy, "cycles", 7, 2, options | more)
    for one in frames:
        made.add_frame(one)
    return made


def picture(path: Path, color: tuple[int, int, int]) -> None:
    """One colour, with a little noise, so that nothing about it is too simple."""
    noise = np.random.default_rng(1).integers(-8, 9, (SIZE[1], SIZE[0], 1))
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.clip(np.array(color) + noise, 0, 255).astype(np.uint8)).save(path)


def states(folder: Path, number: int = 1, certified: np.ndarray | None = None) -> None:
    """Of 317 instances that stay 12 were met by no path."""
    state = np.full(4000, State.CULLED, np.uint8)
    state[:317] = State.ACTIVE
    hits = np.zeros((4000, 5), np.int64)
    hits[12:317, 2] = 3
    (folder / "states").mkdir(parents=True, exist_ok=True)
    known = np.linspace(0, 0.0433, TILES, dtype=np.float32) if certified is None else certified
    np.savez(folder / "states" / f"frame_{number:04}.npz", state=state, hits=hits, certified=known)


def rendered(folder: Path, *frames: dict[str, Any], **more: Any) -> Path:
    """A folder with report, pictures and states of frames."""
    folder.mkdir(parents=True, exist_ok=True)
    report(*frames, **more).write(folder)
    for one in frames:
        picture(folder / f"frame_{one['frame']:04}.png", CULLED)
        states(folder, one["frame"])
    return folder


def verified(
    folder: Path, crops: list[list[int]], changes: np.ndarray | None = None, number: int = 1
) -> dict[str, Any]:
    """What a verification adds to a frame's entry; its pictures are in the folder."""
    for name, color in (("full", FULL), ("culled", CULLED)):
        picture(folder / "verified" / f"frame_{number:04}_{name}.png", color)
    tiles = np.full((len(crops), TILES // 12), 0.004) if changes is None else changes
    least = {"verified_least_mean": 0.0, "verified_least_worst": 0.0}
    known = {"verified_mean": float(tiles.mean()), "verified_worst": float(tiles.max()), **least, "verify_s": 3.4}
    return known | {"verified_crops": crops, "verified_grid": [4, 3], "verified_tiles": tiles.tolist()}


__all__ = ["COLUMNS", "ROWS", "Page", "frame", "picture", "rendered", "report", "states", "verified"]
