"""The version: pyproject.toml and the extension's zip take it from here; a test keeps blender_manifest.toml the
same."""

__version__ = "0.1.0"
