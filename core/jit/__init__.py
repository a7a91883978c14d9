"""What compiles kernels and keeps them: numba's cache by a hash of the sources, checked on load; atomics, raw pointers,
random numbers in kernels.

The floor of the house: imports nothing of the other rooms. A change here compiles every kernel anew.
"""
