"""Live culling in the viewport, measured: docs/viewport.md."""
