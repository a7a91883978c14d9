"""What the engine renders: frozen dataclasses of NumPy arrays (structure of arrays).

Coordinates. World space is Blender's (right-handed, Z up, metres), minus `Scene.origin`, which is subtracted in float64
before anything becomes float32; so a city at 1e6 m keeps its millimetres. Object space is a mesh's own. Colours are
linear Rec.709. Angles are radians.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum, IntFlag

import numpy as np
from numpy.typing import NDArray

from ..arrays import F32, F64, I32, U8, Records
from .mesh import CoarserMeshes, Mesh, MeshTable
from .render_costs import RenderCosts
from .together import Removal


class RayType(IntEnum):
    """Kinds of ray that feedback tells apart; the column of every feedback array."""

    CAMERA = 0
    DIFFUSE = 1
    GLOSSY = 2
    TRANSMISSION = 3
    SHADOW = 4


RAY_TYPES = len(RayType)
ALL_RAYS = (1 << RAY_TYPES) - 1


class Shading(IntEnum):
    """Which Cycles' surface models are followed: they changed with Blender 5.3 (Oren-Nayar, coat, layers, tables of
    GGX)."""

    BLENDER_5_0 = 0
    BLENDER_5_3 = 1

    @classmethod
    def of(cls, version: Sequence[int]) -> Shading:
        """Those of a version of Blender, such as (5, 2, 3)."""
        return cls.BLENDER_5_3 if tuple(version) >= (5, 3) else cls.BLENDER_5_0


class Shader(IntEnum):
    """BSDF model of a material (`MATERIAL["shader"]`)."""

    PRINCIPLED = 0
    DIFFUSE = 1  # Lambert, or Oren-Nayar where `diffuse_roughness` > 0
    GLOSSY = 2  # GGX reflection with `base_color` at every angle
    GLASS = 3  # GGX reflection and refraction by `ior`, tinted by `base_color`
    EMISSION = 4  # emits, scatters nothing
    TRANSPARENT = 5  # passes straight through, tinted by `base_color`
    HOLDOUT = 6  # black with zero alpha
    REFRACTION = 7  # GGX refraction only
    TRANSLUCENT = 8  # Lambert transmission
    # From here on: composed of others
    MIX = 64  # one of two other materials (`parts`), the second with a probability of `alpha`
    BY_RAY = 65  # one of two other materials, by what sees it (`rays`)


class Extension(IntEnum):
    """What a texture returns outside [0, 1] (`TEXTURE["extension"]`)."""

    REPEAT = 0
    EXTEND = 1
    CLIP = 2
    MIRROR = 3


class LightKind(IntEnum):
    """`LIGHT["kind"]`."""

    POINT = 0
    SUN = 1
    SPOT = 2
    AREA = 3


class AreaShape(IntEnum):
    """`LIGHT["shape"]` of an area light."""

    RECTANGLE = 0
    ELLIPSE = 1


class Unsure(IntFlag):
    """`MATERIAL["unsure"]`: what of an approximation is not known."""

    BEHIND = 1  # how much is seen through it: what is, is kept
    CLEAR = 2  # whether it is there at all: it is kept where paths meet it, and some paths pass all such materials
    LIGHT = 4  # how much light comes by it: changes are relative to none of it


class InstanceFlag(IntFlag):
    """`Instances.flags`: one visibility bit per `RayType` (bit value 1 << RayType), then these."""

    HOLDOUT = 1 << 5
    SHADOW_CATCHER = 1 << 6
    DIVISIBLE = 1 << 7  # faces of its mesh may be culled by themselves


NO_TEXTURE = -1
BY_ANGLE = 5
# what a BY_RAY material tells apart: ray types, and light sampling behind them; first of the front, then of the back
VIEWS = RAY_TYPES + 1

# Records have no padding: their bytes are compared and hashed, and NumPy may leave anything in what belongs to no
# field.
MATERIAL = np.dtype(
    [
        ("shader", "u4"),
        ("base_color", "f4", (3,)),
        ("metallic", "f4"),
        ("roughness", "f4"),  # as in Blender's socket: alpha = roughness**2
        ("diffuse_roughness", "f4"),
        ("ior", "f4"),
        ("specular_level", "f4"),  # Principled "Specular IOR Level", 0.5 = as the IOR says
        ("specular_tint", "f4", (3,)),
        ("transmission", "f4"),
        ("alpha", "f4"),
        ("coat", "f4"),
        ("coat_roughness", "f4"),
        ("coat_ior", "f4"),
        ("coat_tint", "f4", (3,)),
        ("emission", "f4", (3,)),  # colour times strength, W/m2/sr
        ("normal_strength", "f4"),
        # Texture indices into Scene.textures, NO_TEXTURE where a socket is not textured. A texture multiplies the value
        # above.
        ("base_color_texture", "i4"),
        ("metallic_texture", "i4"),
        ("roughness_texture", "i4"),
        ("alpha_texture", "i4"),
        ("emission_texture", "i4"),
        ("normal_texture", "i4"),  # tangent space, +Y up
        ("transmission_texture", "i4"),
        # Channel that a scalar socket reads: 0 red, 1 green, 2 blue, 3 alpha, 4 mean of RGB (luminance); of a MIX also
        # BY_ANGLE: red, at the cosine of the angle at which a ray meets the surface
        ("metallic_channel", "u1"),
        ("roughness_channel", "u1"),
        ("alpha_channel", "u1"),
        ("transmission_channel", "u1"),
        ("mis_emission", "u1"),  # 1: its emission is sampled as a light (Blender's "Emission Sampling")
        ("single_sided_emission", "u1"),  # 1: emits from the front side only
        ("rays", "u2"),  # of BY_RAY: a bit per view that sees the second part
        ("unsure", "u4"),  # `Unsure`
        # 1: how much it emits is not known; `emission` is the most that it may be
        ("unsure_emission", "u4"),
        ("sure", "f4"),  # share of `base_color` that is surely there: places may be darker than is thought
        # what is within so many metres changes what it looks like, by nodes that look around; 0: by light alone
        ("reach", "f4"),
        # of MIX and BY_RAY: rows of two materials, never in a cycle; emission there is the brightest of theirs
        ("parts", "i4", (2,)),
    ],
    align=True,
)

TEXTURE = np.dtype(
    [
        ("offset", "i8"),  # of the first channel of the first pixel in the byte or the float pool
        ("width", "i4"),
        ("height", "i4"),
        ("is_float", "u1"),  # 0: Textures.bytes, 1: Textures.floats. Always four channels (RGBA), rows bottom up.
        ("srgb", "u1"),  # decode sRGB after interpolation (as Cycles does for byte images)
        ("extension", "u1"),
        ("closest", "u1"),  # 1: nearest pixel, 0: bilinear
        ("uv_map", "i4"),  # index into Scene.uv_maps
        ("uv_matrix", "f4", (2, 3)),  # applied to UV before the lookup
    ],
    align=True,
)

LIGHT = np.dtype(
    [
        ("kind", "u4"),
        ("shape", "u4"),
        ("position", "f4", (3,)),
        ("axis_x", "f4", (3,)),  # unit, world
        ("axis_y", "f4", (3,)),
        ("axis_z", "f4", (3,)),  # unit; the light shines along -axis_z, as in Blender
        ("power", "f4", (3,)),  # colour x energy x 2**exposure in Blender's units: W (point, spot, area), W/m2 (sun)
        # area: full width and height in metres, scale applied; spot: how many times as wide as along its axis its cone
        # is, by the scale; 0: as wide
        ("size", "f4", (2,)),
        ("radius", "f4"),  # point, spot: Blender's shadow_soft_size, metres
        ("angle", "f4"),  # sun: angular diameter
        ("spot_size", "f4"),  # full cone angle
        ("spot_blend", "f4"),
        ("spread", "f4"),  # area, pi = all of the hemisphere
        ("visibility", "u4"),  # bit per RayType: which rays see the light's shape itself
        ("cast_shadow", "u1"),
        ("normalize", "u1"),  # 1: `power` is divided by the shape's area (Blender's default)
        ("soft_falloff", "u1"),  # point, spot
        ("use_mis", "u1"),
        ("max_bounces", "i4"),
        # 1: what of its light arrives where is not known, this is the most that may; 2 or 3: it takes it away
        ("unsure", "u4"),
    ],
    align=True,
)


# What a camera ray meets: instance (-1: nothing), triangle of its mesh, barycentrics of the triangle's vertices 1 and
# 2.
HIT = np.dtype([("instance", "i4"), ("triangle", "u4"), ("b1", "f4"), ("b2", "f4")])


@dataclass(frozen=True)
class Instances:
    """Every instance of the scene, N of them, in a stable order.

    transform: (N, 3, 4) float32 object to world (minus `Scene.origin`).
    mesh: (N,) int32 into `Scene.meshes`.
    slots: (N,) int32: material of a triangle is `Scene.slot_materials[slots[i] + mesh.slots[triangle]]`.
    flags: (N,) uint8, `InstanceFlag` (visibility bits by ray type first).
    bounds: (N, 2, 3) float32 world box (low, high).
    """

    transform: F32
    mesh: I32
    slots: I32
    flags: U8
    bounds: F32

    def __len__(self) -> int:
        return len(self.mesh)


@dataclass(frozen=True)
class Textures:
    """records: (T,) of TEXTURE; bytes: (B,) uint8 pool; floats: (F,) float32 pool."""

    records: Records
    bytes: U8
    floats: F32

    @staticmethod
    def none() -> Textures:
        """No texture at all."""
        return Textures(np.zeros(0, TEXTURE), np.zeros(0, np.uint8), np.zeros(0, np.float32))


@dataclass(frozen=True)
class World:
    """Light from infinity.

    color: (3,) float32 radiance where there is no image.
    image: (H, W, 3) float32 equirectangular radiance, rows bottom up, or None. The middle column looks along -X:
    u = atan2(y, -x) / 2pi + 0.5, v = asin(z) / pi + 0.5 for a unit world direction (x, y, z).
    visibility: bit per RayType.
    seen: (H, W, 3), as the image: what camera rays see, where that is something else.
    """

    color: F32
    image: F32 | None = None
    visibility: int = ALL_RAYS
    seen: F32 | None = None


@dataclass(frozen=True)
class Camera:
    """A perspective or orthographic camera.

    to_world: (3, 4) float64, camera to world (minus `Scene.origin`); it looks along its -Z, +Y is up.
    frame: (4,) float64 left, right, bottom, top of the picture at distance 1 (perspective), or in metres
    (orthographic); lens shift, sensor fit and pixel aspect applied, as `bpy.types.Camera.view_frame` gives it.
    aperture: lens radius in metres, 0 without depth of field; focus: distance of the sharp plane; blades: 0 for a disk.
    """

    to_world: F64
    frame: F64
    orthographic: bool = False
    clip_start: float = 0.0
    clip_end: float = 1e30
    aperture: float = 0.0
    focus: float = 1.0
    blades: int = 0
    blade_rotation: float = 0.0
    aperture_ratio: float = 1.0


@dataclass(frozen=True)
class PathLimits:
    """Bounce limits with Cycles' meaning (0 bounces: direct light only), and whose surface models paths follow."""

    total: int = 12
    diffuse: int = 4
    glossy: int = 4
    transmission: int = 12
    transparent: int = 8
    caustics_reflective: bool = True
    caustics_refractive: bool = True
    clamp_direct: float = 0.0  # 0: off
    clamp_indirect: float = 0.0
    filter_glossy: float = 0.0
    shading: Shading = Shading.BLENDER_5_0
    # Fast GI, from this bounce on, 0: never: rays reach so many metres, and end, or see the world times a factor
    fast_gi: int = 0
    fast_reach: float = 0.0
    fast_factor: float = 1.0
    world: int = 1024  # bounces after which light sampling leaves the world out


