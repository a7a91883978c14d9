"""Evaluated meshes: bounds at once, triangles on demand.

A mesh is held as the `GeometrySet` that Blender's Python gives out: it owns its data (shared, not copied, with the
evaluated object while that lives), so it can be read after the dependency graph is gone. Of scatters, too, nothing but
the GeometrySet is kept, whose matrices are read in place.
"""

from __future__ import annotations

import ctypes
import hashlib
import weakref
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ....core.accel.triangulation import corners_of_faces, vertex_normals
from ....core.arrays import F32, F64, U32
from ....core.scene.mesh import Mesh, MeshSequence
from ....core.scene.placing import LARGEST
from ...attributes import NAME, PLACE, colors_of, places, places_in_pattern
from ..materials.displacement import Relief, shells
from .fibres import Fibres

NO_BOUNDS = np.array([[1.0] * 3, [-1.0] * 3], np.float32)  # low above high: no triangles
EMPTY = Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint32))


@dataclass
class MeshSource:
    """Where a mesh comes from: its geometry, name for messages, number of material slots that its triangles use, and
    whether any material needs UVs.

    origin: (3,) where its coordinates begin (`core.scene.placing.local_origin`), set when it is first placed; bounds
    are in Blender's own coordinates. divisible: whether faces of it may be culled by themselves, so that their numbers
    are read.
    relief: how its materials displace it, in metres of its own space; None where none does. simplifiable: whether all
    objects that show it let it be exchanged for a simplified one; None before one was asked. steps: by how many it can
    be coarser (`lipac_addon.coarsening`), by a setting of the object owner; fixed: why that must stay.
    fibres: what is rendered beside its faces. moving: whether it brings velocities, by which Cycles blurs it.
    loaded: what was read of it last, to tell what of it changes. ready: the mesh, where it was read already, for the
    first who asks. spare: another GeometrySet of the same: what Blender copies of one that is read goes with that.
    """

    geometry: Any  # GeometrySet
    name: str
    bounds: F32
    slot_count: int
    broken: bool  # has vertices that are not finite
    needs_uv: bool = False
    origin: F64 | None = None
    loaded: Loaded | None = None
    ready: Mesh | None = None
    spare: Any = None
    relief: Relief | None = None
    divisible: bool = False
    simplifiable: bool | None = None
    steps: int = 0
    owner: str = ""
    fixed: str = ""
    fibres: Fibres | None = None
    moving: bool = False

    @property
    def plain(self) -> bool:
        """Whether it is what its faces are, and nothing else."""
        return not self.broken and self.relief is None and self.fibres is None

    def box(self) -> F32:
        """(2, 3) box of what `load` gives, in Blender's own coordinates."""
        if self.relief is None:
            return self.bounds
        most = np.float32(max(abs(self.relief.low), abs(self.relief.high)))
        return np.stack((self.bounds[0] - most, self.bounds[1] + most))

    def local_bounds(self) -> F32:
        """(2, 3) box as `load` gives the positions."""
        return self.box() if self.origin is None else (self.box() - self.origin).astype(np.float32)


@dataclass(frozen=True)
class Loaded:
    """A mesh that was read: references to its triangles that keep nothing alive, and digests (SHA-256) of triangles
    with slots, and of all else."""

    triangles: tuple[weakref.ref[NDArray[Any]], ...]
    topology: bytes
    shape: bytes

    @staticmethod
    def of(mesh: Mesh, before: Loaded | None = None) -> Loaded:
        """The record of a mesh. before: of what it was; who holds that follows its changes."""
        held = () if before is None else tuple(ref for ref in before.triangles if ref() is not None)
        return Loaded(
            (*held, weakref.ref(mesh.triangles)),
            _digest(mesh.triangles, mesh.slots),
            _digest(mesh.positions, mesh.normals, mesh.uvs),
        )

    def again(self, mesh: Mesh) -> Loaded:
        """The record of the same mesh, read once more."""
        held = (ref for ref in self.triangles if ref() is not None)
        return replace(self, triangles=(*held, weakref.ref(mesh.triangles)))

    @property
    def held(self) -> bool:
        """Whether somebody still has the mesh, or what it was."""
        return any(ref() is not None for ref in self.triangles)


