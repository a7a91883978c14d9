"""A shot as a job of Flamenco 3: the job type, which the manager compiles, and a job of it, as its API takes it."""

from __future__ import annotations

import shlex
import shutil
from pathlib import Path

from ....core.files.atomic import replacing
from ....core.files.shell import quoted
from ..layout import FarmShot, write_json
from .graph import Programs

JOB_TYPE = Path(__file__).with_name("lipac_shot.js")


def write(shot: FarmShot, chunk: int, programs: Programs) -> str:
    """Write the job type's script and a job into the shot's folder; returns what is to be done with them. chunk: frames
    to a task."""
    script = shot.folder / JOB_TYPE.name
    with replacing(script) as part:
        shutil.copyfile(JOB_TYPE, part)
    settings = {
        "frames": f"{shot.first}-{shot.last}",
        **{"chunk_size": chunk, "max_error": shot.mean, "verify": shot.checks},
        **{"shot_folder": str(shot.folder), "blendfile": str(shot.scene), "lipac": shlex.quote(programs.lipac[0])},
        "options": options_of(shot),
    }
    # as the manager names types
    name, kind = f"{shot.scene.stem} {shot.first}-{shot.last}", JOB_TYPE.stem.replace("_", "-")
    job = {"name": name, "type": kind, "priority": 50, "submitter_platform": "manager", "settings": settings}
    path = shot.folder / "flamenco_job.json"
    write_json(path, job)
    return (
        f"copy {quoted(script)} into the folder scripts beside flamenco-manager; then Flamenco's panel has it, or "
        f"curl -H 'Content-Type: application/json' -d {quoted(f'@{path}')} MANAGER/api/v3/jobs"
    )


def options_of(shot: FarmShot) -> str:
    """What `lipac farm` is to be given so that it writes this shot again."""
    given = {
        "max-error": f"{shot.mean},{shot.worst}",
        "paths": shot.paths or None,
        "seed": shot.seed,
        "samples": shot.samples,
    }
    given["resolution"] = "{}x{}".format(*shot.resolution) if shot.resolution else None
    return " ".join(f"--{name} {value}" for name, value in given.items() if value is not None)
