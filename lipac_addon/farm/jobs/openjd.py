"""A shot as a job template of Open Job Description, 2023-09 (github.com/OpenJobDescription/openjd-specifications,
Template Schemas), with task chunks."""

from __future__ import annotations

from typing import Any

from ....core.files.shell import quoted
from ..layout import FarmShot, write_json
from .graph import BLENDER, FOLDER, FRAMES, ITEMS, LIPAC, SCENE, Programs, Step

TEMPLATE = "template.json"
NOTICE = 30  # seconds between asking a task to end, and ending it
MIB = 2**20
_VALUES = {FOLDER: "{{Param.Folder}}", SCENE: "{{Param.Scene}}", BLENDER: "{{Param.Blender}}"}


def template(name: str, steps: list[Step]) -> dict[str, Any]:
    """The job template. name: of the job. It names no path of this machine: values of its parameters do (`values`)."""
    chunk = next(step.chunk for step in steps if step.of == FRAMES)
    folder = "Where all of the shot is, on a folder that all machines share"
    parameters = [
        {
            "name": "Folder",
            "type": "PATH",
            "objectType": "DIRECTORY",
            "dataFlow": "INOUT",
            "default": ".",
            "description": folder,
        },
        {"name": "Scene", "type": "PATH", "objectType": "FILE", "dataFlow": "IN", "description": "The scene"},
        {"name": "LiPaC", "type": "STRING", "default": "lipac", "description": "The lipac command"},
        {
            "name": "Blender",
            "type": "STRING",
            "default": "blender",
            "description": "The Blender that renders; it need not have LiPaC",
        },
        {"name": "ChunkSize", "type": "INT", "minValue": 1, "default": chunk, "description": "Frames to a task"},
    ]
    return {
        "specificationVersion": "jobtemplate-2023-09",
        "extensions": ["TASK_CHUNKING"],
        "name": name,
        "parameterDefinitions": parameters,
        "steps": [_step(step) for step in steps],
    }


def write(shot: FarmShot, steps: list[Step], programs: Programs) -> str:
    """Write the template, and its parameters' values on this machine, into the shot's folder: for `openjd run` and as
    Deadline Cloud's job bundles have them.

    Returns how it is run.
    """
    values = {
        "Folder": str(shot.folder),
        "Scene": str(shot.scene),
        "LiPaC": programs.lipac[0],
        "Blender": programs.blender[0],
    }
    path, given = shot.folder / TEMPLATE, shot.folder / "parameters.json"
    write_json(path, template(f"{shot.scene.stem} {shot.first}-{shot.last}", steps))
    write_json(given, values)
    write_json(
        shot.folder / "parameter_values.json",
        {"parameterValues": [{"name": name, "value": value} for name, value in values.items()]},
    )
    parameters = quoted(f"file://{given}")
    return f"openjd run {quoted(path)} -p {parameters} --step {steps[-1].name} --run-dependencies"


def _step(step: Step) -> dict[str, Any]:
    task = f"{{{{Task.Param.{step.of}}}}}" if step.of else ""
    run = {
        "command": "{{Param.LiPaC}}" if step.program == LIPAC else "{{Param.Blender}}",
        "args": step.filled(_VALUES | {ITEMS: task}),
        "timeout": step.timeout,
        "cancelation": {"mode": "NOTIFY_THEN_TERMINATE", "notifyPeriodInSeconds": NOTICE},
    }
    out: dict[str, Any] = {"name": step.name, "script": {"actions": {"onRun": run}}}
    if step.after:
        out["dependencies"] = [{"dependsOn": name} for name in step.after]
    if step.of:
        out["parameterSpace"] = {"taskParameterDefinitions": [_items(step)]}
    if step.memory:
        out["hostRequirements"] = {"amounts": [{"name": "amount.worker.memory", "min": -(-step.memory // MIB)}]}
    return out


def _items(step: Step) -> dict[str, Any]:
    whole = f"{step.items[0]}-{step.items[-1]}" if len(step.items) > 1 else f"{step.items[0]}"
    if step.of != FRAMES:
        return {"name": step.of, "type": "INT", "range": whole}
    return {
        "name": step.of,
        "type": "CHUNK[INT]",
        "range": whole,
        "chunks": {"defaultTaskCount": "{{Param.ChunkSize}}", "rangeConstraint": "CONTIGUOUS"},
    }
