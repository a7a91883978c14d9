"""The lines that the panel begins with."""

import bpy
import pytest

from lipac.core.scene import render_costs
from lipac.lipac_addon.ui import panel
from lipac.lipac_addon.ui.draw import verdict
from lipac.lipac_addon.ui.jobs import job
from lipac.lipac_addon.ui.jobs.analysis import AnalysisJob
from lipac.lipac_addon.ui.state import results
from lipac.lipac_addon.ui.state.results import Difference


def test_what_is_kept_certified_and_saved(scene):
    assert verdict.verdict(scene) == ["Nothing is analyzed in this session"]
    bpy.ops.lipac.analyze()
    kept = "Keeps 6 of 10 instances"
    unknown = "How much the picture changes is not certified"  # by distance: nothing measures it
    assert verdict.verdict(scene) == [kept, unknown]
    results.at(scene).stats.update(certified_mean=0.0051, certified_worst=0.031)
    change = "Changes the picture by at most 0.51 %, any tile by 3.1 % (95 % confidence)"
    assert verdict.verdict(scene) == [kept, change]
    results.differences[scene.session_uid, 1] = Difference((8.0, 2.5), (2, 1), 0.1, 0.2)
    assert verdict.verdict(scene) == [kept, change, "Renders in 2.5 s instead of 8.0 s"]
    scene.frame_set(7)
    assert verdict.verdict(scene) == ["Frame 7 is not analyzed"]


def test_the_first_warnings_and_how_many_more(analyzed):
    assert verdict.warnings(analyzed) == list(results.at(analyzed).warnings)
    found = results.at(analyzed)
    object.__setattr__(found, "warnings", ("a", "b", "c", "d", "e"))
    assert verdict.warnings(analyzed) == ["a", "b", "c", "2 more in Results"]
    analyzed.frame_set(7)
    assert verdict.warnings(analyzed) == []


def test_frames_that_render_in_full_are_counted(analyzed):
    analyzed.frame_start, analyzed.frame_end = 1, 10
    assert verdict.status(analyzed) == ("Renders show everything", False)
    analyzed.lipac.use_for_renders = True
    line, alert = verdict.status(analyzed)
    assert line.endswith("9 of 10 frames of the range are not analyzed: they render in full")
    assert not alert
    results.put(analyzed, {f: results.at(analyzed) for f in range(1, 11)})
    assert verdict.status(analyzed) == ("Renders hide what frame 1 does not need", False)
    analyzed.frame_set(11)
    assert verdict.status(analyzed) == ("Frame 11 is not analyzed: it renders in full", True)


@pytest.fixture
def small(scene, monkeypatch):
    """The scene, analysed by few light paths, which take long to load: however busy the machine is, nothing can be
    won."""
    monkeypatch.setattr(render_costs, "LOADING_S", 60.0)
    scene.lipac.policy, scene.lipac.width, scene.lipac.paths, scene.frame_end = "light-paths", 16, 1, 1
    return scene


def test_what_cannot_be_won_is_said(small, drawn, capfd):
    """While it is analysed, in the verdict, and by both buttons; it is analysed all the same."""
    scene = small
    running = job.start(lambda: AnalysisJob(scene))
    while running.step() and not running.note:
        pass
    assert not running.error
    assert running.note.startswith("Nothing can be won: with 10 instances (")
    assert " and 4,608 paths of a picture" in running.note  # 64 x 36, two samples
    assert "Nothing can be won" in drawn(panel.LIPAC_PT_main)
    running.run()
    assert verdict.verdict(scene)[-1] == running.note
    assert verdict.verdict(scene)[0].startswith("Keeps ")
    for button in (bpy.ops.lipac.analyze, bpy.ops.lipac.bake_shot):
        capfd.readouterr()
        assert button() == {"FINISHED"}
        assert running.note in capfd.readouterr().out


@pytest.mark.parametrize(
    "change",
    [
        lambda scene: setattr(scene.cycles, "samples", 1 << 16),
        lambda scene: setattr(scene.render, "engine", "BLENDER_EEVEE"),
        lambda scene: setattr(scene.lipac, "policy", "distance"),
        lambda scene: scene.view_layers.new("second"),
    ],
    ids=["samples", "engine", "rule", "layers"],
)
def test_what_may_be_won_or_is_not_known_is_not_said(small, change):
    change(small)
    assert bpy.ops.lipac.analyze() == {"FINISHED"}
    assert not any("Nothing can be won" in line for line in verdict.verdict(small))
