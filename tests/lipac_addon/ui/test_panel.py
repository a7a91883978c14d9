"""What the panels say: Blender's own layout, read back."""


import bpy
import pytest

from lipac.core.culling.policies import NOTHING, POLICIES
from lipac.lipac_addon.ui import panel
from lipac.lipac_addon.ui.draw import figures
from lipac.lipac_addon.ui.jobs import engine, job, live
from lipac.lipac_addon.ui.jobs.analysis import AnalysisJob
from lipac.lipac_addon.ui.state import applying, results
from lipac.lipac_addon.ui.state.results import Difference

PANELS = panel._CLASSES


@pytest.mark.parametrize("policy", [name for name, policy in POLICIES.items() if policy.listed and name != NOTHING])
def test_before_an_analysis(scene, drawn, policy):
    scene.lipac.policy = policy
    texts = [drawn(cls) for cls in PANELS]
    assert "lipac.analyze" in texts[0].lower() or "LIPAC_OT_analyze" in texts[0]
    assert "Renders show everything" in texts[0]
    assert "Nothing analyzed yet" in texts[1]


def test_the_verdict_comes_first(analyzed, drawn):
    text = drawn(panel.LIPAC_PT_main)
    places = [text.index(part) for part in ("Keeps 6 of 10", "Renders show everything", "policy")]
    assert places == sorted(places)
    object.__setattr__(results.at(analyzed), "warnings", ("mind the gap",))
    text = drawn(panel.LIPAC_PT_main)
    assert text.index("mind the gap") < text.index("policy")


def test_live_mode_has_the_switch_for_the_viewport(scene, drawn):
    assert "cull_viewport" not in drawn(panel.LIPAC_PT_main)
    live.start()
    try:
        live.tick()
        assert "cull_viewport" in drawn(panel.LIPAC_PT_main)
        live.current.culling.message = "shows 3 of 10 instances"
        assert "The viewport shows 3" in drawn(panel.LIPAC_PT_main)
    finally:
        live.stop()


def test_results_and_reason(analyzed, drawn):
    bpy.context.view_layer.objects.active = bpy.data.objects["box5"]
    texts = {cls.__name__: drawn(cls) for cls in PANELS}
    assert "6 (60.0 %)" in texts["LIPAC_PT_results"]
    assert "culled" in texts["LIPAC_PT_object"]
    bpy.ops.lipac.apply()
    assert "hidden until" in drawn(panel.LIPAC_PT_object)
    analyzed.frame_set(7)
    assert "This frame was not analyzed" in drawn(panel.LIPAC_PT_results)


def test_progress_and_error(scene, drawn):
    running = job.start(lambda: AnalysisJob(scene))
    running.message = "counting sheep"
    running.progress = 0.25
    assert " left" not in running.line
    running._pace.start -= 10
    running.progress = 0.5
    assert running.line == "counting sheep (10 s, 20 s left)"  # as commands say it
    text = drawn(panel.LIPAC_PT_main)
    assert ("50 %" in text, "s left)" in text, "Cancel" in text) == (True, True, True)
    assert "counting sheep" in drawn(panel.LIPAC_PT_main)
    assert "lipac.cancel" in drawn(panel.LIPAC_PT_main).lower().replace("lipac_ot_", "lipac.")
    running.cancel()
    running.run()
    assert "cancelled" in drawn(panel.LIPAC_PT_main)


def test_the_first_compilation_shows_that_it_goes_on(scene, drawn, monkeypatch, tmp_path):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "kernels-3"))
    monkeypatch.setattr(job, "LOOK", 0.0)
    running = job.start(lambda: AnalysisJob(scene))
    running.step()
    assert "Compiling" not in drawn(panel.LIPAC_PT_main)
    folder = tmp_path / "kernels-3" / "core"
    folder.mkdir(parents=True)
    for k in range(3):
        (folder / f"{k}.nbi").touch()
    running.step()
    assert "3 kernels so far" in drawn(panel.LIPAC_PT_main)
    running.run()


def test_no_active_object_and_no_camera(scene, drawn):
    bpy.context.view_layer.objects.active = None
    scene.camera = None
    for cls in PANELS:
        drawn(cls)


