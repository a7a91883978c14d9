"""What `lipac bench` writes of animated scenes: animation.md, with tables and plots of what `bench_animation` and
`bench_flythrough` measured."""

from __future__ import annotations

import shutil
import statistics
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ....core.files.atomic import replacing
from ..compare import markdown
from .figures import COLORS, PICTURES, STEADY, Part, Row, figure, percent
from .report_growth import growth, growth_summary, memory, memory_summary, rest, rest_summary

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def write(folder: Path, results: dict[str, Part]) -> str:
    """Write folder/animation.md and its pictures; returns the table of what was asked for and what was measured."""
    (folder / PICTURES).mkdir(exist_ok=True)
    rows: list[Row] = [("what", "measured", "target")]
    sections: list[str] = []
    for name, (summary, section) in SECTIONS.items():
        part = results.get(name)
        if part is None or "skipped" in part:
            continue
        rows += summary(part)
        sections.append(section(part, folder / PICTURES))
    machines = "; ".join(sorted({part["machine"] for part in results.values()}))
    head = [
        "# Animation",
        f"Written by `lipac bench --only animation` (`make animation`): {machines}. Seconds are of a machine that "
        "had other work to do, ",
    ]
    head[1] += "so each table compares what took turns in one run."
    with replacing(folder / "animation.md") as path:
        path.write_text(_wrapped("\n\n".join([*head, *_demos(folder, results), markdown(rows), *sections])) + "\n")
    return markdown(rows)


def _wrapped(page: str) -> str:
    """A page whose paragraphs are broken into lines."""
    blocks = page.split("\n\n")
    return "\n\n".join(
        b if b.startswith(("#", "|", "!")) else textwrap.fill(b, 120, break_long_words=False, break_on_hyphens=False)
        for b in blocks
    )


def _demos(folder: Path, results: dict[str, Part]) -> list[str]:
    if "pictures" not in results:
        return []
    lines = []
    for name in ("crowd", "flythrough"):
        shutil.copyfile(folder / f"{name}.jpg", folder / PICTURES / f"{name}.jpg")
        lines.append(
            f"![{name}: as it is rendered when culled, and what of it is kept for that]({PICTURES}/{name}.jpg)"
        )
    text = (
        "`crowd` and `flythrough` (`lipac demo`): culled, by Cycles, and what is kept for that, seen from "
        "outside: orange; boxes stand for the rest."
    )
    return [*lines, text]


# Crowd


def _crowd_ratios(part: Part) -> dict[str, float]:
    """Culled over whole, in settled frames: median of each figure."""
    frames = part["frames"][STEADY:]
    return {
        key: statistics.median(f["culled"][key] / f["whole"][key] for f in frames)
        for key in ("blas_held_bytes", "blas_bytes", "blas_s")
    }


def _crowd_summary(part: Part) -> list[Row]:
    ratio, worst = _crowd_ratios(part), max(part["errors"], key=lambda e: e["mean"])
    name = f"{part['figures']:,} figures of {part['triangles'] / part['figures']:,.0f} triangles"
    return [
        (f"{name}: BLAS bytes held, share of `--cull none`", f"{ratio['blas_held_bytes']:.3f}", "<= 0.2"),
        (f"{name}: BLAS milliseconds per frame, share of `--cull none`", f"{ratio['blas_s']:.3f}", "<= 0.2"),
        (f"{name}: error, frame of the largest", f"{percent(worst['mean'])} ± {percent(worst['mean_ci'])}", "<= 1 %"),
    ]


