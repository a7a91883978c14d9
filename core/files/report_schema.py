"""What report.json and the files of states hold, as tables.

docs/reference.md and the JSON Schema are written from them; tests hold files against them.
"""

from __future__ import annotations

from typing import Any

from .report import FIELDS, HEADER, SCHEMA

COUNT: dict[str, Any] = {"type": "integer", "minimum": 0}
NUMBER: dict[str, Any] = {"type": "number"}
SHARE: dict[str, Any] = {"type": "number", "minimum": 0}
TEXT: dict[str, Any] = {"type": "string"}
LINES: dict[str, Any] = {"type": "array", "items": TEXT}
COUNTS: dict[str, Any] = {"type": "object", "additionalProperties": COUNT}

# Name: its type, and what it says
TOP: dict[str, tuple[dict[str, Any], str]] = {
    "schema": ({"const": SCHEMA}, "version of this format"),
    "scene": (TEXT, "the scene's file, as given"),
    "blender": (TEXT, "version of Blender"),
    "lipac": (TEXT, "version of LiPaC"),
    "policy": (TEXT, "what decided: `--cull`"),
    "engine": (TEXT, "what rendered; empty for `lipac analyze`"),
    "seed": (COUNT, "of all random numbers"),
    "threads": (COUNT, "of the analysis"),
    "frames": ({"type": "array"}, "one entry for each finished frame, in order"),
    "totals": ({"type": "object"}, "over all frames"),
    "approximated": (
        LINES,
        "what the analysis, or an engine of ours, shows otherwise than Blender does, without repetitions",
    ),
    "warnings": (LINES, "other lines for the user, without repetitions"),
    "options": ({"type": "object"}, "whatever else the results depend on, by name"),
}

FRAME: dict[str, tuple[dict[str, Any], str]] = {
    "frame": ({"type": "integer"}, "its number"),
    # Decision
    "instances": (COUNT, "instances of the scene"),
    "active": (COUNT, "those that stay; with `--bake shot`, in the set of the shot"),
    "pending": (COUNT, "wanted, but their acceleration structure is not there yet (`--blas-budget`)"),
    "culled": (COUNT, "the others"),
    "needed": (
        COUNT,
        "`--bake shot`: instances that this frame brought into the set; missing where the set of the others held",
    ),
    "view_layers": (COUNT, "view layers that were analysed, where there are several"),
    "hitboxes": (COUNT, "boxes that stand in for what is culled"),
    "meshes": (COUNT, "distinct meshes of active instances"),
    "triangles": (COUNT, "of these meshes, each counted once"),
    "parts": (COUNT, "parts of divided meshes"),
    "parts_active": (COUNT, "those that stay"),
    "levels": (COUNT, "`--levels`: meshes that are simplified, or made with fewer levels or points"),
    "levels_triangles": (COUNT, "triangles that these have less, each mesh counted once"),
    # Error, as shares
    "predicted_mean": (SHARE, "change of the mean of tiles that single worths add up to"),
    "predicted_worst": (SHARE, "the same of the worst tile"),
    "calibrated_mean": (SHARE, "change that the search measured by its own paths"),
    "calibrated_worst": (SHARE, "the same of the worst tile"),
    "certified_mean": (SHARE, "upper confidence bound of the change, by paths that did not choose the set"),
    "certified_worst": (SHARE, "the same of the worst tile"),
    "confidence": ({"type": "number", "minimum": 0, "maximum": 1}, "that both bounds hold"),
    "unknown_mean": (SHARE, "light that paths carry through boxes that were not opened; part of `certified_mean`"),
    "unknown_worst": (SHARE, "the same of the worst tile"),
    "verified_mean": (SHARE, "`--verify`: change of the tiles of rendered crops, by luminance, colour and alpha, mean"),
    "verified_worst": (SHARE, "the same of the worst tile of them"),
    "verified_least_mean": (NUMBER, "what is left of it when what noise may make is taken off"),
    "verified_least_worst": (NUMBER, "the same of the worst tile"),
    "verified_crops": (
        {"type": "array", "items": {"type": "array", "items": COUNT}},
        "column and row of each crop, rows from the bottom",
    ),
    "verified_grid": ({"type": "array", "items": COUNT}, "columns and rows of parts that crops are picked from"),
    "verified_tiles": (
        {"type": "array", "items": {"type": "array", "items": SHARE}},
        "change of each tile of each crop, in rows from the bottom",
    ),
    "enforced": (COUNT, "`--enforce`: how often the frame was analysed again"),
    # Work
    "paths": (COUNT, "paths traced by the analysis"),
    "rays": (COUNT, "rays of them"),
    "iterations": (COUNT, "rounds before the measurement"),
    "calibration_paths": (COUNT, "paths traced again by the search"),
    "certificate_paths": (COUNT, "paths of the certificate"),
    "blas_built": (COUNT, "acceleration structures of meshes that were built"),
    "blas_refitted": (COUNT, "and refitted"),
    # Bytes
    "blas_bytes": (COUNT, "bytes of the acceleration structures of active meshes, by Embree's own count"),
    "blas_held_bytes": (COUNT, "of all that are held"),
    "tlas_bytes": (COUNT, "bytes of the structure over active instances and hitboxes"),
    "analysis_peak_bytes": (COUNT, "peak memory of the process that analysed ahead"),
    "memory_bytes": (COUNT, "what the process that renders by Cycles on the CPU is predicted to take"),
    "memory_error_bytes": (COUNT, "by which it is not expected to exceed that"),
    "memory_limit_bytes": (COUNT, "`--memory`"),
    "device_bytes": (
        {"type": ["integer", "null"]},
        "most of the graphics card's memory by Cycles' count; null where Blender does not say",
    ),
    # Seconds
    "sync_s": (SHARE, "seconds of reading the frame from Blender"),
    "build_s": (SHARE, "of building acceleration structures"),
    "blas_s": (SHARE, "of these, of meshes"),
    "refit_s": (SHARE, "of refitting"),
    "trace_s": (SHARE, "of tracing"),
    "feedback_s": (SHARE, "of deciding by what was traced"),
    "writeback_s": (SHARE, "of taking what is culled out of Blender"),
    "render_s": (SHARE, "of rendering"),
    "first_sample_s": (
        {"type": ["number", "null"]},
        "until the engine told of its first sample; null where it does not say",
    ),
    "verify_s": (SHARE, "of verifying"),
    "verified_full_s": (SHARE, "of these, of rendering the crops in full"),
    "verified_culled_s": (SHARE, "and culled"),
    "wait_s": (SHARE, "that a frame waited for an analysis ahead"),
    "overlap_s": (SHARE, "`hybrid`: seconds in which two threads worked at once"),
    "raster_s": (SHARE, "`hybrid`: of EEVEE and first hits"),
    # Other
    "device": (TEXT, "what the engine rendered on"),
    "not_analysed": (TEXT, "why nothing was culled, where culling could save nothing"),
    "writeback": (
        {
            "type": "object",
            "properties": {
                **dict.fromkeys(
                    (
                        "removed",
                        "hidden_objects",
                        "masked_hosts",
                        "particle_hosts",
                        "face_hosts",
                        "faces_removed",
                        "simplified_objects",
                        "emptied_sources",
                    ),
                    COUNT,
                ),
                "kept": COUNTS,
                "whole": COUNTS,
            },
            "additionalProperties": False,
        },
        "how culling was written into Blender: instances `removed`; how many stay all the same (`kept`), and objects "
        "that keep all faces (`whole`), by reason",
    ),
    "timeline": (
        {"type": "array", "items": {"type": "object"}},
        "`hybrid`: stages by thread, with begin and end in seconds",
    ),
    "render_rays": (COUNT, "`hybrid`: rays of the picture"),
    "path_share": (SHARE, "`hybrid`: share of the picture that paths have made"),
}

