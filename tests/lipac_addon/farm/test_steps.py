"""A shot from its analysis to its certificate: repeated, split, and with what a step must notice."""

from __future__ import annotations

import gc
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import bpy
import numpy as np
import pytest

from lipac.core.culling.options import State
from lipac.core.error_budget.budget import Budget
from lipac.core.errors import InputError
from lipac.core.files.report import load_states, save_states
from lipac.lipac_addon.batch.deciding import decide_layers
from lipac.lipac_addon.batch.shots.shot_set import ShotSet
from lipac.lipac_addon.farm import analyse, certificate, children, judge, unite, verify
from lipac.lipac_addon.farm.jobs.writing import Wanted, write_shot
from lipac.lipac_addon.farm.layout import FarmShot, read_json
from lipac.lipac_addon.farm.opening import open_shot
from lipac.lipac_addon.open import open_scene
from lipac.lipac_addon.pictures import read_picture
from lipac.lipac_addon.roles import PIN
from lipac.scripts.lipac import main

pytestmark = pytest.mark.slow


def times(folder: Path) -> dict[str, int]:
    return {str(p.relative_to(folder)): p.stat().st_mtime_ns for p in folder.rglob("*") if p.is_file()}


def all_steps(shot: FarmShot) -> dict[str, Any]:
    analyse.analyse(shot, shot.frames)
    unite.unite(shot)
    judge.judge(shot, shot.frames)
    children.render(shot, shot.frames)
    for number in range(1, shot.checks + 1):
        verify.verify(shot, number)
    return certificate.certify(shot)


def test_all_steps_and_all_again(shot: FarmShot) -> None:
    """The second time nothing is written but the certificate. What it says is what the steps' files say."""
    found = all_steps(shot)
    before = times(shot.folder)
    assert all_steps(shot) == json.loads((shot.folder / "certificate.json").read_text())
    assert {name for name, at in times(shot.folder).items() if at != before.get(name)} == {
        "certificate.json",
        "certificate.html",
    }
    assert (found["verified"], found["failed"], found["broken"], found["mended"]) == (2, 0, 0, [])
    assert [frame["frame"] for frame in found["frames"]] == [1, 2, 3, 4, 5, 6]
    assert [frame["frame"] for frame in found["frames"] if frame["verified"]] == [shot.checked(1), shot.checked(2)]
    needed = [int((load_states(shot.analysis(frame)).state != State.CULLED).sum()) for frame in shot.frames]
    assert [frame["analysis"]["active"] for frame in found["frames"]] == needed
    assert max(needed) <= found["active"] < found["instances"]
    assert all(found["peak_bytes"][name] > 1e7 for name in found["peak_bytes"])
    assert "The other 4 frames were not rendered in full" in " ".join(found["statement"])
    assert found["uncertified"] == []
    bounds = [read_json(shot.judged(frame)) or {} for frame in shot.frames]
    assert found["certified_mean"] == max(bound["certified_mean"] for bound in bounds) <= shot.mean
    assert found["certified_worst"] == max(bound["certified_worst"] for bound in bounds) <= shot.worst
    page = (shot.folder / "certificate.html").read_text()
    assert all(sentence.split("%")[0] in page for sentence in found["statement"])


def test_pictures_are_of_the_culled_file_as_any_blender_renders_it(shot: FarmShot) -> None:
    analyse.analyse(shot, shot.frames)
    removed = unite.unite(shot)["removed"]
    children.render(shot, (2, 3))
    bpy.ops.wm.open_mainfile(filepath=str(shot.culled))
    assert len([ob for ob in bpy.data.objects if ob.name.startswith("box")]) == 9 - removed < 9
    for frame in (2, 3):
        bpy.context.scene.frame_set(frame)
        bpy.context.scene.render.filepath = str(shot.folder / "plain.png")
        bpy.ops.render.render(write_still=True)
        np.testing.assert_array_equal(read_picture(shot.folder / "plain.png"), read_picture(shot.picture(frame)))


def test_chunks_in_any_order_give_the_set_of_one(shot: FarmShot) -> None:
    analyse.analyse(shot, shot.frames)
    whole = unite.unite(shot)["set"]
    (shot.folder / "analysis").rename(shot.folder / "other")
    for chunk in ((5, 6), (1,), (2, 3, 4)):
        analyse.analyse(shot, chunk)
    assert unite.unite(shot)["set"] == whole
    for frame in shot.frames:
        a, b = (load_states(shot.folder / name / f"frame_{frame:04}.npz") for name in ("other", "analysis"))
        for name in ("state", "score", "hits"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def test_what_is_pinned_is_rendered(rising: Path, tmp_path: Path) -> None:
    """A box that no light path of the frame meets, in the file that is rendered."""
    open_scene(rising)
    bpy.data.objects["box5"].lipac_role = PIN
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "pinned.blend"))
    shot = write_shot(tmp_path / "shot", tmp_path / "pinned.blend", Wanted((1,), Budget(0.05, 0.3), 4))
    analyse.analyse(shot, shot.frames)
    unite.unite(shot)
    bpy.ops.wm.open_mainfile(filepath=str(shot.culled))
    assert {ob.name for ob in bpy.data.objects if ob.name in ("box4", "box5", "box6", "box7")} == {"box5"}
    assert not bpy.data.objects["box5"].hide_render


