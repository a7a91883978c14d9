"""What users choose of engines and hybrid pictures, by name; loads neither Blender nor kernels."""

from __future__ import annotations

BLENDER_ENGINES = {"cycles": "CYCLES", "eevee": "BLENDER_EEVEE"}
ENGINES = (*BLENDER_ENGINES, "hybrid", "path")