def _digest(*arrays: NDArray[Any] | None) -> bytes:
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(b"none" if array is None else repr(array.shape).encode())
        if array is not None:
            digest.update(np.ascontiguousarray(array))
    return digest.digest()


def read(collection: Any, name: str, count: int, width: int = 1, dtype: type = np.float32) -> NDArray[Any]:
    """`foreach_get` of a bpy collection: (count, width), or (count,) where width is 1."""
    out: NDArray[Any] = np.empty(count * width, dtype)
    if count:
        collection.foreach_get(name, out)
    return out if width == 1 else out.reshape(count, width)


def matrices(collection: Any, count: int, owner: Any) -> NDArray[np.float32]:
    """The 4x4 matrices of an attribute, (count, 4, 4) float32, column-major as Blender stores them: not to be written
    to. They are read in place, where Blender says that they lie one after the other, and keep owner, whose they are,
    alive; at a million that saves 64 MB, and the time to fill them.
    """
    if count < 2:
        return read(collection, "value", count, 16).reshape(count, 4, 4)
    first, last = collection[0], collection[count - 1]
    if last.as_pointer() - first.as_pointer() != 64 * (count - 1):
        return read(collection, "value", count, 16).reshape(count, 4, 4)
    out = np.asarray(_InPlace(first.as_pointer(), (count, 4, 4), owner))
    same = all(
        np.array_equal(out[k].T, np.array(item.value, np.float32), equal_nan=True)
        for k, item in ((0, first), (-1, last))
    )
    return out if same else read(collection, "value", count, 16).reshape(count, 4, 4)


class _InPlace:
    """float32 numbers at an address, for NumPy; arrays of them keep this alive."""

    def __init__(self, address: int, shape: tuple[int, ...], owner: Any) -> None:
        self.owner = owner
        # kernels have but one variant
        self.__array_interface__ = {"version": 3, "typestr": "<f4", "shape": shape, "data": (address, False)}


def _positions(mesh: Any) -> F32:
    return read(mesh.attributes["position"].data, "vector", len(mesh.vertices), 3)


def _usable(positions: F32) -> NDArray[np.bool_]:
    with np.errstate(invalid="ignore"):
        return np.asarray((np.abs(positions) <= LARGEST).all(axis=1))


def _box(positions: F32) -> F32:
    """(2, 3) lowest and highest of (V, 3)."""
    columns = positions.T.copy()  # one coordinate after the other: many times faster
    return np.stack((columns.min(axis=1), columns.max(axis=1)))


def describe(geometry: Any, name: str, fibres: Fibres | None = None) -> MeshSource | None:
    """Bounds and slots of the mesh in a GeometrySet, and of fibres beside it; None where there are neither, the mesh
    having no faces or no usable vertex."""
    source = _faces(geometry, name)
    if fibres is None:
        return source
    slots, box = int(fibres.slots.max()) + 1, fibres.box()
    if source is None:
        return MeshSource(geometry, name, box, slots, False, fibres=fibres)
    both = np.stack((np.minimum(source.bounds[0], box[0]), np.maximum(source.bounds[1], box[1])))
    return replace(source, bounds=both, slot_count=max(source.slot_count, slots), fibres=fibres)


def has_velocities(geometry: Any) -> bool:
    """Whether something in a GeometrySet says by an attribute where it is while the shutter is open."""
    for data in (geometry.mesh, geometry.pointcloud, geometry.curves):
        attribute = None if data is None else data.attributes.get("velocity")
        if attribute is not None and (attribute.domain, attribute.data_type) == ("POINT", "FLOAT_VECTOR"):
            return bool(read(attribute.data, "vector", len(attribute.data), 3).any())
    return False


def _faces(geometry: Any, name: str) -> MeshSource | None:
    mesh = geometry.mesh
    if mesh is None or len(mesh.polygons) == 0:
        return None
    positions = _positions(mesh)
    bounds = _box(positions)
    broken = not np.abs(bounds).max() <= LARGEST  # also true for NaN, which min and max hand on
    if broken:
        positions = positions[_usable(positions)]
        if not len(positions):
            return None
        bounds = _box(positions)
    index = mesh.attributes.get("material_index")
    slots = (
        int(read(index.data, "value", len(mesh.polygons), dtype=np.int32).max()) + 1
        if index is not None and index.domain == "FACE"
        else 1
    )
    return MeshSource(geometry, name, bounds.astype(np.float32), min(max(slots, 1), 1 << 16), broken)


