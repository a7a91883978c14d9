"""The error that --verify states is that of the two pictures, by whichever engine, and the file is left as it was."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import bpy
import numpy as np
import pytest

from lipac.core.arrays import F32
from lipac.core.culling.options import CullOptions
from lipac.core.error_budget.budget import Budget
from lipac.core.evaluation.judge import picture_change
from lipac.core.files.report import Report
from lipac.core.scene.film import LUMINANCE
from lipac.lipac_addon.batch import enforcing, session
from lipac.lipac_addon.batch import verify as verifying
from lipac.lipac_addon.batch.job import Job
from lipac.lipac_addon.batch.pipeline import run
from lipac.lipac_addon.batch.verify import GRID, Verified, change, random_crops
from lipac.lipac_addon.pictures import read_picture
from lipac.page.pictures import of_crops

NEAR = CullOptions(policy="distance", setting=13.2)  # culls boxes that the camera sees
ALL = GRID[0] * GRID[1]


@pytest.mark.parametrize("engine", ["cycles", "path"])
def test_all_crops_measure_what_the_whole_pictures_show(boxes: Any, tmp_path: Path, engine: str) -> None:
    """Tolerance: crops and pictures need not share their noise; of 16 samples, it is a tenth of the change at most."""
    frames = {}
    for name, options, verify in (("full", CullOptions(policy="none"), 0), ("culled", NEAR, ALL)):
        report = Report("boxes", "", "", options.policy, engine, 0, 1)
        run(Job(tmp_path / name, (1,), options, engine, samples=16, verify=verify), report)
        frames[name] = report.frames[0]
    culled = frames["culled"]
    assert 0 < culled["active"] < 10
    mean, worst = picture_change(*(read_picture(tmp_path / name / "frame_0001.exr") for name in ("full", "culled")))
    assert mean > 0.01
    assert culled["verified_mean"] == pytest.approx(mean, rel=0.1)
    assert culled["verified_worst"] == pytest.approx(worst, rel=0.1)
    assert len(culled["verified_crops"]) == ALL
    assert "verified_mean" not in frames["full"]
    assert not any(ob.hide_render for ob in bpy.data.objects) and not bpy.context.scene.render.use_border


class Noise:
    """In place of a tracer: the light of a path is noise by seed and sample."""

    def __init__(self, scene: Any, options: CullOptions, _cancelled: Any) -> None:
        self.seed, self.sizes = options.seed, (scene.film.height, options.width)
        self.tracer, self.activation = self, SimpleNamespace(exists=np.ones(1, bool))
        self.traced: list[tuple[int, int]] = []
        Noise.last = self

    last: Noise

    def trace_paths(self, _keep: Any, first: int, only: Any) -> tuple[F32, None]:
        assert only.flags.c_contiguous and only.all()
        self.traced.append((first, only.shape[2]))
        drawn = [np.random.default_rng([self.seed, first + k]).random((*self.sizes, 4)) for k in range(only.shape[2])]
        return np.mean(drawn, axis=0).astype(np.float32), None


def test_paths_of_a_verification_are_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """By other random numbers than an analysis of the same seed, whose picture may be as large. What is kept of them at
    a time is limited, and changes nothing but that."""
    monkeypatch.setattr(verifying, "Loop", Noise)
    scene: Any = SimpleNamespace(film=SimpleNamespace(height=36, width=64))

    def crops(samples: int, at_once: int) -> F32:
        monkeypatch.setattr(verifying, "PATH_BYTES", 36 * 64 * 13 * at_once)
        found = verifying._path_crops(scene, np.ones(1, bool), samples, 7, 0, random_crops(ALL, 0), lambda: False)
        np.testing.assert_array_equal(*found)
        return np.concatenate(found[0])

    whole = crops(5, 5)
    assert Noise.last.seed != 7
    assert Noise.last.traced == [(0, 5)] * 2
    np.testing.assert_allclose(crops(5, 2), whole, rtol=1e-5)
    assert Noise.last.traced == [(0, 2), (2, 2), (4, 1)] * 2
    np.testing.assert_allclose(crops(5, 0), whole, rtol=1e-5)
    crops(10_000, 10_000)
    assert Noise.last.traced == [(0, verifying.PATH_SAMPLES)] * 2


def test_nothing_culled_measures_as_nothing(boxes: Any, tmp_path: Path) -> None:
    report = Report("boxes", "", "", "distance", "cycles", 0, 1)
    run(Job(tmp_path, (1,), CullOptions(policy="distance", setting=1e6), "cycles", samples=1, verify=1), report)
    assert (report.frames[0]["verified_mean"], report.frames[0]["verified_worst"]) == (0.0, 0.0)
    assert "measured on crops that cycles rendered in full and culled: 0 % in the mean" in report.table()


def test_crops_are_not_denoised(boxes: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A denoiser's blotches are as smooth as a change: they told of a lamp in a shade that its budget was broken
    fivefold, which 2,000 samples do not show."""
    cycles, seen = bpy.context.scene.cycles, []
    cycles.use_denoising = True
    render = verifying.render_blender

    def watched(*args: Any) -> Any:
        seen.append(cycles.use_denoising)
        return render(*args)

    monkeypatch.setattr(verifying, "render_blender", watched)
    verifying.verified_blender("cycles", tmp_path / "crops", 1, 0, 1, 1)
    assert seen == [False, False]  # culled, and full
    assert cycles.use_denoising


