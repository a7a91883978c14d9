"""The lines that the panel begins with."""

import bpy

from lipac.lipac_addon.ui.draw import verdict
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