@dataclass(frozen=True)
class Film:
    """Size in pixels, pixel filter as in Cycles, exposure; `transparent`: the world is not seen by the camera.

    glass: nor, where that is so, through what refracts by a roughness (GGX's alpha) of so much; below 0: there it is.
    """

    width: int
    height: int
    filter: str = "BLACKMAN_HARRIS"  # or BOX, GAUSSIAN
    filter_width: float = 1.5  # pixels
    exposure: float = 1.0
    transparent: bool = False
    glass: float = -1.0


@dataclass(frozen=True, eq=False)
class FirstHitBuffer:
    """One pass of first hits.

    hits: (H, W) of HIT, rows bottom up. camera: pinhole camera whose rays through the pixel centres met them. meshes:
    what they lie on is loaded there. lamps_known: a raster's shadow maps tell which light of lamps arrives at them,
    whatever is built: feedback and path logs leave that light out.
    """

    hits: Records
    camera: Camera
    meshes: MeshTable
    lamps_known: bool = False


@dataclass(frozen=True)
class Scene:
    """One frame of a scene.

    meshes: a sequence that may produce its items on demand (`meshes[m]` loads mesh m); bounds are known without
    loading.
    mesh_bounds: (M, 2, 3) float32 object space; low > high marks a mesh without triangles.
    slot_materials: (S,) int32 into materials.
    approximated: one line per thing that the engine renders differently from Blender.
    first_hits: what camera rays meet, where it is known from elsewhere, by width and height of the picture: paths of
    such a picture start there. shutter: the camera at evenly spaced moments of an exposure, of which each path takes
    one at random; none: it stands still. whole: why nothing may be culled by light paths, in words; "": it may. stays:
    (N,) bool, instances that the picture shows by other things than light; None: none.
    simplifiable: (M,) bool, meshes that may be exchanged for simplified ones; None: none. coarser: meshes that can be
    had with fewer triangles. triangles: (M,) int64 of each mesh, where they are known without loading. removal: what
    cannot be taken out alone; None: all can.
    """

    instances: Instances
    meshes: Sequence[Mesh]
    mesh_bounds: F32
    slot_materials: I32
    materials: Records
    lights: Records
    world: World
    camera: Camera
    film: Film
    textures: Textures = field(default_factory=Textures.none)
    uv_maps: tuple[str, ...] = ("",)  # index 0 "" is each mesh's active render map
    limits: PathLimits = field(default_factory=PathLimits)
    origin: F64 = field(default_factory=lambda: np.zeros(3))
    approximated: tuple[str, ...] = ()
    first_hits: Mapping[tuple[int, int], FirstHitBuffer] = field(default_factory=dict)
    shutter: tuple[Camera, ...] = ()
    render_costs: RenderCosts | None = None
    whole: str = ""
    stays: NDArray[np.bool_] | None = None
    simplifiable: NDArray[np.bool_] | None = None
    coarser: CoarserMeshes | None = None
    triangles: NDArray[np.int64] | None = None
    removal: Removal | None = None


def default_material() -> Records:
    """One MATERIAL record as Blender renders a mesh without a material (Principled, 0.8 grey, roughness 0.5)."""
    m = np.zeros((), MATERIAL)
    m["base_color"] = 0.8
    m["roughness"] = 0.5
    m["ior"] = m["coat_ior"] = 1.5
    m["specular_level"] = 0.5
    m["specular_tint"] = m["coat_tint"] = 1.0
    m["alpha"] = m["normal_strength"] = 1.0
    for name in MATERIAL.names or ():
        if name.endswith("_texture"):
            m[name] = NO_TEXTURE
    m["mis_emission"] = m["sure"] = 1
    return m