def _map(mesh: Any, name: str, loops: NDArray[np.int32], vertices: NDArray[np.int32], at: F32 | None) -> F32:
    """(T, 3, 2) of a UV map, or of what is one by its name. loops, vertices: (T, 3) of triangles; at: (V, 2) where
    vertices lie in the pattern."""
    if name == PLACE and at is not None:
        return at[vertices]
    return _attribute(mesh, name.removeprefix(NAME), loops) if name.startswith(NAME) else _uv(mesh, name)[loops]


def _uv(mesh: Any, name: str) -> F32:
    """(loops, 2) of a UV map; index 0's name "" is the active render map. Zeros where the mesh has none, as in
    Cycles."""
    layers = mesh.uv_layers
    layer = next((item for item in layers if item.active_render), None) if name == "" else layers.get(name)
    count = len(mesh.loops)
    return np.zeros((count, 2), np.float32) if layer is None else read(layer.uv, "vector", count, 2)


def _attribute(mesh: Any, name: str, loops: NDArray[np.int32]) -> F32:
    """(T, 3, 2) places of an attribute in the palette, for triangles of three corners each, (T, 3). name "": the active
    colour. Where the mesh has none it is black, as in Cycles."""
    attribute = mesh.attributes.get(name) if name else mesh.color_attributes.active_color
    values = None if attribute is None else colors_of(attribute)
    corner = None if attribute is None else _of_corners(mesh, attribute.domain)
    if values is None or corner is None:
        colors = np.zeros((len(loops), 3), np.float32)
    else:
        colors = values[corner[loops]].mean(axis=1)
    return np.repeat(places(colors)[:, None], 3, axis=1)


def _of_corners(mesh: Any, domain: str) -> NDArray[np.int32] | None:
    """(loops,) element of a domain that each corner belongs to; None for edges."""
    count = len(mesh.loops)
    if domain == "CORNER":
        return np.arange(count, dtype=np.int32)
    if domain == "POINT":
        return _vertices(mesh)
    if domain == "FACE":
        sizes = _sizes(mesh)
        return np.repeat(np.arange(len(sizes), dtype=np.int32), sizes)
    return None


def _sizes(mesh: Any) -> NDArray[np.int32]:
    """(F,) corners of each face."""
    return read(mesh.polygons, "loop_total", len(mesh.polygons), dtype=np.int32)


def _small(mesh: Any) -> NDArray[np.int32] | None:
    """(F,) corners of each face, where none has more than four; else None."""
    sizes = _sizes(mesh)
    return sizes if int(sizes.max(initial=3)) <= 4 else None


def _vertices(mesh: Any) -> NDArray[np.int32]:
    """(C,) vertex of each corner."""
    return read(mesh.attributes[".corner_vert"].data, "value", len(mesh.loops), dtype=np.int32)


def _normals(mesh: Any) -> F32:
    """(V, 3) normals of vertices of a mesh that has these."""
    sizes = _small(mesh)
    if sizes is None:
        return read(mesh.vertex_normals, "vector", len(mesh.vertices), 3)
    return np.asarray(vertex_normals(_positions(mesh), _vertices(mesh), sizes))