def mended(shot: FarmShot, frame: int) -> str:
    note = read_json(shot.rendered(frame))
    assert note is not None
    return str(note["mended"])


def cull_too_much(shot: FarmShot) -> None:
    """Make all analyses say that nothing is needed."""
    for frame in shot.frames:
        states = load_states(shot.analysis(frame))
        together = ShotSet()
        together.add(states)
        save_states(
            shot.analysis(frame),
            np.zeros_like(states.state),
            states.score,
            states.hits,
            together.keys.records,
            together.keys.names,
            states.note,
        )


def test_a_wrong_set_is_found_and_mended(shot: FarmShot) -> None:
    """All frames of the span are rendered again, with what a tighter analysis of them needs; the certificate says so; a
    repetition changes nothing."""
    analyse.analyse(shot, shot.frames)
    cull_too_much(shot)
    chosen = unite.unite(shot)
    assert chosen["active"] == 0
    assert not any(one["holds"] for one in judge.judge(shot, shot.frames))
    children.render(shot, shot.frames)
    empty = {frame: read_picture(shot.picture(frame)) for frame in shot.frames}
    found = verify.verify(shot, 1)
    first, *_, last = found["attempts"]
    assert first["broken"]
    assert first["verified_least_mean"] > shot.mean
    assert not last["broken"]
    assert last["mended"].startswith("0001-0003_")
    assert all((read_picture(shot.picture(frame)) != empty[frame]).any() for frame in (1, 2, 3))
    assert all((read_picture(shot.picture(frame)) == empty[frame]).all() for frame in (4, 5, 6))
    assert all(mended(shot, frame) == last["mended"] for frame in (1, 2, 3))
    before = times(shot.folder)
    children.render(shot, shot.frames)
    assert verify.verify(shot, 1) == found
    assert times(shot.folder) == before
    verify.verify(shot, 2)
    said = certificate.certify(shot)
    assert (said["failed"], said["broken"], said["mended"]) == (2, 0, [[1, 3], [4, 6]])
    assert "Frames 1-3, 4-6 were analysed again, tighter, and rendered again" in " ".join(said["statement"])


def test_a_set_that_paths_do_not_certify_is_mended_where_no_picture_tells(shot: FarmShot) -> None:
    """One frame of a span is said not to hold, whatever the sample shows."""
    analyse.analyse(shot, shot.frames)
    unite.unite(shot)
    told = judge.judge(shot, shot.frames)
    path = shot.judged(2)
    path.write_text(json.dumps(told[1] | {"holds": False}))
    children.render(shot, shot.frames)
    found = verify.verify(shot, 1)
    first, last = found["attempts"]
    assert not first["broken"] and first["uncertified"] == [2]
    assert last["uncertified"] == [] and last["mended"].startswith("0001-0003_1")
    assert max(mean for mean, _ in last["certified"]) <= shot.mean
    assert {mended(shot, frame) for frame in (1, 2, 3)} == {last["mended"]}
    assert len(verify.verify(shot, 2)["attempts"]) == 1
    said = certificate.certify(shot)
    assert (said["failed"], said["broken"], said["mended"], said["uncertified"]) == (0, 0, [[1, 3]], [2])
    assert "The shot's set was not certified in frame 2. Frames 1-3 were analysed again" in " ".join(said["statement"])
    assert "for paths do not certify the shot's set in frame 2" in certificate.verdict(found)


def test_where_no_analysis_helps_all_is_kept(shot: FarmShot, monkeypatch: pytest.MonkeyPatch) -> None:
    analyse.analyse(shot, shot.frames)
    cull_too_much(shot)
    unite.unite(shot)
    told = judge.judge(shot, shot.frames)
    children.render(shot, shot.frames)
    monkeypatch.setattr(
        verify,
        "mend",
        lambda shot, _number, attempt, *_: (shot.scene, []) if attempt == verify.MENDS else (shot.culled, told[3:]),
    )
    attempts = verify.verify(shot, 2)["attempts"]
    assert [one["mended"] == verify.ALL for one in attempts] == [False, False, False, True]
    assert [one["broken"] for one in attempts] == [True, True, True, False]
    assert attempts[-1]["verified_worst"] == 0.0
    assert {mended(shot, frame) for frame in (4, 5, 6)} == {verify.ALL}


