"""First hits of the whole scene, culled instances included."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from ...core.errors import InputError
from ...core.scene import Scene
from . import opengl

if TYPE_CHECKING:
    from ...core.primary import Primary

PRIMARY = ("raster", "traced")


class FirstHits:
    """First hits of the whole scene, culled instances included, by a raster or by rays over everything (built for it, and freed again)."""

    def __init__(self, scene: Scene, primary: str, threads: int = 0) -> None:
        """Raises InputError where there is no OpenGL and primary asks for it."""
        if primary not in PRIMARY:
            raise InputError(f"unknown first hits '{primary}': choose one of {', '.join(PRIMARY)}")
        self.scene = scene
        self.draw: Callable[[tuple[int, int], int, int], Primary]
        if primary == "raster":
            opengl.require()
            from .gbuffer import GBuffer

            buffer = GBuffer(scene)
            self.meshes, self.draw = buffer.meshes, buffer.draw
            return
        from ...core.blas import BlasCache
        from ...core.embree import shared_device
        from ...core.primary import MeshTable, in_view, pass_camera, trace_primary
        from ...core.tlas import Tlas

        seen = in_view(scene)
        blas = BlasCache(scene.meshes, shared_device(threads))
        blas.need(scene.instances.mesh[seen])
        tlas = Tlas(scene.instances, blas, seen)
        self.meshes = MeshTable(scene.meshes)

        def draw(size: tuple[int, int], index: int = 0, count: int = 1) -> Primary:
            return trace_primary(tlas, self.meshes, pass_camera(scene.camera, scene.film, size, index, count), size, scene.instances.mesh)

        self.draw = draw