def test_crops_differ_from_each_other_and_by_seed() -> None:
    assert len(set(random_crops(ALL, 0))) == ALL
    picks = {random_crops(2, seed) for seed in range(20)}
    assert len(picks) > 10
    assert all(0 <= x < GRID[0] and 0 <= y < GRID[1] for pick in picks for x, y in pick)
    assert np.array_equal(random_crops(3, 7), random_crops(3, 7))


def test_what_noise_may_make_is_taken_off() -> None:
    """Independent noise of 30 % in both pictures: the change that is surely there is none. A twentieth less light in a
    crop: most of that."""
    rng = np.random.default_rng(4)
    full, same, darker = (1 + 0.3 * rng.standard_normal((60, 80, 4)).astype(np.float32) for _ in range(3))
    noise, real = change([full], [same], ((0, 0),)), change([full], [0.8 * darker], ((0, 0),))
    assert noise.worst > 0
    assert (noise.least_mean, noise.least_worst) == (0.0, 0.0)
    assert 0.1 < real.least_mean < real.mean
    assert not noise.breaks(Budget(1e-4, 1e-4)) and real.breaks(Budget(0.05, 0.9)) and real.breaks(Budget(0.9, 0.05))


def test_noise_of_few_pixels_breaks_no_budget() -> None:
    """Pairs of independent noise, 4 x 4 pixels in each of 144 tiles: the mean size of noise is no change, and some tile
    is always off by a lot."""
    rng = np.random.default_rng(1)
    crops = tuple((x, y) for y in range(GRID[1]) for x in range(GRID[0]))
    found = []
    for _ in range(40):
        full, culled = (
            [rng.gamma(2.0, 0.5, (12, 16, 1)).astype(np.float32) * np.ones(4, np.float32) for _ in crops]
            for _ in range(2)
        )
        found.append(change(full, culled, crops))
    assert min(one.mean for one in found) > 0.1
    assert sum(one.least_mean > 0 for one in found) == 0
    assert sum(one.least_worst > 0.05 for one in found) <= 2


def test_colours_of_equal_luminance_break_a_budget() -> None:
    """Red and green for grey, as the budget counts it: nothing by luminance, and surely above it by colour."""
    full = np.ones((60, 80, 4), np.float32)
    culled = full.copy()
    culled[..., 0], culled[..., 1] = 1 + 0.1 / LUMINANCE[0], 1 - 0.1 / LUMINANCE[1]
    assert np.abs((culled - full)[..., :3] @ LUMINANCE).max() < 1e-6
    found = change([full], [culled], ((0, 0),))
    assert found.mean == pytest.approx(np.sqrt(((0.1 / LUMINANCE[:2]) ** 2).sum() / 3), rel=1e-5)
    assert found.breaks(Budget(0.1, 0.5)) and not found.breaks(Budget(0.5, 0.5))


@pytest.mark.parametrize("enforce", [False, True])
def test_a_broken_budget_warns_or_is_enforced(
    boxes: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, enforce: bool
) -> None:
    """An analysis that takes any change for none: the engine's pictures say otherwise. Enforced, the last attempt keeps
    everything."""
    decide = session.Session.decide

    def blind(self: session.Session, *args: Any) -> Any:
        result = decide(self, *args)
        result.state[:] = 0
        return result

    monkeypatch.setattr(session.Session, "decide", blind)
    report = Report("boxes", "", "", "light-paths", "cycles", 0, 1)
    options = CullOptions(max_error=Budget(0.01, 0.05), width=64)
    run(Job(tmp_path, (1,), options, "cycles", samples=4, verify=ALL, enforce=enforce), report)
    (frame,) = report.frames
    assert report.status == (0 if enforce else 3)
    assert any("more than the 1 % and 5 % that --max-error allows" in line for line in report.warnings) != enforce
    if enforce:
        assert frame["enforced"] == enforcing.ENFORCED
        assert frame["active"] == frame["instances"]
    else:
        assert frame["verified_least_worst"] > 0.05


