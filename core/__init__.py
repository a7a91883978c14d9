"""LiPaC's engine: arrays in, arrays out, no Blender.

Read the modules in the order of a frame: `scene` (what comes in), `blas`, `tlas`, `hitboxes` and `regions` (build the structure), `tracer` and `path_kernel`
(trace), `feedback`, `culling`, `budget` and `calibration` (process feedback), `loop` (the three steps, repeated) and `analysis` (a frame), `frames` (a shot).
"""

from . import kernel_cache

kernel_cache.use()
