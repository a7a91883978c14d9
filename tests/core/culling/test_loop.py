"""The loop keeps what light paths need and culls the rest, the same at any number of threads."""

from __future__ import annotations

import numpy as np
import pytest

from lipac.core.accel.blas import BlasCache
from lipac.core.accel.tlas import Tlas
from lipac.core.culling.analysis import analyze
from lipac.core.culling.loop import Loop
from lipac.core.culling.options import CullOptions, State
from lipac.core.culling.policies import LIGHT_PATHS, POLICIES
from lipac.core.errors import Cancelled
from lipac.core.feedback.hits import Weights
from lipac.core.feedback.path_log import PathLog
from lipac.core.scene import model as s
from lipac.core.tracing.tracer import prepare, trace

from .. import scenes
from .test_certificate import meadow

FLOOR, MIRROR, SEEN, REFLECTED, BEHIND_MIRROR, CASTER, UNDERGROUND = range(7)


def stage() -> s.Scene:
    """Looking along +Y at a mirror that faces the camera: one cube ahead, one behind the camera that the mirror shows,
    one behind the mirror, one high up beside the picture that throws its shadow into it, and a crowd of cubes under the
    floor."""
    grey, mirror = s.default_material(), s.default_material()
    mirror["metallic"], mirror["roughness"], mirror["base_color"] = 1.0, 0.0, 0.95
    upright = np.array([[16, 0, 0, 0], [0, 0, -1, 6], [0, 12, 0, 6]], np.float32)  # a quad in the XZ plane, facing -Y
    placement = [
        (1, scenes.placed((0, 0, 0), 60.0), 0),
        (1, upright, 1),
        (0, scenes.placed((-1.5, 3, 0.5)), 0),
        (0, scenes.placed((1.5, -14, 0.5)), 0),
        (0, scenes.placed((0, 12, 0.5)), 0),
        (0, scenes.placed((12, 3, 12), 2.5), 0),
    ]
    rng = np.random.default_rng(4)
    placement += [(2, scenes.placed((*rng.uniform(-25, 25, 2), rng.uniform(-9, -2))), 0) for _ in range(3000)]
    sun = np.zeros(1, s.LIGHT)
    toward = np.array([1.0, 0.0, 1.0]) / np.sqrt(2)
    sun["kind"], sun["power"], sun["angle"], sun["cast_shadow"], sun["normalize"], sun["use_mis"] = (
        s.LightKind.SUN, 3.0, 0.01, 1, 1, 1
    )
    sun["visibility"], sun["max_bounces"] = s.ALL_RAYS, 1024
    sun["axis_z"], sun["axis_x"], sun["axis_y"] = toward, (0, 1, 0), np.cross(toward, (0, 1, 0))
    return scenes.build(
        [scenes.cube(), scenes.quad(), scenes.sphere(6)],
        placement,
        [grey, mirror],
        scenes.look_at((0, -6, 1.6), (0, 6, 1.6)),
        sun,
        world=(0.2, 0.25, 0.3),
        size=(160, 90),
        limits=s.PathLimits(total=2, diffuse=1, glossy=2, transmission=0),
    )


OPTIONS = CullOptions(width=160, paths=4, min_share=2e-5)


def test_a_result_carries_what_it_built(monkeypatch: pytest.MonkeyPatch) -> None:
    """A renderer goes on with it: nothing is read or built again."""
    scene = stage()
    result = analyze(scene, OPTIONS)
    assert result.built is not None
    assert result.built.tlas.ids.tolist() == np.flatnonzero(result.active).tolist()
    monkeypatch.setattr(BlasCache, "_build", lambda *_: pytest.fail("built again"))
    picture = trace(result.built.prepared.with_emitters(result.active), result.built.tlas, 1)
    blas = BlasCache(scene.meshes)
    monkeypatch.undo()
    blas.need(scene.instances.mesh[result.active])
    anew = trace(prepare(scene, blas).with_emitters(result.active), Tlas(scene.instances, blas, result.active), 1)
    assert picture.sums.tobytes() == anew.sums.tobytes()


def test_what_the_picture_needs_is_active_and_nothing_else() -> None:
    scene = stage()
    result = analyze(scene, OPTIONS)
    assert result.active[[FLOOR, MIRROR, SEEN, REFLECTED, CASTER]].all()
    assert not result.active[UNDERGROUND:].any()
    assert not result.active[BEHIND_MIRROR]
    hits = result.hits
    assert hits[SEEN, s.RayType.CAMERA] > 100
    assert hits[REFLECTED, s.RayType.GLOSSY] > 30
    assert hits[CASTER, s.RayType.CAMERA] == 0
    assert hits[CASTER, s.RayType.SHADOW] > 30
    assert hits[BEHIND_MIRROR].sum() == 0
    np.testing.assert_allclose(result.score * 4 * 160 * 90, hits.sum(axis=1), rtol=1e-5)


