"""Step `certify`: what was rendered, what was measured of it and what was not, as certificate.json."""

from __future__ import annotations

import math
from statistics import fmean
from typing import Any

from ...core.errors import InputError
from ...core.files.atomic import replacing, sweep
from ...core.files.figures import percent
from ...core.files.shell import quoted
from ...page.html import missing
from ...version import __version__
from .analyse import note_of
from .certificate_page import page, worst_of
from .judge import of_frames
from .layout import FarmShot, read_json, rendered_from, write_json
from .verify import ALL, of_sample

CONFIDENCE = 0.95


def certify(shot: FarmShot) -> dict[str, Any]:
    """Write the certificate, as JSON and as a page; returns it. Raises InputError where a picture or a verification is
    missing."""
    united = read_json(shot.united, key=shot.key)
    if united is None:
        raise InputError(f"there is no set yet: run lipac shot unite {quoted(shot.folder)} first")
    lost = [frame for frame in shot.frames if rendered_from(shot, frame, united["set"]) is None]
    if lost:
        raise InputError(
            f"pictures are missing, damaged, or from another set: {_few(lost)}; run lipac shot render "
            f"{quoted(shot.folder)} for these"
        )
    told = of_frames(shot, shot.frames)
    # what killed tasks had begun; now nobody is at work
    for folder in ("analysis", "judged", "pictures", "verified", "mended"):
        sweep(shot.folder / folder, {f"frame_{frame:04}" for frame in shot.frames})
    sample = of_sample(shot)
    if len(sample) < shot.checks:
        looked = {found["frame"] for found in sample}
        unseen = [number for number in range(1, shot.checks + 1) if shot.checked(number) not in looked]
        raise InputError(
            f"not verified: numbers {_few(unseen)} of the sample; run lipac shot verify {quoted(shot.folder)} --check "
            "for these"
        )
    frames = [_frame(shot, one, sample) for one in told]
    certificate = {
        "schema": 1,
        **{
            "scene": shot.scene.name,
            "lipac": __version__,
            "blender": united["blender"],
            "key": shot.key,
            "set": united["set"],
        },
        "max_error": [shot.mean, shot.worst],
        "certified_mean": max(frame["certified"]["mean"] for frame in frames),
        "certified_worst": max(frame["certified"]["worst"] for frame in frames),
        "uncertified": [one["frame"] for one in told if not one["holds"]],
        **{name: united[name] for name in ("instances", "active", "warnings")},
        "verified": len(sample),
        "failed": sum(found["attempts"][0]["broken"] for found in sample),
        "broken": sum(found["attempts"][-1]["broken"] for found in sample),
        "at_most": at_most(sum(found["attempts"][0]["broken"] for found in sample), len(sample))
        if len(sample) < len(frames)
        else None,
        "mended": [found["span"] for found in sample if len(found["attempts"]) > 1],
        "seconds": _seconds(frames, sample, united),
        "peak_bytes": _memory(frames, sample, united),
        "frames": frames,
    }
    certificate["statement"] = statement(certificate)
    write_json(shot.folder / "certificate.json", certificate)
    if not missing():
        worst = worst_of(certificate)
        picture = None if worst is None else shot.picture(certificate["frames"][worst]["frame"])
        with replacing(shot.folder / "certificate.html") as part:
            part.write_text(page(certificate, picture), encoding="utf-8")
    return certificate


def _few(numbers: list[int]) -> str:
    return ", ".join(map(str, numbers[:8])) + (f" and {len(numbers) - 8} more" if len(numbers) > 8 else "")


def _frame(shot: FarmShot, told: dict[str, Any], sample: list[dict[str, Any]]) -> dict[str, Any]:
    """A frame's entry: what it proposed, what paths say of the set that it is delivered with, its render, and what was
    measured where it is of the sample. told: what paths said of the shot's set."""
    frame = told["frame"]
    note, rendered = note_of(shot.analysis(frame)), read_json(shot.rendered(frame)) or {}
    own = {name: note.get(name) for name in ("instances", "active", "seconds", "peak_bytes")}
    found = next((one for one in sample if one["frame"] == frame), None)
    span = next(one for one in sample if one["span"][0] <= frame <= one["span"][1])
    mean, worst = span["attempts"][-1]["certified"][frame - span["span"][0]]
    return {
        "frame": frame,
        "analysis": own,
        "certified": {"mean": mean, "worst": worst},
        "judgement": {name: told[name] for name in ("holds", "seconds", "peak_bytes")},
        "render": {name: rendered[name] for name in ("seconds", "peak_bytes", "mended", "blender")},
        "verified": None if found is None else {name: found[name] for name in ("attempts", "full", "seconds")},
    }


def _seconds(
    frames: list[dict[str, Any]], sample: list[dict[str, Any]], united: dict[str, Any]
) -> dict[str, float | None]:
    """Of machines' work, summed. full: what renders in full would take, by how much longer the crops took in full; None
    where nothing tells."""
    spent = {name: sum(frame[name]["seconds"] for frame in frames) for name in ("analysis", "judgement", "render")}
    first = [(found["full"]["seconds"], found["attempts"][0]["seconds"]) for found in sample]
    ratio = sum(full for full, _ in first) / max(sum(culled for _, culled in first), 1e-9) if first else None
    whole = [frame["render"]["seconds"] for frame in frames if frame["render"]["mended"] == ALL]
    full = None if ratio is None else ratio * (spent["render"] - sum(whole)) + sum(whole)
    return {
        **spent,
        "unite": united["seconds"],
        "verify": sum(found["seconds"] for found in sample),
        "full": full,
        "ratio": ratio,
    }


