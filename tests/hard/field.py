"""Small files after public reports and strangers' files, by the real commands, each with the value that is right:
`../shared/cases/README.md` lists them."""

from __future__ import annotations

import io
import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lipac.core.arrays import F32
from lipac.core.evaluation.judge import picture_change
from lipac.core.files.report import States, load_states
from lipac.lipac_addon.pictures import read_picture
from lipac.scripts.lipac import main

from .case import Figure, case

GROUP = "Files of strangers"
FIELD = Path(__file__).parents[2] / ".." / "shared" / "cases" / "field"
MEAN, WORST = 0.011, 0.06  # the budget of 1 and 5 %, and noise: both pictures have the same few samples


@dataclass(frozen=True)
class Rendered:
    """What `lipac render` leaves of a file: its report, the states of its frame, its picture."""

    report: dict[str, Any]
    states: States
    picture: F32

    @property
    def frame(self) -> dict[str, Any]:
        """The frame's entry in the report."""
        return dict(self.report["frames"][0])

    @property
    def kept(self) -> set[str]:
        """Names of the objects that stay."""
        return {self.states.names[k] for k in self.states.keys["object"][self.states.state == 2]}

    def lacks(self, *names: str) -> int:
        """How many of these objects do not stay."""
        return len(set(names) - self.kept)

    def says(self, kind: str, text: str) -> int:
        """1 where no line of the report, of a kind ("approximated", "warnings"), has this text."""
        return int(not any(text in line for line in self.report[kind]))


def rendered(name: str, *options: str, size: str = "128x72", samples: int = 16, apart: bool = False) -> Rendered:
    """Render a file by the command, culled although these files are so small that it would render everything. apart: in
    a process of its own, which may crash. Raises AssertionError where it does not end with status 0."""
    with tempfile.TemporaryDirectory() as folder:
        arguments = [
            "render",
            str(FIELD / f"{name}.blend"),
            "-o",
            folder,
            "--resolution",
            size,
            "--samples",
            str(samples),
            "--quiet",
            *(options if "--cull" in options else ("--cull", "light-paths", *options)),
        ]
        if apart:
            status = subprocess.run(
                [sys.executable, "-m", "lipac.scripts.lipac", *arguments], stdout=subprocess.DEVNULL, check=False
            ).returncode
        else:
            with redirect_stdout(io.StringIO()):
                status = main(arguments)
        assert status == 0, f"{name}: status {status}"
        report = json.loads((Path(folder) / "report.json").read_text())
        return Rendered(
            report, load_states(next(Path(folder).glob("states/*.npz"))), read_picture(next(Path(folder).glob("*.exr")))
        )


def changes(what: str, culled: Rendered, full: Rendered, why: str = "") -> Iterator[Figure]:
    """How much culling changes the picture: rows of the mean and of the worst tile."""
    mean, worst = picture_change(full.picture, culled.picture)
    yield Figure(what, "change of the picture, mean", mean, MEAN, why)
    yield Figure(what, "change of the picture, worst tile", worst, WORST)


def compared(
    name: str, what: str, why: str, most: int, size: str = "128x72", samples: int = 16
) -> Iterator[Figure | Rendered]:
    """The file, culled, against the whole of it. most: how many instances may stay. The last thing is what was culled,
    for more to be asked of it."""
    options = {"size": size, "samples": samples}
    culled, full = rendered(name, **options), rendered(name, "--cull", "none", **options)  # type: ignore[arg-type]
    yield from changes(f"{name}: {what}", culled, full, why)
    yield Figure(
        f"{name}: {what}", f"kept, of {full.frame['instances']:,}", culled.frame["active"], most, "what culling is for"
    )
    yield culled


def figures(found: Iterator[Figure | Rendered]) -> Iterator[Figure]:
    """Rows alone."""
    return (f for f in found if isinstance(f, Figure))


@case(GROUP)
def edit_mode() -> Iterator[Figure]:
    """What was being edited when the file was saved is there, and stays where the camera sees it."""
    for name, instances, edited, was in (
        ("edit_mode_mirror", 104, "item1", "KeyError"),
        ("edit_mode_mirrorfloor", 409, "Ground", "the floor, missing, changed the picture by 26 / 97 %"),
        ("edit_mode_plain", 104, "item1", "103 instances, without a word"),
    ):
        what = f"{name}: saved in Edit Mode"
        culled, full = rendered(name), rendered(name, "--cull", "none")
        missing = abs(instances - culled.frame["instances"]) + abs(instances - full.frame["active"])
        yield Figure(what, "instances that are missing", missing, 0, f"before: {was}")
        yield Figure(what, "what was edited is culled", culled.lacks(edited), 0)
        yield from changes(what, culled, full)


