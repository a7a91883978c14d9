"""What `lipac bench` writes of animated scenes: animation.md, with tables and plots of what `bench_animation` and `bench_flythrough` measured."""

from __future__ import annotations

import shutil
import statistics
import textwrap
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ...core.files.atomic import replacing
from ...core.files.report import size
from .compare import markdown

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Part = dict[str, Any]
Row = tuple[str, ...]
STEADY = 3  # index of the first frame that counts as settled: before it, what deforms is built for being refitted
LATE = 10  # frames after which nothing may change at rest
COLORS = ("tab:red", "tab:blue", "tab:green")
PICTURES = "animation"  # folder beside the page


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
    head = ["# Animation", f"Written by `lipac bench --only animation` (`make animation`) on {machines}. Seconds are of a machine that had other work to do, "]
    head[1] += "so each table compares what took turns in one run."
    with replacing(folder / "animation.md") as path:
        path.write_text(_wrapped("\n\n".join([*head, *_demos(folder, results), markdown(rows), *sections])) + "\n")
    return markdown(rows)


def _wrapped(page: str) -> str:
    """A page whose paragraphs are broken into lines."""
    blocks = page.split("\n\n")
    return "\n\n".join(b if b.startswith(("#", "|", "!")) else textwrap.fill(b, 150, break_long_words=False, break_on_hyphens=False) for b in blocks)


def _demos(folder: Path, results: dict[str, Part]) -> list[str]:
    if "pictures" not in results:
        return []
    lines = []
    for name in ("crowd", "flythrough"):
        shutil.copyfile(folder / f"{name}.png", folder / PICTURES / f"{name}.png")
        lines.append(f"![{name}: as it is rendered when culled, and what of it is kept for that]({PICTURES}/{name}.png)")
    text = "`crowd` and `flythrough` (`lipac demo`): culled, by Cycles, and what is kept for that, seen from outside: orange; boxes stand for the rest."
    return [*lines, text]


