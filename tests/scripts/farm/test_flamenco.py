"""The job type of Flamenco: compiled by a JavaScript engine, compared with the graph, and its commands done in
order."""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import bpy
import pytest
from py_mini_racer import JSEvalException, MiniRacer

from lipac.lipac_addon.farm.jobs import flamenco
from lipac.lipac_addon.farm.jobs.graph import ITEMS, LIPAC, Programs, graph
from lipac.lipac_addon.farm.layout import FarmShot, read_json
from lipac.scripts.lipac import main

from .conftest import FARM
from .same import assert_same_shot

MANAGER = Path(__file__).with_name("flamenco_manager.js")
STAND_IN = Path(__file__).with_name("blender_stand_in.py")
TYPES = {"string": str, "int32": int, "float": float, "bool": bool}


@pytest.fixture(scope="module")
def manager() -> MiniRacer:
    """The engine with the script loaded."""
    engine = MiniRacer()
    engine.eval(MANAGER.read_text())
    engine.eval(flamenco.JOB_TYPE.read_text())
    return engine


def compiled(manager: MiniRacer, **settings: Any) -> list[dict[str, Any]]:
    given = {
        "frames": "1-8",
        "chunk_size": 3,
        "max_error": 0.01,
        "verify": 0,
        "shot_folder": "/farm/shot",
        "lipac": "lipac",
        "blendfile": "/farm/a.blend",
    }
    tasks: list[dict[str, Any]] = json.loads(manager.call("compiled", given | settings))
    return tasks


def test_settings_are_as_the_manager_knows_them(manager: MiniRacer) -> None:
    """By the schema AvailableJobSetting of its API; what Blender fills in can be evaluated."""
    job_type = json.loads(str(manager.eval("JSON.stringify(JOB_TYPE)")))
    known = {
        "key", "type", "subtype", "choices", "propargs", "description", "label", "default", "eval", "evalInfo",
        "visible", "required", "editable"
    }
    for setting in job_type["settings"]:
        assert setting.keys() <= known
        assert setting["visible"] in ("visible", "hidden", "submission", "web") if "visible" in setting else True
        assert isinstance(setting["default"], TYPES[setting["type"]]) if "default" in setting else True
    evals = {setting["key"]: setting["eval"] for setting in job_type["settings"] if "eval" in setting}
    names = {"C": bpy.context, "Path": Path, "abspath": lambda text: Path("/scenes"), "jobname": "shot 3"}
    bpy.context.scene.frame_start, bpy.context.scene.frame_end = 5, 47
    assert {key: eval(code, {}, names) for key, code in evals.items()} == {
        "frames": "5-47",
        "shot_folder": "/scenes/lipac/shot 3",
    }


@pytest.mark.parametrize(("last", "chunk", "verify"), [(8, 3, 0), (1, 10, 0), (250, 10, 0), (60, 7, 5)])
def test_tasks_are_those_of_the_graph(manager: MiniRacer, last: int, chunk: int, verify: int) -> None:
    """Names, arguments and dependencies; before them the job is written."""
    checks = min(last, verify or max(2, -(-last // 25)))
    shot = FarmShot(Path("/farm/shot"), Path("/farm/a.blend"), "", 1, last, checks=checks)
    steps = graph(shot, chunk, Programs(("lipac", "shot"), ("{blender}", "--python")))
    tasks = compiled(manager, frames=f"1-{last}", chunk_size=chunk, verify=verify)
    assert tasks[0]["name"] == "prepare"
    names = {"prepare": ["prepare"]} | {
        step.name: [f"{step.name}-{items}" if items else step.name for items in step.chunks()] for step in steps
    }
    assert [task["name"] for task in tasks] == [name for stage in names.values() for name in stage]
    after = {
        name: [one for before in (step.after or ("prepare",)) for one in names[before]]
        for step in steps
        for name in names[step.name]
    }
    assert {task["name"]: task["dependencies"] for task in tasks} == {"prepare": []} | after
    found = {task["name"]: task["commands"] for task in tasks}
    values = {"<folder>": "/farm/shot", "<scene>": "/farm/a.blend", "<blender>": "{blender}"}
    for step in steps:
        for name, items in zip(names[step.name], step.chunks(), strict=True):
            (command,) = found[name]
            arguments = step.filled(values | {ITEMS: items})
            if step.program == LIPAC:
                assert command["name"] == "exec"
                assert command["parameters"] == {"exe": "lipac", "args": arguments}
            else:
                assert command["name"] == "blender-render"
                assert command["parameters"]["blendfile"] == "/farm/shot/shot.blend"
                assert command["parameters"]["args"] == ["--python-exit-code", "1", *arguments]
                ends = [int(end) for end in items.split("-")]
                assert command["totalStepCount"] == ends[-1] - ends[0] + 1


@pytest.mark.parametrize("frames", ["", "1-", "5-3", "1-10,20-25", "a", "-3"])
def test_frames_with_gaps_or_none_are_refused(manager: MiniRacer, frames: str) -> None:
    with pytest.raises(JSEvalException, match=re.escape(f"'{frames}' is no range of frames")):
        compiled(manager, frames=frames)


def test_its_commands_in_order_give_the_shot(
    manager: MiniRacer, flythrough: Path, one_process: FarmShot, tmp_path: Path
) -> None:
    """As a worker runs them, with Python in Blender's place: the pictures of one process, and a certificate."""
    first = tmp_path / "first"
    assert main(["farm", str(flythrough), "-o", str(first), "--for", "flamenco", *FARM, "--verify", "1"]) == 0
    job = json.loads((first / "flamenco_job.json").read_text())
    assert job["type"] == "lipac-shot"
    assert (first / "lipac_shot.js").read_text() == flamenco.JOB_TYPE.read_text()
    folder = tmp_path / "shot"
    tasks = compiled(manager, **job["settings"] | {"shot_folder": str(folder)})
    done: list[str] = []
    for task in tasks:
        assert set(task["dependencies"]) <= set(done), "the manager would run it later"
        for command in task["commands"]:
            given = command["parameters"]
            if command["name"] == "exec":
                line = [given["exe"], *given["args"]]
            else:
                exe = {"{blender}": sys.executable, "{blenderArgs}": shlex.quote(str(STAND_IN))}
                line = [
                    exe[given["exe"]],
                    *shlex.split(exe[given["exeArgs"]]),
                    *given["argsBefore"],
                    given["blendfile"],
                    *given["args"],
                ]
            line = [sys.executable if word == "{blender}" else word for word in line]
            ran = subprocess.run(line, capture_output=True, text=True, timeout=200, check=False)
            assert ran.returncode == 0, f"{line}\n{ran.stdout}\n{ran.stderr}"
            if command["name"] == "blender-render":
                assert (
                    len(re.findall(r"^Saved: '.*/frame_\d{4}\.png'$", ran.stdout, re.MULTILINE))
                    == command["totalStepCount"]
                )
        done.append(task["name"])
    assert FarmShot.load(folder).key == FarmShot.load(first).key
    assert_same_shot(FarmShot.load(folder), one_process)
    assert (read_json(folder / "certificate.json") or {})["verified"] == 1
