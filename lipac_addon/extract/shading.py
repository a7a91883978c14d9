"""Materials and textures over the frames of a shot: converted again only where Blender says that something of theirs
changed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.arrays import I32, Records
from ...core.scene.model import Shader, Textures
from .. import attributes
from .graph import GraphReader
from .graph_items import colors_by_material
from .materials.displacement import Relief
from .materials.material_table import MaterialTable
from .materials.textures import Pixels, TextureTable

_CLASSES = ("Material", "NodeTree", "Texture", "Image")


@dataclass(frozen=True)
class Shading:
    """What a `Scene` needs of the materials; textured: (M,) bool, which of those that slots have need UVs; reliefs: how
    these displace, M of them; by_object: whether they show what objects have of their own."""

    slot_materials: I32
    materials: Records
    textures: Textures
    uv_maps: tuple[str, ...]
    textured: NDArray[np.bool_]
    approximated: tuple[str, ...]
    reliefs: tuple[Relief | None, ...] = ()
    by_object: bool = False

    def same(self, other: Shading) -> bool:
        """Whether all arrays are the same."""
        pairs = [(getattr(self, name), getattr(other, name)) for name in ("slot_materials", "materials")]
        pairs += [
            (getattr(self.textures, name), getattr(other.textures, name)) for name in ("records", "bytes", "floats")
        ]
        plain = (self.uv_maps, self.approximated, self.reliefs) == (other.uv_maps, other.approximated, other.reliefs)
        return plain and all(same_array(a, b) for a, b in pairs)


def same_array(a: NDArray[Any], b: NDArray[Any]) -> bool:
    """Whether two arrays have the same numbers, to the bit. Of records the fields count, not what lies between them."""
    if a is b:
        return True
    if a.shape != b.shape or a.dtype != b.dtype:
        return False
    return all(same_array(a[name], b[name]) for name in a.dtype.names) if a.dtype.names else a.tobytes() == b.tobytes()


class ShadingReader:
    """Converts the materials of a frame. The pixels of an image are read once, unless Blender says that the image
    changed."""

    def __init__(self, most: bool = True) -> None:
        """most: as of `MaterialTable`."""
        self.most = most
        self._last: Shading | None = None
        self._order: tuple[str | None, ...] = ()
        self._pixels: dict[tuple[str, bool], Pixels] = {}

    def read(self, reader: GraphReader) -> Shading:
        """The materials of what the reader found, in the order in which it found them; the same object as in the frame
        before where nothing changed."""
        order, table, last = tuple(reader.geometry.slots.order), reader.geometry.slots.table(), self._last
        listed = [update.id for update in reader.listed.values()] if reader.listed is not None else None
        if (
            last is not None
            and not last.by_object
            and listed is not None
            and order == self._order
            and not any(_shades(block) for block in listed)
        ):
            if not np.array_equal(table, last.slot_materials):
                last = replace(last, slot_materials=table)
        else:
            changed = {block.name_full for block in listed or () if type(block).__name__ == "Image"}
            self._pixels = {key: pixels for key, pixels in self._pixels.items() if key[0] not in changed}
            owners = attributes.Owners([node.item for node in reader.order], reader.geometry.bounds)
            with attributes.owned_by(owners):
                now = self._convert(order, reader, table)
            last = last if last is not None and last.same(now) else now
        self._last, self._order = last, order
        return last

    def _convert(self, order: tuple[str | None, ...], reader: GraphReader, table: I32) -> Shading:
        textures = TextureTable(print, self._pixels)
        records = MaterialTable(textures, self.most, cache(lambda: colors_by_material(reader.order)))
        for name in order:
            records.index(None if name is None else reader.geometry.materials[name])
        textured = np.array([records.textured(k) for k in range(len(records.records))], bool)
        return Shading(
            table,
            records.build(),
            textures.build(),
            tuple(textures.uv_maps),
            textured,
            tuple(records.approximated),
            tuple(records.reliefs),
            records.by_object,
        )


def linked_emission(
    materials: Records, order: Sequence[str | None], linked: Mapping[str | None, str], most: bool = True
) -> tuple[list[str], Records]:
    """MATERIAL records in which the emission of some is marked as unsure, and a line for each. order: the names of the
    first of them; linked: of those in question, each with the object that has it; most: as of
    `MaterialTable`."""
    out, lines = materials.copy(), []
    for name, item in linked.items():
        rows = with_parts(out, {order.index(name)})
        if any(out[row]["emission"].any() for row in rows):
            lines.append(f"object {item}: light linking of its emission not rendered: everything is lit")
            out["unsure_emission"][rows] = most
    return lines, out


def with_parts(materials: Records, rows: set[int]) -> list[int]:
    """Rows of materials, and of all that these are composed of."""
    out = sorted(rows)
    for row in out:  # grows meanwhile
        out += materials["parts"][row].tolist() if materials["shader"][row] >= Shader.MIX else []
    return out


def _shades(block: Any) -> bool:
    """Whether a change of a data-block may change materials."""
    name = type(block).__name__
    return any(part in name for part in _CLASSES) and not name.startswith(("Geometry", "Compositor"))
