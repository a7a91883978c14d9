"""Registration leaves nothing behind, loads no heavy library, and every control explains itself."""

import re
import subprocess
import sys
from fnmatch import fnmatch
from pathlib import Path

import bpy
import pytest

import lipac
from lipac.lipac_addon.ui import manual, operators
from lipac.lipac_addon.ui.draw import overlay
from lipac.lipac_addon.ui.state import preferences, props

GROUPS = (props.LipacSettings, preferences.LipacPreferences)
OPERATORS = operators._CLASSES
OWNERS = (bpy.types.Scene, bpy.types.Object, bpy.types.Collection)


def traces() -> set:
    """Whatever the extension leaves in Blender."""
    classes = {name for name in dir(bpy.types) if "lipac" in name.lower()}
    lists = [
        handlers for name in dir(bpy.app.handlers) if isinstance(handlers := getattr(bpy.app.handlers, name), list)
    ]
    handlers = {h.__qualname__ for handlers in lists for h in handlers if "lipac" in getattr(h, "__module__", "")}
    return (
        classes
        | handlers
        | {owner.__name__ for owner in OWNERS if hasattr(owner, "lipac") or hasattr(owner, "lipac_role")}
        | set(overlay._handles)
    )


def test_register_again_and_again():
    lipac.register()  # roles are known from the first file on that a test has opened
    lipac.unregister()
    before = traces()
    for _ in range(2):
        lipac.register()
        assert {"Scene", "Object", "Collection", "LIPAC_PT_main", "before_frame", "after_load"} <= traces()
        lipac.unregister()
        assert traces() == before


def test_libraries_are_not_loaded_by_registering():
    code = (
        "import sys, bpy, lipac; lipac.register(); sys.exit(any(n in sys.modules for n in ('numba', 'llvmlite', "
        "'scipy')))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def own_properties(group):
    return [p for p in group.bl_rna.properties if p.identifier not in {"rna_type", "name", "bl_idname"}]


def test_every_control_has_a_place_in_the_guide(ui):
    """Blender's Online Manual looks for the first pattern that matches the control's name in lower case."""
    guide = Path(lipac.__file__).parent / "docs" / "user-guide.md"
    places = {
        re.sub(r"[^a-z]+", "-", line.lstrip("# ").lower())
        for line in guide.read_text().splitlines()
        if line.startswith("#")
    }
    page, entries = manual.manual()
    assert page.startswith("file://")
    names = [f"bpy.types.{group.__name__}.{p.identifier}" for group in GROUPS for p in own_properties(group)]
    names += [
        "bpy.types.Object.lipac_role",
        "bpy.types.Collection.lipac_role",
        *(f"bpy.ops.{cls.bl_idname}" for cls in OPERATORS),
    ]
    assert len(names) > 30
    for name in names:
        place = next((rest for pattern, rest in entries if fnmatch(name.lower(), pattern)), None)
        assert place is not None, name
        assert place.removeprefix("#") in places, name
    assert {rest.removeprefix("#") for _, rest in entries} <= places


@pytest.mark.parametrize("group", GROUPS)
def test_every_property_has_a_tooltip(ui, group):
    own = own_properties(group)
    assert own
    for p in own:
        assert len(p.description) > 10, p.identifier
        for item in p.enum_items if p.type == "ENUM" else ():
            assert len(item.description) > 10, item.identifier


def test_every_operator_has_a_tooltip(ui):
    for cls in OPERATORS:
        text = getattr(bpy.ops.lipac, cls.bl_idname.removeprefix("lipac.")).get_rna_type().description
        assert len(text) > 10, cls
        assert not text.endswith(".")  # Blender shows it as it is


def test_policies_and_rays_are_those_of_the_engine(ui):
    from lipac.core.culling.policies import POLICIES
    from lipac.core.scene.model import RayType
    from lipac.lipac_addon.ui.state.results import RAYS

    listed = {policy.name: policy for policy in POLICIES.values() if policy.listed and policy.name != "none"}
    properties = props.LipacSettings.bl_rna.properties
    assert {item.identifier: item.value for item in properties["policy"].enum_items} == {
        name: policy.rank for name, policy in listed.items()
    }
    settings = [policy.setting for policy in listed.values() if policy.setting]
    assert len(settings) >= 3
    for own in settings:
        assert properties[own.name].default == pytest.approx(own.default)
        assert properties[own.name].description == own.description
    assert tuple(kind.name.lower() for kind in RayType) == RAYS


def test_settings_become_options(scene):
    from lipac.core.culling.options import CullOptions

    settings = scene.lipac
    settings.property_unset("policy")
    settings.property_unset("distance")
    assert props.cull_options(settings) == CullOptions()
    settings.max_error, settings.paths, settings.seed = 2.5, 9, 5
    options = props.cull_options(settings)
    assert (options.max_error.mean, options.paths, options.seed) == (pytest.approx(0.025), 9, 5)
