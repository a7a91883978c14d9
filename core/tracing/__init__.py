"""The path tracer: kernels from camera ray to light, and `tracer`, which calls them with arrays.

Kernels follow Cycles' models, by the tests against it; `bsdf` and `lights` may grow by a lobe or a lamp without a
change in `path_kernel`.
"""
