"""First hits by a raster pass of our own through Blender's `gpu` module: instance, triangle and barycentrics, exact to
single precision."""

from __future__ import annotations

from typing import Any

import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader
from mathutils import Matrix

from ...core.arrays import F32, I64
from ...core.errors import InputError
from ...core.hybrid.first_hits import in_view, pass_camera
from ...core.scene.camera import projection
from ...core.scene.mesh import MeshTable
from ...core.scene.model import HIT, Camera, FirstHitBuffer, Scene

ROW = 1024  # instances per row of the texture that holds transforms
_TEXELS = 3  # of an instance: the rows of its transform
# whole numbers up to this are exact in single precision: of instances in view, and of triangles of a mesh
EXACT = 1 << 24

_VERTEX = """
void main()
{
  int slot = first + gl_InstanceID;
  ivec2 at = ivec2(3 * (slot % row), slot / row);
  vec4 p = vec4(position, 1.0);
  vec3 world;
  for (int k = 0; k < 3; k++) {
    world[k] = dot(texelFetch(transforms, at + ivec2(k, 0), 0), p);
  }
  gl_Position = view_projection * vec4(world, 1.0);
  int corner = gl_VertexID % 3;
  barycentrics = vec2(corner == 1 ? 1.0 : 0.0, corner == 2 ? 1.0 : 0.0);
  distance_from_camera = dot(depth_plane, vec4(world, 1.0));
  ids = vec2(float(slot + 1), float(gl_VertexID / 3));
}
"""
# Distance over the far end, in float: as exact near and far; what a projection puts into the depth buffer is not, far
# from the camera.
_FRAGMENT = """
void main()
{
  gl_FragDepth = distance_from_camera;
  result = vec4(ids, barycentrics);
}
"""


def _make_shader() -> Any:
    between = gpu.types.GPUStageInterfaceInfo("lipac_gbuffer")
    between.smooth("VEC2", "barycentrics")
    between.smooth("FLOAT", "distance_from_camera")
    between.flat("VEC2", "ids")
    info = gpu.types.GPUShaderCreateInfo()
    info.push_constant("MAT4", "view_projection")
    info.push_constant("VEC4", "depth_plane")
    info.push_constant("INT", "first")
    info.push_constant("INT", "row")
    info.sampler(0, "FLOAT_2D", "transforms")
    info.vertex_in(0, "VEC3", "position")
    info.vertex_out(between)
    info.fragment_out(0, "VEC4", "result")
    info.depth_write("ANY")
    info.vertex_source(_VERTEX)
    info.fragment_source(_FRAGMENT)
    return gpu.shader.create_from_info(info)


class GBuffer:
    """A scene on the graphics card, to draw first hits of. Everything that camera rays may see is drawn, whether culled
    or not.

    `opengl.require` goes before it. To be used on the thread that made it.
    Raises InputError where there are more instances in view, or triangles of a mesh, than a pixel can tell (EXACT).
    """

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.meshes = MeshTable(scene.meshes)
        instances = scene.instances
        chosen = np.flatnonzero(in_view(scene))
        self.order: I64 = chosen[np.argsort(instances.mesh[chosen], kind="stable")]
        self._check(len(self.order), "instances in view")
        self._shader = _make_shader()
        self._transforms = self._upload()
        self._batches: list[tuple[Any, int, int]] = []
        meshes, starts = np.unique(instances.mesh[self.order], return_index=True)
        ends = np.append(starts[1:], len(self.order))
        for mesh, a, b in zip(meshes.tolist(), starts.tolist(), ends.tolist(), strict=True):
            self.meshes.need(np.array([mesh]))
            data = self.meshes[mesh]
            self._check(len(data.triangles), "triangles of a mesh")
            if len(data.triangles):
                corners = np.ascontiguousarray(data.positions[data.triangles.ravel()])
                self._batches.append((batch_for_shader(self._shader, "TRIS", {"position": corners}), a, b - a))

    @staticmethod
    def _check(count: int, what: str) -> None:
        if count >= EXACT:
            raise InputError(
                f"{count:,} {what} are more than a raster can tell apart ({EXACT - 1:,}): use --primary traced"
            )

    def _upload(self) -> Any:
        rows = max(-(-len(self.order) // ROW), 1)
        texels = np.zeros((rows * ROW, _TEXELS, 4), np.float32)
        texels[: len(self.order)] = self.scene.instances.transform[self.order]
        data = gpu.types.Buffer("FLOAT", texels.size, texels.ravel())
        return gpu.types.GPUTexture((_TEXELS * ROW, rows), format="RGBA32F", data=data)

    def draw(self, size: tuple[int, int], index: int = 0, count: int = 1) -> FirstHitBuffer:
        """Pass `index` of `count` (`core.hybrid.first_hits.pass_camera`), of a picture of size (width, height)."""
        camera = pass_camera(self.scene.camera, self.scene.film, size, index, count)
        found = self._pixels(camera, size)
        hits = np.zeros((size[1], size[0]), HIT)
        slot = found[..., 0].astype(np.int64)
        lookup = np.append(np.int64(-1), self.order)
        hits["instance"] = lookup[slot]
        hits["triangle"] = found[..., 1].astype(np.uint32)
        hits["b1"] = np.clip(found[..., 2], 0, 1)
        hits["b2"] = np.clip(found[..., 3], 0, 1 - hits["b1"])
        return FirstHitBuffer(hits, camera, self.meshes)

    def _pixels(self, camera: Camera, size: tuple[int, int]) -> F32:
        """(H, W, 4) float32, rows bottom up: slot + 1 (0: nothing), triangle, barycentrics."""
        view_projection, depth_plane = projection(camera)
        color = gpu.types.GPUTexture(size, format="RGBA32F")
        depth = gpu.types.GPUTexture(size, format="DEPTH_COMPONENT32F")
        frame = gpu.types.GPUFrameBuffer(depth_slot=depth, color_slots=[color])
        with frame.bind():
            frame.clear(color=(0.0, 0.0, 0.0, 0.0), depth=1.0)
            gpu.state.depth_test_set("LESS")
            gpu.state.depth_mask_set(True)
            gpu.state.blend_set("NONE")
            gpu.state.face_culling_set("NONE")
            try:
                self._shader.bind()
                self._shader.uniform_float("view_projection", Matrix(view_projection.tolist()))
                self._shader.uniform_float("depth_plane", depth_plane.tolist())
                self._shader.uniform_int("row", ROW)
                self._shader.uniform_sampler("transforms", self._transforms)
                for batch, first, number in self._batches:
                    self._shader.uniform_int("first", first)
                    batch.draw_instanced(self._shader, instance_count=number)
            finally:
                gpu.state.depth_test_set("NONE")
                gpu.state.depth_mask_set(False)
            data = frame.read_color(0, 0, *size, 4, 0, "FLOAT")
        data.dimensions = size[0] * size[1] * 4
        return np.array(data, np.float32).reshape(size[1], size[0], 4)
