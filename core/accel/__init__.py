"""Acceleration structures over the scene: Embree, a BLAS per mesh, the TLAS over active instances, hitboxes of culled
ones, the region tree.

Nothing here knows of light or of budgets. Structures may be swapped as long as the same ray finds the same hit at any
number of threads.
"""
