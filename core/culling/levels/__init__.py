"""Levels of detail: meshes of what stays are exchanged for simplified ones, as far as an error budget goes."""
