"""Evaluated meshes over the frames of a shot, and their material slots.

Read on the main thread, triangles only when somebody asks; arrays are copies, for Blender frees its own.
"""