@case(GROUP)
def settings() -> Iterator[Figure]:
    """Files whose settings ended the command, or its process."""
    for name, what, was in (
        ("film_rgba_h264", "film output with a colour mode that the codec lacks", "TypeError after the render"),
        ("render_result_renamed", "the image Render Result has another name", "KeyError after the render"),
        ("freestyle", "Freestyle on", "SIGSEGV"),
    ):
        culled = rendered(name, apart=name == "freestyle")
        full = rendered(name, "--cull", "none", apart=name == "freestyle")
        yield Figure(
            f"{name}: {what}", "instances that are missing", abs(64 - culled.frame["instances"]), 0, f"before: {was}"
        )
        yield from changes(f"{name}: {what}", culled, full)
        if name == "freestyle":
            yield Figure(
                f"{name}: {what}", "not said: lines of what is culled", culled.says("approximated", "Freestyle"), 0
            )


@case(GROUP)
def points_only() -> Iterator[Figure]:
    """Light paths are traced through faces in place of the points; the render has the points themselves."""
    culled, full = rendered("points_only"), rendered("points_only", "--cull", "none")
    what = "points_only: only a point cloud"
    yield Figure(
        what,
        "pixels that differ in any bit",
        float((culled.picture != full.picture).any(axis=-1).mean()),
        0,
        "before: refused",
    )
    yield Figure(what, "not said: faces in place of points", culled.says("approximated", "rendered as faces"), 0)


@case(GROUP)
def two_view_layers() -> Iterator[Figure]:
    """The second, which lacks the wall, shows what stands behind it: the compositor puts it beside the first."""
    what = "two view layers, the second without what stands before"
    for found in compared("r_viewlayers", what, "before: what only the second shows was culled, 79 to 86 %", 60):
        if isinstance(found, Rendered):
            yield Figure(
                f"r_viewlayers: {what}",
                "culled of what either shows",
                found.lacks("Wall", *(f"item{k}" for k in range(7))),
                0,
            )
            yield Figure(
                f"r_viewlayers: {what}", "view layers that were not analysed", 2 - found.frame["view_layers"], 0
            )
        else:
            yield found


@case(GROUP)
def seen_through() -> Iterator[Figure]:
    """What shows through, or moves into view, stays: some 300 instances are behind the camera, or hidden."""
    yield from figures(
        compared("t_camwall", "wall of Mix(Is Camera Ray, Diffuse, Transparent)", "before: 137 / 529 %", 60)
    )
    yield from figures(
        compared("t_backface", "cutaway room, Mix(Backfacing, Diffuse, Transparent)", "before: 14 / 112 %", 60)
    )
    yield from figures(compared("t_whip", "fast pan with motion blur", "before: 5 / 34 %", 60))
    for name, what, why, most, said in (
        ("t_cloudbox", "a box with a volume shader only", "before: 9 / 215 %", 60, "volume not rendered"),
        ("t_crater", "true displacement downwards", "before: 4 / 181 %", 406, "displacement taken for two surfaces"),
    ):
        for found in compared(name, what, why, most):
            yield (
                found
                if isinstance(found, Figure)
                else Figure(f"{name}: {what}", f"not said: {said}", found.says("approximated", said), 0)
            )


@case(GROUP)
def read_by_others() -> Iterator[Figure]:
    """What a driver, or particles, read of an object that is culled: it is left alone, and that is said."""
    for name, what, was, said in (
        (
            "h_driver_parent",
            "hide_render driven by that of a controller",
            "before: 10 / 260 %",
            "a driver reads whether its object renders",
        ),
        ("h_metaparticles", "hair particles that instance a metaball", "before: 2.5 / 27 %", "metaballs"),
    ):
        for found in compared(name, what, was, 60):
            yield (
                found
                if isinstance(found, Figure)
                else Figure(f"{name}: {what}", f"not said: {said}", found.says("warnings", said), 0)
            )


@case(GROUP)
def scatter_of_posts() -> Iterator[Figure]:
    """None of them matters alone. Small: what an analysis of so many costs grows with the picture."""
    yield from figures(
        compared(
            "r_scatter_origin",
            "80,002 thin posts at eye height",
            "before: 4 / 32 %, where 0.86 / 5 % were said",
            60_000,
            "64x36",
            64,
        )
    )
