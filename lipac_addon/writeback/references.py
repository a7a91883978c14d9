"""Who instances whom: which objects cannot be hidden or masked without touching more than their own instances."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import cached_property

import bpy

from ..coarsening import RENDERED

_KINDS = {"OBJECT", "COLLECTION", "NODETREE", "PARTICLE"}
_DUPLI = {"VERTS", "FACES"}
_SHOWN_BY_PARTICLES = {"OBJECT", "COLLECTION"}
_SIMULATION = {"COLLISION", "FLUID", "DYNAMIC_PAINT"}
# What a render shows and instances of geometry do not stand for
_OTHER_TYPES = {"LIGHT", "LIGHT_PROBE", "VOLUME", "CURVES", "POINTCLOUD", "META", "GREASEPENCIL", "GPENCIL"}
# What may name an object without looking at its faces: where it is, or that it is there
_HARMLESS = (
    bpy.types.Scene, bpy.types.Collection, bpy.types.Camera, bpy.types.Material, bpy.types.World, bpy.types.Light,
    bpy.types.Action
)
_SWITCHES = {"hide_render", "show_render", *RENDERED.values()}


class References:
    """The instancing relations of the open file at the time of construction; holds references to data-blocks, so it
    must not outlive an edit."""

    def __init__(self, others: Iterable[bpy.types.Scene] = ()) -> None:
        """others: scenes that are part of the picture, beside the one that was analysed."""
        users = _instancing_users()
        blocks = [x for x in users if not isinstance(x, bpy.types.Object)]
        roots = [x for x in blocks if any(isinstance(y, bpy.types.Object) for y in users[x])]
        children: dict[bpy.types.ID, list[bpy.types.ID]] = {}
        for x in blocks:
            for y in users[x]:
                children.setdefault(y, []).append(x)
        self._users = users
        self._of: dict[bpy.types.ID, list[bpy.types.ID]] | None = None
        self._used = _closure(roots, lambda x: children.get(x, ()))
        self._carriers = _closure([ob for ob in bpy.data.objects if _shows_more(ob)], lambda x: users.get(x, ()))
        particle_collections = [
            p.instance_collection for p in bpy.data.particles if p.render_type == "COLLECTION" and p.instance_collection
        ]
        self._picked = {ob for c in particle_collections for ob in c.all_objects}
        self._alone_in_nodes = self._objects_of_nodes()
        self._caches = _read_by_simulations()
        self._drivers = _read_by_drivers()
        self._elsewhere = _shown_in(others, users)
        self._particle_sources = {
            m.object for ob in bpy.data.objects for m in ob.modifiers if m.type == "PARTICLE_INSTANCE"
        }

    @cached_property
    def ids_are_read(self) -> bool:
        """Whether a material reads the attribute `id` of instances, of which Blender knows nothing where a scatter has
        none."""
        trees = [m.node_tree for m in bpy.data.materials if m.node_tree is not None]
        trees += [tree for tree in bpy.data.node_groups if tree.bl_idname == "ShaderNodeTree"]
        attributes = (node for tree in trees for node in tree.nodes if node.bl_idname == "ShaderNodeAttribute")
        return any(node.attribute_type == "INSTANCER" and node.attribute_name == "id" for node in attributes)

    def feeds(self, block: bpy.types.Object | bpy.types.Collection) -> bool:
        """Whether another object instances this one, or something that contains it."""
        if block in self._used:
            return True
        return any(
            y in self._used or (isinstance(y, bpy.types.Object) and y != block) for y in self._users.get(block, ())
        )

    def instanced_by(self, ob: bpy.types.Object) -> set[bpy.types.ID]:
        """All that the object instances, at any depth, and itself."""
        if self._of is None:
            self._of = _used_by(self._users)
        used = self._of
        return _closure([ob], lambda x: used.get(x, ()))

    def in_instanced_collection(self, ob: bpy.types.Object | None) -> bool:
        """Whether some object instances a collection with this object."""
        return any(isinstance(y, bpy.types.Collection) and y in self._used for y in self._users.get(ob, ()))

    def carries_more(self, ob: bpy.types.Object) -> bool:
        """Whether the object is, or instances, something besides surfaces: a light, a volume, hair, grease pencil."""
        return ob in self._carriers

    def picked_by_particles(self, ob: bpy.types.Object) -> bool:
        """Whether a particle system picks from a collection with this object: hiding it would change what the other
        particles show."""
        return ob in self._picked

    def alone_in_nodes(self, ob: bpy.types.Object) -> bool:
        """Whether geometry nodes may instance the object by itself, not within a whole collection; such instances do
        not mind its `hide_render`."""
        return ob in self._alone_in_nodes

    def particle_source(self, ob: bpy.types.Object) -> bool:
        """Whether a Particle Instance modifier of another object uses the object's particles."""
        return ob in self._particle_sources

    def holds_cache(self, ob: bpy.types.Object) -> bool:
        """Whether any change to the object, of which Blender is told, may empty an unbaked cache: its own, or that of
        what is its child, instances it or names it otherwise, at any depth."""
        return ob in self._caches

    def drives(self, ob: bpy.types.Object) -> bool:
        """Whether a driver reads if the object, or a modifier of it, is rendered."""
        return ob in self._drivers

    def elsewhere(self, ob: bpy.types.Object) -> bool:
        """Whether another scene of the picture shows the object, itself or as an instance."""
        return ob in self._elsewhere

    def shapes_others(self, ob: bpy.types.Object) -> bool:
        """Whether something else may be made from the faces of an object: modifiers, constraints or nodes name it, or a
        collection with it."""
        for user in bpy.data.user_map(subset=(ob,))[ob]:
            if isinstance(user, bpy.types.Object):
                if user != ob and ((user.parent == ob and user.parent_type.startswith("VERTEX")) or _names(user, ob)):
                    return True
            elif not isinstance(user, _HARMLESS):
                return True
        return any(_names(other, collection) for collection in ob.users_collection for other in bpy.data.objects)

    def _objects_of_nodes(self) -> set[bpy.types.ID]:
        separate = any(_separates_children(tree) for tree in bpy.data.node_groups)
        sources: set[bpy.types.ID] = set()
        for x, by in self._users.items():
            by_nodes = any(
                isinstance(y, bpy.types.NodeTree) or (isinstance(y, bpy.types.Object) and _has_nodes(y)) for y in by
            )
            if by_nodes and isinstance(x, bpy.types.Object):
                sources.add(x)
            elif by_nodes and separate and isinstance(x, bpy.types.Collection):
                sources.update(x.all_objects)
        return sources


