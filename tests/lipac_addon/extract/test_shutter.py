"""What an exposure sees: cameras on the way, and whether anything else moves."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
import pytest

from lipac.core.culling.options import CullOptions
from lipac.core.files.report import Report, load_states
from lipac.core.scene.model import Camera
from lipac.lipac_addon.batch.job import Job
from lipac.lipac_addon.batch.pipeline import run
from lipac.lipac_addon.depsgraph import go_to
from lipac.lipac_addon.extract import Extractor, extract_frame
from lipac.lipac_addon.extract.materials.reader import WORTHLESS
from lipac.lipac_addon.extract.scene import VELOCITY
from lipac.lipac_addon.extract.shutter import CAMERAS, Passing, of_more_steps
from lipac.lipac_addon.keys import any_of

from .conftest import add, cube


def animate(item: Any, path: str, index: int, *keys: tuple[float, float]) -> None:
    """Straight lines between (frame, value)."""
    for frame, value in keys:
        getattr(item, path)[index] = value
        item.keyframe_insert(path, index=index, frame=frame)
    for layer in item.animation_data.action.layers:
        for curve in layer.strips[0].channelbag(item.animation_data.action_slot).fcurves:
            for point in curve.keyframe_points:
                point.interpolation = "LINEAR"


@pytest.fixture
def exposed() -> Any:
    """A cube before a camera; the shutter is open for a frame around frame 5."""
    scene = bpy.context.scene
    add("cube", cube())
    scene.frame_set(5)
    scene.render.use_motion_blur, scene.render.motion_blur_shutter, scene.render.motion_blur_position = (
        True, 1.0, "CENTER"
    )
    return scene


def path(cameras: tuple[Camera, ...], origin: Any, index: int) -> np.ndarray:
    """One world coordinate of the cameras."""
    return np.array([camera.to_world[index, 3] + origin[index] for camera in cameras])


@pytest.mark.parametrize(("position", "first"), [("CENTER", -0.5), ("START", 0.0), ("END", -1.0)])
def test_cameras_of_an_exposure(exposed: Any, position: str, first: float) -> None:
    """They go where Blender's camera goes, from where the shutter opens to where it closes; the file stays at its
    frame."""
    animate(exposed.camera, "location", 0, (0, 0.0), (10, 20.0))
    exposed.render.motion_blur_position = position
    extraction = extract_frame(exposed)
    scene = extraction.scene
    assert len(scene.shutter) == CAMERAS
    times = 5 + first + (np.arange(CAMERAS) + 0.5) / CAMERAS
    np.testing.assert_allclose(path(scene.shutter, scene.origin, 0), 2 * times, atol=1e-5)
    np.testing.assert_allclose(scene.camera.to_world[0, 3] + scene.origin[0], 10, atol=1e-5)
    assert extraction.moments == ()
    assert exposed.frame_float == 5


@pytest.mark.parametrize("frame", [5.5, -3.75])
def test_between_two_frames(exposed: Any, frame: float) -> None:
    """An exposure around a moment between two frames, where the scene then still is; what else moves is looked at when
    the shutter opens and closes for it."""
    animate(exposed.camera, "location", 0, (-10, -20.0), (10, 20.0))
    animate(bpy.data.objects["cube"], "location", 2, (-10, -1.0), (10, 1.0))
    go_to(exposed, frame)
    with Extractor(exposed) as extractor:
        extraction = extractor.frame()
        times = frame - 0.5 + (np.arange(CAMERAS) + 0.5) / CAMERAS
        np.testing.assert_allclose(path(extraction.scene.shutter, extraction.scene.origin, 0), 2 * times, atol=1e-5)
        assert exposed.frame_float == frame
        bounds = [extraction.scene.instances.bounds[0, 0, 2] + extraction.scene.origin[2]]
        for moment in extraction.moments:
            other = extractor.frame(None, True, moment).scene
            bounds.append(other.instances.bounds[0, 0, 2] + other.origin[2])
        np.testing.assert_allclose(np.diff([bounds[1], bounds[0], bounds[2]]), 0.05, atol=1e-5)
    assert exposed.frame_float == frame


def test_a_turning_camera_turns_evenly(exposed: Any) -> None:
    """A quarter of a turn."""
    exposed.camera.rotation_euler = (np.pi / 2, 0, 0)
    animate(exposed.camera, "rotation_euler", 2, (4.5, 0.0), (5.5, np.pi / 2))
    cameras = extract_frame(exposed).scene.shutter
    angle = [np.arctan2(camera.to_world[0, 2], -camera.to_world[1, 2]) for camera in cameras]
    np.testing.assert_allclose(np.abs(np.diff(np.unwrap(angle))), np.pi / 2 / CAMERAS, rtol=0.02)
    for camera in cameras:
        np.testing.assert_allclose(camera.to_world[:, :3].T @ camera.to_world[:, :3], np.eye(3), atol=1e-6)


def test_still_or_without_blur_there_is_one_camera(exposed: Any) -> None:
    assert extract_frame(exposed).scene.shutter == ()
    animate(exposed.camera, "location", 0, (0, 0.0), (10, 20.0))
    assert Extractor(exposed, whole=False).frame(keep=False).scene.shutter == ()
    exposed.render.use_motion_blur = False
    assert extract_frame(exposed).scene.shutter == ()


def test_what_moves_is_looked_at_at_other_moments(exposed: Any) -> None:
    """A moving object, not a moving empty; seen by the cameras of the frame, and the next frame is as it would be by
    itself."""
    animate(add("empty"), "location", 0, (0, 0.0), (10, 20.0))
    with Extractor(exposed) as extractor:
        assert extractor.frame().moments == ()
        animate(bpy.data.objects["cube"], "location", 0, (0, 0.0), (10, 20.0))
        animate(exposed.camera, "location", 0, (0, 0.0), (10, 20.0))
        extraction = extractor.frame()
        assert extraction.moments == (-0.5, 0.5)
        assert any(line.startswith("motion blur") for line in extraction.scene.approximated)
        x = {0.0: 10.0}
        for moment in extraction.moments:
            other = extractor.frame(at=moment)
            x[moment] = float(other.scene.instances.transform[0, 0, 3] + other.scene.origin[0])
            np.testing.assert_allclose(
                path(other.scene.shutter, other.scene.origin, 0),
                path(extraction.scene.shutter, extraction.scene.origin, 0),
                atol=1e-5,
            )
        assert x == pytest.approx({-0.5: 9, 0.0: 10, 0.5: 11}, abs=1e-5)
        assert exposed.frame_float == 5
        after = extractor.frame(6)
    alone = extract_frame(exposed, 6)
    np.testing.assert_array_equal(after.scene.instances.transform, alone.scene.instances.transform)


def test_what_a_door_shows_while_the_shutter_is_open_stays(exposed: Any, tmp_path: Any) -> None:
    """A closed door that opens within the exposure: what stands behind it is kept; what a wall hides all the time is
    not."""
    exposed.camera.location, exposed.camera.rotation_euler = (0, -20, 0), (np.pi / 2, 0, 0)
    bpy.data.objects.remove(bpy.data.objects["cube"])
    exposed.world = bpy.data.worlds.new("World")
    exposed.world.node_tree.nodes["Background"].inputs[0].default_value = (1, 1, 1, 1)
    exposed.render.resolution_x, exposed.render.resolution_y = 64, 36
    for name, x in (("door", -4.0), ("wall", 4.0)):
        add(name, cube(name, 4.0), location=(x, 0, 0), scale=(1, 0.05, 1))
    for name, x in (("behind", -4.0), ("hidden", 4.0)):
        add(name, cube(name), location=(x, 8, 0))
    animate(bpy.data.objects["door"], "location", 2, (5.0, 0.0), (5.5, 12.0))
    run(Job(tmp_path, (5,), CullOptions(seed=1)), Report("door", "", "", "light-paths", "", 0, 1))
    states = load_states(tmp_path / "states" / "frame_0005.npz")
    kept = {states.names[k] for k, state in zip(states.keys["object"], states.state, strict=True) if state}
    assert "behind" in kept
    assert "hidden" not in kept


def test_a_rolling_shutter_is_said(exposed: Any) -> None:
    """Rows have moments of their own, and paths the whole exposure: said where something moves."""
    for rolling, moves, said in (("NONE", True, False), ("TOP", False, False), ("TOP", True, True)):
        exposed.cycles.rolling_shutter_type = rolling
        if moves:
            animate(bpy.data.objects["cube"], "location", 2, (0, -1.0), (10, 1.0))
        else:
            bpy.data.objects["cube"].animation_data_clear()
        lines = [line for line in extract_frame(exposed).scene.approximated if line.startswith("rolling")]
        assert bool(lines) == said


@pytest.mark.parametrize(
    ("position", "moments"), [("START", (0.5, 1.0)), ("CENTER", (-0.5, 0.5)), ("END", (-1.0, -0.5))]
)
def test_what_passes_while_the_shutter_is_open_is_looked_at_half_way(
    exposed: Any, position: str, moments: tuple[float, ...]
) -> None:
    """Wherever the frame lies in the exposure: a train is before the picture when it begins, and behind it at its
    end."""
    animate(bpy.data.objects["cube"], "location", 0, (0, -50.0), (10, 50.0))
    exposed.render.motion_blur_position = position
    assert extract_frame(exposed).moments == moments
    exposed.view_layers[0].use_motion_blur = False
    assert extract_frame(exposed).moments == ()


@pytest.mark.parametrize(("speed", "passes"), [(1.5, False), (6.0, True)])
def test_what_passes_between_the_moments_stays(exposed: Any, speed: float, passes: bool) -> None:
    """A cube of 2 m, which moves so many times that from one to the next."""
    animate(bpy.data.objects["cube"], "location", 0, (0, 0.0), (10, 40 * speed))
    seen = Passing()
    with Extractor(exposed) as extractor:
        extraction = extractor.frame()
        seen.add(0.0, extraction.keys, extraction.scene)
        for moment in extraction.moments:
            other = extractor.frame(at=moment)
            seen.add(moment, other.keys, other.scene)
    assert any_of(extraction.keys.records, seen.found()).tolist() == [passes]


@pytest.mark.parametrize(("size", "turn", "passes"), [(1.0, np.pi, True), (1.0, 0.3, False), (0.02, np.pi, False)])
def test_what_a_wheel_hides_between_the_moments_is_said(
    exposed: Any, tmp_path: Any, size: float, turn: float, passes: bool
) -> None:
    """It stays where it is, and its spokes are elsewhere; not of what is smaller than a tile."""
    wheel = bpy.data.objects["cube"]
    wheel.scale = (size,) * 3
    animate(wheel, "rotation_euler", 2, (0, 0.0), (10, 20 * turn))
    seen = Passing()
    with Extractor(exposed) as extractor:
        extraction = extractor.frame()
        seen.add(0.0, extraction.keys, extraction.scene)
        for moment in extraction.moments:
            other = extractor.frame(at=moment)
            seen.add(moment, other.keys, other.scene)
    assert any_of(extraction.keys.records, seen.found()).tolist() == [passes]
    report = Report("wheel", "", "", "light-paths", "", 0, 1)
    run(Job(tmp_path, (5,), CullOptions(seed=1)), report)
    assert any(line.endswith(WORTHLESS) for line in report.warnings) == passes


def test_what_moves_along_more_places_stays(exposed: Any) -> None:
    """A blade that turns by whole turns from moment to moment, and is never looked at where it is seen."""
    blade = bpy.data.objects["cube"]
    blade.scale, blade.location = (1, 0.1, 0.1), (0, 60, 0)
    hub = add("hub")
    blade.parent = hub
    hub.location = exposed.camera.location
    animate(hub, "rotation_euler", 2, (0, np.pi), (10, 41 * np.pi))
    blade.cycles.motion_steps = 5
    extraction = extract_frame(exposed)
    assert of_more_steps(extraction.keys)[extraction.keys.records["object"]].all()
    blade.cycles.motion_steps = 1
    assert not of_more_steps(extraction.keys).any()


@pytest.mark.parametrize(("speed", "blur", "stays"), [(9.0, True, True), (0.0, True, False), (9.0, False, False)])
def test_what_velocities_blur_stays_and_is_said(exposed: Any, speed: float, blur: bool, stays: bool) -> None:
    """Simulations and caches bring velocities: where a mesh is while the shutter is open, no moment shows."""
    exposed.render.use_motion_blur = blur
    mesh = cube("splash")
    mesh.attributes.new("velocity", "FLOAT_VECTOR", "POINT").data.foreach_set("vector", np.full(24, speed, np.float32))
    add("splash", mesh)
    extraction = extract_frame(exposed)
    assert any(line == VELOCITY for line in extraction.warnings) == stays
    names = [extraction.keys.names[n] for n in extraction.keys.records["object"]]
    found = extraction.scene.stays
    assert ([] if found is None else [name for name, stay in zip(names, found, strict=True) if stay]) == (
        ["splash"] if stays else []
    )
