"""What follows from the options of commands: of each engine, from its row of ENGINES."""

from __future__ import annotations

import argparse
from pathlib import Path

import pytest

from lipac.core.errors import InputError
from lipac.lipac_addon.batch.engines.choices import BLENDER_ENGINES, ENGINES, DeviceChoice, Engine
from lipac.scripts.command.options import check, check_device, cull_options, scene_parser


def parsed(folder: Path, engine: str, *options: str) -> argparse.Namespace:
    """Arguments of a command that renders an empty file by an engine."""
    (folder / "scene.blend").touch()
    args = scene_parser("render", "").parse_args([str(folder / "scene.blend"), "-o", str(folder / "out"), *options])
    args.engine = engine
    return args


@pytest.mark.parametrize(
    ("text", "frames"),
    [("7", (7,)), ("-2", (-2,)), ("1-3", (1, 2, 3)), ("-2-1", (-2, -1, 0, 1)), ("-3--2", (-3, -2))],
)
def test_frames(tmp_path, text, frames):
    assert parsed(tmp_path, "cycles", f"--frames={text}").frames == frames


@pytest.fixture
def added(monkeypatch: pytest.MonkeyPatch) -> str:
    """An engine that has nothing but its row."""
    row = Engine("mine", "one more", hardware="mine is on an abacus", shows_culled=True)
    monkeypatch.setitem(ENGINES, row.name, row)
    return row.name


def test_an_added_engine_is_known_by_its_row(added: str, tmp_path: Path) -> None:
    args = parsed(tmp_path, added)
    check(args)
    options = cull_options(args)
    assert options.max_error.worst == options.max_error.mean  # for what is culled is shown all the same
    assert not options.parts
    with pytest.raises(InputError, match=r"^--verify is for --bake frame, and for the engines cycles, eevee and path$"):
        check(parsed(tmp_path, added, "--verify"))
    args.device = DeviceChoice("cpu")
    with pytest.raises(InputError, match="mine is on an abacus"):
        check_device(args)


@pytest.mark.parametrize("engine", ENGINES.values(), ids=list(ENGINES))
def test_each_engine_is_treated_as_its_row_says(engine: Engine, tmp_path: Path) -> None:
    options = cull_options(parsed(tmp_path, engine.name))
    assert options.max_error.worst == options.max_error.mean * (1 if engine.shows_culled else 5)
    assert options.parts == (engine.name in BLENDER_ENGINES)
    args = parsed(tmp_path, engine.name)
    args.device = DeviceChoice("cpu")
    if engine.name == "cycles":
        check_device(args)
        return
    assert engine.hardware
    with pytest.raises(InputError, match=engine.hardware):
        check_device(args)


@pytest.mark.parametrize(
    "options",
    [
        ("--min-share", "0.001"),
        ("--cull", "frustum"),
        ("--blas-budget", "1G"),
        ("--warm",),
    ],
)
def test_levels_are_of_frames_with_a_budget(options: tuple[str, ...], tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"^--levels"):
        check(parsed(tmp_path, "cycles", "--levels", *options))


@pytest.mark.parametrize("engine", ENGINES)
def test_levels_are_of_blenders_engines(engine: str, tmp_path: Path) -> None:
    args = parsed(tmp_path, engine, "--levels")
    if engine in BLENDER_ENGINES:
        check(args)
        assert cull_options(args).levels and not cull_options(parsed(tmp_path, engine)).levels
        return
    with pytest.raises(InputError, match=r"^--levels is of Blender's engines"):
        check(args)


@pytest.mark.parametrize(
    ("options", "open_"),
    [
        ("", True),
        ("--frames 1-9 --resolution 9x9 --seed 3 --threads 1 --resume --quiet", True),
        ("--cull light-paths", False),
        ("--max-error 0.01", False),
        ("--min-share 0.1", False),
        ("--paths 2", False),
        ("--distance 3", False),
        ("--bake shot", False),
        ("--warm", False),
        ("--no-parts", False),
        ("--levels", False),
        ("--blas-budget 1G", False),
        ("--memory 8G", False),
        ("--verify", False),
    ],
)
def test_who_says_how_to_cull_is_analysed_in_any_case(options: str, open_: bool, tmp_path: Path) -> None:
    args = scene_parser("render", "").parse_args(["scene.blend", "-o", str(tmp_path), *options.split()])
    assert args.if_it_pays == open_
    assert args.cull == "light-paths"


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ("--distance 3", "--distance is of --cull distance"),
        ("--cull frustum --distance 3", "--distance is of --cull distance"),
        ("--cull distance --max-error 0.1", "keeps to no --max-error"),
        ("--min-share 0.1 --max-error 0.1", "takes the place of --max-error"),
        ("--cull frustum --min-share 0.1", "--min-share is of --cull light-paths"),
        ("--ahead --cull frustum", "--ahead is of --cull light-paths"),
        ("--ahead --bake shot --warm", "--ahead goes with --bake shot where frames judge one set"),
        ("--ahead --bake shot --min-share 0.1", "--ahead goes with --bake shot where frames judge one set"),
        ("--ahead --verify --enforce", "--ahead is of --cull light-paths"),
    ],
)
def test_what_would_do_nothing_is_refused(options: str, says: str, tmp_path: Path) -> None:
    own = argparse.Namespace(ahead="--ahead" in options)
    args = parsed(tmp_path, "cycles", *options.replace("--ahead", "").split())
    with pytest.raises(InputError, match=says):
        check(argparse.Namespace(**vars(args), **vars(own)))


def test_an_error_that_is_measured_may_be_bounded_for_any_policy(tmp_path: Path) -> None:
    check(parsed(tmp_path, "cycles", "--cull", "distance", "--distance", "3", "--max-error", "0.1", "--verify"))
    check(parsed(tmp_path, "cycles", "--cull", "none", "--max-error", "0.1"))  # keeps to any


@pytest.mark.parametrize("engine", [name for name in ENGINES if name not in BLENDER_ENGINES])
def test_ahead_is_of_engines_that_render_meanwhile(engine: str, tmp_path: Path) -> None:
    args = parsed(tmp_path, engine)
    args.ahead = True
    with pytest.raises(InputError, match="of Blender's engines"):
        check(args)
