"""What a report comes to, in a sentence or two: the first thing that its page says."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from .html import percent

GOOD, FAIR, BAD = "good", "fair", "bad"


@dataclass(frozen=True)
class Verdict:
    """standing: GOOD, FAIR (nobody can tell, or there is nothing to tell) or BAD; headline: in a few words; sentences:
    what it rests on. culled, certified, verified: whether any frame is."""

    standing: str
    headline: str
    sentences: tuple[str, ...] = ()
    culled: bool = False
    certified: bool = False
    verified: bool = False


def verdict(report: dict[str, Any], measured: tuple[float, float] | None = None) -> Verdict:
    """Of a report: whether its pictures are surely as near to those of the full scene as was asked, and how that is
    known.

    measured: the mean change and that of the worst tile of a frame that was rendered with everything, too."""
    frames = report["frames"]
    certified, verified = (any(f"{what}_mean" in frame for frame in frames) for what in ("certified", "verified"))
    culled = any(frame["culled"] for frame in frames)
    return replace(_judged(report, measured), culled=culled, certified=certified, verified=verified)


def bound_of(report: dict[str, Any]) -> dict[str, float] | None:
    """The error budget that decided, `mean` and `worst`; None where something else did."""
    options = report["options"]
    return options.get("max_error") if report["policy"] == "light-paths" and options.get("min_share") is None else None


def _judged(report: dict[str, Any], measured: tuple[float, float] | None) -> Verdict:
    frames = report["frames"]
    if not frames:
        return Verdict(FAIR, "No frame is finished", ("Nothing can be said yet.",))
    if not any(frame["culled"] for frame in frames):
        why = next((frame["not_analysed"] for frame in frames if "not_analysed" in frame), "")
        said = "Everything is in the picture: there is no change to judge, and nothing is saved."
        return Verdict(FAIR, "Nothing was left out", (said, *([f"{why[:1].upper()}{why[1:]}."] if why else ())))
    frames = [frame for frame in frames if "not_analysed" not in frame]
    bound = bound_of(report)
    verified = [frame for frame in frames if "verified_mean" in frame]
    certified = [frame for frame in frames if "certified_mean" in frame]
    if bound is None and certified:
        return Verdict(FAIR, "Certified, against no bound that the report knows")
    if bound is None:
        return _without_budget(verified)
    broken = [frame["frame"] for frame in verified if _above(frame, bound, "verified_least")]
    if broken:
        return Verdict(
            BAD,
            "The picture changes by more than was allowed",
            (_where(broken), "Render again with --enforce, or with a smaller --max-error."),
        )
    if len(certified) < len(frames) or any(_above(frame, bound, "certified") for frame in certified):
        known = "For at least one frame the analysis could not show that the change stays within the budget."
        return Verdict(
            BAD if not verified else FAIR,
            "Not certain to be within the error budget",
            (known, *_compared(verified, frames, bound, measured)),
        )
    shot = any("needed" in frame for frame in frames)
    own = "Each frame's own set was certified; the set of the shot, with more in it, was not by itself." if shot else ""
    return Verdict(
        GOOD, "Within the error budget", tuple(filter(None, (*_compared(verified, frames, bound, measured), own)))
    )


def _without_budget(verified: list[dict[str, Any]]) -> Verdict:
    known = "What stays was not chosen by an error budget, so nothing is certified."
    more = (
        "The change was measured in parts of the picture."
        if verified
        else "How much the picture changes is not known: --verify measures it."
    )
    return Verdict(FAIR, "Culled without an error budget", (known, more))


def _compared(
    verified: list[dict[str, Any]],
    frames: list[dict[str, Any]],
    bound: dict[str, float],
    measured: tuple[float, float] | None,
) -> tuple[str, ...]:
    """How the renderer's pictures stand to the bounds."""
    if measured is not None:
        found = f"{percent(measured[0])} in the mean and {percent(measured[1])} in the worst tile"
        said = f"Checked by rendering: the full picture and the culled one differ by {found}"
        if measured[0] <= bound["mean"] and measured[1] <= bound["worst"]:
            return (f"{said}, less than was allowed.",)
        return (f"{said}, more than was allowed; part of that may be noise, which more samples would show.",)
    if not verified:
        return ("Certified by the analysis, with its own light paths. Not checked by rendering: --verify does that.",)
    of = f"{len(verified)} of {len(frames)} frames" if len(frames) > 1 else "the frame"
    said = f"Checked by rendering: parts of {of}, chosen at random, were rendered in full and culled."
    if all(frame[f"verified_{what}"] <= bound[what] for frame in verified for what in ("mean", "worst")):
        return (f"{said} They differ by less than was allowed.",)
    return (
        f"{said} They differ by more than was allowed, but noise alone may account for it: more samples would show.",
    )


def _above(frame: dict[str, Any], bound: dict[str, float], what: str) -> bool:
    return any(frame.get(f"{what}_{name}", 0.0) > bound[name] for name in ("mean", "worst"))


def _where(frames: list[int]) -> str:
    some = ", ".join(map(str, frames[:8])) + (f" and {len(frames) - 8} more" if len(frames) > 8 else "")
    return f"Verification found this in frame {some}; noise cannot account for it."
