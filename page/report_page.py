"""report.html: what a command did and left, from the files in its folder."""

from __future__ import annotations

import os
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..core.arrays import F32
from ..core.errors import InputError
from ..core.feedback.tiles import COLUMNS, ROWS
from ..core.files.atomic import replacing
from ..core.files.report import UNREADABLE, found_report, keep_beside
from .curves import Curve, curves
from .html import Figures, percent, render, times
from .memory import takers
from .pictures import (
    STEPS,
    Embedded,
    Tile,
    backdrop,
    changes_of,
    embed,
    embed_pixels,
    flip_map,
    of_crops,
    opened,
    tiles,
)
from .verdict import bound_of, verdict

if TYPE_CHECKING:
    from PIL.Image import Image

STAGES = {
    "sync_s": "reading the scene",
    "build_s": "building what light paths ask for",
    "trace_s": "tracing light paths",
    "feedback_s": "deciding what stays",
    "writeback_s": "taking the rest out of Blender",
    "render_s": "rendering",
    "verify_s": "verifying",
}
SECONDS = (*STAGES, "wall_s")
CULLED = 0  # `State`
PAGE = "report.html"
OURS = b'<meta name="generator" content="LiPaC">'


def write(folder: Path, full: Path | None = None, run: Path | None = None) -> Path:
    """Write folder/report.html and return its path.

    full: the folder of a command that rendered the same frames with nothing culled. run: that of pictures and states,
    where that is not `folder`. Raises InputError where folder or full has no report, or one that no command of ours
    wrote.
    """
    from jinja2 import TemplateError

    ours, whole = _report(folder), None if full is None else _report(full)
    try:
        text = page(ours, run or folder, whole, full, opened(folder / "tlas.png"))
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError, TemplateError) as error:
        if os.environ.get("LIPAC_DEBUG", "") not in ("", "0"):
            raise
        raise InputError(
            f"{PAGE} cannot be made of {folder / 'report.json'}, which has figures that lipac does not write there "
            f"({type(error).__name__}: {error}); render or analyze into another folder"
        ) from error
    path = folder / PAGE
    drop(folder)
    with replacing(path) as part:
        part.write_text(text, encoding="utf-8")
    return path


def drop(folder: Path) -> None:
    """Remove the page of a folder, so that it does not speak of what is no more; a file of that name that is no page of
    ours is kept beside."""
    path = folder / PAGE
    with suppress(FileNotFoundError):
        with path.open("rb") as file:
            ours = OURS in file.read(2000)
        if ours:
            path.unlink()
        else:
            keep_beside(path)


def _report(folder: Path) -> dict[str, Any]:
    found = found_report(folder)
    if found is None:
        raise InputError(
            f"{folder} has no report.json of this version: name a folder that lipac render or analyze filled"
        )
    return found


def page(
    report: dict[str, Any],
    folder: Path,
    full: dict[str, Any] | None = None,
    before: Path | None = None,
    outside: Image | None = None,
) -> str:
    """The page of a report, as HTML. folder: of its pictures and states; full, before: report and pictures with nothing
    culled; outside: a picture of the TLAS."""
    data = {**report, "full": full} if full else report
    figures, shown = Figures(data), shown_frame(report, folder)
    seen = None if shown is None else pictures(report, shown, folder, before)
    values = {
        "fig": figures,
        "bound": bound_of(report),
        "report": _with_totals(report),
        "full": full and _with_totals(full),
        "scene": Path(report["scene"].replace("\\", "/")).name or "the open scene",
        "verdict": verdict(report, seen.measured if seen else None),
        "steps": STEPS,
        "saving": saving(report, full) if full else "",
        "full_device": _full_device(full) if full else "",
        "stages": STAGES,
        # seconds that a bar of full length stands for
        "most": max(_with_totals(one)["totals"][name] for one in (report, full) if one for name in SECONDS) or 1.0,
        "shown": shown,
        "pictures": seen,
        "outside": None if outside is None else embed(outside),
        "unmet": None if shown is None else unmet(folder, report["frames"][shown]["frame"]),
        "curves": frames_as_curves(report),
        "takers": takers(folder),
    }
    return render("report.html", **values)