def _crowd(title: str, picture: str, part: Part, folder: Path) -> str:
    frames, ratio = part["frames"], _crowd_ratios(part)

    def draw(left: Axes, right: Axes) -> None:
        for name, color in zip(("whole", "culled"), COLORS[1::-1], strict=True):
            left.plot(
                [f["frame"] for f in frames],
                [f[name]["blas_held_bytes"] / 1e6 for f in frames],
                "o-",
                color=color,
                label=name,
            )
            right.plot(
                [f["frame"] for f in frames], [1000 * f[name]["blas_s"] for f in frames], "o-", color=color, label=name
            )
        left.set(xlabel="frame", ylabel="BLAS bytes held, MB", ylim=(0, None))
        right.set(xlabel="frame", ylabel="reading, building and refitting BLASes, ms", yscale="log")
        left.legend()

    figure(folder / f"{picture}.png", 2, draw)
    active = [f["culled"]["active"] for f in frames]
    rows: list[Row] = [
        ("frame", "mean change", "half of its 95 % interval", "worst tile", "another seed, nothing culled")
    ]
    rows += [
        (str(e["frame"]), *(percent(e[key]) for key in ("mean", "mean_ci", "worst", "seed"))) for e in part["errors"]
    ]
    return "\n\n".join(
        [
            f"## {title}",
            f"{part['figures']:,} figures, each with a skeleton and a shape of its own, in eight streets; the camera "
            "stands in one. "
            f"{part['triangles']:,} triangles, "
            f"{frames[0]['instances']:,} instances; {min(active):,} to {max(active):,} stay within the default budget. "
            "What the paths of a frame "
            "ask for is measured, "
            f"and its BLASes held: {percent(ratio['blas_held_bytes'])} of the bytes; those of what stays are "
            f"{percent(ratio['blas_bytes'])}. "
            "From its first deformation on, culled or not, a mesh is built so that it can be refitted, which takes "
            "twice the bytes: frame 2 "
            "builds, later ones refit.",
            f"![BLAS bytes and milliseconds per frame]({PICTURES}/{picture}.png)",
            f"Error: mean over the picture's tiles, by {part['samples']} paths per pixel, with random numbers that are "
            "the same for both pictures "
            "and not the analysis's.",
            markdown(rows),
        ]
    )


# Flythrough


def _latency_row(counts: Part) -> Row:
    frames = counts["frames"]
    more = sum(frames[4:])
    return (
        str(counts["before"]),
        *(str(frames[k] if k < len(frames) else 0) for k in range(4)),
        str(more),
        str(counts["never"]),
    )


def _typical(counts: Part) -> str:
    """Median and largest latency in words."""
    each = [k for k, n in enumerate(counts["frames"]) for _ in range(n)]
    return f"median {statistics.median(each):g}, most {max(each)} ({len(each)} instances)" if each else "none was late"


def _fly_summary(part: Part) -> list[Row]:
    mitigated, without = (part["runs"][name]["latency"] for name in ("as it is", "no mitigation"))
    kinds = list(mitigated)
    large, mirror = kinds[0], kinds[-1]
    steady, jumpy = (part["runs"][name] for name in ("as it is", "no hysteresis"))
    return [
        ("flythrough, large instances: frames from appearance to activation", _typical(mitigated[large]), "0"),
        ("the same without mitigation", _typical(without[large]), "measured"),
        ("flythrough, in mirrors alone: frames from appearance to activation", _typical(mitigated[mirror]), "measured"),
        _change_row("real time", steady, jumpy),
        (
            "flicker, real time; without hysteresis",
            f"{percent(steady['flicker_tiles'])}; {percent(jumpy['flicker_tiles'])}",
            "measured",
        ),
    ]


def _change_row(name: str, steady: Part, jumpy: Part) -> Row:
    a, b = steady["states"]["changes"], jumpy["states"]["changes"]
    return (f"state changes per instance and 100 frames, {name}; without hysteresis", f"{a:.2f}; {b:.2f}", "fewer")


def _runs_table(part: Part) -> str:
    head = ("loop", "active", "hitboxes", "changes", "undone", "error", "flicker, tiles", "flicker, pixels")
    rows: list[Row] = [head]
    for name, run in part["runs"].items():
        mean = {key: statistics.mean(run[key][part["started"] :]) for key in ("active", "hitboxes", "error")}
        counts = (f"{mean['active']:.0f}", f"{mean['hitboxes']:,.0f}")
        states = (f"{run['states']['changes']:.2f}", f"{run['states']['undone']:.2f}")
        rows.append(
            (name, *counts, *states, *(percent(x) for x in (mean["error"], run["flicker_tiles"], run["flicker"])))
        )
    return markdown(rows)


def _fly_plot(part: Part, path: Path) -> None:
    def draw(left: Axes, right: Axes) -> None:
        for (name, run), color in zip(part["runs"].items(), COLORS, strict=True):
            frames = range(part["frames"][0], part["frames"][1] + 1)
            left.plot(frames, np.maximum(run["error"], 1e-5), color=color, label=name, linewidth=1)
            right.plot(frames, run["active"], color=color, label=name, linewidth=1)
        for axes, label in ((left, "error: mean over tiles"), (right, "active instances")):
            for cut in part["cuts"]:
                axes.axvline(cut, color="gray", linestyle=":", linewidth=0.8)
            axes.set(xlabel="frame (dotted: cuts)", ylabel=label)
        left.set(yscale="log")
        left.legend(fontsize=8)

    figure(path, 2, draw)


