"""Raster and light paths in one picture: first hits from elsewhere, what guides a denoiser, and the composition of
both.

Nothing below imports it. Where raster and paths disagree, paths decide what they know.
"""
