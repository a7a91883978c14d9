"""The certificate as a page to read: one file, nothing loaded from elsewhere."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ...page.curves import Curve, curves
from ...page.html import Figures, render
from ...page.pictures import STEPS, backdrop, of_crops, opened, tiles
from ...page.verdict import BAD, GOOD, Verdict

STEPS_OF_SHOT = {
    "analysis": ("analysis", "analysis"),
    "unite": ("union", "unite"),
    "judgement": ("judgement by paths", "judgement"),
    "render": ("render, culled", "render"),
    "verify": ("verification", "crops_full"),
}
TRIED = {"": "the shot's set", "all": "everything kept"}


def page(certificate: dict[str, Any], picture: Path | None = None) -> str:
    """The page, from what `certify` writes as JSON. picture: of the frame of `worst`, as it was delivered."""
    seconds = certificate["seconds"]
    spent = sum(seconds[name] for name in STEPS_OF_SHOT)
    worst, shown = worst_of(certificate), None if picture is None else opened(picture)
    return render(
        "certificate.html",
        fig=Figures(certificate),
        certificate=certificate,
        verdict=verdict(certificate),
        steps=STEPS_OF_SHOT,
        tried=TRIED,
        curves=_curves(certificate),
        saved=None if seconds["full"] is None else seconds["full"] - spent,
        worst=worst,
        dim=None if shown is None else backdrop(shown),
        tiles=None if worst is None else _tiles(certificate, worst),
        colors=STEPS,
    )


def verdict(certificate: dict[str, Any]) -> Verdict:
    """What the page says first."""
    if certificate["broken"]:
        return Verdict(BAD, "Above the error budget, where it was measured", tuple(certificate["statement"]))
    within = "Certified in every frame, and within the error budget where it was measured"
    return Verdict(GOOD, within, tuple(certificate["statement"]))


def worst_of(certificate: dict[str, Any]) -> int | None:
    """The place of the verified frame whose picture changes most in the mean, as delivered; None where none was."""
    changes = [
        (frame["verified"]["attempts"][-1]["verified_mean"], -k)
        for k, frame in enumerate(certificate["frames"])
        if frame["verified"]
    ]
    return -max(changes)[1] if changes else None


def _tiles(certificate: dict[str, Any], place: int) -> list[Any]:
    found = certificate["frames"][place]["verified"]["attempts"][-1]
    if "verified_tiles" not in found:
        return []
    changes = of_crops(found["verified_crops"], found["verified_tiles"], tuple(found["verified_grid"]))
    return tiles(changes, certificate["max_error"][1])


def _curves(certificate: dict[str, Any]) -> list[tuple[str, str]]:
    """What was measured, what is kept and what each frame took, as SVG."""
    frames, bound = certificate["frames"], certificate["max_error"][0]
    numbers = [frame["frame"] for frame in frames]
    ends = [numbers[0], numbers[-1]]
    tried = [(f["frame"], a) for f in frames if f["verified"] for a in f["verified"]["attempts"][:-1]]
    last = [(f["frame"], f["verified"]["attempts"][-1]) for f in frames if f["verified"]]

    def dots(label: str, found: list[tuple[int, dict[str, Any]]]) -> Curve:
        return Curve(label, [n for n, _ in found], [100 * a["verified_mean"] for _, a in found], dots=True)

    certified = [100 * frame["certified"]["mean"] for frame in frames]
    change = [
        Curve("allowed", ends, [100 * bound] * 2, bound=True),
        dots("verified, as delivered", last),
        Curve("certified, as delivered", numbers, certified),
        dots("verified, before it was mended", tried),
    ]
    active = [Curve("what each frame proposes", numbers, [frame["analysis"]["active"] for frame in frames])]
    steps = ("analysis", "judgement", "render")
    seconds = [Curve(name, numbers, [frame[name]["seconds"] for frame in frames]) for name in steps]
    titles = ("Mean change of the picture, by frame", "Instances that each frame proposes", "Seconds, by frame")
    drawn = zip(titles, (change, active, seconds), ("per cent", "instances", "seconds"), strict=True)
    return [(title, curves([line for line in lines if line.x], what)) for title, lines, what in drawn]
