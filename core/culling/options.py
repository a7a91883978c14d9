"""How to cull, and the states that it leads to."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from ..error_budget.budget import Budget
from ..errors import InputError
from ..feedback.tiles import COLUMNS, ROWS, TILES
from ..scene.model import Film, Scene
from .policies import LIGHT_PATHS, POLICIES

# Paths per coarse tile, times the bound T of the worst tile: by the rule of three something that none of n paths meets
# may be worth 3 / n of the tile's light, so n = 3 * 40 / T leaves at most a fortieth of T unseen (docs/method.md).
TILE_PATHS = 120
COUNTED_PATHS = 4  # per pixel, by counts
MOST_PATHS = 64  # per pixel


class State(IntEnum):
    """Activation state of an instance."""

    CULLED = 0
    PENDING = 1
    ACTIVE = 2


DEFAULT_BUDGET = Budget(0.01, 0.05)


@dataclass(frozen=True)
class CullOptions:
    """How to cull. Defaults suit a first scene.

    policy: one of `policies.POLICIES`. setting: the number that it goes by, such as metres or degrees; None: its
    default. max_error: for `light-paths`: the error budget. min_share: for `light-paths`, in place of a budget: an
    instance stays if at least this share of the paths meets it. paths: per pixel, for the measurement of both; 0: as
    many as the bounds need. width: of the analysis picture in pixels (its height follows the film). hitbox_every: one
    path in so many is tested against hitboxes. settled: requests per path at which the rounds of a frame end, 0: none
    may be left; max_iterations: rounds of a frame at most.

    memory: `light-paths`: bytes that the render may take; where `Scene.render_costs` say that it takes more, more is
    culled than max_error allows. 0: no limit.

    parts: large meshes are culled by parts, where an instance's flags let them. levels: with an error budget, meshes of
    what stays are exchanged for simplified ones, where `Scene.simplifiable` lets them.

    Over the frames of a shot: hysteresis: keep threshold = new threshold / hysteresis, 1 for none; mitigation: large
    instances that come into view are active at once (latency mitigation). blas_budget_ms: milliseconds of BLAS building
    per frame, the rest is done in later frames; blas_budget_bytes: of all BLASes together; 0: no limit, as for a final
    render.
    """

    policy: str = LIGHT_PATHS
    setting: float | None = None
    max_error: Budget = DEFAULT_BUDGET
    min_share: float | None = None
    paths: int = 0
    width: int = 240
    hitbox_every: int = 1
    settled: float = 0.02
    max_iterations: int = 64
    parts: bool = False
    levels: bool = False
    memory: int = 0
    hysteresis: float = 2.0
    mitigation: bool = True
    blas_budget_ms: float = 0.0
    blas_budget_bytes: int = 0
    seed: int = 0
    threads: int = 0

    def picture_size(self, film: Film) -> tuple[int, int]:
        """Width and height of the analysis picture: each tile has a pixel, also where the film is smaller."""
        width, height = min(self.width, film.width), min(round(self.width * film.height / film.width), film.height)
        return max(width, COLUMNS), max(height, ROWS)

    def coarse_size(self, film: Film) -> tuple[int, int]:
        """Width and height of the picture of coarse rounds."""
        width, height = self.picture_size(film)
        return max(width // 2, 1), max(height // 2, 1)

    def paths_per_pixel(self, film: Film) -> int:
        """Paths per pixel of a measurement, and of the certificate of what is chosen by it."""
        if self.by_counts:
            return self.paths or COUNTED_PATHS
        if self.paths:
            return max(self.paths, 2)
        width, height = self.picture_size(film)
        return int(
            np.clip(np.ceil(TILE_PATHS * TILES / (max(self.max_error.worst, 1e-3) * width * height)), 2, MOST_PATHS)
        )

    def first_paths_per_pixel(self, film: Film) -> int:
        """Paths per pixel of a first measurement: half of all, for the others judge what is chosen by these; by counts
        all."""
        samples = self.paths_per_pixel(film)
        return samples if self.by_counts else -(-samples // 2)

    def round_paths_per_pixel(self, film: Film) -> int:
        """Paths per pixel of a round at full size that comes before: half of a first measurement's."""
        return max(1, self.first_paths_per_pixel(film) // 2)

    @property
    def by_counts(self) -> bool:
        """Whether no budget is kept."""
        return self.min_share is not None or self.policy != LIGHT_PATHS

    def __post_init__(self) -> None:
        if self.policy not in POLICIES:
            raise InputError(
                f"unknown culling policy '{self.policy}': choose one of "
                f"{', '.join(name for name, p in POLICIES.items() if p.listed)}"
            )

    def rule(self, scene: Scene) -> np.ndarray:
        """Instances that the policy keeps, one that needs no light paths: (N,) bool."""
        policy = POLICIES[self.policy]
        assert policy.keep is not None
        default = policy.setting.default if policy.setting else 0.0
        return policy.keep(scene, default if self.setting is None else self.setting)
