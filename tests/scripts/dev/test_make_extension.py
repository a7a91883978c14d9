"""The extension's zip: built, checked, installed into a fresh Blender that has none of its libraries, and used
there: the one place in all tests where every kernel is compiled, by two processes."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy
import pytest

from lipac.scripts.dev import make_extension

OURS = ("numba", "llvmlite", "embreex", "opengl_decimate", "lipac", "__editable__")
PYTHON = f"{sys.version_info[0]}{sys.version_info[1]}"

# What a process compiles, of ours
COMPILED = """
from numba.core import event
class Compiled(event.Listener):
    def on_start(self, event):
        function = event.data["dispatcher"].py_func
        if function.__module__.startswith("bl_ext.user_default.lipac."):
            compiled.add(function.__module__.rpartition(".")[2] + "." + function.__qualname__)
    def on_end(self, event):
        pass
compiled = set()
event.register("numba:compile", Compiled())
"""
USE = """
import importlib, importlib.util, os, pathlib, pkgutil, sys, bpy
resources, path = sys.argv[1:]
bpy.ops.wm.read_factory_settings(use_empty=True)
print(bpy.ops.extensions.package_install_files(filepath=path, repo="user_default", enable_on_install=False))
print(bpy.ops.preferences.addon_enable(module="bl_ext.user_default.lipac"))
assert "numba" not in sys.modules, "loaded at registration"
def part(name):
    return importlib.import_module("bl_ext.user_default.lipac." + name)
part("lipac_addon.demo.mirror_city").build(1000, 0)  # begins with factory settings, without add-ons
print(bpy.ops.preferences.addon_enable(module="bl_ext.user_default.lipac"))
scene = bpy.context.scene
scene.render.resolution_x, scene.render.resolution_y, scene.cycles.samples, scene.lipac.width = 64, 36, 1, 64
scene.render.filepath = os.path.join(resources, "picture.png")
def state():
    return {ob.name: (ob.hide_render, [m.name for m in ob.modifiers]) for ob in bpy.data.objects}
before = state()
COMPILED
assert bpy.ops.lipac.analyze() == {"FINISHED"}
# numba numbers a function's variants: had the second process, which compiles a part, other signatures than the kernel,
# each could take the same number for another one
files = {end: [str(path) for path in pathlib.Path(resources).rglob("*." + end)] for end in ("nbc", "nbi")}
assert len(files["nbc"]) == len(files["nbi"]), {end: len(names) for end, names in files.items()}
kernels = {os.path.basename(name).split("-")[0] for name in files["nbi"]}
assert {"tile_kernel.trace_tiles", *SHARED} <= kernels, "no compiled kernel in the extension's user folder"
assert part("core.threads").processors() == 1 or SHARED - compiled, "nothing was compiled by the second process"
for name in ("numba", "embreex"):
    origin = importlib.util.find_spec(name).origin
    assert origin.startswith(resources), origin
assert bpy.ops.lipac.apply() == {"FINISHED"}
assert state()["City"] == (False, before["City"][1] + ["LiPaC mask"]), state()["City"]
bpy.ops.render.render(write_still=True)
assert os.path.getsize(scene.render.filepath) > 500
assert bpy.ops.lipac.restore() == {"FINISHED"}
assert state() == before
page, places = part("lipac_addon.ui.manual").manual()
html = open(page.removeprefix("file://")).read()
assert page.endswith("user-guide.html")
assert all(f'id="{place[1:]}"' in html for _, place in places)
for root in ("core", "page", "lipac_addon", "scripts"):  # all that can be imported is there, with its data
    for module in pkgutil.walk_packages(part(root).__path__, root + "."):
        if not module.name.endswith("child_render"):  # a script
            part(module.name)
