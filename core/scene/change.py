"""How a frame of a scene differs from the one before: what an animated loop needs to know, so that what did not change
is not looked at again."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..arrays import I32


@dataclass(frozen=True)
class Change:
    """From one `Scene` to the next of the same file.

    Meshes keep their index from frame to frame: `Scene.meshes` only grows, a mesh that vanished stays as an empty one
    until its index is given to another.

    previous: (N,) int32 row of each instance in the scene before, -1 for new ones; None: the same rows in the same
    order.
    moved: (N,) bool, instances whose transform, bounds, mesh, slots or flags changed (new ones included); None: none
    is.
    deformed: (D,) int32 meshes with the same triangles over moved vertices. replaced: (R,) int32 meshes with other
    triangles, new ones included. shading: materials, textures, lights or world changed. camera: the camera changed.
    """

    previous: I32 | None
    moved: np.ndarray | None
    deformed: I32
    replaced: I32
    shading: bool
    camera: bool

    @property
    def still(self) -> bool:
        """Nothing changed at all."""
        return (
            self.previous is None
            and self.moved is None
            and not len(self.deformed)
            and not len(self.replaced)
            and not self.shading
            and not self.camera
        )
