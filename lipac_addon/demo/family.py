"""`family`: random scatters, each from one number: what people scatter, in sizes from a tenth of a pixel to a hundred,
and an error budget.

No single instance of most of these scenes matters, and all of them together do. A seed draws a kind (`family_kinds`),
how many instances there are and how large they look, what they are made of, what lights them, and what they are seen
through. Whoever finds a budget broken needs to know the seed alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import bpy
import numpy as np

from ...core.errors import InputError
from .family_kinds import KINDS
from .family_stage import LENSES, SIZE, Stage

FEWEST, MOST = 300, 60_000
SMALLEST = 0.1  # pixels
BUDGETS = 0.003, 0.06  # of the mean
SPREAD = 5.0  # of the worst tile's bound to the mean's, mostly
SPREADS = 1.5, 20.0  # else
LIGHTS = "sun", "area", "spot", "point", "sky"
CLUSTER = 5  # parts of each instance, where instances are clusters


@dataclass(frozen=True)
class Draw:
    """What a seed draws.

    kind: name in `KINDS`; count: rows of the scatter; pixels: size of an instance where it is about in the middle of
    the scatter, in a picture of `SIZE`; clusters: whether a row is a collection of CLUSTER parts; mean, worst: the
    budget; lights: names; veil: what all is seen through or in, "" for nothing.
    """

    seed: int
    kind: str
    count: int
    pixels: float
    clusters: bool
    mean: float
    worst: float
    lights: tuple[str, ...]
    veil: str


def draw(seed: int) -> Draw:
    """The choices of a seed. Raises InputError for a negative one."""
    if seed < 0:
        raise InputError(f"--seed {seed}: give a number from 0 up")
    rng = np.random.default_rng((seed, 0))
    name = str(rng.choice(list(KINDS)))
    kind = KINDS[name]
    pixels = _log_uniform(rng, SMALLEST, kind.largest)
    most = kind.layers * SIZE[0] * SIZE[1] / pixels**2
    count = round(min(_log_uniform(rng, FEWEST, MOST), most))
    mean = _log_uniform(rng, *BUDGETS)
    spread = SPREAD if rng.random() < 0.75 else _log_uniform(rng, *SPREADS)
    lights = kind.lights
    if lights is None:
        lights = tuple(str(x) for x in rng.choice(LIGHTS, rng.integers(1, 4), replace=False))
    veil = str(rng.choice(["", "glass", "mirror"], p=[0.8, 0.1, 0.1])) if kind.veils else ""
    return Draw(
        seed,
        name,
        count,
        pixels,
        bool(rng.random() < 0.25) and kind.clusters,
        mean,
        min(spread * mean, 1.0),
        lights,
        veil,
    )


def build(instances: int | None, seed: int) -> None:
    """Replace the open file by the scene of a seed, with so many rows in its scatter, None: as many as the seed draws.
    Raises InputError for bad numbers."""
    drawn = draw(seed)
    if instances is not None and not 1 <= instances <= MOST:
        raise InputError(f"family takes 1 to {MOST:,} instances, not {instances:,}: change --instances")
    build_drawn(drawn if instances is None else replace(drawn, count=instances))


def build_drawn(drawn: Draw) -> None:
    """Replace the open file by a scene."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    rng = np.random.default_rng((drawn.seed, 1))
    stage = Stage(bpy.context.scene, rng, float(rng.choice(LENSES)))
    stage.settings(bounces=int(rng.choice([4, 8, 12])))
    scatter = KINDS[drawn.kind].build(stage, drawn.count, drawn.pixels)
    stage.scatter(scatter, CLUSTER if drawn.clusters else 1)
    if drawn.veil == "glass":
        stage.pane()
    elif drawn.veil == "mirror":
        stage.mirrored()
    for name in drawn.lights:
        stage.light(name, scatter.middle)
    if "sky" not in drawn.lights:
        stage.sky(float(rng.choice([0.0, 0.05, 0.3])))


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return math.exp(rng.uniform(math.log(low), math.log(high)))
