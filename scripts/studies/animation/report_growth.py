"""Sections of animation.md on what grows: cost with the scene, changes at rest, memory with the frames."""

from __future__ import annotations

import statistics
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from ....core.files.figures import size
from ..compare import markdown
from .figures import COLORS, PICTURES, STEADY, Part, Row, figure, percent

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LATE = 10  # frames after which nothing may change at rest


def _settled(city: Part) -> dict[str, float]:
    """Medians of settled frames: seconds by step and of the whole, counts; whole_s: of a TLAS over everything."""
    frames = city["frames"][STEADY:]
    keys = ("build_s", "trace_s", "feedback_s", "hitboxes", "active")
    out = {key: statistics.median(f["culled"][key] for f in frames) for key in keys}
    out["read_s"] = statistics.median(f["read_s"] for f in frames)
    out["frame_s"] = statistics.median(f["read_s"] + f["culled"]["advance_s"] for f in frames)
    return out | {
        "around_s": out["read_s"] + out["build_s"] + out["feedback_s"],
        "whole_s": statistics.median(f["whole"]["build_s"] for f in frames),
    }


def growth_summary(part: Part) -> list[Row]:
    first, last = part["cities"][0], part["cities"][-1]
    a, b, cold = _settled(first), _settled(last), last["cold"]
    names = f"{first['instances']:,} to {last['instances']:,} instances"
    entries = (b["active"] + b["hitboxes"]) / last["instances"]
    return [
        (f"seconds of a settled frame, {names}", f"{b['frame_s'] / a['frame_s']:.2f} times", "<= 2"),
        ("the same without tracing", f"{b['around_s'] / a['around_s']:.2f} times", "<= 2"),
        (
            "cold start at a million: instances built to those active at the end",
            f"{cold['asked'] / cold['active']:.2f}",
            "<= 2",
        ),
        ("entries of the TLAS at a million: instances and boxes", percent(entries), "<= 5 %"),
    ]


def growth(part: Part, folder: Path) -> str:
    cities = part["cities"]
    counts, settled = [c["instances"] for c in cities], [_settled(c) for c in cities]

    def draw(left: Axes, right: Axes) -> None:
        steps = (
            ("frame_s", "whole frame", "o-"),
            ("trace_s", "tracing", "^:"),
            ("build_s", "TLAS, boxes", "s:"),
            ("read_s", "reading Blender", "v:"),
        )
        for key, label, style in steps:
            left.plot(
                counts,
                [1000 * s[key] for s in settled],
                style,
                color=COLORS[0],
                label=label,
                alpha=1.0 if key == "frame_s" else 0.6,
            )
        left.plot(
            counts, [1000 * s["whole_s"] for s in settled], "x--", color=COLORS[1], label="nothing culled: TLAS alone"
        )
        left.set(xlabel="instances", ylabel="settled frame, ms", xscale="log", yscale="log")
        for key, label, color in (
            ("asked", "built", COLORS[1]),
            ("met", "met by paths", COLORS[2]),
            ("active", "active at the end", COLORS[0]),
        ):
            right.plot(counts, [c["cold"][key] for c in cities], "o-", color=color, label=label)
        right.set(xlabel="instances", ylabel="cold start, instances", xscale="log", ylim=(0, None))
        left.legend(fontsize=8, loc="center left", bbox_to_anchor=(0.0, 0.68))
        right.legend(fontsize=8, loc="lower left")

    figure(folder / "growth.png", 2, draw)
    rows: list[Row] = [
        (
            "instances",
            "reading",
            "TLAS, boxes",
            "feedback",
            "tracing",
            "frame",
            "nothing culled: TLAS",
            "active",
            "boxes",
        )
    ]
    for n, s in zip(counts, settled, strict=True):
        times = (
            f"{1000 * s[key]:,.{0 if s[key] > 0.1 else 1}f}"
            for key in ("read_s", "build_s", "feedback_s", "trace_s", "frame_s", "whole_s")
        )
        rows.append((f"{n:,}", *times, f"{s['active']:.0f}", f"{s['hitboxes']:,.0f}"))
    cold: list[Row] = [("instances", "rounds", "built", "met by paths", "active", "meshes", "built to active")]
    for c in cities:
        k = c["cold"]
        cold.append(
            (
                f"{c['instances']:,}",
                *(f"{k[key]:,}" for key in ("rounds", "asked", "met", "active", "meshes")),
                f"{k['asked'] / k['active']:.2f}",
            )
        )
    return "\n\n".join(
        [
            "## Growth",
            f"`mirror-city` in {len(cities)} sizes: the picture is the same, the city beyond the street grows. The "
            "camera moves sideways, the "
            "scatter stays. Medians of "
            f"{len(cities[0]['frames']) - STEADY} frames, milliseconds, without Blender's own evaluation; "
            f"{part['size'][0]} x {part['size'][1]}, "
            "default budget, "
            "measurement and calibration included.",
            markdown(rows),
            f"![Settled frames and cold starts by number of instances]({PICTURES}/growth.png)",
            "Cold starts, from boxes alone. Built: all that was asked for in any round. Of what paths then meet, the "
            "budget lets about half go again.",
            markdown(cold),
        ]
    )