def _memory(frames: list[dict[str, Any]], sample: list[dict[str, Any]], united: dict[str, Any]) -> dict[str, int]:
    """The largest of processes of each kind, bytes."""
    culled = max(found["attempts"][0]["peak_bytes"] for found in sample)
    analysis = max(frame["analysis"]["peak_bytes"] or 0 for frame in frames)
    judgement = max(frame["judgement"]["peak_bytes"] for frame in frames)
    render = max(frame["render"]["peak_bytes"] for frame in frames)
    full = max(found["full"]["peak_bytes"] for found in sample)
    return {
        "analysis": analysis,
        "unite": united["peak_bytes"],
        "judgement": judgement,
        "render": render,
        "crops_culled": culled,
        "crops_full": full,
    }


def at_most(failed: int, of: int) -> float:
    """Upper bound, at CONFIDENCE, of the share that fails of what a sample was drawn from (Clopper and Pearson 1934,
    one-sided)."""
    low, high = failed / of, 1.0
    for _ in range(60):
        p = (low + high) / 2
        seen = sum(math.comb(of, k) * p**k * (1 - p) ** (of - k) for k in range(failed + 1))
        low, high = (p, high) if seen > 1 - CONFIDENCE else (low, p)
    return high


def verdict(found: dict[str, Any]) -> str:
    """A line about a frame of the sample."""
    tried = [
        f"{percent(one['verified_mean'])} in the mean, {percent(one['verified_worst'])} in the worst tile"
        for one in found["attempts"]
    ]
    first, last = found["attempts"][0], found["attempts"][-1]
    if len(found["attempts"]) == 1:
        return f"frame {found['frame']}: changes by {tried[0]}: {standing(first, found['max_error'])}"
    done = (
        "above the budget still"
        if last["broken"]
        else f"frames {found['span'][0]}-{found['span'][1]} rendered again with more kept"
    )
    if not first["broken"]:
        done += f", for paths do not certify the shot's set in {_these(first['uncertified'])}"
    return f"frame {found['frame']}: changes by {', then '.join(tried)}: {done}"


def standing(attempt: dict[str, Any], bounds: list[float]) -> str:
    """How a measurement stands to the bounds: noise may be what is above them."""
    if attempt["broken"]:
        return "above the budget"
    within = attempt["verified_mean"] <= bounds[0] and attempt["verified_worst"] <= bounds[1]
    return "within the budget" if within else "not surely above the budget: more samples would tell"


def statement(certificate: dict[str, Any]) -> list[str]:
    """What the certificate says, and what it does not, in sentences."""
    frames, n, failed = certificate["frames"], certificate["verified"], certificate["failed"]
    mean, worst = map(percent, certificate["max_error"])
    sure = " and ".join(percent(certificate[name]) for name in ("certified_mean", "certified_worst"))
    attempts = [frame["verified"]["attempts"][-1] for frame in frames if frame["verified"]]
    change, most = fmean(a["verified_mean"] for a in attempts), max(a["verified_worst"] for a in attempts)
    found = f"{percent(change)} in the mean over the sample, {percent(most)} in its worst tile"
    out = [
        f"{certificate['active']:,} of {certificate['instances']:,} instances are in the pictures of all {len(frames)} "
        "frames.",
        f"Paths that chose nothing of that set certify, for each frame with {100 * CONFIDENCE:.0f} % confidence, that "
        f"the picture changes by no more than {mean} in the mean and {worst} in the worst tile. The greatest of these "
        f"bounds is {sure}.",
        f"{n} frames were verified: a random part of each was rendered in full and culled by the Blender that renders. "
        f"As delivered they differ by {found}; "
        f"{mean} and {worst} are allowed. Noise of the renders counts as difference, and a frame fails "
        "where the difference is above a bound by "
        "more than noise can be.",
    ]
    if certificate["mended"]:
        spans = ", ".join(f"{first}-{last}" for first, last in certificate["mended"])
        why = [f"{failed} of them failed at first"] if failed else []
        if certificate["uncertified"]:
            why.append(f"the shot's set was not certified in {_these(certificate['uncertified'])}")
        out.append(
            f"{_sentence('; '.join(why))}. Frames {spans} were analysed again, tighter, and rendered again with more "
            "kept."
        )
    if certificate["broken"]:
        out.append(f"{certificate['broken']} of them are above the budget still.")
    if certificate["at_most"] is not None:
        out.append(
            f"The other {len(frames) - n} frames were not rendered in full: of them paths alone say what changes, "
            "as far as materials are modelled. "
            f"By the sample, at {100 * CONFIDENCE:.0f} % confidence, at most "
            f"{100 * certificate['at_most']:.0f} % of the shot's frames fail such a "
            "verification" + (" before mending." if failed else ".")
        )
    return out


def _these(frames: list[int]) -> str:
    return f"frame{'s' if len(frames) > 1 else ''} {_few(frames)}"


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:]


def summary(certificate: dict[str, Any]) -> str:
    """For the terminal."""
    lost = missing()
    files = "certificate.json holds" if lost else "certificate.html and certificate.json hold"
    why = f"; there is no certificate.html, for this Python has no {', '.join(lost)}" if lost else ""
    found = f"{files} what was found of {len(certificate['frames'])} frames{why}"
    return "\n".join([*certificate["statement"], found])
