"""What `lipac evaluate` writes: tables, plots, pictures and a report in words."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ...core.culling.policies import RULES
from ...core.evaluation.evaluate import BUDGETS, COUNTS, ORACLE, OURS, RANDOM, Evaluation
from ...core.evaluation.judge import SURE
from ...core.files.atomic import replacing
from ...core.files.figures import size
from ...page.curves import svg_of
from ...page.html import Figures, render
from ...page.pictures import embed, opened
from ...page.verdict import BAD, GOOD, Verdict
from .compare import markdown
from .hybrid.report import sections, wrapped
from .machine import measured_by
from .pictures.strips import save, strip

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_COLORS, _MARKERS = (
    ("tab:blue", "tab:green", "tab:purple", "tab:olive", "tab:cyan", "tab:brown"),
    ("s-", "^-", "d-", "v-"),
)
STYLE = {
    OURS: ("tab:red", "o-"),
    ORACLE: ("black", "*--"),
    COUNTS: ("tab:pink", "o:"),
    **{name: (_COLORS[k % len(_COLORS)], _MARKERS[k % len(_MARKERS)]) for k, name in enumerate(RULES)},
    RANDOM: ("tab:gray", "x"),
}
AXES = {
    "memory": ("BLAS and TLAS, bytes", lambda r: r["blas_bytes"] + r["tlas_bytes"]),
    "time": ("build and trace, seconds", lambda r: r["build_s"] + r["tlas_s"] + r["trace_s"]),
    "active": ("active share of instances", lambda r: r["active"] / r["instances"]),
}
Summary = dict[str, Any]
MARK = "<!-- below: written by lipac evaluate --all -->"


def write(folder: Path, summary: Summary, evaluation: Evaluation) -> None:
    """evaluation.json, evaluation.csv, plots, pictures, report.md, report.html."""
    with replacing(folder / "evaluation.json") as path:
        path.write_text(json.dumps(summary, indent=1, default=float) + "\n")
    columns = list(dict.fromkeys(key for row in summary["rows"] for key in row))
    with replacing(folder / "evaluation.csv") as path, path.open("w", newline="") as stream:
        writer = csv.DictWriter(stream, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(
            {key: f"{value:.6g}" if isinstance(value, float) else value for key, value in row.items()}
            for row in summary["rows"]
        )
    figures = plots(summary)
    for name, figure in figures.items():
        with replacing(folder / f"error_{name}.png") as path:
            figure.savefig(path, dpi=80)
    pictures(folder, summary, evaluation)
    with replacing(folder / "report.md") as path:
        path.write_text(report(summary))
    with replacing(folder / "report.html") as path:
        path.write_text(page(summary, figures, folder / "pictures.jpg"), encoding="utf-8")


def page(summary: Summary, figures: dict[str, Figure], sheet: Path) -> str:
    """report.html: the same as report.md, with figures by `plots` and the sheet of pictures inside."""
    entries = summary["equal_error"]
    broken = [percent(e["error"]) for e in entries if not e["holds"]]
    within = f"Within {len(entries) - len(broken)} of {len(entries)} error budgets"
    shown = opened(sheet)
    return render(
        "evaluation.html",
        fig=Figures(summary),
        summary=summary,
        verdict=Verdict(BAD if broken else GOOD, within, (f"Not within {', '.join(broken)}.",) if broken else ()),
        lines=[line for e in entries for line in verdict(e)],
        rules=", ".join(RULES),
        sheet=None if shown is None else embed(shown),
        curves=[(f"Error against {name}", svg_of(figure, name)) for name, figure in figures.items()],
    )


def plots(summary: Summary) -> dict[str, Figure]:
    """Error against memory, time and active share: mean change and HDR-FLIP, with the noise floor of another seed."""
    from matplotlib.figure import Figure

    out = {}
    for name, (label, cost) in AXES.items():
        out[name] = figure = Figure(figsize=(11, 4.2), layout="constrained")
        for axes, key, text in zip(
            figure.subplots(1, 2), ("mean", "flip"), ("mean relative change of tiles", "HDR-FLIP"), strict=True
        ):
            for policy, (color, style) in STYLE.items():
                # a line goes from setting to setting, by what is kept: seconds follow that but roughly
                rows = sorted((r for r in summary["rows"] if r["policy"] == policy), key=lambda r: r["active"])
                if rows:
                    axes.plot(
                        [cost(r) for r in rows],
                        [max(r[key], 1e-5) for r in rows],
                        style[0] if name == "time" else style,
                        color=color,
                        label=policy,
                        markersize=5,
                        linewidth=1,
                    )
            axes.axhline(
                summary["noise_floor"][key],
                color="gray",
                linewidth=0.8,
                linestyle=":",
                label="another seed, nothing culled",
            )
            axes.set(xlabel=label, ylabel=f"{text} (1e-5: none)", xscale="log", yscale="log")
            axes.grid(alpha=0.3)
        figure.axes[0].legend(fontsize=7)
        figure.suptitle(f"{summary['scene']}, {summary['instances']:,} instances")
    return out


def shown(picture: np.ndarray) -> np.ndarray:
    """A linear picture (H, W, 3), rows bottom up, as sRGB bytes with rows from the top."""
    x = np.clip(picture[::-1], 0, 1)
    return (np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055) * 255 + 0.5).astype(np.uint8)


def pictures(folder: Path, summary: Summary, evaluation: Evaluation) -> None:
    """One sheet: the full picture by two seeds, and for the 1 % budget ours, the oracle and the best heuristic of no
    more instances, each with its FLIP map."""
    from matplotlib import colormaps

    from ...core.evaluation.metrics import flip_hdr

    rows, full = summary["rows"], evaluation.pictures[0]
    sheet = [np.concatenate([shown(full), shown(evaluation.judge.second_seed[..., :3])])]
    for k in chosen(rows):
        difference, _ = flip_hdr(full, evaluation.pictures[k])
        sheet.append(
            np.concatenate([shown(evaluation.pictures[k]), colormaps["magma"](difference[::-1], bytes=True)[..., :3]])
        )
    with replacing(folder / "pictures.jpg") as path:
        save(strip([column[..., :3] for column in sheet], labels(rows)), path)


def labels(rows: list[dict[str, Any]]) -> list[str]:
    """What stands above the columns of the sheet."""
    kept = [f"{rows[k]['policy']}: {rows[k]['active']:,} instances; below: FLIP" for k in chosen(rows)]
    return ["everything; below: another seed", *kept]


def chosen(rows: list[dict[str, Any]]) -> list[int]:
    """Rows of the sheet: ours and the oracle at 1 %, and the heuristic of least error among those that keep at most 1.2
    times as much as ours."""
    find = {(r["policy"], r["setting"]): k for k, r in enumerate(rows)}
    ours = find[OURS, BUDGETS[1]]
    like = [k for k, r in enumerate(rows) if r["policy"] in RULES and r["active"] <= 1.2 * rows[ours]["active"]]
    return [ours, find[ORACLE, BUDGETS[1]], *([min(like, key=lambda k: rows[k]["mean"])] if like else [])]


def percent(x: float) -> str:
    """A share as a percentage."""
    return f"{100 * x:.3g} %"


def equal_error_table(entries: list[tuple[str, dict[str, Any]]]) -> str:
    """Markdown: per scene and budget what is kept by ours, by the oracle and by the best heuristic."""
    head = (
        "scene",
        "E",
        "measured mean",
        "worst tile",
        "in bounds",
        "instances",
        "oracle",
        "heuristic",
        "BLAS",
        "oracle",
        "heuristic",
        "to oracle",
    )
    rows: list[tuple[str, ...]] = [head]
    for name, e in entries:
        ratio = [e[key] / max(e[f"{key}_oracle"], 1) for key in ("active", "blas_bytes")]
        rows.append(
            (
                name,
                percent(e["error"]),
                percent(e["mean"]),
                percent(e["worst"]),
                "yes" if e["holds"] else "NO",
                *(f"{e[f'active{who}']:,}" for who in ("", "_oracle")),
                f"{e['active_heuristic']:,} ({e['active_heuristic_policy']})",
                *(size(e[f"blas_bytes{who}"]) for who in ("", "_oracle", "_heuristic")),
                f"{ratio[0]:.2f}, {ratio[1]:.2f}" + ("" if max(ratio) <= 1.25 else " (over 1.25)"),
            )
        )
    return markdown(rows)


def report(summary: Summary) -> str:
    """report.md: which policy wins where, and where ours loses."""
    entries = summary["equal_error"]
    lines = [f"# {summary['scene']}: cost against error", ""]
    lines += [
        f"{summary['instances']:,} instances, {summary['size'][0]} x {summary['size'][1]}, judged by "
        f"{summary['samples']} paths per pixel. {measured_by(summary)}",
        "",
    ]
    lines += [
        "'E' bounds the mean relative change of the picture's tiles, 5 E that of its worst tile. Heuristic: the "
        "cheapest setting of"
    ]
    lines[-1] += (
        f" {', '.join(RULES)} that keeps both bounds. Last column: ours over the oracle, instances and BLAS bytes."
    )
    lines += [""]
    lines += [equal_error_table([(summary["scene"], e) for e in entries]), ""]
    lines += [f"- {line}" for e in entries for line in verdict(e)]
    floor = summary["noise_floor"]
    lines += [
        "",
        f"Two seeds of the full picture differ by {percent(floor['mean'])} in the mean, {percent(floor['worst'])} in "
        "the worst tile,",
    ]
    lines[-1] += (
        f" HDR-FLIP {floor['flip']:.4f}, relMSE {floor['relmse']:.4f}; culling is judged with equal random numbers, "
        "and so far below that."
    )
    if "budget_check" in summary:
        lines += ["", f"Budget check: {held(summary['budget_check'])}."]
    if "ray_budget" in summary:
        lines += ["", "Paths and boxes that the states need (E = 1 %):", "", ray_budget_table(summary["ray_budget"])]
    if "cycles" in summary:
        full, culled = summary["cycles"]["full"], summary["cycles"]["culled"]
        lines += ["", f"Cycles: {full['render_s']:.2f} s and {size(full['peak_bytes'])} full,"]
        lines[-1] += f" {culled['render_s']:.2f} s and {size(culled['peak_bytes'])} culled (defaults)."
    lines += ["", *(f"![Error against {name}](error_{name}.png)\n" for name in AXES)]
    lines += ["![Full picture and another seed; ours, oracle, best heuristic as large, with FLIP maps](pictures.jpg)"]
    return wrapped("\n".join(lines))


def held(check: dict[str, Any]) -> str:
    """In words, of `core.evaluation.evaluate.budget_check`."""
    line = f"the measured error stays in both bounds in {check['holding']} of {check['cases']} cases"
    line += f" ({check['seeds']} seeds)"
    if "broken" in check:
        most = max((c["judged_by"] for c in check["each"]), default=0)
        line += f", surely so in {check['surely_holding']}; it is surely beyond one in {check['broken']}"
        line += f" (judged by up to {most} paths per pixel, until noise does not decide)"
    return line


def verdict(e: dict[str, Any]) -> list[str]:
    """One budget in words."""
    out = []
    who = f"E = {percent(e['error'])}"
    if not e["holds"]:
        out.append(
            f"{who}: ours leaves the budget: {percent(e['mean'])} in the mean, {percent(e['worst'])} in the worst tile."
        )
    for key, what in (("active", "instances"), ("blas_bytes", "BLAS bytes")):
        ours, oracle, heuristic = max(e[key], 1), max(e[f"{key}_oracle"], 1), max(e[f"{key}_heuristic"], 1)
        policy, share = e[f"{key}_heuristic_policy"], heuristic / ours
        best = "a scene with nothing culled" if policy == "none" else f"the best heuristic ({policy})"
        if share < 0.995:
            kept = f"{1 / share:.2f} times as many {what} as {best}"
        elif f"{share:.3g}" == "1":
            kept = f"as many {what} as {best}"
        else:
            kept = f"1/{share:.3g} of the {what} of {best}"
        out.append(f"{who}: ours keeps {kept}, {ours / oracle:.2f} times the oracle's.")
    return out


def ray_budget_table(rows: list[dict[str, Any]]) -> str:
    """Markdown of `core.evaluation.evaluate.ray_budget`."""
    head = ("paths per pixel", "one path in", "rounds", "active", "mean", "worst tile", "in bounds", "rays")
    body = [
        (
            str(r["paths"]),
            str(r["hitbox_every"]),
            str(r["iterations"]),
            f"{r['active']:,}",
            percent(r["mean"]),
            percent(r["worst"]),
            "yes" if r["holds"] else "NO",
            f"{r['rays']:,}",
        )
        for r in rows
    ]
    return markdown([head, *body])


def write_results(folder: Path) -> str:
    """Replace what results.md beside the folder has after MARK, or begin it; returns that part."""
    text, page = results(folder), folder.parent / "results.md"
    head = page.read_text().split(MARK)[0] if page.exists() else "# Results\n\n"
    with replacing(page) as part:
        part.write_text(f"{head}{MARK}\n\n{text}")
    return text


def results(folder: Path) -> str:
    """What results.md has after MARK: the table over all scenes in folder, whose evaluations are done."""
    summaries = [json.loads(path.read_text()) for path in sorted(folder.glob("*/evaluation.json"))]
    entries = [(Path(s["scene"]).stem, e) for s in summaries for e in s["equal_error"]]
    lines = [
        "Regenerated by `make results` (`lipac evaluate --all -o docs/results`). The demo scenes are made; the "
        "[others](#the-scenes) are not in the repository: `--scenes DIR` says where they are, and "
        "`lipac evaluate SCENE` measures any scene. 'E' bounds the mean [error](error.md) of the picture's 16 x 9 "
        "tiles, 5 E that of the worst one. Measured by traces with equal random numbers that the analysis did not use.",
    ]
    made = sorted({s["made_by"] for s in summaries if "made_by" in s})
    lines += [f"Measured by {'; '.join(made)}."] if made else []
    unknown = [Path(s["scene"]).stem for s in summaries if "made_by" not in s]
    lines += [f"Measured by code that did not note its version: {', '.join(unknown)}."] if unknown else []
    judged = ", ".join(f"{s['samples']}" for s in summaries)
    lines += [f"Paths per pixel of those traces, by scene: {judged}."]
    lines += [
        "Oracle: the cheapest set found that keeps both bounds with 95 % confidence in each tile "
        "(core/evaluation/oracle.py)."
    ]
    lines += ["Heuristic: the cheapest setting that keeps both bounds."]
    lines += [
        "To oracle: instances and BLAS bytes that ours keeps over those of the oracle; the aim is 1.25. Where ours is "
        "over it, or a heuristic's: an analysis decides by a few paths per pixel, and what these cannot certify stays, "
        "with other random numbers, too; the oracle searches by all the judge's paths, which a user would not wait for."
    ]
    checks = [s["budget_check"] for s in summaries if "budget_check" in s]
    if checks:
        holding, cases = (sum(c[key] for c in checks) for key in ("holding", "cases"))
        lines += [
            "",
            f"Over all scenes and seeds both bounds hold in {holding} of {cases} analyses, {percent(holding / cases)}.",
        ]
        if all("broken" in c for c in checks):
            lines[-1] += f" Surely beyond a bound, by {SURE:.0f} deviations: {sum(c['broken'] for c in checks)}."
    lines += ["", equal_error_table(entries), ""]
    for s in summaries:
        name = Path(s["scene"]).stem
        lines += [
            f"## {name}",
            "",
            f"{s['instances']:,} instances; [report](results/{name}/report.md), "
            f"[figures](results/{name}/evaluation.csv).",
            "",
        ]
        lines += [f"- {line}" for e in s["equal_error"] for line in verdict(e)]
        if "budget_check" in s:
            lines += ["", f"Four budgets: {held(s['budget_check'])}."]
        lines += ["", f"![Error against active share](results/{name}/error_active.png)", ""]
    return wrapped("\n".join(lines)) + sections(folder)
