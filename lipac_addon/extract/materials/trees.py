"""Materials that may consist of others, which paths pick at random by their shares."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ....core.arrays import Records
from ....core.scene.model import VIEWS, RayType, Shader, Unsure, default_material

ANY = np.inf  # stands for normals of which nothing is known, not even that they are near the surface's
UNKNOWN = 0.5  # roughness that stands for bumps: it spreads what is reflected over some 30 degrees


@dataclass(frozen=True)
class Composed:
    """A material that consists of two others. head: its own record, MIX or BY_RAY."""

    head: Records
    first: Tree
    second: Tree


Tree = Records | Composed


def leaves(tree: Tree) -> Iterator[Records]:
    """All records of a material that are not composed, to be changed in place."""
    if isinstance(tree, Composed):
        yield from leaves(tree.first)
        yield from leaves(tree.second)
    else:
        yield tree


def heads(tree: Tree) -> Iterator[Records]:
    """All records of a material that are composed of others."""
    if isinstance(tree, Composed):
        yield tree.head
        yield from heads(tree.first)
        yield from heads(tree.second)


def unsure(tree: Tree, whether: bool = False) -> Tree:
    """The material, where it is not known how much passes through it. whether: nor that it does not pass all, or
    none."""
    clear = whether and any(passes_straight(leaf) for leaf in leaves(tree))
    for leaf in leaves(tree):
        mark(leaf, Unsure.BEHIND | Unsure.CLEAR if clear else Unsure.BEHIND)
    return tree


def mark(record: Records, what: Unsure) -> None:
    """Note that this of a record is not known, too."""
    record["unsure"] |= np.uint32(what)


def lets_in(record: Records) -> bool:
    """Whether light passes a material, in whatever direction."""
    through = (Shader.GLASS, Shader.REFRACTION, Shader.TRANSLUCENT)
    return bool(
        record["shader"] in through
        or record["transmission"] > 0
        or record["transmission_texture"] >= 0
        or passes_straight(record)
    )


def passes_straight(record: Records) -> bool:
    """Whether light passes a material on a straight line."""
    return bool(record["shader"] == Shader.TRANSPARENT or record["alpha"] < 1 or record["alpha_texture"] >= 0)


def doubled(tree: Tree) -> Tree:
    """The material, where half of the paths see it and nobody knows how many do: its emission is the most that it may
    be."""
    for leaf in leaves(tree):
        leaf["emission"] *= 2
        leaf["unsure_emission"] |= bool(leaf["emission"].any())
    return tree


def key_of(tree: Tree) -> bytes:
    """Tells materials apart."""
    return (
        tree.head.tobytes() + key_of(tree.first) + key_of(tree.second) if isinstance(tree, Composed) else tree.tobytes()
    )


def mixed(first: Tree, second: Tree) -> Composed:
    """Half of each."""
    head = default_material()
    head["shader"], head["alpha"] = Shader.MIX, 0.5
    return Composed(head, first, second)


def opaque_to_shadows(tree: Tree) -> Tree:
    """The material, which lets light of lamps through nowhere (Blender's Transparent Shadows is off)."""
    head = default_material()
    head["shader"], head["rays"] = Shader.BY_RAY, 1 << RayType.SHADOW | 1 << (VIEWS + RayType.SHADOW)
    return Composed(head, tree, black())


def spread(tree: Tree, roughness: float) -> Tree:
    """The material, where its normals turn by what is not followed: half as it is, half as if it were so rough, so that
    both what a smooth surface reflects and what is around it is seen. What is as rough anyway stays as it is. Of what
    shows nothing but what it reflects or refracts, by normals of which nothing is known (ANY), half is sure."""
    rough = copied(tree)
    for leaf in leaves(rough):
        if roughness == ANY and leaf["roughness"] < UNKNOWN and _mirrors(leaf):
            mark(leaf, Unsure.LIGHT)
        leaf["roughness"], leaf["roughness_texture"] = max(float(leaf["roughness"]), min(roughness, 1.0)), -1
        if leaf["coat"] > 0:
            leaf["coat_roughness"] = max(float(leaf["coat_roughness"]), min(roughness, 1.0))
    return tree if key_of(rough) == key_of(tree) else mixed(tree, rough)


def _mirrors(record: Records) -> bool:
    """Whether a material shows nothing but what it reflects or refracts."""
    return bool(
        int(record["shader"]) in (Shader.GLOSSY, Shader.GLASS, Shader.REFRACTION)
        or (record["shader"] == Shader.PRINCIPLED and max(record["metallic"], record["transmission"]) > 0)
    )


def copied(tree: Tree) -> Tree:
    """The same material, to be changed."""
    if isinstance(tree, Composed):
        return Composed(tree.head.copy(), copied(tree.first), copied(tree.second))
    return tree.copy()


def glowing_through(record: Records, share: float) -> Tree:
    """A surface of which light goes in and comes out elsewhere: half of that share of the paths come out at the other
    side."""
    through = record.copy()
    through["shader"] = Shader.TRANSLUCENT
    mark(through, Unsure.LIGHT)
    out = mixed(record, through)
    out.head["alpha"] = share / 2
    return out


def scattered() -> Records:
    """Light that a volume scatters, whatever its direction, where it enters."""
    record = default_material()
    record["shader"] = Shader.TRANSLUCENT
    return record


def filled(tree: Tree, glow: float, scatters: bool) -> Tree:
    """A surface with a volume behind it: how much of the light that enters comes out again nobody knows. glow: what a
    metre of the volume emits; scatters: half of the paths are scattered where they enter."""
    into = [leaf for leaf in leaves(tree) if lets_in(leaf)]
    for leaf in into:
        mark(leaf, Unsure.LIGHT)
    within = scattered() if into and scatters else black()
    if within["shader"] == Shader.TRANSLUCENT:
        mark(within, Unsure.LIGHT)
    elif glow <= 0:
        return tree
    return mixed(tree, glowing(within, 2 * glow))


def half_sure(tree: Tree) -> Tree:
    """A surface that may send on less light than is thought: half of it counts as surely there."""
    doubtful = copied(tree)
    for leaf in leaves(doubtful):
        mark(leaf, Unsure.LIGHT)
    return mixed(tree, doubtful)


def glowing(record: Records, radiance: float) -> Records:
    """The material, that emits so much at most."""
    record["emission"], record["unsure_emission"] = radiance, radiance > 0
    return record


def black() -> Records:
    record = default_material()
    record["shader"] = Shader.EMISSION
    return record


def clear() -> Records:
    record = default_material()
    record["shader"], record["base_color"] = Shader.TRANSPARENT, 1.0
    return record


def is_clear(record: Records) -> bool:
    return bool(
        record["shader"] == Shader.TRANSPARENT
        and np.abs(record["base_color"] - 1).max() <= 1e-3
        and record["base_color_texture"] < 0
    )


def both_textured(emitter: Records, tree: Tree) -> bool:
    """Whether some leaf cannot take the emission on."""
    return any(_clash(emitter, leaf) for leaf in leaves(tree))


def _clash(a: Records, b: Records) -> bool:
    both = a["emission"].any() and b["emission"].any()
    return bool(both and (a["emission_texture"] >= 0 or b["emission_texture"] >= 0))


def add_emission(record: Records, emitter: Records) -> None:
    record["emission"] += emitter["emission"]
    record["unsure_emission"] |= emitter["unsure_emission"]
    if emitter["emission"].any():
        record["emission_texture"] = emitter["emission_texture"]