def _figure(path: Path, panels: int, draw: Callable[..., None], width: float = 11.0) -> None:
    """Save a figure that draw(axes, ...) makes."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, 3.6), layout="constrained")
    draw(*figure.subplots(1, panels, squeeze=False)[0])
    with replacing(path) as part:
        figure.savefig(part, dpi=80)


def _percent(x: float) -> str:
    return f"{100 * x:.3g} %"


# Crowd


def _crowd_ratios(part: Part) -> dict[str, float]:
    """Culled over whole, in settled frames: median of each figure."""
    frames = part["frames"][STEADY:]
    return {key: statistics.median(f["culled"][key] / f["whole"][key] for f in frames) for key in ("blas_held_bytes", "blas_bytes", "blas_s")}


def _crowd_summary(part: Part) -> list[Row]:
    ratio, worst = _crowd_ratios(part), max(part["errors"], key=lambda e: e["mean"])
    name = f"{part['figures']:,} figures of {part['triangles'] / part['figures']:,.0f} triangles"
    return [
        (f"{name}: BLAS bytes held, share of `--cull none`", f"{ratio['blas_held_bytes']:.3f}", "<= 0.2"),
        (f"{name}: BLAS milliseconds per frame, share of `--cull none`", f"{ratio['blas_s']:.3f}", "<= 0.2"),
        (f"{name}: error, frame of the largest", f"{_percent(worst['mean'])} ± {_percent(worst['mean_ci'])}", "<= 1 %"),
    ]


def _crowd(title: str, picture: str, part: Part, folder: Path) -> str:
    frames, ratio = part["frames"], _crowd_ratios(part)

    def draw(left: Axes, right: Axes) -> None:
        for name, color in zip(("whole", "culled"), COLORS[1::-1], strict=True):
            left.plot([f["frame"] for f in frames], [f[name]["blas_held_bytes"] / 1e6 for f in frames], "o-", color=color, label=name)
            right.plot([f["frame"] for f in frames], [1000 * f[name]["blas_s"] for f in frames], "o-", color=color, label=name)
        left.set(xlabel="frame", ylabel="BLAS bytes held, MB", ylim=(0, None))
        right.set(xlabel="frame", ylabel="reading, building and refitting BLASes, ms", yscale="log")
        left.legend()

    _figure(folder / f"{picture}.png", 2, draw)
    active = [f["culled"]["active"] for f in frames]
    rows: list[Row] = [("frame", "mean change", "half of its 95 % interval", "worst tile", "another seed, nothing culled")]
    rows += [(str(e["frame"]), *(_percent(e[key]) for key in ("mean", "mean_ci", "worst", "seed"))) for e in part["errors"]]
    return "\n\n".join(
        [
            f"## {title}",
            f"{part['figures']:,} figures, each with a skeleton and a shape of its own, in eight streets; the camera stands in one. "
            f"{part['triangles']:,} triangles, "
            f"{frames[0]['instances']:,} instances; {min(active):,} to {max(active):,} stay within the default budget. What the paths of a frame "
            "ask for is measured, "
            f"and its BLASes held: {_percent(ratio['blas_held_bytes'])} of the bytes; those of what stays are {_percent(ratio['blas_bytes'])}. "
            "From its first deformation on, culled or not, a mesh is built so that it can be refitted, which takes twice the bytes: frame 2 "
            "builds, later ones refit.",
            f"![BLAS bytes and milliseconds per frame]({PICTURES}/{picture}.png)",
            f"Error: mean over the picture's tiles, by {part['samples']} paths per pixel, with random numbers that are the same for both pictures "
            "and not the analysis's.",
            markdown(rows),
        ]
    )


# Flythrough


def _latency_row(counts: Part) -> Row:
    frames = counts["frames"]
    more = sum(frames[4:])
    return (str(counts["before"]), *(str(frames[k] if k < len(frames) else 0) for k in range(4)), str(more), str(counts["never"]))


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
        ("flicker, real time; without hysteresis", f"{_percent(steady['flicker_tiles'])}; {_percent(jumpy['flicker_tiles'])}", "measured"),
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
        rows.append((name, *counts, *states, *(_percent(x) for x in (mean["error"], run["flicker_tiles"], run["flicker"]))))
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

    _figure(path, 2, draw)


_COLUMNS = (
    "Active: mean over frames. Changes: of states, per instance that is ever active and 100 frames; undone: within ten frames of the last. Error: "
    "of the picture "
    "with what is active against the whole scene's, by the same random numbers, mean over tiles. Flicker: how much the difference of the two "
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

    _figure(folder / "latency.png", 3, draw)
    _fly_plot(part, folder / "flythrough-runs.png")
    rows: list[Row] = [("what appears", "loop", "active before", "0", "1", "2", "3", "later", "never")]
    rows += [(kind, name, *_latency_row(part["runs"][name]["latency"][kind])) for kind in kinds for name in names]
    return "\n\n".join(
        [
            "## Flythrough, in real time",
            f"`flythrough`, frames {part['frames'][0]} to {part['frames'][1]} at {part['size'][0]} x {part['size'][1]}: one round per frame, four paths per "
            "pixel; what one path in 10,000 meets is kept. "
            "The whole scene is traced beside it and says when an instance appears: one path in 10,000 meets it, none did in the ten frames before. "
            "Large: its box is a twentieth of the picture's width or more. In reflections alone: its box is outside the picture. "
            f"The first {part['started']} frames, in which the loop starts from nothing, do not count.",
            markdown(rows),
            f"![Frames from appearance to activation]({PICTURES}/latency.png)",
            "What the drive brings into view is active before: bounced light has asked for it. The cut and the cut back, in which all of a "
            "picture is new, show what "
            "mitigation does. It knows nothing of mirrors: what is seen in them waits until paths ask for it.",
            markdown_of_runs(part),
            f"![Error and number of active instances by frame]({PICTURES}/flythrough-runs.png)",
        ]
    )


def markdown_of_runs(part: Part) -> str:
    """The table of a flythrough's loops, and what its columns are."""
    return f"{_runs_table(part)}\n\n{_COLUMNS}The picture itself changes by {_percent(part['own_change'])} per frame, in single pixels."


