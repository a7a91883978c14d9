"""Engines that render the open file: Blender's own by their names, the path tracer of `core`, and the hybrid of raster
and light paths."""
