"""Preferences: what the machine is to give, and the budget of scenes that set none."""

import os
import subprocess
import sys
from pathlib import Path

import bpy
import pytest

from lipac.lipac_addon.ui.state import kernel_folder as kernels
from lipac.lipac_addon.ui.state import preferences, props


@pytest.fixture
def preferred(scene):
    """The add-on's own preferences, as when it is enabled in Blender."""
    addon = bpy.context.preferences.addons.new()
    addon.module = preferences.ROOT
    yield addon.preferences
    bpy.context.preferences.addons.remove(addon)


def test_defaults_without_an_enabled_add_on(scene):
    assert preferences.get() is preferences.DEFAULTS
    own = {
        p.identifier: p.default
        for p in preferences.LipacPreferences.bl_rna.properties
        if hasattr(preferences.DEFAULTS, p.identifier)
    }
    assert own == vars(preferences.DEFAULTS)


def test_threads_and_memory_go_to_the_analysis(preferred, scene):
    preferred.threads, preferred.memory = 1, 0.5
    options = props.cull_options(scene.lipac)
    assert (options.threads, options.blas_budget_bytes) == (1, 1 << 29)


def test_the_default_budget_is_for_scenes_that_set_none(preferred, scene):
    preferred.max_error, preferred.worst_error = 3.0, 9.0
    assert (scene.lipac.max_error, scene.lipac.worst_error) == (3.0, 9.0)
    scene.lipac.max_error = 1.0  # the built-in default, but set
    assert props.cull_options(scene.lipac).max_error.mean == pytest.approx(0.01)
    assert scene.lipac.worst_error == 9.0
    scene.lipac.property_unset("max_error")
    assert scene.lipac.max_error == 3.0


def test_a_memory_budget_is_kept(preferred, scene):
    """A byte is not enough for any mesh."""
    scene.lipac.policy, scene.lipac.width = "light-paths", 64
    assert bpy.ops.lipac.analyze() == {"FINISHED"}
    from lipac.lipac_addon.ui.state import results

    free = results.at(scene).stats["blas_held_bytes"]
    preferred.memory = free / 2 / preferences.GIB
    bpy.ops.lipac.analyze()
    assert results.at(scene).stats["blas_held_bytes"] <= free / 2


def test_kernels_of_other_versions_are_not_counted(tmp_path, monkeypatch):
    """They are counted twice a second while an analysis runs: only the folder in use is looked at."""
    monkeypatch.setenv("LIPAC_CACHE_DIR", str(tmp_path))
    old, new = "kernels-3.13-00000000000a", "kernels-3.13-00000000000b"
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / new))
    assert kernels.count() == 0
    for version, numbers in ((old, range(5)), (new, range(3))):
        (tmp_path / version / "core").mkdir(parents=True)
        (tmp_path / version / ".lipac-kernels").touch()
        for k in numbers:
            (tmp_path / version / "core" / f"{k}.nbi").write_bytes(bytes(100))
    (tmp_path / new / "core" / "0.1.nbc").write_bytes(bytes(100))
    assert kernels.count() == 3
    assert kernels.size() == 900


def test_a_kernel_that_goes_while_it_is_measured(tmp_path, monkeypatch):
    """numba writes under another name first; the preferences are drawn meanwhile."""
    monkeypatch.setenv("LIPAC_CACHE_DIR", str(tmp_path))
    folder = tmp_path / "kernels-3.13-00000000000a"
    folder.mkdir()
    for name in (".lipac-kernels", "a.nbi", "tmp.b.nbi"):
        (folder / name).write_bytes(bytes(100))
    stat = Path.stat

    def gone(path, **options):
        if path.name == "tmp.b.nbi":
            raise FileNotFoundError(path)
        return stat(path, **options)

    monkeypatch.setattr(Path, "is_file", lambda _path: True)
    monkeypatch.setattr(Path, "stat", gone)
    assert kernels.size() == 200


def test_an_extension_is_enabled_where_its_folder_is_read_only(monkeypatch):
    def refused(*_names, **_options):
        raise PermissionError("read-only")

    monkeypatch.setattr(preferences, "ROOT", "bl_ext.studio.lipac")
    monkeypatch.setattr(bpy.utils, "extension_path_user", refused)
    monkeypatch.delenv("LIPAC_CACHE_DIR", raising=False)
    preferences._use_cache()
    assert "LIPAC_CACHE_DIR" not in os.environ


def test_the_button_removes_what_is_ours_alone(tmp_path, monkeypatch):
    monkeypatch.setenv("LIPAC_CACHE_DIR", str(tmp_path))
    for name in ("kernels-of-my-own", "kernels-3.13-00000000000a"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "precious").write_bytes(bytes(100))
    (tmp_path / "kernels-3.13-00000000000a" / ".lipac-kernels").touch()
    assert kernels.clear() == 100
    assert [p.name for p in tmp_path.iterdir()] == ["kernels-of-my-own"]


CACHE = """
import os, sys, bpy, lipac
from lipac.lipac_addon.ui.state import kernel_folder, preferences
addon = bpy.context.preferences.addons.new()
addon.module = "lipac"
bpy.utils.register_class(preferences.LipacPreferences)
addon.preferences.cache = sys.argv[1]
bpy.utils.unregister_class(preferences.LipacPreferences)
lipac.register()
from lipac.core.jit.kernel_cache import user_cache
assert str(user_cache()) == sys.argv[1], user_cache()
folder = next(user_cache().glob("kernels-*"))
(folder / "a.nbi").write_bytes(bytes(1000))
assert kernel_folder.size() == 1000
assert bpy.ops.lipac.clear_cache() == {"FINISHED"}
assert kernel_folder.size() == 0 and not folder.exists()
lipac.unregister()
assert "LIPAC_CACHE_DIR" not in os.environ
print("DONE")
"""


def test_the_cache_folder_and_clearing_it(tmp_path):
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("LIPAC", "NUMBA"))}
    done = subprocess.run(
        [sys.executable, "-c", CACHE, str(tmp_path / "own")],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert "DONE" in done.stdout, done.stdout + done.stderr
