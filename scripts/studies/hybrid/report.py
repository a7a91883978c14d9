"""What is measured of the hybrid renderer, as docs/results.md has it: tables in words, and the plot of error against
time."""

from __future__ import annotations

import json
import textwrap
from pathlib import Path
from typing import Any

import numpy as np

from ....core.files.atomic import replacing
from ..compare import markdown
from ..machine import measured_by

TRUTH, RASTER, WHOLE, CULLED, ROUGH, NOTHING, RAW = (
    "Cycles",
    "EEVEE",
    "hybrid",
    "hybrid, 1 %",
    "hybrid, 30 %",
    "hybrid, all culled",
    "hybrid, not denoised",
)
SHOWN = (TRUTH, RASTER, WHOLE, CULLED)
SETTINGS = ("resolution", "truth", "samples", "raster_samples")
STAGES = ("first hits", "EEVEE", "analysis", "building", "tracing", "combine")
TITLE = "## The hybrid renderer"
Row = dict[str, Any]


def write_page(output: Path) -> None:
    """Put the sections about the hybrid renderer, as the files in a folder say, at the end of the page beside it, where
    there is one."""
    page = output.parent / "results.md"
    if page.exists():
        head = page.read_text().partition(f"\n{TITLE}\n")[0]
        with replacing(page) as part:
            part.write_text(head + sections(output))


def sections(folder: Path) -> str:
    """All that the files in a folder say, where there are any."""
    parts = (("hybrid.json", results), ("hybrid_pop.json", pop))
    text = "".join(
        "\n" + section(json.loads((folder / name).read_text())) for name, section in parts if (folder / name).exists()
    )
    return wrapped(text)


def wrapped(text: str) -> str:
    """Markdown whose prose has lines of at most 120 columns."""
    blocks = [
        b if not b or b.startswith(("#", "|", "!", "-", "\n#")) else b[: len(b) - len(b.lstrip("\n"))] + _filled(b)
        for b in text.rstrip("\n").split("\n\n")
    ]
    return "\n\n".join(blocks) + "\n" if text else text


def _filled(prose: str) -> str:
    return textwrap.fill(prose.strip("\n"), 120, break_long_words=False, break_on_hyphens=False)


def pictures_folder(output: Path) -> Path:
    """Where pictures of results in a folder go."""
    folder = output.parent / "pictures"
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def plot(costs: dict[str, list[Row]], path: Path) -> None:
    """Error against time."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    figure = Figure(figsize=(4.6 * len(costs), 4.6), layout="constrained")
    for axes, (name, rows) in zip(np.atleast_1d(figure.subplots(1, len(costs))), costs.items(), strict=True):
        for way, style in ((TRUTH, "k.-"), (WHOLE, "s-"), (CULLED, "o-")):
            own = [r for r in rows if r["way"] == way]
            axes.plot([r["seconds"] for r in own], [r["flip"] for r in own], style, label=way, markersize=5)
            if way != TRUTH:
                hidden = [r["seconds"] - r["stages"]["EEVEE"] for r in own]
                axes.plot(
                    hidden,
                    [r["flip"] for r in own],
                    style.replace("-", ":"),
                    color=axes.lines[-1].get_color(),
                    label=f"{way}, less EEVEE",
                    markersize=3,
                )
        axes.set(
            xlabel="seconds of a frame",
            ylabel="mean FLIP against converged Cycles",
            xscale="log",
            yscale="log",
            title=name,
        )
        axes.grid(alpha=0.3, which="both")
        for axis in (axes.xaxis, axes.yaxis):  # of the numbers between powers of ten those that do not meet
            axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axis.set_minor_formatter(NullFormatter())
    lines, names = figure.axes[0].get_legend_handles_labels()
    figure.legend(lines, names, loc="outside lower center", ncols=len(names), fontsize=8)
    with replacing(path) as part:
        figure.savefig(part, dpi=80)


def results(measured: dict[str, Any]) -> str:
    """A section of docs/results.md."""
    settings = measured["settings"]
    ways = (RASTER, WHOLE, CULLED, ROUGH, NOTHING)
    head = ("scene", *ways[:3], "worse by", *ways[3:])
    body, linear = [], []
    for name, row in measured["scenes"].items():
        errors, worse = (
            {m: row[m] for m in ("flip", "relmse")},
            {m: row[m][CULLED] / row[m][WHOLE] - 1 for m in ("flip", "relmse")},
        )
        blas, tlas = row["blas_bytes"], row["tlas_bytes"]
        share = (blas[0] + tlas[0]) / max(blas[1] + tlas[1], 1)
        cells = [[f"{errors[m][way]:.4f}" if way in errors[m] else "" for way in (*ways, RAW)] for m in errors]
        kept = (
            f"{row['active']:,} of {row['instances']:,}",
            f"{blas[0] / max(blas[1], 1):.0%}",
            f"{share:.0%}",
            f"{row['overlap']:.0%}",
        )
        body.append((name, *cells[0][:3], f"{worse['flip']:+.1%}", *cells[0][3:5], *kept))
        linear.append((name, *cells[1][:3], f"{worse['relmse']:+.1%}", *cells[1][3:]))
    lines = [TITLE, ""]
    size, truth, samples, raster = (settings[name] for name in SETTINGS)
    lines += [
        f"`python -m lipac.scripts.studies.hybrid.results -o docs/results`, at {size}: {truth} paths per pixel of "
        "Cycles are the truth,"
    ]
    lines += [f"{samples} those of the hybrid renderer, {raster} the samples of EEVEE. Mean FLIP of what is displayed."]
    lines += [
        "Bytes of the culled picture over those of the unculled one, hitboxes included. Overlap: share of the frame "
        "in which both threads worked."
    ]
    lines += [measured_by(measured)]
    lines += ["", markdown([(*head, "kept", "BLAS", "BLAS and TLAS", "overlap"), *body]), ""]
    lines += ["relMSE of the linear pictures:", "", markdown([(*head, RAW), *linear]), ""]
    lines += mixtures(measured["scenes"])
    lines += [f"From left to right {', '.join(SHOWN)}:", ""]
    lines += [f"![{name}](pictures/hybrid-{name}.jpg)" for name in measured["scenes"]]
    if measured["cost"]:
        lines += ["", "### Cost", "", "Seconds of a frame by stage (they overlap, on two threads), and error:", ""]
        for name, rows in measured["cost"].items():
            lines += [cost_table(name, rows), ""]
        lines += ["![Error against time, next to Cycles](pictures/hybrid-cost.png)"]
    return "\n".join(lines) + "\n"


def mixtures(scenes: dict[str, Row]) -> list[str]:
    """What is said of pictures that are EEVEE's in part or as a whole."""
    lines = []
    shares = {
        name: ", ".join(f"{way}: {share:.0%}" for way, share in row.get("path_share", {}).items())
        for name, row in scenes.items()
    }
    mixed = [f"{name} ({of})" for name, of in shares.items() if of]
    if mixed:
        lines += [f"Mixed with EEVEE's picture, and by which share made by paths: {'; '.join(mixed)}.", ""]
    alone = [f"{name} ({', '.join(row['raster_only'])})" for name, row in scenes.items() if row.get("raster_only")]
    if alone:
        lines += [
            "Measured when one of the two pictures was chosen, before they were mixed (an error that is EEVEE's can "
            "have become smaller since), and"
        ]
        lines += [f"shown by EEVEE alone: {'; '.join(alone)}.", ""]
    return lines