def _names(ob: bpy.types.Object, block: bpy.types.ID) -> bool:
    """Whether a modifier or a constraint of an object, or of a bone of it, names a data-block."""
    bones = ob.pose.bones if ob.pose is not None else ()
    things = (*ob.modifiers, *ob.constraints, *(constraint for bone in bones for constraint in bone.constraints))
    own = (getattr(thing, p.identifier) for thing in things for p in thing.bl_rna.properties if p.type == "POINTER")
    return any(value == block for value in own) or any(
        x == block for m in ob.modifiers if m.type == "NODES" for x in inputs_of(m)
    )


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


def is_unbaked(ob: bpy.types.Object) -> bool:
    """Whether an object has a simulation of its own whose results are in memory alone: any change to it empties that,
    or has it go on from something else."""
    caches = [m.point_cache for m in ob.modifiers if m.type in {"CLOTH", "SOFT_BODY"}]
    caches += [p.point_cache for p in ob.particle_systems if _moves_particles(p)]
    return not all(cache.is_baked for cache in caches) or any(
        m.type == "NODES" and _simulates(m.node_group, set()) for m in ob.modifiers
    )


def _moves_particles(system: bpy.types.ParticleSystem) -> bool:
    return system.use_hair_dynamics if system.settings.type == "HAIR" else system.settings.physics_type != "NO"


def _simulates(tree: bpy.types.NodeTree | None, seen: set[bpy.types.NodeTree]) -> bool:
    """Whether a node tree, or a group in it, has a simulation zone. Whether that is baked cannot be read."""
    if tree is None or tree in seen:
        return False
    seen.add(tree)
    return any(
        node.bl_idname == "GeometryNodeSimulationOutput" or _simulates(getattr(node, "node_tree", None), seen)
        for node in tree.nodes
    )


def scenes_in_picture(scene: bpy.types.Scene) -> set[bpy.types.Scene]:
    """Other scenes that a render of this one shows: those that its compositor and its sequencer read, what these read
    in turn, and the sets behind them. The set behind the scene itself is analysed with it."""
    found, front = set[bpy.types.Scene](), [scene]
    while front:
        of = front.pop()
        new = _scenes_read_by(of) - found - {scene}
        if of != scene and of.background_set not in (None, scene, *found):
            new.add(of.background_set)
        found |= new
        front += new
    return found


def _scenes_read_by(scene: bpy.types.Scene) -> set[bpy.types.Scene]:
    found: set[bpy.types.Scene] = set()
    if scene.render.use_compositing:
        trees, front = set[bpy.types.NodeTree](), [getattr(scene, "compositing_node_group", None)]
        while front:
            tree = front.pop()
            if tree is not None and tree not in trees:
                trees.add(tree)
                found.update(
                    node.scene for node in tree.nodes if node.bl_idname == "CompositorNodeRLayers" and node.scene
                )
                front += [getattr(node, "node_tree", None) for node in tree.nodes]
    if scene.render.use_sequencer and scene.sequence_editor is not None:
        found.update(strip.scene for strip in scene.sequence_editor.strips_all if strip.type == "SCENE" and strip.scene)
    return found


