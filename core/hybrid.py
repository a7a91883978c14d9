"""From passes of a raster and light paths to one picture.

The raster shows every instance; the light that paths bring to its hits comes from what is built alone. Shadows of lamps are traced where the blocker is built.
Where it is culled, the raster's shadow maps know: they tell which share v of a lamp's light arrives at all, and paths tell which share meets nothing that is
built and crosses no box of what is culled (clear), which crosses such a box (maybe), and which something built blocks (blocked). Only the light that crosses
boxes is in doubt, so the raster decides over it alone:

    clear + s maybe = v (clear + maybe + blocked),  0 <= s <= 1

With nothing culled there is no doubt, and shadows are exactly the traced ones; with everything culled they are exactly the raster's.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from . import path_kernel as kernel
from .errors import InputError
from .film import Picture
from .scene import F32, Scene

MODES = ("path", "diffuse-1", "reflections", "none")


def with_mode(scene: Scene, mode: str) -> Scene:
    """The scene with the bounces of a mode: all of the scene's own; one bounce of each kind; reflections and refractions but no diffuse bounce.

    Light of lamps, emitters and sky at a hit does not count as a bounce. With "none" nothing is traced. Raises InputError for an unknown mode.
    """
    limits = scene.limits
    if mode == "diffuse-1":
        limits = dataclasses.replace(limits, total=min(limits.total, 2), diffuse=min(limits.diffuse, 1), glossy=min(limits.glossy, 1), transmission=2)
    elif mode == "reflections":
        limits = dataclasses.replace(limits, diffuse=0)
    elif mode not in MODES:
        raise InputError(f"unknown global illumination '{mode}': choose one of {', '.join(MODES)}")
    return dataclasses.replace(scene, limits=limits)


@dataclass(frozen=True)
class Light:
    """Mean light of all passes, (H, W, 3) float32 each, linear, rows bottom up.

    straight: emission and background seen directly. clear, maybe: of lamps, at the first hit. indirect: all other light. alpha: (H, W).
    sampled: (H, W, 3), luminance of lamp samples at the first hit: clear, maybe, blocked.
    """

    straight: F32
    clear: F32
    maybe: F32
    indirect: F32
    alpha: F32
    sampled: F32

    @staticmethod
    def of(pictures: list[Picture]) -> Light:
        """From the passes' pictures, each with parts."""
        samples = np.float32(sum(p.samples for p in pictures))
        total = sum((p.sums for p in pictures[1:]), pictures[0].sums.copy()) / samples
        parts = [p.parts for p in pictures if p.parts is not None]
        part = sum(parts[1:], parts[0].copy()) / samples
        straight, clear, maybe = (part[..., at : at + 3] for at in (kernel.STRAIGHT, kernel.CLEAR, kernel.MAYBE))
        indirect = np.maximum(total[..., :3] - straight - clear - maybe, np.float32(0))
        return Light(straight, clear, maybe, indirect, total[..., 3], part[..., kernel.SAMPLED_CLEAR : kernel.SAMPLED_BLOCKED + 1])

    def doubt(self, visible: F32 | None) -> F32:
        """s (H, W): the share of `maybe` that arrives, where the share `visible` (H, W) of the lamps' light does; all of it where no raster says."""
        clear, maybe, blocked = np.moveaxis(self.sampled, 2, 0)
        if visible is None:
            return np.ones_like(maybe)
        wanted = visible * (clear + maybe + blocked) - clear
        return np.where(maybe > 0, np.clip(wanted / np.maximum(maybe, np.float32(1e-20)), 0, 1), np.float32(1)).astype(np.float32)

    def lamps(self, visible: F32 | None) -> F32:
        """Light of lamps at the first hit, (H, W, 3), shadows of built and of culled instances applied."""
        return self.clear + self.doubt(visible)[..., None] * self.maybe
