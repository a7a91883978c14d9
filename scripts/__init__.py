"""The commands: thin, each usable from a shell and inside `blender -b FILE -P`."""
