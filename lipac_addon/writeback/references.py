"""Who instances whom: which objects cannot be hidden or masked without touching more than their own instances."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import bpy

_KINDS = {"OBJECT", "COLLECTION", "NODETREE", "PARTICLE"}
_DUPLI = {"VERTS", "FACES"}
_SHOWN_BY_PARTICLES = {"OBJECT", "COLLECTION"}
_SIMULATION = {"COLLISION", "FLUID", "DYNAMIC_PAINT"}
# What a render shows and instances of geometry do not stand for
_OTHER_TYPES = {"LIGHT", "LIGHT_PROBE", "VOLUME", "GREASEPENCIL", "GPENCIL"}


class References:
    """The instancing relations of the open file at the time of construction; holds references to data-blocks, so it must not outlive an edit."""

    def __init__(self) -> None:
        users = _instancing_users()
        blocks = [x for x in users if not isinstance(x, bpy.types.Object)]
        roots = [x for x in blocks if any(isinstance(y, bpy.types.Object) for y in users[x])]
        children: dict[bpy.types.ID, list[bpy.types.ID]] = {}
        for x in blocks:
            for y in users[x]:
                children.setdefault(y, []).append(x)
        self._users = users
        self._used = _closure(roots, lambda x: children.get(x, ()))
        self._carriers = _closure([ob for ob in bpy.data.objects if _shows_more(ob)], lambda x: users.get(x, ()))
        particle_collections = [p.instance_collection for p in bpy.data.particles if p.render_type == "COLLECTION" and p.instance_collection]
        self._picked = {ob for c in particle_collections for ob in c.all_objects}
        self._alone_in_nodes = self._objects_of_nodes()
        self._particle_sources = {m.object for ob in bpy.data.objects for m in ob.modifiers if m.type == "PARTICLE_INSTANCE"}

    def feeds(self, block: bpy.types.Object | bpy.types.Collection) -> bool:
        """Whether another object instances this one, or something that contains it."""
        if block in self._used:
            return True
        return any(y in self._used or (isinstance(y, bpy.types.Object) and y != block) for y in self._users.get(block, ()))

    def in_instanced_collection(self, ob: bpy.types.Object | None) -> bool:
        """Whether some object instances a collection with this object."""
        return any(isinstance(y, bpy.types.Collection) and y in self._used for y in self._users.get(ob, ()))

    def carries_more(self, ob: bpy.types.Object) -> bool:
        """Whether the object is, or instances, something besides surfaces: a light, a volume, hair, grease pencil."""
        return ob in self._carriers

    def picked_by_particles(self, ob: bpy.types.Object) -> bool:
        """Whether a particle system picks from a collection with this object: hiding it would change what the other particles show."""
        return ob in self._picked

    def alone_in_nodes(self, ob: bpy.types.Object) -> bool:
        """Whether geometry nodes may instance the object by itself, not within a whole collection; such instances do not mind its `hide_render`."""
        return ob in self._alone_in_nodes

    def particle_source(self, ob: bpy.types.Object) -> bool:
        """Whether a Particle Instance modifier of another object uses the object's particles."""
        return ob in self._particle_sources

    def _objects_of_nodes(self) -> set[bpy.types.ID]:
        separate = any(_separates_children(tree) for tree in bpy.data.node_groups)
        sources: set[bpy.types.ID] = set()
        for x, by in self._users.items():
            by_nodes = any(isinstance(y, bpy.types.NodeTree) or (isinstance(y, bpy.types.Object) and _has_nodes(y)) for y in by)
            if by_nodes and isinstance(x, bpy.types.Object):
                sources.add(x)
            elif by_nodes and separate and isinstance(x, bpy.types.Collection):
                sources.update(x.all_objects)
        return sources


def takes_modifiers(ob: bpy.types.Object) -> bool:
    """Whether a modifier can be added to the object."""
    return ob.is_editable and ob.type not in {"META", "EMPTY"}


def instances_others(ob: bpy.types.Object) -> bool:
    """Whether an object may make instances of others."""
    return ob.instance_type != "NONE" or bool(ob.particle_systems) or _has_nodes(ob)


def simulates(ob: bpy.types.Object) -> bool:
    """Whether an object may act on others in a simulation: a hidden collider or force field is none in a render."""
    field = ob.field is not None and ob.field.type != "NONE"
    return field or ob.rigid_body is not None or any(m.type in _SIMULATION for m in ob.modifiers)


def is_animated(ob: bpy.types.Object, path: str) -> bool:
    """Whether a driver, an action or an NLA strip of the object controls the property `path`."""
    data = ob.animation_data
    if data is None:
        return False
    actions = [data.action, *(strip.action for track in data.nla_tracks for strip in track.strips)]
    return any(d.data_path == path for d in data.drivers) or any(_moves(action, path) for action in actions if action is not None)


def _moves(action: bpy.types.Action, path: str) -> bool:
    curves = (c for layer in action.layers for strip in layer.strips for bag in strip.channelbags for c in bag.fcurves)
    return any(c.data_path == path for c in curves)


def _has_nodes(ob: bpy.types.Object) -> bool:
    return any(m.type == "NODES" for m in ob.modifiers)


def _separates_children(tree: bpy.types.NodeTree) -> bool:
    sockets = (node.inputs["Separate Children"] for node in tree.nodes if node.bl_idname == "GeometryNodeCollectionInfo")
    return any(socket.is_linked or socket.default_value for socket in sockets)


def _shows_more(ob: bpy.types.Object) -> bool:
    return ob.type in _OTHER_TYPES or any(p.settings.render_type == "PATH" and p.settings.type == "HAIR" for p in ob.particle_systems)


def _instancing_users() -> dict[bpy.types.ID, set[bpy.types.ID]]:
    """For each object, collection, node tree and particle setting: the ones of these through which it is instanced.

    Objects use objects in many ways that instance nothing (parents, constraints, booleans), so of those only modifier inputs and duplication count.
    """
    users = bpy.data.user_map(key_types=_KINDS, value_types=_KINDS)
    for x, by in users.items():
        if isinstance(x, bpy.types.Object):
            by.difference_update([y for y in by if isinstance(y, bpy.types.Object)])
    for ob in bpy.data.objects:
        for modifier in ob.modifiers:
            if modifier.type == "NODES":
                for block in _inputs(modifier):
                    users.setdefault(block, set()).add(ob)
        if ob.parent is not None and ob.parent.instance_type in _DUPLI:
            users.setdefault(ob, set()).add(ob.parent)
    return users


def _inputs(modifier: bpy.types.Modifier) -> Iterator[bpy.types.ID]:
    """Objects and collections that are inputs of a geometry-nodes modifier."""
    if modifier.node_group is None:
        return
    for item in modifier.node_group.interface.items_tree:
        if item.item_type == "SOCKET" and item.in_out == "INPUT" and item.socket_type in {"NodeSocketObject", "NodeSocketCollection"}:
            if bpy.app.version >= (5, 2, 0):
                value = getattr(getattr(modifier.properties.inputs, item.identifier, None), "value", None)
            else:
                value = modifier.get(item.identifier)
            if isinstance(value, bpy.types.ID):
                yield value


def _closure(start: Iterable[bpy.types.ID], step: object) -> set[bpy.types.ID]:
    """All that is reached from `start` by `step(x) -> iterable`."""
    seen = set(start)
    front = list(seen)
    while front:
        new = [y for x in front for y in step(x) if y not in seen]  # type: ignore[operator]
        seen.update(new)
        front = list(set(new))
    return seen
