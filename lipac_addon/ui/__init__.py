"""What an artist sees: the panel "LiPaC" in the sidebar of the 3D viewport, its operators, the overlay and the render
handlers.

Modules by layers, each importing from those above it alone:

- Blender and the machine: `session`, `kernels`, `preferences`, `background` (threads), `engine` (loaded by one).
- What is known: `results` (what analyses found, plain arrays), `props` (what the user set), `scatters`, `boxes` (laid
  out to be drawn), `figures` and `verdict` (in words).
- What is done: `applying` (write-back), `job` (the one that runs), `analysis` and `difference` (jobs), `viewport`,
  `viewport_switches`, `foresight`, `viewport_culling` and `live` (beside the user's work).
- What Blender calls: `overlay`, `modal` and `operators`, `handlers`, `overview` and `panel`, `manual`; all are added
  and taken away by `registration`.

Data flows one way: `props` -> `analysis` or `live` (read Blender on the main thread, compute in a worker) -> `results`
-> `applying`, `overlay`, `panel`. Importing a module loads neither numba nor Embree.
"""