extraction = part("lipac_addon.extract").Extractor(scene).frame(1, keep=False)
hits = part("lipac_addon.raster.first_hits").TracedHits(extraction.scene).draw((64, 36)).hits
assert (hits["instance"] >= 0).mean() > 0.5, "the zip's numba and Embree trace no rays"
print(bpy.ops.preferences.addon_disable(module="bl_ext.user_default.lipac"))
assert not hasattr(bpy.types.Scene, "lipac")
print("USED")
""".replace("COMPILED", COMPILED)
AGAIN = """
import importlib, sys, bpy
bpy.ops.preferences.addon_enable(module="bl_ext.user_default.lipac")
importlib.import_module("bl_ext.user_default.lipac.lipac_addon.demo.mirror_city").build(1000, 0)
bpy.ops.preferences.addon_enable(module="bl_ext.user_default.lipac")
COMPILED
bpy.context.scene.render.resolution_x, bpy.context.scene.render.resolution_y = 64, 36
bpy.context.scene.lipac.width = 64
assert bpy.ops.lipac.analyze() == {"FINISHED"}
print("AGAIN", *compiled)
""".replace("COMPILED", COMPILED)
# Of what `second_process` compiles
SHARED = {"setup.bsdf_setup", "sample.bsdf_sample", "evaluate.bsdf_eval", "direct_light.add_direct_light"}


@pytest.fixture(scope="module")
def extension(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The zip for Linux and this Python."""
    if sys.platform != "linux":
        pytest.skip("installs the zip for Linux")
    out = tmp_path_factory.mktemp("dist")
    try:
        make_extension.download("linux-x64", [PYTHON], out / "wheels")
    except subprocess.CalledProcessError:
        pytest.skip("wheels cannot be downloaded here")
    assert make_extension.main(["-o", str(out), "--platform", "linux-x64", "--python", PYTHON]) == 0
    return next(out.glob("*.zip"))


def bare_site(folder: Path) -> Path:
    """A folder with everything that is installed here, but for our own package and the libraries that the extension
    brings."""
    folder.mkdir()
    for path in Path(numpy.__file__).parents[1].iterdir():
        if not path.name.startswith(OURS) and not path.name.endswith(".pth"):
            (folder / path.name).symlink_to(path)
    return folder


def test_a_fresh_blender_installs_and_uses_the_zip(extension: Path, tmp_path: Path) -> None:
    resources = tmp_path / "resources"
    resources.mkdir()
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("LIPAC", "NUMBA"))}
    environment |= {"BLENDER_USER_RESOURCES": str(resources), "PYTHONPATH": str(bare_site(tmp_path / "site"))}

    def blender(code: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-S", "-c", f"SHARED = {SHARED}\n{code}", str(resources), str(extension)],
            env=environment,
            capture_output=True,
            text=True,
            check=False,
            cwd=tmp_path,
        )

    done = blender(USE)
    assert "USED" in done.stdout, done.stdout + done.stderr
    done = blender(AGAIN)
    said = [line for line in done.stdout.splitlines() if line.startswith("AGAIN")]
    assert said == ["AGAIN"], done.stdout + done.stderr  # nothing is compiled again


@pytest.mark.parametrize("lost", ["numba-", "core/culling/loop.py", "docs/user-guide.html"])
def test_a_zip_that_lacks_something_is_refused(extension: Path, tmp_path: Path, lost: str) -> None:
    broken = tmp_path / extension.name
    with zipfile.ZipFile(extension) as source, zipfile.ZipFile(broken, "w") as target:
        for name in source.namelist():
            if lost not in name:
                target.writestr(name, b"" if name.endswith(".whl") else source.read(name))
    with pytest.raises(SystemExit, match=lost.rstrip("-")):
        make_extension.check(broken, "linux-x64", [PYTHON])


def test_every_platform_has_a_manifest_that_names_its_wheels() -> None:
    for platform in make_extension.PLATFORMS:
        text = make_extension.manifest(platform, ["a.whl"])
        assert f'platforms = ["{platform}"]' in text
        assert '"./wheels/a.whl"' in text


def test_pages_of_the_zip_lead_to_each_other(tmp_path: Path) -> None:
    """Links and pictures of the manual are in the zip; blocks of commands are blocks."""
    make_extension.write_docs(tmp_path / "docs")
    for page in (tmp_path / "docs").glob("*.html"):
        text = page.read_text()
        for target in re.findall(r'(?:href|src)="([^"#:]+)"', text):
            assert (page.parent / target.partition("#")[0]).is_file(), f"{page.name}: {target}"
    assert "<pre><code" in (tmp_path / "docs" / "user-guide.html").read_text()