def test_missing_libraries_are_named(scene, drawn, monkeypatch):
    monkeypatch.setattr(engine, "missing", lambda: ("numba", "embreex"))
    text = drawn(panel.LIPAC_PT_main)
    assert "missing" in text
    assert "embreex" in text
    assert "analyze" not in text.lower()
    assert "Renders show everything" in text  # a file may have something hidden all the same
    assert "restore" in text.lower()
    assert not any(cls.poll(bpy.context) for cls in PANELS[1:])


def test_libraries_that_python_cannot_find(monkeypatch):
    monkeypatch.setattr(engine, "find_spec", lambda name: None if name == "llvmlite" else name)
    assert engine.missing.__wrapped__() == ("llvmlite",)


def test_figures(analyzed):
    result = results.at(analyzed)
    result.stats.update(
        blas_bytes=3 << 20,
        tlas_bytes=1 << 19,
        predicted_mean=0.002,
        predicted_worst=0.01,
        certified_mean=0.004,
        certified_worst=0.02,
    )
    rows = dict(figures.rows_of(result))
    assert "Change, predicted" not in rows  # a bound says more
    assert rows["Change, at most"] == "0.40 %, worst 2.00 %"
    del result.stats["certified_mean"]
    rows = dict(figures.rows_of(result))
    assert rows["Instances"] == "10"
    assert rows["BVH memory"] == "3.5 MiB"
    assert rows["Change, predicted"] == "0.20 %, worst 1.00 %"
    for worst, text in ((0.1128, "11.3 %"), (2.4, "240 %"), (0.0995, "10.0 %")):  # in a line of the sidebar
        assert figures.change(0.0126, worst) == f"1.26 %, worst {text}"
        assert len(figures.lines(figures.change(0.0126, worst), figures.LONGEST // 2)) == 1
    assert [figures.size(n) for n in (0, 1023, 1024, 5 << 30)] == ["0 B", "1023 B", "1.0 KiB", "5.0 GiB"]


def test_why(scene, drawn):
    """Of the active object: kept by light paths, culled without, pinned."""
    scene.lipac.policy, scene.lipac.width = "light-paths", 64
    bpy.data.objects["box6"].lipac_role = "PIN"
    pins = bpy.data.collections.new("pins")
    scene.collection.children.link(pins)
    pins.objects.link(bpy.data.objects["box7"])
    pins.lipac_role = "PIN"
    bpy.ops.lipac.analyze()
    bpy.data.objects["box4"].lipac_role = "PIN"  # after the analysis
    said = {
        "box7": ("pinned", "kept"),
        "box4": ("culled", "no light path", "pinned since"),
        "box0": ("light paths meet it", "Camera paths", "Worth at most"),
        "box5": ("no light path", "culled"),
        "box6": ("pinned", "kept"),
    }
    for name, texts in said.items():
        bpy.context.view_layer.objects.active = bpy.data.objects[name]
        shown = drawn(panel.LIPAC_PT_object)
        assert all(text in shown for text in texts), (name, shown)


def test_live_and_what_stays_although_it_is_culled(analyzed, drawn, monkeypatch):
    monkeypatch.setattr(applying, "notes", ("3 culled instances stay in renders: they are shy",))
    assert "shy" not in drawn(panel.LIPAC_PT_main)
    analyzed.lipac.use_for_renders = True
    assert "shy" in drawn(panel.LIPAC_PT_main)
    live.start()
    while live.current is None or not live.current.resting:
        live.tick()
    assert "at rest" in drawn(panel.LIPAC_PT_main)
    assert "Live, frame 1" in drawn(panel.LIPAC_PT_results)
    live.stop()


def test_difference(analyzed, drawn):
    results.differences[analyzed.session_uid, 1] = Difference((9.0, 2.5), (3 << 30, 1 << 30), 0.002, 0.03)
    text = drawn(panel.LIPAC_PT_results)
    assert all(part in text for part in ("6.5 of 9.0 s", "2.0 GiB of 3.0", "0.20 %"))


def test_a_second_view_layer_is_a_warning(scene):
    scene.view_layers.new("second")
    bpy.ops.lipac.analyze()
    assert any("view layer" in line for line in results.at(scene).warnings)