def test_what_is_missing_is_named(shot: FarmShot) -> None:
    with pytest.raises(InputError, match="not analysed, or damaged: frame_0001, frame_0002"):
        unite.unite(shot)
    with pytest.raises(InputError, match="unite first"):
        children.render(shot, (1,))
    for step in (lambda: verify.verify(shot, 1), lambda: judge.judge(shot, (1,))):
        with pytest.raises(InputError, match="run lipac shot unite"):
            step()
    analyse.analyse(shot, shot.frames)
    shot.analysis(4).write_bytes(shot.analysis(4).read_bytes()[:1000])
    with pytest.raises(InputError, match="damaged: frame_0004; run lipac shot analyze"):
        unite.unite(shot)
    assert analyse.analyse(shot, shot.frames) == 1
    unite.unite(shot)
    children.render(shot, (1, 2))
    with pytest.raises(InputError, match="3, 4, 5, 6; run lipac shot render"):
        certificate.certify(shot)
    children.render(shot, (3, 4, 5, 6))
    judge.judge(shot, (1, 3, 5))
    with pytest.raises(InputError, match="not judged in frames 2, 4, 6; run lipac shot judge"):
        certificate.certify(shot)
    with pytest.raises(InputError, match="not judged in frames 2; run lipac shot judge"):
        verify.verify(shot, 1)
    judge.judge(shot, shot.frames)
    with pytest.raises(InputError, match="numbers 1, 2 of the sample"):
        certificate.certify(shot)


def test_a_scene_that_changed_is_refused(shot: FarmShot, rising: Path) -> None:
    changed = FarmShot.load(shot.folder, shot.folder / "other.blend")
    changed.scene.write_bytes(rising.read_bytes() + b" ")
    with pytest.raises(InputError, match="has changed since the job was written"):
        analyse.analyse(changed, (1,))


@pytest.mark.skipif(os.name == "nt", reason="no limit of file sizes")
@pytest.mark.parametrize("step", ["analyze", "unite", "render"])
def test_a_full_disk_leaves_nothing_half(shot: FarmShot, step: str) -> None:
    """Here no file may be larger than 600 bytes: the step fails, what it would have written is not there, and with room
    again it is done."""
    before = {"analyze": (), "unite": ("analyze",), "render": ("analyze", "unite")}[step]
    for earlier in before:
        assert main(["shot", earlier, str(shot.folder), "--quiet"]) == 0
    there = set(times(shot.folder))
    limited = "import resource, sys; resource.setrlimit(resource.RLIMIT_FSIZE, (600, resource.RLIM_INFINITY)); "
    code = limited + "from lipac.scripts.lipac import main; sys.exit(main(sys.argv[1:]))"
    done = subprocess.run(  # -B: Python itself would leave half of the modules that it compiles
        [sys.executable, "-B", "-c", code, "shot", step, str(shot.folder), "--quiet"],
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )
    assert done.returncode in (1, 2), done.stderr
    assert not {name for name in times(shot.folder) if not Path(name).name.startswith(".")} - there
    assert main(["shot", step, str(shot.folder), "--quiet"]) == 0
    assert set(times(shot.folder)) > there


def test_at_most() -> None:
    """Without failures 1 - 0.05 ** (1 / n); else the quantile of the binomial distribution's other side."""
    assert certificate.at_most(0, 10) == pytest.approx(1 - 0.05**0.1)
    assert certificate.at_most(1, 10) == pytest.approx(0.3942, abs=1e-4)
    assert certificate.at_most(10, 10) == pytest.approx(1.0)


def test_a_chunk_holds_no_frame_that_is_done(shot: FarmShot, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where Python's collector of circles does not begin by itself: a chunk needs the memory of a frame."""
    held = []

    def decide(*arguments: Any) -> Any:
        held.append(sum(array.nbytes for array in _arrays()))
        return decide_layers(*arguments)

    monkeypatch.setattr(analyse, "decide_layers", decide)
    open_shot(shot)
    gc.disable()
    try:
        analyse.decide_frames(shot, shot.frames, shot.options(), shot.analysis)
    finally:
        gc.enable()
    assert held[-1] - held[1] < 100_000


def _arrays() -> list[np.ndarray]:
    """Arrays that something which the collector knows refers to, and that own their memory."""
    found = {
        id(one): one
        for holder in gc.get_objects()
        for one in gc.get_referents(holder)
        if isinstance(one, np.ndarray) and one.base is None
    }
    return list(found.values())
