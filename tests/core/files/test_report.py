"""report.json, states and the table."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from lipac.core.errors import InputError
from lipac.core.files.atomic import replacing
from lipac.core.files.figures import percent, size
from lipac.core.files.level import Level
from lipac.core.files.report import FIELDS, Report, load_states, output_folder, save_states
from lipac.lipac_addon.keys import KEY, MAX_DEPTH


def report():
    return Report("a.blend", "5.2", "0.1", "light-paths", "cycles", 0, 2)


def test_file_follows_the_contract(tmp_path):
    r = report()
    r.add_frame(
        {"frame": 1, "instances": np.int64(5), "render_s": 2.0, "paths": 10, "blas_bytes": 7, "error": {"flip": 0.1}},
        ("a",),
        ("w",),
    )
    r.add_frame({"frame": 2, "render_s": 3.0, "paths": 20, "blas_bytes": 5}, ("a", "b"), ())
    r.write(tmp_path)
    data = json.loads((tmp_path / "report.json").read_text())
    assert list(data)[:10] == [
        "schema", "scene", "blender", "lipac", "policy", "engine", "seed", "threads", "frames", "totals"
    ]
    assert data["schema"] == 1
    assert set(FIELDS) <= set(data["frames"][1])
    assert data["frames"][0]["instances"] == 5
    assert data["frames"][0]["error"] == {"flip": 0.1}
    totals = data["totals"]
    assert (totals["frames"], totals["render_s"], totals["paths"], totals["blas_bytes"]) == (2, 5.0, 30, 7)
    assert totals["peak_bytes"] > 1e6
    assert (data["approximated"], data["warnings"]) == (["a", "b"], ["w"])
    assert not list(tmp_path.glob(".*"))


def test_empty_report_is_valid(tmp_path):
    report().write(tmp_path)
    assert json.loads((tmp_path / "report.json").read_text())["frames"] == []
    assert "0.0 s in all" in report().table()


def test_a_failure_leaves_the_old_file(tmp_path):
    file = tmp_path / "x.txt"
    file.write_text("old")
    with pytest.raises(RuntimeError), replacing(file) as part:
        part.write_text("half")
        raise RuntimeError
    assert file.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["x.txt"]


def test_states_come_back(tmp_path):
    rng = np.random.default_rng(0)
    n = 50
    keys = np.zeros(n, KEY)
    keys["path"] = -1
    keys["path"][:, :2] = rng.integers(0, 9, (n, 2))
    keys["kind"], keys["host"], keys["object"] = rng.integers(0, 5, n), rng.integers(-1, 2, n), rng.integers(-1, 2, n)
    state, score, hits = (
        rng.integers(0, 3, n).astype(np.uint8),
        rng.random(n, np.float32),
        rng.integers(0, 70000, (n, 5)),
    )
    boxes = rng.random((7, 2, 3))
    faces = {"a": rng.random(1001) < 0.5, "lib\nb": rng.random(3) < 0.5}
    one = Level(rng.integers(0, 99, (5, 3)).astype(np.int32), np.arange(5, dtype=np.int32))
    levels = {"a": one, "lib\nb": Level(one.corners[:2], one.faces[:2]), "c": one}
    names = ("a", "lib\nb")
    save_states(tmp_path / "s.npz", state, score, hits, keys, names, boxes=boxes, faces=faces, levels=levels)
    other = {"faces": dict(reversed(faces.items())), "levels": dict(reversed(levels.items()))}
    save_states(tmp_path / "t.npz", state, score, hits, keys, names, boxes=boxes, **other)
    assert (tmp_path / "s.npz").read_bytes() == (tmp_path / "t.npz").read_bytes()  # in whatever order they were found
    with np.load(tmp_path / "s.npz") as found:
        assert (found["state"] == state).all()
        assert (found["score"] == score).all()
        assert (found["hits"] == hits).all()
        assert found["hits"].dtype == np.uint32
        path = np.full((n, MAX_DEPTH), -1)
        path[:, : found["key_path"].shape[1]] = found["key_path"]
        assert (path == keys["path"]).all()
        assert found["key_path"].shape[1] == 2
        for name in ("kind", "host", "object"):
            assert (found["key_" + name] == keys[name]).all()
        assert found["names"].tolist() == ["a", "lib\nb"]
        assert (found["boxes"] == boxes).all()
    back = load_states(tmp_path / "s.npz")
    assert list(back.levels) == sorted(levels) and back.levels["a"] is back.levels["c"]
    for name, level in levels.items():
        assert np.array_equal(back.levels[name].corners, level.corners)
        assert np.array_equal(back.levels[name].faces, level.faces)
    assert (
        (back.state == state).all() and (back.hits == hits).all() and back.names == ("a", "lib\nb") and back.note == ""
    )
    assert back.faces.keys() == faces.keys() and all(np.array_equal(back.faces[name], faces[name]) for name in faces)


def test_states_do_not_depend_on_other_names(tmp_path):
    """The same instances with names in another order, and more of them: the same bytes."""
    keys = np.zeros(3, KEY)
    keys["path"] = -1
    nothing = np.zeros(3, np.uint8), np.zeros(3, np.float32), np.zeros((3, 5), np.int64)
    keys["host"], keys["object"] = (-1, 1, 1), (0, 0, 2)
    save_states(tmp_path / "a.npz", *nothing, keys, ("c", "b", "a"), note="x")
    keys["host"], keys["object"] = (-1, 4, 4), (1, 1, 3)
    save_states(tmp_path / "b.npz", *nothing, keys, ("z", "c", "y", "a", "b"), note="x")
    a, b = (load_states(tmp_path / name) for name in ("a.npz", "b.npz"))
    assert a.names == b.names == ("a", "b", "c")
    assert all((a.keys[name] == b.keys[name]).all() for name in a.keys)
    assert a.keys["host"].tolist() == [-1, 1, 1]
    assert a.note == "x"


def filled(folder, frames, **header):
    r = Report("a.blend", "5.2", "0.1", "light-paths", "cycles", 0, header.pop("threads", 2), header or {"samples": 4})
    for frame in frames:
        r.add_frame({"frame": frame, "render_s": 1.0}, (f"a{frame}",))
    r.write(folder)
    return r, json.loads((folder / "report.json").read_text())


def test_reports_of_parts_of_a_range_are_merged(tmp_path):
    """Of the same options but for threads: the frames of both, the later ones where both have them; other options begin
    anew."""
    filled(tmp_path, (5, 6))
    r, data = filled(tmp_path, (1, 6), threads=8)
    assert [f["frame"] for f in data["frames"]] == [1, 5, 6]
    assert (data["totals"]["frames"], data["totals"]["render_s"], data["approximated"]) == (3, 3.0, ["a5", "a6", "a1"])
    assert r.finished(tmp_path) == {1, 5, 6}
    assert r.other_options(tmp_path) == []
    assert len(r.frames) == 2
    r, data = filled(tmp_path, (7,), samples=8)
    assert [f["frame"] for f in data["frames"]] == [7]
    other = Report("b.blend", "5.2", "0.1", "light-paths", "cycles", 0, 1, {"samples": 4})
    assert other.other_options(tmp_path) == ["samples", "scene"]
    assert other.finished(tmp_path) is None


def test_reports_by_processes_at_a_time(tmp_path):
    """Ten writers at once lose no frame."""
    code = (
        "import sys; from tests.core.files.test_report import filled; from pathlib import Path; "
        "filled(Path(sys.argv[1]), (int(sys.argv[2]),))"
    )
    root = Path(__file__).parents[3]
    processes = [subprocess.Popen([sys.executable, "-c", code, str(tmp_path), str(k)], cwd=root) for k in range(4)]
    assert [p.wait() for p in processes] == [0] * 4
    assert report().finished(tmp_path) is None
    assert [f["frame"] for f in json.loads((tmp_path / "report.json").read_text())["frames"]] == list(range(4))


def test_a_damaged_report_counts_as_none(tmp_path):
    for text in ("", "[]", '{"schema": 1}', '{"schema": 1, "frames": ['):
        (tmp_path / "report.json").write_text(text)
        assert (report().finished(tmp_path), report().other_options(tmp_path)) == (None, [])
    assert filled(tmp_path, (1,))[1]["totals"]["frames"] == 1


def test_unwritable_folder(tmp_path):
    (tmp_path / "file").write_text("")
    for folder in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(InputError, match="cannot write"):
            output_folder(folder)
    assert output_folder(tmp_path / "a" / "b").is_dir()


def test_sizes():
    assert [size(n) for n in (0, 999, 1000, 2.5e6, 7.04e10)] == ["0 B", "999 B", "1 kB", "2.5 MB", "70.4 GB"]


def test_another_command_leaves_the_report_of_finished_frames(tmp_path):
    """By other options, or what is no report of ours: kept beside, not only until the first frame; one without frames
    need not be."""
    _, before = filled(tmp_path, (1, 2, 3))
    filled(tmp_path, (1,), samples=8)
    assert json.loads((tmp_path / "report_earlier_1.json").read_text()) == before
    (tmp_path / "report.json").write_text("mine")
    filled(tmp_path, (1,), samples=9)
    assert (tmp_path / "report_earlier_2.json").read_text() == "mine"
    (tmp_path / "empty").mkdir()
    filled(tmp_path / "empty", ())
    filled(tmp_path / "empty", (1,), samples=8)
    assert [p.name for p in (tmp_path / "empty").iterdir()] == ["report.json"]


def test_odd_reports_count_as_none(tmp_path):
    """Right keys with other things in them, nesting without an end, and no file at all."""
    _, data = filled(tmp_path, (1,))
    odd = (
        ("frames", 3),
        ("frames", [{"frame": "1"}]),
        ("frames", [{"frame": 1}]),
        ("totals", []),
        ("options", 1),
        ("warnings", [1]),
    )
    for key, value in (*odd, ("frames", [[]])):
        (tmp_path / "report.json").write_text(json.dumps(data | {key: value}))
        assert report().finished(tmp_path) is None, (key, value)
        r = filled(tmp_path, (2,))[1]
        assert [f["frame"] for f in r["frames"]] == [2]
    (tmp_path / "report.json").write_text("[" * 100_000)
    assert report().finished(tmp_path) is None
    if hasattr(os, "mkfifo"):
        (tmp_path / "report.json").unlink()
        os.mkfifo(tmp_path / "report.json")
        assert report().finished(tmp_path) is None


def test_all_is_all():
    """Opening, verifying and what belongs to no step are in it."""
    r = report()
    r.began = time.monotonic() - 100.0
    r.add_frame({"frame": 1, "trace_s": 3.0, "render_s": 4.0, "verify_s": 20.0})
    assert "100.0 s in all, of which 4.0 s rendering, 20.0 s verifying" in r.table()


def test_seconds_of_parts_are_summed_once(tmp_path):
    """However often a command writes."""
    for frames in ((1, 2), (3,)):
        r = Report("a.blend", "5.2", "0.1", "light-paths", "cycles", 0, 2)
        r.began = time.monotonic() - 50.0
        for frame in frames:
            r.add_frame({"frame": frame})
            r.write(tmp_path)
    assert 100.0 <= json.loads((tmp_path / "report.json").read_text())["totals"]["wall_s"] < 105.0


def test_shares_have_no_exponents() -> None:
    shares = (0.00051, 0.044, 0.994, 0.996, 1.42, 12.5)
    assert [percent(share) for share in shares] == ["0.051 %", "4.4 %", "99 %", "100 %", "142 %", "1,250 %"]
    assert [percent(share) for share in (0.0, 3e-9, 2e-5)] == ["0 %", "<0.001 %", "0.002 %"]
