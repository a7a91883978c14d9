"""Jobs' reports are held against their schema."""

from collections.abc import Iterator
from typing import Any

import bpy
import pytest

from ...reports import checked_reports


@pytest.fixture(autouse=True, scope="module")
def reports() -> Iterator[None]:
    """All that are written here."""
    with checked_reports():
        yield


@pytest.fixture
def moving(boxes: Any) -> Any:
    """The boxes; the camera goes up until it sees over the wall, a box moves behind it, another bends."""
    camera, box = boxes.camera, bpy.data.objects["box1"]
    for frame, height in ((1, 5.0), (6, 60.0)):
        camera.location.z = height
        camera.rotation_euler.x = 1.25 if frame == 1 else 0.26
        camera.keyframe_insert("location", frame=frame)
        camera.keyframe_insert("rotation_euler", frame=frame)
    for frame, y in ((1, 0.0), (6, 9.0)):
        box.location.y = y
        box.keyframe_insert("location", frame=frame)
    bent = bpy.data.objects["box2"]
    bent.data = bent.data.copy()
    bent.shape_key_add(name="rest")
    key = bent.shape_key_add(name="bent")
    key.data[0].co.z -= 0.7
    for frame in (1, 6):
        key.value = frame / 6
        key.keyframe_insert("value", frame=frame)
    return boxes
