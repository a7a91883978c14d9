"""What live mode reads of the viewport: its dependency graph with all that was noted since, less what renders hide; and
the world."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import bpy

from ...writeback.viewport import is_ours

if TYPE_CHECKING:
    from ...extract import ExtractedWorld

_WORLDLY = ("World", "NodeTree", "Image", "Texture")


@dataclass(frozen=True)
class Listed:
    """A data-block of the graph that changed, as `bpy.types.DepsgraphUpdate` says it."""

    id: Any
    is_updated_geometry: bool


class NotedGraph:
    """The viewport's dependency graph, with all that changed since it was last read (Blender keeps no more than the
    latest).

    Without what renders hide, and what live culling makes for itself; with those objects that are out of the viewport
    by it.
    """

    def __init__(
        self, depsgraph: bpy.types.Depsgraph, noted: dict[int, bool], out: Sequence[bpy.types.Object] = ()
    ) -> None:
        """noted: by the address of a data-block, whether its geometry changed. out: objects whose eyes live culling has
        closed."""
        self._depsgraph, self._out = depsgraph, out
        self.ids = [block for block in depsgraph.ids if not is_ours(block)]
        found = [(block, noted.get(block.as_pointer())) for block in self.ids] if noted else []
        self.updates = [Listed(block, geometry) for block, geometry in found if geometry is not None]

    def __getattr__(self, name: str) -> Any:
        return getattr(self._depsgraph, name)

    def reshaped(self) -> set[int]:
        """Session uids of objects whose geometry changed."""
        blocks = (update.id.original for update in self.updates if update.is_updated_geometry)
        return {block.session_uid for block in blocks if isinstance(block, bpy.types.Object)}

    @property
    def objects(self) -> Iterator[Any]:
        """Objects that a render shows, too."""
        layer = self._depsgraph.view_layer.layer_collection
        unseen = {ob.name_full for c in _hidden(layer) for ob in c.all_objects}
        if unseen:
            unseen -= {ob.name_full for c in _rendered(layer) for ob in c.objects}
        shown = self._depsgraph.objects
        if self._out:
            there = {item.as_pointer() for item in shown} | {
                ob.evaluated_get(self._depsgraph).as_pointer() for ob in self._out
            }
            shown = (item for item in self.ids if item.as_pointer() in there)  # in one order, whatever is out
        return (item for item in shown if not item.hide_render and item.name_full not in unseen)


def _hidden(layer: bpy.types.LayerCollection) -> Iterator[bpy.types.Collection]:
    """Collections of a view layer that renders hide, the topmost of each branch."""
    if layer.collection.hide_render:
        yield layer.collection
        return
    for child in layer.children:
        yield from _hidden(child)


def _rendered(layer: bpy.types.LayerCollection) -> Iterator[bpy.types.Collection]:
    if not layer.collection.hide_render:
        yield layer.collection
        for child in layer.children:
            yield from _rendered(child)


class LiveWorld:
    """The world of a scene. One that is not constant has to be rendered: only where it is new or has changed."""

    def __init__(self) -> None:
        self.world: ExtractedWorld | None = None
        self._fingerprint = ""

    def read(
        self, scene: bpy.types.Scene, layer: bpy.types.ViewLayer, graph: NotedGraph, goes_on: bool
    ) -> tuple[ExtractedWorld, bool]:
        """The world, and whether it was rendered, which gives the graph new data-blocks. goes_on: graph is the one that
        was read last."""
        from ...extract.world import constant_world, extract_world, fingerprint, world_of

        if (
            self.world is not None
            and goes_on
            and not any(part in type(u.id).__name__ for u in graph.updates for part in _WORLDLY)
        ):
            return self.world, False
        item = world_of(graph.scene_eval, graph.view_layer_eval)
        found, mark = constant_world(item), ""
        rendered = False
        if found is None:
            mark = fingerprint(item, scene.frame_current)
            found, rendered = self.world, self.world is None or mark != self._fingerprint
            if rendered or found is None:
                found = extract_world(scene, layer)
                layer.update()
        self.world, self._fingerprint = found, mark
        return found, rendered
