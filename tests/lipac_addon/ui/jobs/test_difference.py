"""Render Difference: two renders by Blenders of their own, and what is said of them."""

import subprocess
import sys
import time

import bpy
import numpy as np
import pytest

from lipac.lipac_addon.ui.draw import figures
from lipac.lipac_addon.ui.jobs import difference, job
from lipac.lipac_addon.ui.jobs.difference import DifferenceJob, difference_of
from lipac.lipac_addon.ui.state import results


def test_what_culling_saves_and_changes(analyzed, hidden, snapshot):
    before = snapshot()
    assert bpy.ops.lipac.difference() == {"FINISHED"}
    found = results.differences[analyzed.session_uid, 1]
    assert all(s > 0 for s in found.seconds)
    assert all(b > 50e6 for b in found.peak_bytes)
    assert 0 <= found.mean <= found.worst < 0.2  # what is culled stands behind a wall
    assert hidden() == set()
    image = bpy.data.images[difference.IMAGE]
    assert tuple(image.size) == (64, 36)
    assert any("Time saved" in label for label, _ in figures.rows_of_difference(found))
    bpy.data.images.remove(image)
    after = snapshot()
    assert (after["values"], after["modifiers"]) == (before["values"], before["modifiers"])
    assert after["blocks"] - before["blocks"] <= {("images", "Render Result")}
    bpy.ops.lipac.analyze()
    assert results.differences == {}


def test_a_visible_loss_is_measured(analyzed):
    """All that the camera sees is culled: what is left is the world."""
    result = results.at(analyzed)
    result.state[:] = results.CULLED
    DifferenceJob(analyzed).run()
    assert results.differences[analyzed.session_uid, 1].worst > 0.2
    pixels = np.empty(64 * 36 * 4, np.float32)
    bpy.data.images[difference.IMAGE].pixels.foreach_get(pixels)
    assert pixels.reshape(-1, 4)[:, :3].max() > 0.05


def test_figures():
    full, culled = np.ones((9, 16, 4), np.float32), np.ones((9, 16, 4), np.float32)
    culled[0, 0, :3] = 0.5
    found = difference_of([full, culled], [{"seconds": 4.0, "peak_bytes": 3e9}, {"seconds": 1.5, "peak_bytes": 1e9}])
    assert (found.worst, found.mean) == (pytest.approx(0.5), pytest.approx(0.5 / 144))
    assert dict(figures.rows_of_difference(found))["Time saved"] == "2.5 of 4.0 s"


def test_cancelled(analyzed):
    measuring = job.start(lambda: DifferenceJob(analyzed))
    while "rendering" not in measuring.message:
        measuring.step()
    assert not bpy.ops.lipac.analyze.poll()
    measuring.cancel()
    start = time.monotonic()
    measuring.run()
    assert time.monotonic() - start < 20  # a render in full takes as long as it takes
    assert "cancelled" in measuring.error
    assert results.differences == {}


def test_the_image_outlives_the_undo_of_a_later_edit(analyzed, monkeypatch):
    def work(measuring):
        measuring.difference = difference_of(
            [np.ones((9, 16, 4), np.float32)] * 2, [{"seconds": 1.0, "peak_bytes": 1e9}] * 2
        )
        difference._show([np.ones((9, 16, 4), np.float32)] * 2)
        yield

    bpy.ops.ed.undo_push(message="start")
    monkeypatch.setattr(DifferenceJob, "_work", work)
    assert bpy.ops.lipac.difference() == {"FINISHED"}
    bpy.data.objects["box0"].location.y = 1.0
    bpy.ops.ed.undo_push(message="moved")
    bpy.ops.ed.undo()
    assert difference.IMAGE in bpy.data.images


def test_the_image_is_saved_with_the_file(analyzed, tmp_path):
    difference._show([np.zeros((9, 16, 4), np.float32), np.full((9, 16, 4), 0.25, np.float32)])
    difference._show([np.zeros((9, 16, 4), np.float32), np.full((9, 16, 4), 2.5, np.float32)])  # measured again
    bpy.data.images[difference.IMAGE].use_fake_user = True
    path = str(tmp_path / "with image.blend")
    bpy.ops.wm.save_as_mainfile(filepath=path)
    bpy.ops.wm.open_mainfile(filepath=path)
    pixels = np.empty(9 * 16 * 4, np.float32)
    bpy.data.images[difference.IMAGE].pixels.foreach_get(pixels)
    assert pixels.reshape(-1, 4)[:, :3].min() == 2.5


def test_a_render_ends_with_who_waits_for_it(boxes_file, tmp_path):
    """Its input ends then, whatever became of that: nobody goes on to render for a Blender that has crashed."""
    command = [sys.executable, str(difference._CHILD), "--", str(boxes_file), "Scene", "1", str(tmp_path / "x.exr")]
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "LIPAC" not in done.stdout
    assert not list(tmp_path.iterdir())


def test_a_render_that_fails_is_one_line(analyzed, monkeypatch, tmp_path, capfd):
    broken = tmp_path / "broken.py"
    # what Blender says need be no UTF-8, nor in the encoding of the locale: here a name in Latin-1
    words = "sys.stdout.buffer.write(b'caf\\xe9.blend\\n'); sys.stdout.flush()"
    broken.write_text(f"import sys; {words}; raise SystemExit('no such thing')")
    monkeypatch.setattr(difference, "_CHILD", broken)
    with pytest.raises(RuntimeError, match="full render failed"):
        bpy.ops.lipac.difference()
    assert "no such thing" in capfd.readouterr().err  # why, for the console


def test_not_before_an_analysis_and_not_while_applied(scene):
    assert not bpy.ops.lipac.difference.poll()
    bpy.ops.lipac.analyze()
    assert bpy.ops.lipac.difference.poll()
    bpy.ops.lipac.apply()
    assert not bpy.ops.lipac.difference.poll()
