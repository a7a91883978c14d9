"""What users choose of engines and devices, by name; loads neither Blender nor kernels."""

from __future__ import annotations

from dataclasses import dataclass

BLENDER_ENGINES = {"cycles": "CYCLES", "eevee": "BLENDER_EEVEE"}
ENGINES = (*BLENDER_ENGINES, "hybrid", "path")
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