_COLUMNS = (
    "Active: mean over frames. Changes: of states, per instance that is ever active and 100 frames; undone: within "
    "ten frames of the last. Error: "
    "of the picture "
    "with what is active against the whole scene's, by the same random numbers, mean over tiles. Flicker: how much "
    "the difference of the two "
    "changes from frame "
    "to frame, relative to the picture; single pixels have noise of the paths that take another course. "
)


def _fly(part: Part, folder: Path) -> str:
    kinds = list(part["runs"]["as it is"]["latency"])
    names = ("as it is", "no mitigation")

    def draw(*panels: Axes) -> None:
        for axes, kind in zip(panels, kinds, strict=True):
            for k, (name, color) in enumerate(zip(names, COLORS, strict=False)):
                frames = part["runs"][name]["latency"][kind]["frames"]
                axes.bar(np.arange(len(frames)) + 0.4 * (k - 0.5), frames, 0.4, color=color, label=name)
            axes.set(title=kind, xlabel="frames until active", xticks=range(8), xlim=(-0.6, 7.6))
        panels[0].set(ylabel="instances")
        panels[0].legend(fontsize=8)

    figure(folder / "latency.png", 3, draw)
    _fly_plot(part, folder / "flythrough-runs.png")
    rows: list[Row] = [("what appears", "loop", "active before", "0", "1", "2", "3", "later", "never")]
    rows += [(kind, name, *_latency_row(part["runs"][name]["latency"][kind])) for kind in kinds for name in names]
    return "\n\n".join(
        [
            "## Flythrough, in real time",
            f"`flythrough`, frames {part['frames'][0]} to {part['frames'][1]} at {part['size'][0]} x "
            f"{part['size'][1]}: one round per frame, four paths per "
            "pixel; what one path in 10,000 meets is kept. "
            "The whole scene is traced beside it and says when an instance appears: one path in 10,000 meets it, none "
            "did in the ten frames before. "
            "Large: its box is a twentieth of the picture's width or more. In reflections alone: its box is outside "
            "the picture. "
            f"The first {part['started']} frames, in which the loop starts from nothing, do not count.",
            markdown(rows),
            f"![Frames from appearance to activation]({PICTURES}/latency.png)",
            "What the drive brings into view is active before: bounced light has asked for it. The cut and the cut "
            "back, in which all of a "
            "picture is new, show what "
            "mitigation does. It knows nothing of mirrors: what is seen in them waits until paths ask for it.",
            markdown_of_runs(part),
            f"![Error and number of active instances by frame]({PICTURES}/flythrough-runs.png)",
        ]
    )


def markdown_of_runs(part: Part) -> str:
    """The table of a flythrough's loops, and what its columns are."""
    return (
        f"{_runs_table(part)}\n\n{_COLUMNS}The picture itself changes by {percent(part['own_change'])} per "
        "frame, in single pixels."
    )


def _shot_summary(part: Part) -> list[Row]:
    steady, jumpy = part["runs"]["warm"], part["runs"]["warm, no hysteresis"]
    flickers = f"{percent(steady['flicker_tiles'])}; {percent(jumpy['flicker_tiles'])}"
    return [_change_row("`--warm`", steady, jumpy), ("flicker, `--warm`; without hysteresis", flickers, "measured")]


def _shot(part: Part, folder: Path) -> str:
    _fly_plot(part, folder / "shot-runs.png")
    intro = (
        f"Frames {part['frames'][0]} to {part['frames'][1]} as `lipac render` decides them: rounds until no more is "
        "asked for, then the default budget of 1 %. "
        "By themselves: without `--warm`."
    )
    picture = f"![Error and number of active instances by frame]({PICTURES}/shot-runs.png)"
    return "\n\n".join(["## Flythrough, within an error budget", intro, markdown_of_runs(part), picture])


# Growth


# Rest and memory


SECTIONS: dict[str, tuple[Callable[[Part], list[Row]], Callable[[Part, Path], str]]] = {
    "crowd": (_crowd_summary, lambda part, folder: _crowd("Crowd", "crowd-blas", part, folder)),
    "character": (
        _crowd_summary,
        lambda part, folder: _crowd("Crowd of a supplied character", "character-blas", part, folder),
    ),
    "flythrough": (_fly_summary, _fly),
    "shot": (_shot_summary, _shot),
    "growth": (growth_summary, growth),
    "rest": (rest_summary, rest),
    "memory": (memory_summary, memory),
}