def _shot_summary(part: Part) -> list[Row]:
    steady, jumpy = part["runs"]["warm"], part["runs"]["warm, no hysteresis"]
    flickers = f"{_percent(steady['flicker_tiles'])}; {_percent(jumpy['flicker_tiles'])}"
    return [_change_row("`--warm`", steady, jumpy), ("flicker, `--warm`; without hysteresis", flickers, "measured")]


def _shot(part: Part, folder: Path) -> str:
    _fly_plot(part, folder / "shot-runs.png")
    intro = (
        f"Frames {part['frames'][0]} to {part['frames'][1]} as `lipac render` decides them: rounds until no more is asked for, then the default budget of 1 %. "
        "By themselves: without `--warm`."
    )
    picture = f"![Error and number of active instances by frame]({PICTURES}/shot-runs.png)"
    return "\n\n".join(["## Flythrough, within an error budget", intro, markdown_of_runs(part), picture])


# Growth


def _settled(city: Part) -> dict[str, float]:
    """Medians of settled frames: seconds by step and of the whole, counts; whole_s: of a TLAS over everything."""
    frames = city["frames"][STEADY:]
    keys = ("build_s", "trace_s", "feedback_s", "hitboxes", "active")
    out = {key: statistics.median(f["culled"][key] for f in frames) for key in keys}
    out["read_s"] = statistics.median(f["read_s"] for f in frames)
    out["frame_s"] = statistics.median(f["read_s"] + f["culled"]["advance_s"] for f in frames)
    return out | {"around_s": out["read_s"] + out["build_s"] + out["feedback_s"], "whole_s": statistics.median(f["whole"]["build_s"] for f in frames)}


def _growth_summary(part: Part) -> list[Row]:
    first, last = part["cities"][0], part["cities"][-1]
    a, b, cold = _settled(first), _settled(last), last["cold"]
    names = f"{first['instances']:,} to {last['instances']:,} instances"
    entries = (b["active"] + b["hitboxes"]) / last["instances"]
    return [
        (f"seconds of a settled frame, {names}", f"{b['frame_s'] / a['frame_s']:.2f} times", "<= 2"),
        ("the same without tracing", f"{b['around_s'] / a['around_s']:.2f} times", "<= 2"),
        ("cold start at a million: instances built to those active at the end", f"{cold['asked'] / cold['active']:.2f}", "<= 2"),
        ("entries of the TLAS at a million: instances and boxes", _percent(entries), "<= 5 %"),
    ]


def _growth(part: Part, folder: Path) -> str:
    cities = part["cities"]
    counts, settled = [c["instances"] for c in cities], [_settled(c) for c in cities]

    def draw(left: Axes, right: Axes) -> None:
        steps = (("frame_s", "whole frame", "o-"), ("trace_s", "tracing", "^:"), ("build_s", "TLAS, boxes", "s:"), ("read_s", "reading Blender", "v:"))
        for key, label, style in steps:
            left.plot(counts, [1000 * s[key] for s in settled], style, color=COLORS[0], label=label, alpha=1.0 if key == "frame_s" else 0.6)
        left.plot(counts, [1000 * s["whole_s"] for s in settled], "x--", color=COLORS[1], label="nothing culled: TLAS alone")
        left.set(xlabel="instances", ylabel="settled frame, ms", xscale="log", yscale="log")
        for key, label, color in (("asked", "built", COLORS[1]), ("met", "met by paths", COLORS[2]), ("active", "active at the end", COLORS[0])):
            right.plot(counts, [c["cold"][key] for c in cities], "o-", color=color, label=label)
        right.set(xlabel="instances", ylabel="cold start, instances", xscale="log", ylim=(0, None))
        left.legend(fontsize=8, loc="center left", bbox_to_anchor=(0.0, 0.68))
        right.legend(fontsize=8, loc="lower left")

    _figure(folder / "growth.png", 2, draw)
    rows: list[Row] = [("instances", "reading", "TLAS, boxes", "feedback", "tracing", "frame", "nothing culled: TLAS", "active", "boxes")]
    for n, s in zip(counts, settled, strict=True):
        times = (f"{1000 * s[key]:,.{0 if s[key] > 0.1 else 1}f}" for key in ("read_s", "build_s", "feedback_s", "trace_s", "frame_s", "whole_s"))
        rows.append((f"{n:,}", *times, f"{s['active']:.0f}", f"{s['hitboxes']:,.0f}"))
    cold: list[Row] = [("instances", "rounds", "built", "met by paths", "active", "meshes", "built to active")]
    for c in cities:
        k = c["cold"]
        cold.append((f"{c['instances']:,}", *(f"{k[key]:,}" for key in ("rounds", "asked", "met", "active", "meshes")), f"{k['asked'] / k['active']:.2f}"))
    return "\n\n".join(
        [
            "## Growth",
            f"`mirror-city` in {len(cities)} sizes: the picture is the same, the city beyond the street grows. The camera moves sideways, the "
            "scatter stays. Medians of "
            f"{len(cities[0]['frames']) - STEADY} frames, milliseconds, without Blender's own evaluation; {part['size'][0]} x {part['size'][1]}, "
            "default budget, "
            "measurement and calibration included.",
            markdown(rows),
            f"![Settled frames and cold starts by number of instances]({PICTURES}/growth.png)",
            "Cold starts, from boxes alone. Built: all that was asked for in any round. Of what paths then meet, the budget lets about half go again.",
            markdown(cold),
        ]
    )