def cost_table(name: str, rows: list[Row]) -> str:
    """Stages of the hybrid renderer as shares of its frame, its error, and that of Cycles in the time of the frame, and
    in the time of it without EEVEE."""
    cycles = sorted((r["seconds"], r["flip"]) for r in rows if r["way"] == TRUTH)
    known = np.log([c[0] for c in cycles]), np.log([c[1] for c in cycles])

    def in_time(limit: float) -> str:
        """Error of Cycles after so many seconds, between measured ones on a line of their logarithms; beyond them the
        nearest."""
        return f"{np.exp(np.interp(np.log(max(limit, 1e-9)), *known)):.4f}"

    head = (name, "paths per pixel", *STAGES, "FLIP", "Cycles in equal time", "in that less EEVEE")
    body = []
    for r in rows:
        if r["way"] != TRUTH:
            stages = [f"{r['stages'][stage] / r['seconds']:.0%}" for stage in STAGES]
            body.append(
                (
                    r["way"],
                    str(r["paths"]),
                    *stages,
                    f"{r['flip']:.4f}",
                    in_time(r["seconds"]),
                    in_time(r["seconds"] - r["stages"]["EEVEE"]),
                )
            )
    return markdown([head, *body])


def pop(figures: dict[str, Any]) -> str:
    """What was measured, for docs/results.md."""
    steps = [str(k + 1) for k in range(len(figures["kept"]))]
    rows = [("frame", *steps), ("slab", *("kept" if kept else "culled" for kept in figures["kept"]))]
    rows += [(f"shadow, {name}", *(f"{x:.3f}" for x in values)) for name, values in figures["shadow"].items()]
    rows += [(f"pop, {name}", *(f"{x:.4f}" for x in values)) for name, values in figures["pop"].items()]
    lines = ["### The pop of a shadow whose caster is culled", ""]
    lines += [
        "`python -m lipac.scripts.studies.hybrid.pop -o docs/results`: a camera draws back from a slab, which is "
        "culled by its distance, and returns."
    ]
    lines += [
        "Brightness of the slab's shadow over that of the lit floor, and how much the shadow, less that of the "
        "unculled frame, differs from the"
    ]
    lines += [f"frame before; by what stands in for the shadow of the culled slab. {measured_by(figures)}"]
    lines += ["", markdown(rows), ""]
    lines += [
        "The frame before the slab is culled and the first one without it: unculled, with the raster's shadow maps, "
        "with nothing in their place.",
        "",
    ]
    lines += ["![Two frames](pictures/hybrid-pop.png)"]
    return "\n".join(lines) + "\n"
