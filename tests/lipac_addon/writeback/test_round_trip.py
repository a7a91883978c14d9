"""Extract, write back, extract again: what comes back is what should be left. On every kind of instancing, and on real
scenes."""

from collections import Counter
from pathlib import Path

import bpy
import numpy as np
import pytest

import lipac
from lipac.lipac_addon.extract import extract_frame
from lipac.lipac_addon.writeback import apply, restore
from lipac.lipac_addon.writeback.plan import DUPLI, FEEDS, NESTED, PART, PARTICLE

SHARED = Path(lipac.__file__).parent.parent / "shared" / "scenes"
REAL = [
    "candela_city.blend",
    "rooms1024.blend",
    "kitchen.blend",
    "small/22_simple_GN.blend",
    "small/gn_nested_instances.blend",
    "small/01_multiple_collection_instances.blend",
]


def extracted():
    return extract_frame(bpy.context.scene, allow_no_camera=True)


def places(extraction):
    """Where each instance is, in metres from the world's origin, as a multiset key."""
    scene = extraction.scene
    matrix = scene.instances.transform.astype(np.float64)
    matrix[:, :, 3] += scene.origin
    return [tuple(row) for row in np.round(matrix.reshape(-1, 12), 3)]


def check_round_trip(shares=(0.4, 0.9)):
    full = extracted()
    before = places(full)
    rng = np.random.default_rng(0)
    removed = 0
    objects = full.keys.records["object"]
    # so that nothing of some stays, and these are emptied
    of_objects = (np.random.default_rng(1).random(len(full.keys.names) + 1) < 0.6)[objects]
    of_objects[objects == objects[0]] = False
    for culled in [*(rng.random(len(before)) < share for share in shares), of_objects]:
        result = apply(culled, full.keys, free=True)
        removed += result.removed.sum()
        gone = Counter(p for p, r in zip(before, result.removed, strict=True) if r)
        assert Counter(places(extracted())) == Counter(before) - gone
    restore()
    assert places(extracted()) == before
    return removed


def test_scenes(any_scene):
    check_round_trip()


@pytest.mark.parametrize("name", REAL)
def test_real_scenes(name):
    if not (SHARED / name).exists():
        pytest.skip(f"no {SHARED / name}")
    bpy.ops.wm.open_mainfile(filepath=str(SHARED / name))
    assert check_round_trip() > 0
    bpy.ops.wm.read_factory_settings(use_empty=True)


def left_over(shares=(0.3, 0.7, 0.95)):
    """Why instances stay that a set lets go, where the set has all that its keys say cannot go without it."""
    full, why = extracted(), Counter()
    rng = np.random.default_rng(0)
    for share in shares:
        keep = rng.random(len(full.keys.records)) >= share
        if full.scene.removal is not None:
            keep = full.scene.removal.staying(keep)
        result = apply(~keep, full.keys)
        why += Counter(result.kept)
        assert (result.removed == ~keep).all() == (not result.kept)
    restore()
    return why


def test_a_set_with_what_cannot_go_without_it_is_what_is_rendered(any_scene):
    """But for what keys do not tell: lights in an instance, simulations, and the like."""
    assert not {NESTED, PART, PARTICLE, DUPLI} & set(left_over())


@pytest.mark.parametrize("name", REAL)
def test_so_it_is_in_real_scenes(name):
    if not (SHARED / name).exists():
        pytest.skip(f"no {SHARED / name}")
    bpy.ops.wm.open_mainfile(filepath=str(SHARED / name))
    assert not set(left_over()) - {FEEDS}
    bpy.ops.wm.read_factory_settings(use_empty=True)