# Rest and memory


def _rest_summary(part: Part) -> list[Row]:
    return [(f"state changes in {len(part['changes'])} still frames at a million, after the first {LATE}", f"{sum(part['changes'][LATE:]):,}", "0")]


def _rest(part: Part, _folder: Path) -> str:
    late = {key: part[key][LATE:] for key in ("changes", "active", "hitboxes", "built", "rounds")}
    text = (
        f"{part['instances']:,} instances, {len(part['changes'])} frames in which nothing changes, though each says that the camera has, so that "
        "time passes for the "
        f"regions. States change {sum(part['changes'][:LATE])} times in the first {LATE} frames, {sum(late['changes'])} times after. Then "
        f"{min(late['active'])} to {max(late['active'])} instances are active, with {min(late['hitboxes']):,} to {max(late['hitboxes']):,} boxes; "
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


def _memory_summary(part: Part) -> list[Row]:
    return [(f"memory over {len(run['resident'])} frames, {name}: last fifth to second", f"{_drift(run['resident']):.3f}", "flat") for name, run in _runs(part)]


def _memory(part: Part, folder: Path) -> str:
    def draw(*panels: Axes) -> None:
        for axes, (name, run) in zip(panels, _runs(part), strict=True):
            axes.plot([b / 1e6 for b in run["resident"]], color=COLORS[0], label="process")
            axes.plot([b / 1e6 for b in run["blas"]], color=COLORS[1], label="BLASes")
            axes.set(title=f"{name}, {run['instances']:,} instances", xlabel="frame", ylabel="MB", ylim=(0, None))
        panels[0].legend(fontsize=8)

    _figure(folder / "memory.png", len(list(_runs(part))), draw)
    lines = []
    for name, run in _runs(part):
        used = run["resident"]
        lines.append(f"{name}: {size(used[1])} after the second frame, {size(max(used))} at most, {size(used[-1])} at the end.")
    intro = "By the steps of `lipac analyze --warm`, there and back through the frames. The report, which is kept in memory too, grows by a kilobyte per frame."
    return "\n\n".join(["## Memory", intro, *lines, f"![Memory by frame]({PICTURES}/memory.png)"])


SECTIONS: dict[str, tuple[Callable[[Part], list[Row]], Callable[[Part, Path], str]]] = {
    "crowd": (_crowd_summary, lambda part, folder: _crowd("Crowd", "crowd-blas", part, folder)),
    "character": (_crowd_summary, lambda part, folder: _crowd("Crowd of a supplied character", "character-blas", part, folder)),
    "flythrough": (_fly_summary, _fly),
    "shot": (_shot_summary, _shot),
    "growth": (_growth_summary, _growth),
    "rest": (_rest_summary, _rest),
    "memory": (_memory_summary, _memory),
}