def _with_totals(report: dict[str, Any]) -> dict[str, Any]:
    """With nothing for totals that an earlier version did not write."""
    return report | {"totals": dict.fromkeys((*SECONDS, "peak_bytes", "blas_bytes"), 0) | report["totals"]}


def saving(report: dict[str, Any], full: dict[str, Any]) -> str:
    """What culling saved of the seconds and the memory, in a sentence: of the whole commands and of the renders
    alone."""
    ours, theirs = report["totals"], full["totals"]
    said = []
    for name, what in (("wall_s", "The whole command"), ("render_s", "the render alone")):
        if ours.get(name) and theirs.get(name):
            ratio = theirs[name] / ours[name]
            said.append(f"{what} {f'is {times(ratio)} as fast' if ratio >= 1 else f'takes {times(1 / ratio)} as long'}")
    if ours["peak_bytes"] and theirs["peak_bytes"]:
        said.append(f"peak memory is {percent(ours['peak_bytes'] / theirs['peak_bytes'])} of that of the full render")
    return "; ".join(said) + "." if said else ""


def _full_device(full: dict[str, Any]) -> str:
    return "full/" + Figures(full).largest("device_bytes")


def shown_frame(report: dict[str, Any], folder: Path) -> int | None:
    """The place in the report of the frame whose picture changes most, as far as is known, among those that have
    one."""
    have = [
        k
        for k, frame in enumerate(report["frames"])
        if any(path.is_file() for path in _pictures(folder, frame["frame"]))
    ]
    every = have or range(len(report["frames"]))

    def change(k: int) -> tuple[float, float]:
        frame = report["frames"][k]
        return frame.get("verified_mean", -1.0), frame.get("certified_mean", -1.0)

    return max(every, key=change, default=None)


def _pictures(folder: Path, frame: int) -> tuple[Path, Path, Path]:
    """A frame as it was rendered; its verified parts, in full and culled."""
    verified = [folder / "verified" / f"frame_{frame:04}_{name}.png" for name in ("full", "culled")]
    return folder / f"frame_{frame:04}.png", verified[0], verified[1]


@dataclass(frozen=True)
class Pictures:
    """What a page shows of a frame. before, after: with everything and culled; parts: left, bottom, width, height of
    what of the former was rendered with everything, as shares of the picture, none where that is all of it. flip: how
    much both differ to the eye, and the mean of it. certified, verified: by tile, over `dim`, in colours by `scale`.
    measured: the mean change and that of the worst tile, where whole pictures were compared, and `verified` is of
    these.
    """

    before: Embedded | None
    after: Embedded | None
    parts: tuple[tuple[float, float, float, float], ...]
    flip: Embedded | None
    flip_mean: float
    dim: Embedded | None
    certified: list[Tile]
    verified: list[Tile]
    scale: float
    measured: tuple[float, float] | None


