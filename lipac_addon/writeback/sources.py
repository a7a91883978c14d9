"""Sources of instances that can be emptied: nothing but instancing uses what they look like.

Geometry nodes may look at what they instance (realise it, take its bounds); a modifier, a driver or a constraint of
another object may, too. What is not surely known only to hand a source on counts as looking at it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import bpy

from .references import animatable, inputs_of

_HOLDERS = (bpy.types.Collection, bpy.types.Scene, bpy.types.WindowManager, bpy.types.Screen, bpy.types.WorkSpace)
# nodes that read an object or a collection, and the socket that names it
_INFOS = {"GeometryNodeObjectInfo": "Object", "GeometryNodeCollectionInfo": "Collection"}
_PASSES = {  # nodes that hand instances on, whatever these show; of those with a domain, in that of instances
    *(
        "NodeReroute",
        "GeometryNodeJoinGeometry",
        "GeometryNodeTransform",
        "GeometryNodeGeometryToInstance",
        "GeometryNodeSetID",
    ),
    *(
        "GeometryNodeSwitch",
        "GeometryNodeIndexSwitch",
        "GeometryNodeMenuSwitch",
        "GeometryNodeSeparateComponents",
        "GeometryNodeRemoveAttribute",
    ),
    *(
        "GeometryNodeTranslateInstances",
        "GeometryNodeRotateInstances",
        "GeometryNodeScaleInstances",
        "GeometryNodeSetInstanceTransform",
    ),
    *(
        "GeometryNodeStoreNamedAttribute",
        "GeometryNodeDeleteGeometry",
        "GeometryNodeSeparateGeometry",
        "GeometryNodeSortElements",
    ),
    *("GeometryNodeDuplicateElements", "GeometryNodeCaptureAttribute"),
}
_ENDS = {"NodeGroupOutput", "GeometryNodeViewer", "GeometryNodeInstancesToPoints"}


def unread(objects: Iterable[bpy.types.Object]) -> set[bpy.types.Object]:
    """Those of the objects whose geometry nothing in the file looks at, but to instance it."""
    chosen = set(objects)
    if not chosen:
        return set()
    users = _users_of(chosen)
    targets = _driver_targets()
    trees = _Trees()
    free = (ob for ob in chosen - targets if not any(_reads(block, user) for block, user in _uses(ob, users)))
    return {ob for ob in free if trees.pass_on(ob, _blocks(ob, users), users)}


def _users_of(objects: set[bpy.types.Object]) -> dict[bpy.types.ID, set[bpy.types.ID]]:
    """The users of objects, and of all collections that they are in."""
    found: dict[bpy.types.ID, set[bpy.types.ID]] = {}
    front: set[bpy.types.ID] = set(objects)
    while front:
        new = bpy.data.user_map(subset=front)
        found |= {block: new[block] for block in front if block in new}
        front = {
            user for block in front for user in new.get(block, ()) if isinstance(user, bpy.types.Collection)
        } - found.keys()
    return found


def _blocks(ob: bpy.types.Object, users: dict[bpy.types.ID, set[bpy.types.ID]]) -> set[bpy.types.ID]:
    """An object and the collections with it, at any depth."""
    found, front = set[bpy.types.ID](), {ob}
    while front:
        found |= front
        front = {
            user for block in front for user in users.get(block, ()) if isinstance(user, bpy.types.Collection)
        } - found
    return found


def _uses(
    ob: bpy.types.Object, users: dict[bpy.types.ID, set[bpy.types.ID]]
) -> Iterator[tuple[bpy.types.ID, bpy.types.ID]]:
    return ((block, user) for block in _blocks(ob, users) for user in users.get(block, ()) if user != ob)


def _reads(block: bpy.types.ID, user: bpy.types.ID) -> bool:
    """Whether a user of a block may look at geometry in it. Of geometry nodes `_Trees` speaks."""
    if isinstance(user, _HOLDERS) or (isinstance(user, bpy.types.NodeTree) and user.bl_idname == "GeometryNodeTree"):
        return False
    if isinstance(user, bpy.types.ParticleSettings):
        return block in (user.collision_collection, user.effector_weights and user.effector_weights.collection)
    return not isinstance(user, bpy.types.Object) or _object_reads(block, user)


def _object_reads(block: bpy.types.ID, ob: bpy.types.Object) -> bool:
    if ob.parent == block and ob.parent_type != "OBJECT":
        return True
    constraints = [*ob.constraints, *(c for bone in (ob.pose.bones if ob.pose else ()) for c in bone.constraints)]
    physics = [thing for thing in (ob.rigid_body_constraint, ob.soft_body, ob.field) if thing is not None]
    modifiers = [m for m in ob.modifiers if m.type != "NODES"]
    return any(_points_to(thing, block) for thing in (*constraints, *physics, *modifiers, *ob.particle_systems))


def _points_to(thing: bpy.types.bpy_struct, block: bpy.types.ID) -> bool:
    """Whether a property of a thing, or what it holds in a list of targets, is a block."""
    if any(getattr(thing, p.identifier) == block for p in thing.bl_rna.properties if p.type == "POINTER"):
        return True
    return any(getattr(target, "target", None) == block for target in getattr(thing, "targets", ()))


def _driver_targets() -> set[bpy.types.ID]:
    """What drivers read: of objects and of shape keys, node trees and data, wherever."""
    curves = (
        curve
        for block in animatable()
        for curve in (block.animation_data.drivers if block.animation_data is not None else ())
    )
    return {
        t.id for curve in curves for variable in curve.driver.variables for t in variable.targets if t.id is not None
    }


class _Trees:
    """The geometry-node trees of the file, and which contain which."""

    def __init__(self) -> None:
        self._inner: dict[bpy.types.NodeTree, set[bpy.types.NodeTree]] = {}
        self._outer: dict[bpy.types.NodeTree, set[bpy.types.NodeTree]] = {}
        for tree in bpy.data.node_groups:
            for node in tree.nodes if tree.bl_idname == "GeometryNodeTree" else ():
                if getattr(node, "node_tree", None) is not None:
                    self._inner.setdefault(tree, set()).add(node.node_tree)
                    self._outer.setdefault(node.node_tree, set()).add(tree)
        self._known: dict[frozenset[bpy.types.ID], bool] = {}
        nodes = ([m for m in ob.modifiers if m.type == "NODES" and m.node_group is not None] for ob in bpy.data.objects)
        self._stacks = [[(set(inputs_of(m)), m.node_group) for m in stack] for stack in nodes if stack]

    def pass_on(
        self, ob: bpy.types.Object, blocks: set[bpy.types.ID], users: dict[bpy.types.ID, set[bpy.types.ID]]
    ) -> bool:
        """Whether all trees that may get an object, or one of the blocks with it, do no more than instance it."""
        named = any(ob in inputs for stack in self._stacks for inputs, _ in stack) or any(
            isinstance(user, bpy.types.NodeTree) for user in users.get(ob, ())
        )
        key = frozenset(blocks if named else blocks - {ob})  # those of one collection fare alike
        if key not in self._known:
            self._known[key] = self._pass_on(set(key), users)
        return self._known[key]

    def _pass_on(self, blocks: set[bpy.types.ID], users: dict[bpy.types.ID, set[bpy.types.ID]]) -> bool:
        own = {user for block in blocks for user in users.get(block, ()) if isinstance(user, bpy.types.NodeTree)}
        given = {group for stack in self._stacks for inputs, group in stack if not blocks.isdisjoint(inputs)}
        trees = _reached(_reached(own | given, self._outer), self._inner)
        entered = {
            group
            for stack in self._stacks
            for k, (_, group) in enumerate(stack)
            if any(g in trees for _, g in stack[:k])
        }
        front = trees | entered
        while front:
            tree = front.pop()
            into = _passes_into(tree, blocks, tree in entered)
            if into is None:
                return False
            front |= into - entered
            entered |= into
        return True


def _reached(
    start: set[bpy.types.NodeTree], step: dict[bpy.types.NodeTree, set[bpy.types.NodeTree]]
) -> set[bpy.types.NodeTree]:
    found, front = set[bpy.types.NodeTree](), set(start)
    while front:
        found |= front
        front = {y for x in front for y in step.get(x, ())} - found
    return found


def _passes_into(tree: bpy.types.NodeTree, blocks: set[bpy.types.ID], entered: bool) -> set[bpy.types.NodeTree] | None:
    """The trees within a tree that get instances of the blocks from it; None where it does more than hand these on.
    entered: its own input may have some."""
    front: list[bpy.types.NodeSocket] = []
    for node in tree.nodes:
        kind = node.bl_idname
        if kind == "GeometryNodeGroup" or (kind == "NodeGroupInput" and entered):
            front += _geometry(node)
        elif kind in _INFOS and (
            node.inputs[_INFOS[kind]].is_linked or node.inputs[_INFOS[kind]].default_value in blocks
        ):
            front += _geometry(node)
            whole = node.inputs.get("As Instance")
            if (
                whole is not None
                and any(s.is_linked for s in _geometry(node))
                and (whole.is_linked or not whole.default_value)
            ):
                return None
    seen, into = set[str](), set[bpy.types.NodeTree]()
    while front:
        for link in front.pop().links:
            node = link.to_node
            if node.bl_idname == "GeometryNodeGroup" and node.node_tree is not None:
                into.add(node.node_tree)
            elif node.bl_idname == "GeometryNodeInstanceOnPoints":
                if link.to_socket.name != "Instance":
                    return None
            elif node.bl_idname not in _PASSES | _ENDS or getattr(node, "domain", "INSTANCE") != "INSTANCE":
                return None
            if node.bl_idname not in _ENDS and node.name not in seen:
                seen.add(node.name)
                front += _geometry(node)
    return into


def _geometry(node: bpy.types.Node) -> list[bpy.types.NodeSocket]:
    return [s for s in node.outputs if s.type in {"GEOMETRY", "CUSTOM"}]
