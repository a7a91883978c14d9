"""First hits of the whole scene, culled instances included: by a raster, or by rays where there is none."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

from ...core.errors import InputError
from ...core.scene.model import Scene
from . import opengl

if TYPE_CHECKING:
    from ...core.scene.mesh import MeshTable
    from ...core.scene.model import FirstHitBuffer

PRIMARY = ("raster", "traced")


class FirstHits(Protocol):
    """What finds first hits of a scene, and has loaded the meshes that they lie on."""

    scene: Scene
    meshes: MeshTable

    def draw(self, size: tuple[int, int], index: int = 0, count: int = 1) -> FirstHitBuffer:
        """Pass `index` of `count` (`core.hybrid.first_hits.pass_camera`), of a picture of size (width, height)."""


def first_hits(scene: Scene, primary: str, threads: int = 0) -> FirstHits:
    """What finds first hits by primary, one of PRIMARY. threads: of what is built for rays, 0 for all.

    Raises InputError where there is no OpenGL for a raster, and for another primary.
    """
    if primary not in PRIMARY:
        raise InputError(f"unknown first hits '{primary}': choose one of {', '.join(PRIMARY)}")
    if primary == "traced":
        return TracedHits(scene, threads)
    opengl.require()
    from .gbuffer import GBuffer

    return GBuffer(scene)


class TracedHits:
    """First hits by rays over everything in view, which is built for it, and freed with this."""

    def __init__(self, scene: Scene, threads: int = 0) -> None:
        from ...core.accel.blas import BlasCache
        from ...core.accel.embree import shared_device
        from ...core.accel.tlas import Tlas
        from ...core.hybrid.first_hits import in_view
        from ...core.scene.mesh import MeshTable

        self.scene = scene
        self.meshes = MeshTable(scene.meshes)
        seen = in_view(scene)
        blas = BlasCache(scene.meshes, shared_device(threads))
        blas.need(scene.instances.mesh[seen])
        self._tlas = Tlas(scene.instances, blas, seen)

    def draw(self, size: tuple[int, int], index: int = 0, count: int = 1) -> FirstHitBuffer:
        """As `FirstHits.draw`."""
        from ...core.hybrid.first_hits import pass_camera, trace_primary

        camera = pass_camera(self.scene.camera, self.scene.film, size, index, count)
        return trace_primary(self._tlas, self.meshes, camera, size, self.scene.instances.mesh)