TOTALS: dict[str, tuple[dict[str, Any], str]] = {
    "frames": (COUNT, "how many"),
    **{
        name: FRAME[name]
        for name in ("sync_s", "build_s", "trace_s", "feedback_s", "writeback_s", "render_s", "verify_s")
    },
    **{name: FRAME[name] for name in ("blas_built", "paths", "rays", "iterations")},
    "blas_bytes": (COUNT, "the most of any frame"),
    "tlas_bytes": (COUNT, "the most of any frame"),
    "wall_s": (SHARE, "seconds of the commands, all that they did included"),
    "peak_bytes": (COUNT, "peak memory of the process; 0: unknown"),
}

# Array: dtype kinds, shape, what it says
STATES: dict[str, tuple[str, tuple[str | int, ...], str]] = {
    "state": ("u", ("N",), "0 culled, 1 pending, 2 active"),
    "score": (
        "f",
        ("N",),
        "share of the picture that the instance is worth at most; with `--min-share`, of the paths that met it",
    ),
    "hits": ("u", ("N", 5), "rays that met it, by type: camera, diffuse, glossy, transmission, shadow"),
    "key_kind": ("iu", ("N",), "how Blender makes the instance"),
    "key_host": ("i", ("N",), "index into `names` of the object that makes it, -1: it is an object of its own"),
    "key_object": ("i", ("N",), "index into `names` of the instanced object"),
    "key_path": ("i", ("N", "depth"), "persistent ids, as of Blender's dependency graph"),
    "names": ("U", ("K",), "names of objects, sorted"),
    "certified": ("f", (144,), "by how much each tile of the picture changes at most, where that is certified"),
    "boxes": (
        "f",
        ("H", 2, 3),
        "corners of boxes that stand in for what is culled, in metres, world space; where light paths decide",
    ),
    "face_names": ("U", ("M",), "objects whose mesh was culled by parts, where there are any"),
    "face_counts": ("i", ("M",), "faces of each"),
    "face_bits": ("u", ("B",), "1 for each face that stays, one mesh after the other, as of `numpy.packbits`"),
    "level_names": ("U", ("L",), "objects whose mesh is exchanged for a simplified one, where there are any"),
    "level_counts": ("i", ("L",), "triangles of each"),
    "level_corners": ("i", ("S", 3), "of each triangle of these, one mesh after the other: corners of the whole mesh"),
    "level_faces": ("i", ("S",), "and the face of the whole mesh whose material it has"),
    "coarser_names": ("U", ("C",), "objects whose render levels of subdivision are fewer, where there are any"),
    "coarser_steps": ("u", ("C",), "by how many of each"),
    "note": ("U", (), "a text kept with it, where there is one"),
}


def schema(strict: bool = False) -> dict[str, Any]:
    """The JSON Schema (draft 2020-12) of report.json. strict: nothing is allowed that these tables do not name."""
    more = {} if not strict else {"additionalProperties": False}
    frame = {"type": "object", "properties": _properties(FRAME), "required": list(FIELDS), **more}
    totals = {"type": "object", "properties": _properties(TOTALS), "required": list(TOTALS), **more}
    top = _properties(TOP)
    top["frames"] |= {"items": frame}
    top["totals"] |= totals
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "report.json of LiPaC",
        "type": "object",
        "properties": top,
        "required": ["schema", *HEADER, "threads", "frames", "totals", "approximated", "warnings", "options"],
        **more,
    }


def _properties(table: dict[str, tuple[dict[str, Any], str]]) -> dict[str, dict[str, Any]]:
    return {name: {**kind, "description": text} for name, (kind, text) in table.items()}