def rest_summary(part: Part) -> list[Row]:
    return [
        (
            f"state changes in {len(part['changes'])} still frames at a million, after the first {LATE}",
            f"{sum(part['changes'][LATE:]):,}",
            "0",
        )
    ]


def rest(part: Part, _folder: Path) -> str:
    late = {key: part[key][LATE:] for key in ("changes", "active", "hitboxes", "built", "rounds")}
    text = (
        f"{part['instances']:,} instances, {len(part['changes'])} frames in which nothing changes, though each says "
        "that the camera has, so that "
        "time passes for the "
        f"regions. States change {sum(part['changes'][:LATE])} times in the first {LATE} frames, "
        f"{sum(late['changes'])} times after. Then "
        f"{min(late['active'])} to {max(late['active'])} instances are active, with {min(late['hitboxes']):,} to "
        f"{max(late['hitboxes']):,} boxes; "
        f"{sum(late['built'])} BLASes "
        f"are built; {statistics.mean(late['rounds']):.2f} rounds are traced per frame."
    )
    return f"## Rest\n\n{text}"


def _drift(values: list[int]) -> float:
    """The largest of the last fifth over the largest of the second fifth."""
    n = len(values) // 5
    return max(values[-n:]) / max(max(values[n : 2 * n]), 1)


def _runs(part: Part) -> Iterable[tuple[str, Part]]:
    return ((name, run) for name, run in part.items() if isinstance(run, dict))


def memory_summary(part: Part) -> list[Row]:
    return [
        (
            f"memory over {len(run['resident'])} frames, {name}: last fifth to second",
            f"{_drift(run['resident']):.3f}",
            "flat",
        )
        for name, run in _runs(part)
    ]


def memory(part: Part, folder: Path) -> str:
    def draw(*panels: Axes) -> None:
        for axes, (name, run) in zip(panels, _runs(part), strict=True):
            axes.plot([b / 1e6 for b in run["resident"]], color=COLORS[0], label="process")
            axes.plot([b / 1e6 for b in run["blas"]], color=COLORS[1], label="BLASes")
            axes.set(title=f"{name}, {run['instances']:,} instances", xlabel="frame", ylabel="MB", ylim=(0, None))
        panels[0].legend(fontsize=8)

    figure(folder / "memory.png", len(list(_runs(part))), draw)
    lines = []
    for name, run in _runs(part):
        used = run["resident"]
        lines.append(
            f"{name}: {size(used[1])} after the second frame, {size(max(used))} at most, {size(used[-1])} at the end."
        )
    intro = (
        "By the steps of `lipac analyze --warm`, there and back through the frames. The report, which is kept in "
        "memory too, grows by a kilobyte per frame."
    )
    return "\n\n".join(["## Memory", intro, *lines, f"![Memory by frame]({PICTURES}/memory.png)"])
