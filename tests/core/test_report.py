"""report.json, states and the table."""

import json

import numpy as np
import pytest

from lipac.core.errors import InputError
from lipac.core.report import FIELDS, Report, output_folder, replacing, save_states, size
from lipac.lipac_addon.keys import KEY, MAX_DEPTH


def report():
    return Report("a.blend", "5.2", "0.1", "light-paths", "cycles", 0, 2)


def test_file_follows_the_contract(tmp_path):
    r = report()
    r.add_frame({"frame": 1, "instances": np.int64(5), "render_s": 2.0, "paths": 10, "blas_bytes": 7, "error": {"flip": 0.1}}, ("a",), ("w",))
    r.add_frame({"frame": 2, "render_s": 3.0, "paths": 20, "blas_bytes": 5}, ("a", "b"), ())
    r.write(tmp_path)
    data = json.loads((tmp_path / "report.json").read_text())
    assert list(data)[:10] == ["schema", "scene", "blender", "lipac", "policy", "engine", "seed", "threads", "frames", "totals"]
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
    state, score, hits = rng.integers(0, 3, n).astype(np.uint8), rng.random(n, np.float32), rng.integers(0, 70000, (n, 5))
    save_states(tmp_path / "s.npz", state, score, hits, keys, ("a", "lib\nb"))
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


def test_unwritable_folder(tmp_path):
    (tmp_path / "file").write_text("")
    for folder in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(InputError, match="cannot write"):
            output_folder(folder)
    assert output_folder(tmp_path / "a" / "b").is_dir()


def test_sizes():
    assert [size(n) for n in (0, 999, 1000, 2.5e6, 7.04e10)] == ["0 B", "999 B", "1 kB", "2.5 MB", "70.4 GB"]
