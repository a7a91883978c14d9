"""Whether this machine can rasterize, asked before Blender does: without OpenGL, Blender ends the process."""

from __future__ import annotations

import ctypes
import sys
from functools import cache

import bpy

from ...core.errors import InputError
from ..console import muted
from ..depsgraph import no_new_images

NO_OPENGL = (
    "no OpenGL here to rasterize with: install EGL and a driver (Debian, Ubuntu: apt install libegl1 libgl1 "
    "libegl-mesa0 libgl1-mesa-dri; "
    "Fedora: dnf install mesa-libEGL mesa-libGL mesa-dri-drivers), or trace the first hits as well: --primary traced"
)

_EGL_PLATFORM_DEVICE = 0x313F


@cache
def has_opengl() -> bool:
    """Whether a display can be opened without a window system. True where windows are always there: Windows, macOS, and
    Blender with its window open."""
    if sys.platform != "linux" or not bpy.app.background:
        return True
    try:
        egl = ctypes.CDLL("libEGL.so.1")
    except OSError:
        return False
    pointer = ctypes.c_void_p
    egl.eglGetDisplay.restype, egl.eglGetDisplay.argtypes = pointer, [pointer]
    egl.eglInitialize.argtypes = [pointer] * 3
    egl.eglGetProcAddress.restype, egl.eglGetProcAddress.argtypes = pointer, [ctypes.c_char_p]
    displays = [egl.eglGetDisplay(None)]
    query, of_device = egl.eglGetProcAddress(b"eglQueryDevicesEXT"), egl.eglGetProcAddress(b"eglGetPlatformDisplayEXT")
    if query and of_device:  # without a window system, Blender opens a device, as here
        devices, count = (pointer * 16)(), ctypes.c_int()
        ctypes.CFUNCTYPE(ctypes.c_uint, ctypes.c_int, pointer, pointer)(query)(
            len(devices), devices, ctypes.byref(count)
        )
        open_device = ctypes.CFUNCTYPE(pointer, ctypes.c_uint, pointer, pointer)(of_device)
        displays += [open_device(_EGL_PLATFORM_DEVICE, device, None) for device in devices[: count.value]]
    return any(display and egl.eglInitialize(display, None, None) for display in displays)


def require() -> None:
    """Make the `gpu` module usable. Raises InputError, one line that says which packages to install, where there is no
    OpenGL."""
    import gpu

    if not has_opengl():
        raise InputError(NO_OPENGL)
    if not bpy.app.background:
        return
    with muted():
        if hasattr(gpu, "init"):
            gpu.init()
        _wake()


def _wake() -> None:
    """A render of nothing by EEVEE makes the `gpu` module work without a window, before Blender 5.2, and after a render
    that has drawn Grease Pencil, which leaves it without a context."""
    import gpu

    try:
        gpu.platform.backend_type_get()
        gpu.types.GPUOffScreen(4, 4).free()
        return
    except (SystemError, RuntimeError):
        pass
    scene = bpy.data.scenes.new(".lipac wake")
    camera = bpy.data.objects.new(".lipac wake", bpy.data.cameras.new(".lipac wake"))
    scene.collection.objects.link(camera)
    scene.camera = camera
    scene.render.engine = "BLENDER_EEVEE"
    scene.render.resolution_x = scene.render.resolution_y = 4
    scene.eevee.taa_render_samples = 1
    try:
        with no_new_images():
            bpy.ops.render.render(scene=scene.name)
    finally:
        data = camera.data
        bpy.data.objects.remove(camera)
        bpy.data.cameras.remove(data)
        bpy.data.scenes.remove(scene)
