"""LiPaC's engine: arrays in, arrays out, no Blender.

Read the modules in the order of a frame: `scene` (what comes in), `blas`, `tlas` and `hitboxes` (build the structure), `tracer` (trace), `feedback` and
`culling` (process feedback), `loop` (the three steps, repeated).
"""
