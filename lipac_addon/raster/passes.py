"""EEVEE's passes of the whole scene: light of lamps with shadow maps, base colours, emission, background."""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ...core.arrays import F32
from ...core.errors import InputError
from ...core.scene.film import LUMINANCE
from ..console import muted
from ..depsgraph import changed, no_new_images
from ..pictures import save_render_result

_PASSES = ("diffuse_direct", "diffuse_color", "glossy_direct", "glossy_color", "emit", "environment")
_FILE = {
    "media_type": "MULTI_LAYER_IMAGE",
    "file_format": "OPEN_EXR_MULTILAYER",
    "exr_codec": "NONE",
    "use_exr_interleave": True,
    "color_depth": "32",
}
# The whole picture, sharp and as the engine leaves it: first hits and paths are of one moment, and of all pixels.
_PLAIN = {
    "use_border": False,
    "use_motion_blur": False,
    "use_sequencer": False,
    "use_compositing": False,
    "use_multiview": False,
    "use_persistent_data": False,
}
# Blender 5.0 has none: there lamps are rendered without the world, the background with it
_NO_SKY = "indirect_light_intensity"
_LAMPS_ONLY = {
    # Only lamps: the sky, probes and what the screen shows give no light to surfaces, the path tracer does that.
    _NO_SKY: 0.0,
    "use_raytracing": False,
    "use_fast_gi": False,
    "light_threshold": 1e-5,  # 0 loses shadows, the default cuts dim lamps off
    "use_shadows": True,
}
FAINT = 1e-6  # luminance below which half precision tells no shares


@dataclass(frozen=True)
class Passes:
    """What EEVEE says of a picture, (H, W, 3) float32 each, linear, rows bottom up, filtered over its samples.

    combined: (H, W, 4), EEVEE's own picture of the light that it was asked for. diffuse, glossy: light of lamps that
    arrives and is scattered, their colours not applied. unshadowed: (H, W, 3), `direct` as it would be if nothing cast
    a shadow; None where nobody asked.
    """

    combined: F32
    diffuse: F32
    diffuse_color: F32
    glossy: F32
    glossy_color: F32
    emission: F32
    environment: F32
    unshadowed: F32 | None = None

    @property
    def direct(self) -> F32:
        """Light of lamps, (H, W, 3)."""
        return self.diffuse * self.diffuse_color + self.glossy * self.glossy_color

    @property
    def visible(self) -> F32:
        """Share of the lamps' light that the shadow maps let arrive, (H, W), 1 where there is none or nobody asked.

        It is the light that is compared, not how much of the pixel is in shadow (EEVEE's Shadow pass): half a pixel
        that faces away from a lamp, and is dark by that, says nothing about shadows on the other half.
        """
        if self.unshadowed is None:
            return np.ones(self.emission.shape[:2], np.float32)
        arriving, light = (picture @ LUMINANCE for picture in (self.direct, self.unshadowed))
        return np.where(light > FAINT, np.clip(arriving / np.maximum(light, FAINT), 0, 1), 1).astype(np.float32)

    @property
    def albedo(self) -> F32:
        """Base colours, (H, W, 3); 1 where the background is."""
        total = self.diffuse_color + self.glossy_color
        return np.minimum(
            np.where(
                self.environment.any(axis=2, keepdims=True) & ~total.any(axis=2, keepdims=True), np.float32(1), total
            ),
            np.float32(1),
        )


def render_passes(
    scene: bpy.types.Scene,
    samples: int = 8,
    lamps_only: bool = True,
    unshadowed: bool = False,
    save: Path | None = None,
) -> Passes:
    """Render the current frame of the open file by EEVEE, everything in it, and return its passes; the scene's settings
    are put back.

    lamps_only: no other light falls on surfaces, for others bring it; else all that EEVEE makes of the scene's
    settings. unshadowed: with lamps_only, render their light without shadows too. save: also save the picture as
    save.exr and save.png, displayed as Blender displays its renders.

    Raises InputError where it cannot be rendered, OSError where a file cannot be written. OpenGL must be there
    (`opengl.require`).
    """
    passes = _render(scene, samples, _LAMPS_ONLY if lamps_only else {}, save)
    if lamps_only and not hasattr(scene.eevee, _NO_SKY):
        with changed(scene, world=None):
            lamps = _render(scene, samples, _LAMPS_ONLY)
        passes = dataclasses.replace(passes, diffuse=lamps.diffuse, glossy=lamps.glossy)
    if not unshadowed:
        return passes
    with changed(scene, world=scene.world if hasattr(scene.eevee, _NO_SKY) else None):
        return dataclasses.replace(
            passes, unshadowed=_render(scene, samples, {**_LAMPS_ONLY, "use_shadows": False}).direct
        )


def _render(scene: bpy.types.Scene, samples: int, eevee: dict[str, Any], save: Path | None = None) -> Passes:
    with _settings(scene, samples, eevee), no_new_images():
        try:
            with muted():
                bpy.ops.render.render(scene=scene.name)
                if save is not None:
                    save_render_result(scene, save)
                return _passes(scene)
        except RuntimeError as error:
            raise InputError(f"eevee cannot render the scene: {str(error).removeprefix('Error:').strip()}") from error


@contextmanager
def _settings(scene: bpy.types.Scene, samples: int, eevee: dict[str, Any]) -> Iterator[None]:
    """EEVEE, of the first layer that is rendered, with the passes; as `eevee` says of its settings."""
    layer = next((v for v in scene.view_layers if v.use), scene.view_layers[0])
    with ExitStack() as stack:

        def set_(target: Any, **values: Any) -> None:
            stack.enter_context(changed(target, **_known(target, values)))

        set_(scene.render, engine="BLENDER_EEVEE", **_PLAIN)
        set_(scene.eevee, taa_render_samples=samples, **eevee)
        if scene.world is not None and eevee:
            set_(scene.world, sun_threshold=0.0)
        for other in scene.view_layers:
            set_(other, use=other == layer)
        set_(layer, **{f"use_pass_{name}": True for name in _PASSES})
        yield


def _known(target: Any, values: dict[str, Any]) -> dict[str, Any]:
    """Those of values that this version of Blender has."""
    return {name: value for name, value in values.items() if hasattr(target, name)}


def _passes(scene: bpy.types.Scene) -> Passes:
    """Of the last render. Scripts can read them from a file alone."""
    with tempfile.TemporaryDirectory(prefix="lipac-") as folder:
        path, settings = Path(folder) / "passes.exr", scene.render.image_settings
        with changed(settings, **_known(settings, _FILE)):
            bpy.data.images["Render Result"].save_render(str(path), scene=scene)
        return _read(path)


def _read(path: Path) -> Passes:
    """Passes of a multilayer EXR as EEVEE wrote it."""
    import OpenEXR

    # channels are LAYER.PASS.LETTER, and a layer's name may have dots
    with OpenEXR.File(str(path), separate_channels=True) as file:
        channels = {
            ".".join(name.rsplit(".", 2)[1:]): channel.pixels
            for part in file.parts
            for name, channel in part.channels.items()
        }

    def color(name: str, letters: str = "RGB") -> F32:
        return np.ascontiguousarray(
            np.stack([channels[f"{name}.{letter}"] for letter in letters], axis=2)[::-1], np.float32
        )

    return Passes(
        combined=color("Combined", "RGBA"),
        diffuse=color("Diffuse Direct"),
        diffuse_color=color("Diffuse Color"),
        glossy=color("Glossy Direct"),
        glossy_color=color("Glossy Color"),
        emission=color("Emission"),
        environment=color("Environment"),
    )
