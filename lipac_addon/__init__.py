"""Everything that touches Blender: scene in, culling out, renders, panel and overlay."""


def register() -> None:
    """Register classes with Blender."""


def unregister() -> None:
    """Take back what `register` did."""
