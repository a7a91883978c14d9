"""What an artist sees: the panel "LiPaC" in the sidebar of the 3D viewport, its operators, the overlay and the render handlers.

Data flows one way: `props` (what the user set) -> `job` (reads Blender on the main thread, analyses in a worker) -> `results` (plain arrays) -> `panel`,
`overlay`, `applying` (what is written back) and `handlers`. Modules here load neither numba nor Embree when they are imported.
"""