def test_a_budget_keeps_the_same_things() -> None:
    result = analyze(stage(), CullOptions(width=160))
    assert result.active[[FLOOR, MIRROR, SEEN, REFLECTED, CASTER]].all()
    assert not result.active[[BEHIND_MIRROR, *range(UNDERGROUND, 3006)]].any()
    assert result.stats["certified_mean"] <= 0.01
    assert result.stats["certified_worst"] <= 0.05
    assert (result.score[:BEHIND_MIRROR] > 0.001).all()


def test_cost_follows_what_is_active() -> None:
    scene = stage()

    asked: set[int] = set()

    class Asked(list):
        def __getitem__(self, index):
            asked.add(index)
            return super().__getitem__(index)

    lazy = s.Scene(**{**scene.__dict__, "meshes": Asked(scene.meshes)})
    stats = analyze(lazy, OPTIONS).stats
    assert asked <= {0, 1, 2}
    assert stats["meshes"] == 2  # what was built under the floor, while the floor was not there yet, is freed again
    assert stats["active"] + stats["culled"] == stats["instances"] == 3006
    assert stats["hitboxes"] < 150  # three thousand culled instances stand in few regions
    full = analyze(scene, CullOptions(policy="none")).stats
    assert full["active"] == 3006
    assert stats["tlas_bytes"] < full["tlas_bytes"] / 10
    assert stats["blas_bytes"] < full["blas_bytes"]


def test_a_measurement_sees_all_of_a_meadow() -> None:
    """Where each path meets other blades, its own paths open what they cross: rounds of others would take long to find
    all of them."""
    loop = Loop(meadow(8000), CullOptions(width=96, paths=2))
    measured = loop.run()
    assert loop.rounds <= 16
    everything = loop.tracer.build(loop.activation.exists)
    log = PathLog.zeros(*measured.log.shape)
    weights = Weights.zeros(len(everything), 1.0)
    loop.tracer.count(loop.tracer.prepared, everything, log.shape[2], 0, None, weights, log=log)
    others = (log.color != measured.log.color).any(axis=-1)
    assert others.mean() < 0.02
    assert measured.met.any()
    assert len(measured.tlas) < len(everything)


@pytest.mark.parametrize("threads", [1, 4])
def test_states_and_hits_do_not_depend_on_threads(threads: int) -> None:
    scene = stage()
    a, b = (analyze(scene, CullOptions(width=160, paths=2, threads=t)) for t in (2, threads))
    np.testing.assert_array_equal(a.state, b.state)
    np.testing.assert_array_equal(a.hits, b.hits)
    np.testing.assert_array_equal(a.boxes, b.boxes)


def test_an_unseen_emitter_that_lights_the_picture_stays() -> None:
    lamp = s.default_material()
    lamp["emission"] = 50.0
    placement = [
        (1, scenes.placed((0, 0, 0), 40.0), 0),
        (1, scenes.placed((0, -9, 6), 2.0), 1),
        (1, scenes.placed((0, 0, -50)), 1),
    ]
    facing_down = placement[1][1]
    facing_down[:, :3] *= np.array([1, -1, -1])
    scene = scenes.build(
        [scenes.cube(), scenes.quad()],
        placement,
        [s.default_material(), lamp],
        scenes.look_at((0, -8, 2), (0, 0, 0)),
        world=(0, 0, 0),
    )
    result = analyze(scene, CullOptions(paths=8))
    assert result.state.tolist() == [State.ACTIVE, State.ACTIVE, State.CULLED]
    assert result.hits[1, s.RayType.CAMERA] == 0


def test_instances_that_cannot_exist_are_culled_and_harm_nothing() -> None:
    scene = stage()
    scene.instances.transform[BEHIND_MIRROR] = np.nan
    scene.instances.bounds[BEHIND_MIRROR] = np.nan
    others = np.arange(len(scene.instances)) != BEHIND_MIRROR
    for policy in POLICIES:
        options = CullOptions(policy=policy, width=160)
        result = analyze(scene, options)
        assert not result.active[BEHIND_MIRROR]
        if policy == LIGHT_PATHS:
            assert result.active[SEEN]
        else:
            np.testing.assert_array_equal(result.active[others], analyze(stage(), options).active[others])


def test_cancel_stops_the_work() -> None:
    calls = iter([False] * 3)
    with pytest.raises(Cancelled):
        analyze(stage(), OPTIONS, cancelled=lambda: next(calls, True))


@pytest.mark.parametrize(
    "options",
    [CullOptions(width=160), OPTIONS, CullOptions(policy="distance", setting=0.1)],
    ids=["budget", "counts", "distance"],
)
def test_what_is_pinned_stays(options: CullOptions) -> None:
    scene = stage()
    pinned = np.zeros(len(scene.instances), bool)
    pinned[[BEHIND_MIRROR, UNDERGROUND]] = True
    scene.instances.bounds[UNDERGROUND + 1] = np.nan
    free, result = analyze(scene, options), analyze(scene, options, pinned=pinned)
    assert not free.active[pinned].any()
    assert result.active[pinned].all()
    np.testing.assert_array_equal(result.active[~pinned], free.active[~pinned])
    assert result.stats["active"] == free.stats["active"] + 2
    assert not analyze(scene, options, pinned=np.ones(len(pinned), bool)).active[UNDERGROUND + 1]  # it cannot exist
