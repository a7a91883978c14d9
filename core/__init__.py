"""LiPaC's engine: arrays in, arrays out, no Blender.

Rooms, each above those that it may import: `jit` (compiling), `scene` (what comes in), `accel` (structures), `feedback`
(what paths report), `tracing` (paths), `error_budget` (bounds and what they allow), `culling` (the loop over all of
these, a frame, a shot), `hybrid` (with a raster), `evaluation` (judging all that). Beside them `files`.
tests/test_architecture.py keeps the order.
"""

from .jit import kernel_cache

kernel_cache.use()
