"""Where Cycles renders: the CPU, or graphics cards by the programming interface that reaches them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any

import bpy

from ....core.errors import InputError
from ...console import muted
from ...depsgraph import changed
from .choices import AUTO, CPU, GPU_KINDS, DeviceChoice

NAMES = {"cpu": "CPU", "cuda": "CUDA", "optix": "OptiX", "hip": "HIP", "oneapi": "oneAPI", "metal": "Metal"}
FALLBACK = "device: the scene asks for a graphics card and none is there that Cycles can use: rendered on the CPU"
UNKNOWN = "unknown"


@dataclass(frozen=True)
class Device:
    """What renders. kind: of `choices.DEVICES`, never AUTO; cards: names; ids: Cycles' own for these; note: a line for
    the user where it is not what the scene asks for."""

    kind: str
    cards: tuple[str, ...]
    ids: tuple[str, ...] = ()
    note: str = ""

    def __str__(self) -> str:
        return f"{NAMES[self.kind]}: {', '.join(self.cards)}"


def cards_of(kind: str) -> list[tuple[str, str]]:
    """Name and id of each device of a kind that Cycles can use here, in its order. Nothing of the preferences
    changes."""
    import _cycles

    if kind != CPU and kind.upper() not in {name for name, *_ in _preferences().get_device_types(bpy.context)}:
        return []  # Blender was built without it
    with muted():  # of what it finds no library for, it writes to stdout
        found = _cycles.available_devices(kind.upper())
    return [(str(name), str(identity)) for name, of, identity, *_ in found if of == kind.upper()]


def find_device(scene: Any, choice: DeviceChoice) -> Device:
    """The device of a choice. Raises InputError where there is none of the kind, or no such card."""
    if choice.kind == AUTO:
        return _as_set(scene)
    if choice.kind == CPU:
        return _cpu()
    found = cards_of(choice.kind)
    if not found:
        here = [NAMES[kind] for kind in (CPU, *GPU_KINDS) if kind != choice.kind and cards_of(kind)]
        raise InputError(
            f"--device {choice}: no {NAMES[choice.kind]} device that Cycles can use is here; there is {', '.join(here)}"
        )
    return Device(choice.kind, *_picked(choice, found))


def _picked(choice: DeviceChoice, found: list[tuple[str, str]]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names and ids of the cards that are meant, in Cycles' order."""
    picked = set()
    for card in choice.cards:
        rows = [
            k
            for k, (name, _) in enumerate(found)
            if (card == str(k) if card.isdecimal() else card.lower() in name.lower())
        ]
        if not rows:
            listed = ", ".join(f"{k} {name}" for k, (name, _) in enumerate(found))
            raise InputError(f"--device {choice}: no card '{card}'; {NAMES[choice.kind]} has {listed}")
        picked.update(rows)
    rows = sorted(picked) if choice.cards else [*range(len(found))]
    return tuple(found[k][0] for k in rows), tuple(found[k][1] for k in rows)


def _as_set(scene: Any) -> Device:
    """As the file and the preferences say. Blender as a Python module reads no preferences: then the first kind of
    GPU_KINDS that has a card."""
    if scene.cycles.device == "CPU":
        return _cpu()
    preferences = _preferences()
    kind = preferences.get_compute_device_type().lower()
    if kind == "none":
        kinds = [kind for kind in GPU_KINDS if cards_of(kind)]
        return find_device(scene, DeviceChoice(kinds[0])) if kinds else _cpu(FALLBACK)
    off = {entry.id for entry in preferences.devices if not entry.use}
    used = [(name, identity) for name, identity in cards_of(kind) if identity not in off]
    return (
        Device(kind, tuple(name for name, _ in used), tuple(identity for _, identity in used))
        if used
        else _cpu(FALLBACK)
    )


def _cpu(note: str = "") -> Device:
    return Device(CPU, tuple(name for name, _ in cards_of(CPU)) or (UNKNOWN,), (), note)


@contextmanager
def on_device(scene: Any, choice: DeviceChoice) -> Iterator[Device]:
    """Renders of a scene by Cycles within the block are on that device; the scene and the preferences are put back.
    Raises InputError as `find_device`."""
    device = find_device(scene, choice)
    if device.kind == CPU:
        with changed(scene.cycles, device="CPU"):
            yield device
        return
    preferences = _preferences()
    before = {(entry.type, entry.id) for entry in preferences.devices}
    with ExitStack() as stack:
        stack.callback(_forget_new, preferences, before)
        preferences.get_device_list(device.kind.upper())  # makes their entries
        for entry in preferences.devices:
            if choice.kind != AUTO or (entry.type, entry.id) not in before:  # else it is as the user wants it
                stack.enter_context(changed(entry, use=entry.id in device.ids and entry.type == device.kind.upper()))
        stack.enter_context(changed(preferences, compute_device_type=device.kind.upper()))
        stack.enter_context(changed(scene.cycles, device="GPU"))
        yield device


def _forget_new(preferences: Any, before: set[tuple[str, str]]) -> None:
    for k in reversed(range(len(preferences.devices))):
        if (preferences.devices[k].type, preferences.devices[k].id) not in before:
            preferences.devices.remove(k)


def _preferences() -> Any:
    return bpy.context.preferences.addons["cycles"].preferences


def eevee_device() -> str:
    """What EEVEE renders on, once it has; unknown where Blender does not say."""
    import gpu

    try:
        return f"{gpu.platform.backend_type_get()}: {gpu.platform.renderer_get()}"
    except Exception:  # SystemError in the background before Blender 5.2
        return UNKNOWN
