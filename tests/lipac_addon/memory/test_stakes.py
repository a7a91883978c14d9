"""A frame of which nothing can be won is rendered in full, at once; what is not known is analysed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import bpy
import pytest

from lipac.core.culling import analysis
from lipac.core.culling.options import CullOptions
from lipac.core.files.report import Report, load_states
from lipac.core.scene import render_costs
from lipac.core.scene.render_costs import Stakes
from lipac.lipac_addon.batch.engines.choices import DeviceChoice
from lipac.lipac_addon.batch.job import Job
from lipac.lipac_addon.batch.pipeline import run
from lipac.lipac_addon.extract import Extractor
from lipac.lipac_addon.extract.graph import GraphReader
from lipac.lipac_addon.extract.graph_items import Node
from lipac.lipac_addon.memory.stakes import stakes_of
from lipac.lipac_addon.pictures import read_picture


def rendered(folder: Path, **more: Any) -> dict[str, Any]:
    """The report's entry of frame 1 of the open file."""
    given: dict[str, Any] = {"options": CullOptions(width=32, paths=2), "samples": 1, "if_it_pays": True} | more
    report = Report("", "", "", "light-paths", "cycles", 0, 1)
    run(Job(folder, (1,), engine="cycles", device=DeviceChoice("cpu"), **given), report)
    return report.frames[0]


def found(samples: int = 1) -> Stakes | None:
    """What is at stake in the open file, that an extraction is shown."""
    out, scene = [], bpy.context.scene

    def look(reader: GraphReader, nodes: Sequence[Node]) -> None:
        out.append(stakes_of(reader, nodes, scene, CullOptions(), samples, 1, 0.0))

    Extractor(scene).frame(None, False, look=look)
    return out[0]


def test_the_frame_is_what_it_is_with_nothing_culled(
    boxes: bpy.types.Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(analysis, "decide", lambda *_: 1 / 0)
    monkeypatch.setattr(render_costs, "LOADING_S", 60.0)  # however busy the machine is
    entry = rendered(tmp_path / "small")
    assert entry["not_analysed"].startswith("nothing is culled: with 10 instances (")
    assert (entry["instances"], entry["active"], entry["paths"]) == (10, 10, 0)
    whole = rendered(tmp_path / "whole", options=CullOptions("none"))
    assert "not_analysed" not in whole
    pictures = [read_picture(tmp_path / name / "frame_0001.exr") for name in ("small", "whole")]
    assert (pictures[0] == pictures[1]).all()
    assert (load_states(tmp_path / "small" / "states" / "frame_0001.npz").state == 2).all()


@pytest.mark.parametrize("more", [{"if_it_pays": False}, {"samples": 1 << 16}])
def test_who_asks_for_it_or_may_win_gets_an_analysis(
    boxes: bpy.types.Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, more: dict[str, Any]
) -> None:
    monkeypatch.setattr("lipac.lipac_addon.batch.frame.render", lambda *_: pytest.fail("rendered"))
    monkeypatch.setattr("lipac.lipac_addon.batch.session.Session.decided", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        rendered(tmp_path, **more)


def blurred() -> None:
    bpy.context.scene.render.use_motion_blur = True


def smoke() -> None:
    bpy.data.materials.new("smoke").node_tree.nodes.new("ShaderNodeVolumePrincipled")


def refined() -> None:
    modifier = bpy.data.objects["wall"].modifiers.new("Subdivision", "SUBSURF")
    if not hasattr(modifier, "use_adaptive_subdivision"):
        pytest.skip("this Blender has it in Cycles' settings of the object")
    modifier.use_adaptive_subdivision = True


def hairy() -> None:
    bpy.data.objects["wall"].modifiers.new("Hair", "PARTICLE_SYSTEM")
    bpy.data.objects["wall"].particle_systems[0].settings.type = "HAIR"


@pytest.mark.parametrize("change", [blurred, smoke, refined, hairy])
def test_what_the_rates_do_not_know_is_not_taken_for_nothing(
    boxes: bpy.types.Scene, change: Callable[[], None]
) -> None:
    known = found()
    assert known is not None
    assert known.nothing_to_win
    change()
    assert found() is None


def test_modifiers_count_as_rendered(boxes: bpy.types.Scene) -> None:
    before = found()
    modifier = bpy.data.objects["wall"].modifiers.new("Subdivision", "SUBSURF")
    modifier.levels, modifier.render_levels = 0, 8
    after = found()
    assert before is not None
    assert after is not None
    assert after.saved - before.saved > 6 * 4**8 * 2 * 100  # two triangles for each quad
    assert not after.nothing_to_win


def test_samples_count(boxes: bpy.types.Scene) -> None:
    few, many = found(4), found(1 << 16)
    assert few is not None
    assert many is not None
    assert few.nothing_to_win
    assert not many.nothing_to_win
