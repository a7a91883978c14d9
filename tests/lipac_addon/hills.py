"""Hills that are one mesh, most of which a camera low over them does not see."""

from __future__ import annotations

import bpy
import numpy as np


def hills(side: int, size: float) -> bpy.types.Object:
    """Smooth, of side x side quads over a square of size metres, 18 m high."""
    bpy.ops.mesh.primitive_grid_add(x_subdivisions=side, y_subdivisions=side, size=size)
    ob = bpy.context.object
    positions = np.empty(3 * len(ob.data.vertices), np.float32)
    ob.data.vertices.foreach_get("co", positions)
    positions[2::3] = 9 * np.sin(0.06 * positions[::3]) * np.cos(0.05 * positions[1::3])
    ob.data.vertices.foreach_set("co", positions)
    ob.data.shade_smooth()
    return ob
