"""What stands behind an option: text -> value, for argparse."""

from __future__ import annotations

import argparse
import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ...lipac_addon.batch.engines.choices import DeviceChoice

LAST_FRAME = 1048574  # Blender's own limit


def frame_range(text: str) -> tuple[int, ...]:
    """Frames of 'A-B' or 'A', each may be negative. Raises ArgumentTypeError."""
    found = re.fullmatch(r"(-?\d+)(?:-(-?\d+))?", text.strip())
    first, last = (int(found[1]), int(found[2] or found[1])) if found else (1, 0)
    if not -LAST_FRAME <= first <= last <= LAST_FRAME:
        raise argparse.ArgumentTypeError(f"'{text}' is no frame range: give A-B with A not after B, for example 1-24")
    return tuple(range(first, last + 1))


def resolution(text: str) -> tuple[int, int]:
    """Width and height of 'WxH'. Raises ArgumentTypeError."""
    found = re.fullmatch(r"(\d+)x(\d+)", text.strip().lower())
    if not found or not all(4 <= int(n) <= 65536 for n in found.groups()):
        raise argparse.ArgumentTypeError(
            f"'{text}' is no resolution: give WxH in pixels, 4 to 65536 each, for example 1920x1080"
        )
    return int(found[1]), int(found[2])


def number(text: str) -> float:
    """A number that is finite and not negative. Raises ArgumentTypeError."""
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0 <= value < float("inf"):
        raise argparse.ArgumentTypeError(f"'{text}' is not a number from 0 up")
    return value


def count(text: str, most: int = 2**31 - 1, least: int = 1) -> int:
    """A whole number from least to most. Raises ArgumentTypeError."""
    if not text.isdecimal() or len(text) > 19 or not least <= int(text) <= most:
        raise argparse.ArgumentTypeError(f"'{text[:40]}' is not a whole number from {least} to {most:,}")
    return int(text)


def sample_count(text: str) -> int:
    """Samples per pixel: as many as Cycles takes. Raises ArgumentTypeError."""
    return count(text, 2**24)


def path_count(text: str) -> int:
    """Paths per pixel of an analysis, each of which takes 64 bytes. Raises ArgumentTypeError."""
    return count(text, 4096)


def seed_number(text: str) -> int:
    """A seed. Raises ArgumentTypeError."""
    return count(text, 2**31 - 1, 0)


def thread_count(text: str) -> int:
    """A number of threads; 0: all. Raises ArgumentTypeError."""
    return count(text, 1024, 0)


def crop_count(text: str) -> int:
    """A number of crops. Raises ArgumentTypeError."""
    if not text.isdecimal() or not 1 <= int(text) <= 12:
        raise argparse.ArgumentTypeError(f"'{text}' is no number of parts of a picture: give 1 to 12")
    return int(text)


def device(text: str) -> DeviceChoice:
    """Where Cycles renders, of 'KIND' or 'KIND:CARD,CARD'. Raises ArgumentTypeError."""
    from ...lipac_addon.batch.engines.choices import DEVICES, DeviceChoice

    try:
        return DeviceChoice.parse(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(
            f"'{text}' is no device: give one of {', '.join(DEVICES)}, or cards of a kind, for example optix:0,1"
        ) from error


def byte_count(text: str) -> int:
    """Bytes of '2G', '500M', '64k' or '1000000': powers of 1000, or of 1024 with an i, as in '2Gi'. Less than 1,000 is
    a size whose unit was forgotten. Raises ArgumentTypeError."""
    found = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([kmgt]?)(i?)b?", text.strip().lower())
    size = float(found[1]) * (1024 if found[3] else 1000) ** " kmgt".index(found[2] or " ") if found else 0.0
    if not found or (found[3] and not found[2]) or not 1000 <= size < 2**63:
        raise argparse.ArgumentTypeError(
            f"'{text}' is no size: give a number of bytes, or one with k, M or G, for example 500M or 2G"
        )
    return int(size)
