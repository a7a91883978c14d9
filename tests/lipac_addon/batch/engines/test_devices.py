"""Where Cycles renders: choices, what is here, refusals, and that scene and preferences are as before. Cards are made
up: machines of tests have none."""

import _cycles
import bpy
import pytest

from lipac.core.errors import InputError
from lipac.lipac_addon.batch.engines import devices
from lipac.lipac_addon.batch.engines.blender import _Told
from lipac.lipac_addon.batch.engines.choices import AS_SET, CPU, DeviceChoice
from lipac.lipac_addon.batch.engines.devices import FALLBACK, cards_of, find_device, on_device

CARDS = [("Quick 9000", "CUDA", "CUDA_0"), ("Slow 10", "CUDA", "CUDA_1"), ("Quick 9000", "OPTIX", "CUDA_0_OptiX")]


@pytest.fixture
def preferences():
    return bpy.context.preferences.addons["cycles"].preferences


def state(preferences):
    kind = preferences.get_compute_device_type()
    return (
        kind,
        [(entry.name, entry.type, entry.id, entry.use) for entry in preferences.devices],
        bpy.context.scene.cycles.device,
    )


@pytest.fixture
def cards(boxes, preferences, monkeypatch):
    """Made up cards, as Cycles lists them: with the CPU behind those of a kind."""
    if "CUDA" not in {name for name, *_ in preferences.get_device_types(bpy.context)}:
        pytest.skip("this Blender was built without CUDA")
    real = _cycles.available_devices

    def available(kind):
        cpu = [device for device in real(kind) if device[1] == "CPU"]
        return tuple((*card, *(False,) * (len(cpu[0]) - 3)) for card in CARDS if card[1] == kind) + tuple(cpu)

    monkeypatch.setattr(_cycles, "available_devices", available)


CHOICES = [
    ("auto", ("auto",)),
    ("CPU", ("cpu",)),
    ("optix:0, 2", ("optix", ("0", "2"))),
    ("cuda:Slow", ("cuda", ("Slow",))),
]


@pytest.mark.parametrize(("text", "choice"), CHOICES)
def test_choices(text, choice):
    assert DeviceChoice.parse(text) == DeviceChoice(*choice)


@pytest.mark.parametrize("text", ["", "gpu", "cpu:0", "auto:0", "cuda:", "cuda:0,,1"])
def test_no_choices(text):
    with pytest.raises(ValueError, match="^" + text):
        DeviceChoice.parse(text)


def test_the_cpu_is_always_there(boxes, preferences):
    before = state(preferences)
    assert find_device(boxes, DeviceChoice(CPU)) == find_device(boxes, AS_SET)
    with on_device(boxes, DeviceChoice(CPU)) as device:
        assert str(device).startswith("CPU: ") and len(str(device)) > 5
        assert boxes.cycles.device == "CPU"
    assert state(preferences) == before


def test_what_is_not_here_is_refused(boxes, cards):
    with pytest.raises(
        InputError, match=r"^--device hip: no HIP device that Cycles can use is here; there is CPU, OptiX, CUDA$"
    ):
        find_device(boxes, DeviceChoice("hip"))
    with pytest.raises(InputError, match=r"^--device cuda:7: no card '7'; CUDA has 0 Quick 9000, 1 Slow 10$"):
        find_device(boxes, DeviceChoice("cuda", ("7",)))


def test_cards_are_used_and_everything_is_put_back(boxes, cards, preferences):
    before = state(preferences)
    with on_device(boxes, DeviceChoice("cuda", ("slow",))) as device:
        assert str(device) == "CUDA: Slow 10"
        assert boxes.cycles.device == "GPU"
        kind, entries, _ = state(preferences)
        assert kind == "CUDA"
        assert {entry[2] for entry in entries if entry[3]} == {"CUDA_1"}  # neither the other card nor the CPU
    assert state(preferences) == before
    with on_device(boxes, DeviceChoice("cuda")) as device:
        assert device.cards == ("Quick 9000", "Slow 10")
    assert state(preferences) == before


def test_as_the_file_and_the_preferences_say(boxes, cards, preferences):
    boxes.cycles.device = "GPU"
    assert str(find_device(boxes, AS_SET)) == "OptiX: Quick 9000"  # no preferences: what has a card
    preferences.compute_device_type = "CUDA"
    try:
        preferences.get_devices_for_type("CUDA")
        next(entry for entry in preferences.devices if entry.id == "CUDA_0").use = False
        before = state(preferences)
        with on_device(boxes, AS_SET) as device:
            assert str(device) == "CUDA: Slow 10"
            assert state(preferences) == before
        for entry in preferences.devices:
            entry.use = False
        assert find_device(boxes, AS_SET).note == FALLBACK
    finally:
        preferences.compute_device_type = "NONE"
        while len(preferences.devices):
            preferences.devices.remove(0)


def test_a_card_that_is_asked_for_and_is_not_there_is_said(boxes, monkeypatch):
    boxes.cycles.device = "GPU"
    monkeypatch.setattr(devices, "cards_of", lambda kind: cards_of(kind) if kind == CPU else [])
    assert find_device(boxes, AS_SET).note == FALLBACK
    with on_device(boxes, AS_SET) as device:
        assert device.kind == CPU
        assert boxes.cycles.device == "CPU"
    assert boxes.cycles.device == "GPU"


def test_what_cycles_says_of_its_memory():
    """Of 5.2, and of 5.0, which has Blender's own memory first. Nothing that was said is unknown, and so is 0."""
    told = _Told(lambda *_: None)
    told.note("Mem: 0M | Updating Scene")
    assert told.device_bytes is None
    assert told.first_sample_s is None
    for line in ("Mem: 11M | Sample 0/8", "Remaining: 00:04.43 | Mem: 1.5G | Sample 1/8", "Mem: 14M | Sample 8/8"):
        told.note(line)
    assert told.device_bytes == 3 << 29
    assert told.first_sample_s is not None
