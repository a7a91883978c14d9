"""What results say, in words: rows of label and text, and lines for a sidebar."""

from __future__ import annotations

import bpy

from ....core.files.figures import size as decimal
from ... import roles
from ...writeback.marks import COARSER, EMPTIED, HIDDEN, MASKED, PARTICLES, SIMPLIFIED
from ..state import results

LONGEST = 40  # characters of a line in a sidebar of usual width
_HIDDEN = {
    HIDDEN: "all of it",
    MASKED: "instances that it scatters, or faces",
    PARTICLES: "its particles",
    EMPTIED: "what it is made of",
    SIMPLIFIED: "some of its faces",
    COARSER: "levels of its subdivision",
}


def lines(text: str, width: int = LONGEST) -> list[str]:
    """A text broken into lines for labels."""
    from textwrap import wrap

    return wrap(text, width) or [""]


def size(count: float) -> str:
    """Bytes as people read them."""
    for unit in ("B", "KiB", "MiB"):
        if count < 1024:
            return f"{count:.0f} {unit}" if unit == "B" else f"{count:.1f} {unit}"
        count /= 1024
    return f"{count:.1f} GiB"


def change(mean: float, worst: float) -> str:
    """A change of the picture, as short as fits beside its label."""
    shown = (f"{100 * x:.{2 if x < 0.0995 else 1 if x < 0.995 else 0}f} %" for x in (mean, worst))
    return ", worst ".join(shown)


def rows_of(result: results.FrameResult) -> list[tuple[str, str]]:
    """The figures of a result as label and text."""
    stats = result.stats
    total, active = int(stats["instances"]), int(stats["active"])
    rows = [
        ("Instances", f"{total:,}"),
        ("Active", f"{active:,} ({100 * active / max(total, 1):.1f} %)"),
        *([("Pending", f"{int(stats['pending']):,}")] if stats["pending"] else []),
        *(
            [("Parts of meshes", f"{int(stats['parts_active']):,} of {int(stats['parts']):,}")]
            if "parts" in stats
            else []
        ),
        *_levels(stats),
        ("Stand-in boxes", f"{int(stats['hitboxes']):,}"),
        ("BVH memory", size(stats["blas_bytes"] + stats["tlas_bytes"])),
    ]
    for name, label in (
        ("predicted", "Change, predicted"),
        ("certified", "Change, at most"),
        ("unknown", "Unknown light"),
    ):
        if name + "_mean" in stats and not (name == "predicted" and "certified_mean" in stats):
            rows.append((label, change(stats[f"{name}_mean"], stats[f"{name}_worst"])))
    if result.taken is not None:
        rows.append(("Render, predicted", f"{decimal(result.taken.culled)} of {decimal(result.taken.full)}"))
    return rows


def _levels(stats: dict[str, float | int]) -> list[tuple[str, str]]:
    """How many meshes are coarser, where any are."""
    if not stats.get("levels"):
        return []
    return [("Levels of detail", f"{int(stats['levels']):,} meshes, {int(stats['levels_triangles']):,} triangles less")]


def rows_of_difference(found: results.Difference) -> list[tuple[str, str]]:
    """What two renders say."""
    (full_s, culled_s), (full_b, culled_b) = found.seconds, found.peak_bytes
    return [
        ("Time saved", f"{full_s - culled_s:.1f} of {full_s:.1f} s"),
        ("Memory saved", f"{size(full_b - culled_b)} of {size(full_b)}"),
        ("Change, rendered", change(found.mean, found.worst)),
    ]


def rows_of_object(result: results.FrameResult, ob: bpy.types.Object) -> list[tuple[str, str]]:
    """What a result says about an object, and why."""
    reason = result.reason(ob)
    if not reason.instances:
        return []
    what = (
        "kept"
        if reason.kept == reason.instances
        else "culled"
        if not reason.kept
        else f"{reason.kept:,} of {reason.instances:,} kept"
    )
    rows = [("This frame", what)]
    if not result.stats["paths"]:
        return rows
    if reason.kept == reason.instances and _is_pinned(ob, bool(reason.paths.any())):
        why = "it is pinned"
    elif not reason.paths.any():
        why = "no light path meets it" if not reason.kept else "too few light paths looked there to let it go"
    elif not reason.kept:
        why = "few light paths meet it: losing it stays within the budget"
    else:
        why = "light paths meet it"
    rows.append(("Because", why))
    if reason.kept < reason.instances and ob.lipac_role == roles.PIN:
        rows.append(("In renders", "pinned since: kept"))
    rows += [
        (f"{name.capitalize()} paths", f"{int(n):,}") for name, n in zip(results.RAYS, reason.paths, strict=True) if n
    ]
    if reason.worth > 0:
        rows.append(("Worth at most", f"{100 * min(reason.worth, 1.0):.3g} % of the picture"))
    return rows


def rows_of_renders(words: list[str]) -> list[tuple[str, str]]:
    """What is hidden of an object until Restore, from the words of its mark."""
    what = [text for word, text in _HIDDEN.items() if any(w.startswith(word) for w in words)]
    return [("In renders", f"hidden until Restore: {', '.join(what)}")] if what else []


def _is_pinned(ob: bpy.types.Object, met: bool) -> bool:
    """Whether it is pinned. All collections are looked through only for what no light path met."""
    return ob.lipac_role == roles.PIN or (not met and ob in roles.marked(roles.PIN))
