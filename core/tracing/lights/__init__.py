"""What lights a scene: lamps, emitting triangles, the world, and the tree that picks one of them.

Each kind has a sample and a density that agree (chi-square tests). Bounds of the light tree may be loose, never too
small.
"""