def corners_of(mesh: Any) -> NDArray[np.int32]:
    """(T, 3) corners of the triangles of a mesh.

    Blender keeps what it was once asked for, 16 bytes for each of them, as long as the file is open. So it is only
    asked where faces have more than four corners. It gives them out one by one, which takes most of the time that
    reading a mesh takes. They lie in one array, whose address is that of the first; where it turns out not to be so,
    they are read one by one.
    """
    if (sizes := _small(mesh)) is not None:
        return np.asarray(corners_of_faces(_positions(mesh), _vertices(mesh), sizes))
    triangles, count = mesh.loop_triangles, len(mesh.loop_triangles)
    if not count:
        return np.zeros((0, 3), np.int32)
    first = triangles[0].as_pointer()
    if triangles[count - 1].as_pointer() - first == 12 * (count - 1):
        out = np.ctypeslib.as_array((ctypes.c_int32 * (3 * count)).from_address(first)).reshape(count, 3).copy()
        if all(tuple(triangles[k].loops) == tuple(out[k].tolist()) for k in {0, count // 3, count // 2, count - 1}):
            return out
    return read(triangles, "loops", count, 3, np.int32)


def faces_of(mesh: Any) -> NDArray[np.int32]:
    """(T,) face that each triangle of a mesh is a part of."""
    if (sizes := _small(mesh)) is not None:
        return np.repeat(np.arange(len(sizes), dtype=np.int32), sizes - 2)
    return read(mesh.loop_triangle_polygons, "value", len(mesh.loop_triangles), dtype=np.int32)


def _slots(mesh: Any) -> NDArray[np.uint16]:
    """(T,) material slot of each triangle."""
    index, faces = mesh.attributes.get("material_index"), faces_of(mesh)
    if index is None or index.domain != "FACE":
        return np.zeros(len(faces), np.uint16)
    return read(index.data, "value", len(mesh.polygons), dtype=np.int32)[faces].astype(np.uint16)


def load(source: MeshSource, uv_maps: Sequence[str]) -> Mesh:
    """Reads the triangles of a mesh, and of the fibres beside it. Triangles with a vertex that is not finite are left
    out."""
    faces = source.geometry.mesh
    out = EMPTY if faces is None or not len(faces.polygons) else _loaded(source, faces, uv_maps)
    if source.fibres is None:
        return out
    if not len(out.triangles) and source.needs_uv:
        out = replace(out, uvs=np.zeros((len(uv_maps), 0, 3, 2), np.float32))
    return source.fibres.behind(out, source.origin, uv_maps)


def _loaded(source: MeshSource, mesh: Any, uv_maps: Sequence[str]) -> Mesh:
    positions = _positions(mesh)
    corners = corners_of(mesh)
    vertices = _vertices(mesh)[corners]
    kept: slice | NDArray[np.bool_] = slice(None)
    if source.broken:
        usable = _usable(positions)
        kept = usable[vertices].all(axis=1)
        positions[~usable] = source.bounds[0]  # unused; but no NaN may reach a builder
    if source.origin is not None and source.origin.any():
        positions = (positions - source.origin).astype(np.float32)
    by_corner, count = mesh.normals_domain == "CORNER", len(corners)
    loops = corners[kept] if by_corner or source.needs_uv else None
    del corners
    normals = uvs = slots = None
    if loops is not None and by_corner:
        normals = read(mesh.corner_normals, "vector", len(mesh.loops), 3)[loops]
    elif mesh.normals_domain == "POINT":
        normals = _normals(mesh)
    if loops is not None and source.needs_uv:
        at = None
        if PLACE in uv_maps:
            at = places_in_pattern(positions, source.bounds - (0 if source.origin is None else source.origin))
        uvs = np.stack([_map(mesh, name, loops, vertices[kept], at) for name in uv_maps])
    if source.slot_count > 1:
        slots = _slots(mesh)[kept]
    triangles: U32 = np.ascontiguousarray(vertices[kept]).view(np.uint32)
    faces = None
    if source.divisible and count != len(mesh.polygons):
        faces = faces_of(mesh)[kept]
    out = Mesh(positions, triangles, normals, uvs, slots, faces)
    return out if source.relief is None else shells(out, _normals(mesh), source.relief)


class LazyMeshes(MeshSequence):
    """`Scene.meshes`: item m is read from Blender each time it is asked for, so keep what you need. Not to be asked for
    by two threads at once."""

    def __init__(self, sources: Sequence[MeshSource | None], uv_maps: Sequence[str]) -> None:
        self.sources = list(sources)
        self.uv_maps = tuple(uv_maps)

    def __len__(self) -> int:
        return len(self.sources)

    def mesh(self, index: int) -> Mesh:
        """Read from Blender."""
        source = self.sources[index]
        if source is None:
            return EMPTY
        mesh, source.ready = source.ready or load(source, self.uv_maps), None
        if source.spare is not None:
            source.geometry, source.spare = source.spare, None
        source.loaded = Loaded.of(mesh, source.loaded) if source.loaded is None else source.loaded.again(mesh)
        return mesh
