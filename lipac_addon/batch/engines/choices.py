"""What users choose of engines and devices, by name; loads neither Blender nor kernels."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Engine:
    """What renders pictures.

    name: on the command line and in reports; description: in its help; identifier: Blender's for an engine of its own,
    "" for one of ours; hardware: where it renders, where users have no choice; endings: of a frame's pictures.
    shows_culled: whether its pictures show what is culled all the same, rasterized: then a culled render cannot be
    compared with a full one by crops, and no tile need change by more than the mean may. uses_blender: whether Blender
    draws, which frees its dependency graph.
    """

    name: str
    description: str = ""
    identifier: str = ""
    hardware: str = ""
    endings: tuple[str, ...] = (".exr", ".png")
    shows_culled: bool = False
    uses_blender: bool = True


_EEVEE = "EEVEE is on the graphics card that the system's graphics driver gives it"
_HYBRID = "paths are traced on the CPU, and EEVEE is on the graphics card that the driver gives it"
_LAYERS = (".exr", ".png", "_layers.exr")
ENGINES = {
    engine.name: engine
    for engine in (
        Engine("cycles", identifier="CYCLES"),
        Engine("eevee", identifier="BLENDER_EEVEE", hardware=_EEVEE),
        Engine("hybrid", "EEVEE and light paths together", "", _HYBRID, _LAYERS, shows_culled=True),
        Engine("path", "the path tracer of the analysis", "", "the path tracer is on the CPU", uses_blender=False),
    )
}
BLENDER_ENGINES = {engine.name: engine.identifier for engine in ENGINES.values() if engine.identifier}
AUTO, CPU = "auto", "cpu"
GPU_KINDS = ("optix", "cuda", "hip", "oneapi", "metal")  # the first that has a card comes first
DEVICES = (AUTO, CPU, *GPU_KINDS)


@dataclass(frozen=True)
class DeviceChoice:
    """Where Cycles renders. kind: of DEVICES, AUTO as the file and the preferences say; cards: numbers from 0, or parts
    of names; none: all of the kind."""

    kind: str = AUTO
    cards: tuple[str, ...] = ()

    def __str__(self) -> str:
        return f"{self.kind}:{','.join(self.cards)}" if self.cards else self.kind

    @staticmethod
    def parse(text: str) -> DeviceChoice:
        """Of 'KIND' or 'KIND:CARD,CARD'. Raises ValueError."""
        kind, colon, named = text.strip().partition(":")
        cards = tuple(card.strip() for card in named.split(",")) if colon else ()
        if kind.lower() not in DEVICES or not all(cards) or (cards and kind.lower() not in GPU_KINDS):
            raise ValueError(text)
        return DeviceChoice(kind.lower(), cards)


AS_SET = DeviceChoice()