def pictures(report: dict[str, Any], shown: int, folder: Path, before: Path | None) -> Pictures:
    """What there is of a frame of the report, by its place. before: the folder of pictures with nothing culled."""
    frame = report["frames"][shown]
    rendered, *verified = _pictures(folder, frame["frame"])
    after, parts, looked = opened(rendered), [], None
    other = _pictures(before, frame["frame"])[0] if before else None
    whole = opened(other) if other else None
    crops, grid = frame.get("verified_crops", []), frame.get("verified_grid", [1, 1])
    measured = changes_of(other.with_suffix(".exr"), rendered.with_suffix(".exr")) if other else None
    if whole is None and crops and (found := [opened(path) for path in verified]) and all(found):
        parts = [(x / grid[0], y / grid[1], 1 / grid[0], 1 / grid[1]) for x, y in crops]
        whole, after = (_with_parts(after, picture, parts) for picture in found if picture)
    if measured is None and frame.get("verified_tiles"):
        looked = of_crops(crops, frame["verified_tiles"], (grid[0], grid[1]))
    flip = flip_map(whole, after) if whole and after else None
    certified, bound = _certified(folder, frame["frame"]), bound_of(report)
    changes = [one for one in (certified, looked, measured) if one is not None]
    scale = bound["worst"] if bound else max((float(np.nanmax(one)) for one in changes), default=1.0)
    return Pictures(
        before=embed(whole) if whole else None,
        after=embed(after) if after else None,
        parts=() if len(crops) == grid[0] * grid[1] else tuple(parts),
        flip=embed_pixels(flip[0]) if flip else None,
        flip_mean=flip[1] if flip else 0.0,
        dim=backdrop(after) if after else None,
        certified=tiles(certified, scale),
        verified=tiles(looked if measured is None else measured, scale),
        scale=scale,
        measured=None if measured is None else (float(measured.mean()), float(measured.max())),
    )


def _with_parts(picture: Image | None, other: Image, parts: Iterable[tuple[float, float, float, float]]) -> Image:
    """A picture with parts of another pasted in; the other, where there is none of its size."""
    if picture is None or picture.size != other.size:
        return other
    picture = picture.copy()
    for left, bottom, width, height in parts:
        box = (left, 1 - bottom - height, left + width, 1 - bottom)
        x0, y0, x1, y1 = (round(side * n) for side, n in zip(box, 2 * other.size, strict=True))
        picture.paste(other.crop((x0, y0, x1, y1)), (x0, y0))
    return picture


def _certified(folder: Path, frame: int) -> F32 | None:
    """By how much each tile of a frame changes at most, (ROWS, COLUMNS), as its states say, or those that it needs by
    itself; None where they do not."""
    for kind in ("states", "analysis"):
        with suppress(*UNREADABLE), np.load(folder / kind / f"frame_{frame:04}.npz") as data:
            if "certified" in data.files:
                return np.asarray(data["certified"], np.float32).reshape(ROWS, COLUMNS)
    return None


def unmet(folder: Path, frame: int) -> int | None:
    """How many instances stay in a frame although none of its light paths met them; None where that is not known."""
    try:
        with np.load(folder / "states" / f"frame_{frame:04}.npz") as data:
            return int(np.count_nonzero((data["state"] != CULLED) & ~data["hits"].any(axis=1)))
    except UNREADABLE:
        return None


def frames_as_curves(report: dict[str, Any]) -> list[tuple[str, str]]:
    """Of several frames, curves as SVG, each with what it shows."""
    frames = report["frames"]
    if len(frames) < 2:
        return []

    def line(name: str, label: str, unit: float = 1.0, dots: bool = False) -> Curve:
        known = [f for f in frames if f.get(name) is not None]
        return Curve(label, [f["frame"] for f in known], [unit * f[name] for f in known], dots=dots)

    ends = [frames[0]["frame"], frames[-1]["frame"]]
    bound = (bound_of(report) or {}).get("mean")
    changes = [line("certified_mean", "certified at most", 100), line("verified_mean", "verified", 100, dots=True)]
    changes += [Curve("allowed", ends, [100 * bound] * 2, bound=True)] if bound else []
    change = [one for one in changes if one.x]
    seconds = [
        line("render_s", "rendering"),
        line("trace_s", "tracing light paths"),
        line("sync_s", "reading the scene"),
    ]
    parts = [
        ("Instances that stay, by frame", [line("active", "kept")], "instances"),
        ("Mean change of the picture, by frame", change if any(not one.bound for one in change) else [], "per cent"),
        ("Seconds, by frame", [one for one in seconds if any(one.y)], "seconds"),
    ]
    return [(title, curves(lines, what)) for title, lines, what in parts if lines]
