"""What an instance is needed for: each reason to matter in a scene of its own, kept while the budget needs it and
culled from the budget on that allows it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from lipac.core.culling.analysis import analyze
from lipac.core.culling.options import CullOptions
from lipac.core.error_budget.budget import Budget
from lipac.core.evaluation.judge import Judge
from lipac.core.scene import model as s

from .. import scenes

SUBJECT = 0  # index of the instance in question, in every case
QUAD_UP = scenes.placed((0, 0, 0), 60.0)
PATHS = 24


def facing(
    x: tuple[float, float, float],
    z: tuple[float, float, float],
    location: tuple[float, float, float],
    width: float,
    height: float,
) -> np.ndarray:
    """A quad with its normal along z, its width along x."""
    out = np.zeros((3, 4), np.float32)
    out[:, 0], out[:, 1], out[:, 2], out[:, 3] = np.multiply(x, width), np.cross(z, x) * height, z, location
    return out


def sun(toward: tuple[float, float, float], power: float = 3.0) -> s.Records:
    """A sun of a small disc."""
    light = np.zeros(1, s.LIGHT)
    z = np.divide(toward, np.linalg.norm(toward))
    light["kind"], light["power"], light["angle"], light["cast_shadow"], light["normalize"], light["use_mis"] = (
        s.LightKind.SUN, power, 0.01, 1, 1, 1
    )
    light["visibility"], light["max_bounces"] = s.ALL_RAYS, 1024
    light["axis_z"], light["axis_x"], light["axis_y"] = z, (0, 1, 0), np.cross(z, (0, 1, 0))
    return light


def material(**values: object) -> s.Records:
    """A default material with some values of its own."""
    m = s.default_material()
    for name, value in values.items():
        m[name] = value
    return m


CAMERA = scenes.look_at((0, -8, 2.5), (0, 0, 0.5))
MESHES = [scenes.cube(), scenes.quad()]


def shadow_only() -> s.Scene:
    """A cube high above and beside the picture, whose shadow falls into it."""
    placement = [(0, scenes.placed((12, 0, 12), 3.0), 0), (1, QUAD_UP, 0)]
    return scenes.build(
        MESHES,
        placement,
        [material()],
        CAMERA,
        sun((1, 0, 1)),
        (0.1, 0.1, 0.1),
        (96, 54),
        s.PathLimits(total=1, diffuse=1),
    )


def mirror_only() -> s.Scene:
    """A bright cube behind the camera, seen in a mirror."""
    mirror = facing((1, 0, 0), (0, -1, 0), (0, 4, 3), 14, 8)
    placement = [(0, scenes.placed((1, -14, 2), 4.0), 2), (1, QUAD_UP, 0), (1, mirror, 1)]
    materials = [
        material(),
        material(metallic=1.0, roughness=0.0, base_color=0.95),
        material(base_color=(0.9, 0.1, 0.1)),
    ]
    return scenes.build(
        MESHES,
        placement,
        materials,
        CAMERA,
        sun((0, 1, 1)),
        (0.2, 0.2, 0.2),
        (96, 54),
        s.PathLimits(total=2, diffuse=1, glossy=2),
    )


def glass_only() -> s.Scene:
    """A dark cube that is seen through a pane of glass only: the rest of it is behind a wall."""
    walls = [(1, facing((1, 0, 0), (0, -1, 0), (x, 0, 3), 8, 8), 0) for x in (-5.5, 5.5)]
    placement = [
        (0, scenes.placed((0, 4, 1.5), 3.0), 2),
        (1, QUAD_UP, 0),
        (0, scenes.placed((0, 0, 3), (3, 0.1, 8)), 1),
        *walls,
    ]
    materials = [
        material(),
        material(shader=s.Shader.GLASS, roughness=0.0, ior=1.45, base_color=1.0),
        material(base_color=0.02),
    ]
    return scenes.build(
        MESHES,
        placement,
        materials,
        CAMERA,
        None,
        (1, 1, 1),
        (96, 54),
        s.PathLimits(total=6, diffuse=1, transmission=6),
    )


def sky_blocker() -> s.Scene:
    """A black roof out of sight, over a floor that only the sky lights."""
    roof = facing((1, 0, 0), (0, 0, -1), (0, 0, 8), 20, 20)
    placement = [(1, roof, 1), (1, QUAD_UP, 0)]
    return scenes.build(
        MESHES,
        placement,
        [material(), material(base_color=0.0)],
        CAMERA,
        None,
        (1, 1, 1),
        (96, 54),
        s.PathLimits(total=1, diffuse=1),
    )


def bounce_only() -> s.Scene:
    """A red wall beside the picture in full sun; the floor near it stands in a shadow that only the wall's light
    reaches."""
    wall = facing((0, 1, 0), (-1, 0, 0), (7, 0, 4), 16, 8)
    shade = facing((1, 0, 0), (0, 0, -1), (0, 0, 6), 10, 16)
    placement = [(1, wall, 1), (1, QUAD_UP, 0), (1, shade, 2)]
    materials = [material(), material(base_color=(0.9, 0.05, 0.05)), material(base_color=0.0)]
    return scenes.build(
        MESHES,
        placement,
        materials,
        CAMERA,
        sun((-1, 0, 0.6)),
        (0.02, 0.02, 0.02),
        (96, 54),
        s.PathLimits(total=2, diffuse=2),
    )


def unseen_emitter() -> s.Scene:
    """A lamp behind the camera, made of a glowing quad, that lights the room alone."""
    lamp = facing((1, 0, 0), (0, 0, -1), (0, -9, 6), 2, 2)
    placement = [(1, lamp, 1), (1, QUAD_UP, 0)]
    return scenes.build(
        MESHES,
        placement,
        [material(), material(emission=40.0)],
        CAMERA,
        None,
        (0, 0, 0),
        (96, 54),
        s.PathLimits(total=1, diffuse=1),
    )


CASES = [shadow_only, mirror_only, glass_only, sky_blocker, bounce_only, unseen_emitter]


def effect(scene: s.Scene) -> tuple[float, float]:
    """By how much the picture changes without the subject, mean and worst tile: a paired trace with many paths, which
    no analysis uses."""
    change = Judge(scene, 64).change(np.arange(len(scene.instances)) != SUBJECT)
    return change.mean, change.worst


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.__name__)
def test_kept_below_its_effect_and_culled_above(case: Any) -> None:
    """Half its effect is too small a budget, twice is enough (in between the analysis may err by its noise). The
    smallest budget always keeps it."""
    scene = case()
    mean, worst = effect(scene)
    assert mean > 2e-3  # the case does what it is called for

    def kept(budget: Budget, pinned: np.ndarray | None = None) -> bool:
        return bool(analyze(scene, CullOptions(width=96, paths=PATHS, max_error=budget), pinned=pinned).active[SUBJECT])

    assert kept(Budget(0.0, 0.0))
    assert kept(Budget(min(mean / 2, 0.2), 1e9))
    assert kept(Budget(1e9, min(worst / 2, 0.5)))  # less than what the floor is worth, which would else go first
    # else something larger might go in its place
    assert not kept(Budget(2 * mean, 2 * worst), np.arange(len(scene.instances)) != SUBJECT)


def test_what_does_nothing_is_culled_without_any_budget() -> None:
    """Under the floor: no path meets it, so even a budget of 0 culls it."""
    placement = [(0, scenes.placed((0, 2, -3)), 0), (1, QUAD_UP, 0), (0, scenes.placed((0, 0, 0.5)), 0)]
    scene = scenes.build(MESHES, placement, [material()], CAMERA, sun((1, 0, 1)), size=(96, 54))
    result = analyze(scene, CullOptions(width=96, paths=PATHS, max_error=Budget(0.0, 0.0)))
    assert result.active.tolist() == [False, True, True]


def test_what_the_camera_sees_is_kept() -> None:
    scene = scenes.build(
        MESHES,
        [(0, scenes.placed((0, 0, 0.5)), 0), (1, QUAD_UP, 0)],
        [material()],
        CAMERA,
        sun((1, 0, 1)),
        size=(96, 54),
    )
    assert analyze(scene, CullOptions(width=96, max_error=Budget(0.001, 0.005))).active.all()
