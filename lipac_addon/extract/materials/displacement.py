"""True displacement: how far a material moves a surface, by `ranges`, and the two shells between which the
surface then lies.

The tracer does not displace. In place of the surface it has the innermost and the outermost one that it can be, each of
which lets half of all rays pass, and walls between their ends: so whatever the displaced surface hides, shows or is hit
by, paths meet.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ....core.arrays import F32
from ....core.scene.mesh import Mesh
from .ranges import UNKNOWN, negative, product, range_of, total


@dataclass(frozen=True)
class Relief:
    """Within what a surface is moved along its normals, in metres of the object's space (infinite: not known); world:
    the material means the world's.

    slots: of the mesh, which are displaced; none: those of one material.
    """

    low: float
    high: float
    world: bool = False
    slots: tuple[bool, ...] = ()

    def joined(self, other: Relief | None) -> Relief:
        """What holds for both."""
        return (
            self
            if other is None
            else replace(
                self, low=min(self.low, other.low), high=max(self.high, other.high), world=self.world or other.world
            )
        )

    def scaled(self, factor: float) -> Relief:
        """Larger by a factor, where that is more than 1."""
        return replace(self, low=min(self.low, self.low * factor), high=max(self.high, self.high * factor))


def relief_of(tree: Any) -> Relief | None:
    """The relief by an inlined shader tree; None where it moves nothing."""
    output = tree.get_output_node("CYCLES")
    if output is None or not output.inputs["Displacement"].is_linked:
        return None
    node = output.inputs["Displacement"].links[0].from_node
    world = getattr(node, "space", "OBJECT") == "WORLD"
    if node.type == "DISPLACEMENT":
        low, high = product(
            total(range_of(node.inputs["Height"]), negative(range_of(node.inputs["Midlevel"]))),
            range_of(node.inputs["Scale"]),
        )
    elif node.type == "VECTOR_DISPLACEMENT":
        offset = product(
            total(range_of(node.inputs["Vector"]), negative(range_of(node.inputs["Midlevel"]))),
            range_of(node.inputs["Scale"]),
        )
        high = float(np.sqrt(3) * np.abs(offset).max())  # in any direction
        low = -high
    else:
        low, high = UNKNOWN
    return None if low == high == 0 else Relief(low, high, world)


def shells(mesh: Mesh, normals: F32, relief: Relief) -> Mesh:
    """A mesh whose displaced triangles are there twice: moved as far in and out along the normals of the vertices, (V,
    3) float32, as they may be. Where they end, walls of two triangles an edge join both: no path gets in between
    without meeting any of them."""
    slots: NDArray[Any] = np.zeros(len(mesh.triangles), np.uint16) if mesh.slots is None else mesh.slots
    displaced = np.array(relief.slots, bool)[np.minimum(slots, len(relief.slots) - 1)]
    count = len(mesh.positions)
    positions = np.concatenate(
        [mesh.positions, *(mesh.positions + normals * np.float32(offset) for offset in (relief.low, relief.high))]
    )
    own, moved = np.flatnonzero(~displaced), np.flatnonzero(displaced)
    row, a, b = _ends(mesh.triangles, moved)
    rows = np.concatenate([own, moved, moved, row, row])
    triangles = np.concatenate(
        [
            mesh.triangles[own],
            mesh.triangles[moved] + count,
            mesh.triangles[moved] + 2 * count,
            np.stack((a + count, b + count, b + 2 * count), axis=1),
            np.stack((a + count, b + 2 * count, a + 2 * count), axis=1),
        ]
    )
    shading = mesh.normals
    if shading is not None:
        shading = np.concatenate(3 * (shading,)) if shading.ndim == 2 else shading[rows]
    return Mesh(
        positions.astype(np.float32),
        triangles.astype(np.uint32),
        shading,
        None if mesh.uvs is None else np.ascontiguousarray(mesh.uvs[:, rows]),
        None if mesh.slots is None else mesh.slots[rows],
    )


def _ends(triangles: NDArray[np.uint32], among: NDArray[np.int64]) -> tuple[NDArray[np.int64], ...]:
    """Edges of triangles, (M, 3), that but one of those among has: rows of these, and both vertices."""
    row = np.tile(among, 3)
    a, b = (triangles[among][:, corners].T.reshape(-1).astype(np.int64) for corners in ([0, 1, 2], [1, 2, 0]))
    edge = np.stack((np.minimum(a, b), np.maximum(a, b)), axis=1)
    _, first, times = np.unique(edge, axis=0, return_index=True, return_counts=True)
    once = first[times == 1]
    return row[once], a[once], b[once]