@pytest.mark.parametrize("engine", ["cycles", "path"])
def test_something_black_before_a_transparent_film_counts(boxes: Any, tmp_path: Path, engine: str) -> None:
    """It is all that is culled: its colours are those of nothing."""
    for name in ("Plane", "wall"):
        bpy.data.objects.remove(bpy.data.objects[name])
    black = bpy.data.materials.new("black")
    tree = black.node_tree
    tree.nodes.clear()
    shader, output = tree.nodes.new("ShaderNodeBsdfDiffuse"), tree.nodes.new("ShaderNodeOutputMaterial")
    shader.inputs["Color"].default_value = (0, 0, 0, 1)
    tree.links.new(shader.outputs[0], output.inputs[0])
    near = bpy.data.objects["box0"]
    near.data, near.location.x = near.data.copy(), -4
    bpy.data.objects["box7"].data.materials.append(black)
    boxes.render.film_transparent = True
    report = Report("boxes", "", "", "distance", engine, 0, 1)
    run(Job(tmp_path, (1,), CullOptions(policy="distance", setting=19.5), engine, samples=4, verify=ALL), report)
    (frame,) = report.frames
    full, culled = (read_picture(tmp_path / "verified" / f"frame_0001_{name}.exr") for name in ("full", "culled"))
    np.testing.assert_allclose(full[..., :3].mean(), culled[..., :3].mean(), rtol=0.02)
    assert (full - culled)[..., 3].max() > 0.5
    assert frame["verified_least_worst"] > 0.05


def test_an_enforced_budget_is_as_much_smaller_as_the_picture_is_above_it() -> None:
    job = Job(Path(), (1,), CullOptions(max_error=Budget(0.01, 0.05)), "cycles", verify=1, enforce=True)
    entry = Verified(0.02, 0.2, 0.01, 0.1, ()).entry()
    assert enforcing.tightened(job, entry, 0).options.max_error == Budget(0.01 / 8, 0.05 / 8)
    assert enforcing.tightened(job, entry, enforcing.ENFORCED - 1).options.policy == "none"


def test_what_is_verified_of_each_tile_is_within_what_is_certified_of_it(boxes: Any, tmp_path: Path) -> None:
    """A budget that lets boxes go which the camera sees. Upside down the two do not fit."""
    report = Report("boxes", "", "", "light-paths", "path", 0, 1)
    options = CullOptions(max_error=Budget(0.05, 0.5))
    run(Job(tmp_path, (1,), options, "path", samples=64, verify=ALL), report)
    frame = report.frames[0]
    with np.load(tmp_path / "states" / "frame_0001.npz") as data:
        certified = data["certified"].reshape(9, 16)
    verified = of_crops(frame["verified_crops"], frame["verified_tiles"], GRID)
    assert frame["culled"] > 0 and verified.max() > 0.1
    assert (verified <= certified).mean() > 0.97 > (verified <= certified[::-1]).mean()
    assert verified.max() == pytest.approx(frame["verified_worst"])
    assert certified.max() <= frame["certified_worst"] + 1e-6


@pytest.mark.parametrize("engine", ["cycles", "path"])
def test_what_was_compared_is_kept(boxes: Any, tmp_path: Path, engine: str) -> None:
    """Crops lie where they are in the picture; what is not a crop is black."""
    report = Report("boxes", "", "", "distance", engine, 0, 1)
    run(Job(tmp_path, (1,), NEAR, engine, samples=4, verify=2), report)
    rendered = read_picture(tmp_path / "frame_0001.exr")[..., :3]
    full, culled = (
        read_picture(tmp_path / "verified" / f"frame_0001_{name}.exr")[..., :3] for name in ("full", "culled")
    )
    assert full.shape == culled.shape == rendered.shape
    height, width = rendered.shape[:2]
    inside = np.zeros((height, width), bool)
    for x, y in report.frames[0]["verified_crops"]:
        place = np.s_[y * height // 3 : (y + 1) * height // 3, x * width // 4 : (x + 1) * width // 4]
        inside[place] = True
    assert not full[~inside].any() and not culled[~inside].any()
    assert full[inside].mean() > 0 and np.abs(full - culled)[inside].mean() > 1e-3
    if engine == "cycles":  # the path tracer verifies by other random numbers
        np.testing.assert_allclose(culled[inside], rendered[inside], rtol=0.01, atol=1e-4)
        assert report.frames[0]["verified_full_s"] > 0 < report.frames[0]["verified_culled_s"]
    assert (tmp_path / "verified" / "frame_0001_full.png").stat().st_size > 100
