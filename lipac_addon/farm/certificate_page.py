"""The certificate as a page to read: one file, nothing loaded from elsewhere."""

from __future__ import annotations

from html import escape
from typing import Any

from ...core.files.report import size
from ...core.progress import clock

STYLE = (
    "body{max-width:60em;margin:2em auto;padding:0 1em;font:16px/1.5 sans-serif}table{border-collapse:collapse}"
    "td,th{padding:.2em .7em;text-align:right;border-bottom:1px solid "
    "#ccc}svg{width:100%;height:auto}.bad{color:#b00020;font-weight:bold}"
)
WIDTH, HEIGHT, MARGIN = 800, 200, 40


def page(certificate: dict[str, Any]) -> str:
    """The page, from what `certify` writes as JSON."""
    status = "above the budget" if certificate["broken"] else "within the budget where it was measured"
    heading = f"<h1>{escape(certificate['scene'])}: {len(certificate['frames'])} frames, {status}</h1>"
    said = "".join(f"<p>{escape(line)}</p>" for line in certificate["statement"])
    warnings = "".join(f"<li>{escape(line)}</li>" for line in certificate["warnings"])
    made = (
        f"LiPaC {certificate['lipac']}, Blender {certificate['blender']}, job {certificate['key'][:12]}, set "
        f"{certificate['set'][:12]}"
    )
    parts = [
        heading,
        said,
        f"<ul>{warnings}</ul>" if warnings else "",
        _chart(certificate),
        _costs(certificate),
        _table(certificate),
        f"<p>{escape(made)}</p>",
    ]
    title = f"<title>{escape(certificate['scene'])}: certificate</title>"
    return (
        f"<!doctype html><html lang=en><meta charset=utf-8>{title}<style>{STYLE}</style>\n"
        + "\n".join(filter(None, parts))
        + "\n</html>\n"
    )


def _chart(certificate: dict[str, Any]) -> str:
    """Measured mean change by frame, as SVG: first attempts, what was delivered, and the bound."""
    frames, bound = certificate["frames"], certificate["max_error"][0]
    first, last = frames[0]["frame"], frames[-1]["frame"]
    points = [
        (f["frame"], a["verified_mean"], k == len(f["verified"]["attempts"]) - 1)
        for f in frames
        if f["verified"]
        for k, a in enumerate(f["verified"]["attempts"])
    ]
    top = 1.1 * max([bound, *(error for _, error, _ in points)], default=1.0) or 1.0

    def at(frame: float, error: float) -> tuple[float, float]:
        return MARGIN + (frame - first) / max(last - first, 1) * (WIDTH - 2 * MARGIN), HEIGHT - MARGIN - error / top * (
            HEIGHT - 2 * MARGIN
        )

    (left, line), (right, _), (_, zero) = at(first, bound), at(last, bound), at(first, 0)
    dots = []
    for frame, error, delivered in points:
        x, y = at(frame, error)
        colour = "#1f77b4" if delivered else "none"
        dots.append(
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" fill="{colour}" stroke="#1f77b4"><title>frame {frame}: '
            f"{100 * error:.3g} %</title></circle>"
        )
    axes = (
        f'<path d="M{left:.1f} {zero:.1f}H{right:.1f}" stroke="#333"/><path d="M{left:.1f} '
        f'{line:.1f}H{right:.1f}" stroke="#b00020" stroke-dasharray="4"/>'
    )
    words = (
        f'<text x="{left:.1f}" y="{zero + 20:.1f}">frame {first}</text><text x="{right:.1f}" y="{zero + 20:.1f}" '
        f'text-anchor="end">{last}</text>'
    )
    words += f'<text x="{left:.1f}" y="{line - 5:.1f}" fill="#b00020">{100 * bound:.3g} % allowed in the mean</text>'
    caption = (
        "<figcaption>Measured mean change of the picture. Full dots are what was delivered, empty ones were "
        "mended.</figcaption>"
    )
    svg = (
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" font-size="12" role="img" aria-label="measured change by '
        f'frame">{axes}{words}{"".join(dots)}</svg>'
    )
    return f"<figure>{svg}{caption}</figure>"


def _costs(certificate: dict[str, Any]) -> str:
    """Seconds and memory."""
    seconds, peak = certificate["seconds"], certificate["peak_bytes"]
    rows = [
        ("analysis", clock(seconds["analysis"]), size(peak["analysis"])),
        ("union", clock(seconds["unite"]), size(peak["unite"])),
        ("render, culled", clock(seconds["render"]), size(peak["render"])),
        ("verification", clock(seconds["verify"]), size(peak["crops_full"])),
    ]
    if seconds["full"] is not None:
        spent = sum(seconds[name] for name in ("analysis", "unite", "render", "verify"))
        rows.append(("render in full, estimated", clock(seconds["full"]), size(peak["crops_full"])))
        rows.append(
            (
                "saved, estimated" if seconds["full"] >= spent else "lost, estimated",
                clock(abs(seconds["full"] - spent)),
                "",
            )
        )
    body = "".join(f"<tr><th>{name}</th><td>{time}</td><td>{memory}</td></tr>" for name, time, memory in rows)
    note = (
        "Seconds are summed over machines. The estimate takes the crops' seconds in full over those culled, in which "
        "Blender's preparation of the scene "
        f"weighs more than in whole pictures. Of the crops, {size(peak['crops_culled'])} were held culled and "
        f"{size(peak['crops_full'])} in full."
    )
    return f"<h2>Cost</h2><table><tr><th></th><th>time</th><th>peak memory</th></tr>{body}</table><p>{note}</p>"


def _table(certificate: dict[str, Any]) -> str:
    """A row for each frame of the sample and each that was mended."""
    rows = []
    for frame in certificate["frames"]:
        for attempt in (frame["verified"] or {"attempts": []})["attempts"]:
            measured = "".join(
                f"<td>{100 * attempt[f'verified_{name}']:.3g} %</td>"
                for name in ("mean", "worst", "least_mean", "least_worst")
            )
            state = "<td class=bad>above</td>" if attempt["broken"] else "<td>within</td>"
            tried = {"": "the shot's set", "all": "everything kept"}.get(
                attempt["mended"], f"analysed again, {100 * attempt['max_error'][0]:.2g} %"
            )
            rows.append(f"<tr><td>{frame['frame']}</td><td>{tried}</td>{measured}{state}</tr>")
    head = "".join(
        f"<th>{name}</th>" for name in ("frame", "set", "mean", "worst tile", "mean, surely", "worst, surely", "budget")
    )
    return f"<h2>Frames that were verified</h2><table><tr>{head}</tr>{''.join(rows)}</table>"