def _has_nodes(ob: bpy.types.Object) -> bool:
    return any(m.type == "NODES" for m in ob.modifiers)


def _separates_children(tree: bpy.types.NodeTree) -> bool:
    sockets = (
        node.inputs["Separate Children"] for node in tree.nodes if node.bl_idname == "GeometryNodeCollectionInfo"
    )
    return any(socket.is_linked or socket.default_value for socket in sockets)


def _shows_more(ob: bpy.types.Object) -> bool:
    return ob.type in _OTHER_TYPES or any(
        p.settings.render_type == "PATH" and p.settings.type == "HAIR" for p in ob.particle_systems
    )


def _instancing_users() -> dict[bpy.types.ID, set[bpy.types.ID]]:
    """For each object, collection, node tree and particle setting: the ones of these through which it is instanced.

    Objects use objects in many ways that instance nothing (parents, constraints, booleans), so of those only modifier
    inputs and duplication count.
    """
    users = bpy.data.user_map(key_types=_KINDS, value_types=_KINDS)
    for x, by in users.items():
        if isinstance(x, bpy.types.Object):
            by.difference_update([y for y in by if isinstance(y, bpy.types.Object)])
    for ob in bpy.data.objects:
        for modifier in ob.modifiers:
            if modifier.type == "NODES":
                for block in inputs_of(modifier):
                    users.setdefault(block, set()).add(ob)
        if ob.parent is not None and ob.parent.instance_type in _DUPLI:
            users.setdefault(ob, set()).add(ob.parent)
    return users


def inputs_of(modifier: bpy.types.Modifier) -> Iterator[bpy.types.ID]:
    """Objects and collections that are inputs of a geometry-nodes modifier."""
    if modifier.node_group is None:
        return
    for item in modifier.node_group.interface.items_tree:
        if (
            item.item_type == "SOCKET"
            and item.in_out == "INPUT"
            and item.socket_type in {"NodeSocketObject", "NodeSocketCollection"}
        ):
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


def _shown_in(scenes: Iterable[bpy.types.Scene], users: dict[bpy.types.ID, set[bpy.types.ID]]) -> set[bpy.types.ID]:
    """All that some scenes show: their objects, and what these instance."""
    tops = [ob for scene in scenes for ob in scene.collection.all_objects]
    if not tops:
        return set()
    used = _used_by(users)
    return _closure(tops, lambda x: used.get(x, ()))


def _used_by(users: dict[bpy.types.ID, set[bpy.types.ID]]) -> dict[bpy.types.ID, list[bpy.types.ID]]:
    used: dict[bpy.types.ID, list[bpy.types.ID]] = {}
    for x, by in users.items():
        for y in by:
            used.setdefault(y, []).append(x)
    return used


def _read_by_simulations() -> set[bpy.types.ID]:
    """Objects with unbaked simulations, and all that these name, at any depth: when that changes, Blender may begin the
    simulation anew, with the next render for instance."""
    unbaked = [ob for ob in bpy.data.objects if is_unbaked(ob)]
    if not unbaked:
        return set()
    used = _used_by(bpy.data.user_map(key_types=_KINDS, value_types=_KINDS))
    return _closure(unbaked, lambda x: used.get(x, ()))


def _read_by_drivers() -> set[bpy.types.ID]:
    """Data-blocks of which a driver reads whether they, or something of theirs, are rendered."""
    found: set[bpy.types.ID] = set()
    for block in animatable():
        data = block.animation_data
        for curve in data.drivers if data is not None else ():
            for target in (target for variable in curve.driver.variables for target in variable.targets):
                owner, _, name = target.data_path.rpartition(".")
                if name in _SWITCHES:
                    found.update(_owners(target, owner))
            if any(name in curve.driver.expression for name in _SWITCHES):  # by Python: whatever it names
                found.update(ob for ob in bpy.data.objects if ob.name in curve.driver.expression)
                found.add(block)
    return found


def _owners(target: bpy.types.DriverTarget, path: str) -> Iterator[bpy.types.ID]:
    """The data-blocks that a path from a driver's target leads to; one without a data-block goes from the scene that is
    rendered, whichever that is."""
    for start in bpy.data.scenes if target.id is None else (target.id,):
        try:
            thing = start.path_resolve(path) if path else start
        except ValueError:
            continue
        if getattr(thing, "id_data", None) is not None:
            yield thing.id_data


def animatable() -> Iterator[bpy.types.ID]:
    """All data-blocks of the file that may have drivers, node trees of materials and the like included."""
    for name in (p.identifier for p in bpy.data.bl_rna.properties if p.type == "COLLECTION"):
        for block in getattr(bpy.data, name):
            tree = getattr(block, "node_tree", None)
            yield from (x for x in (block, tree) if hasattr(x, "animation_data"))
