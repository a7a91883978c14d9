"""Options that commands share, and what follows from them."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NoReturn

from ...core.culling.options import DEFAULT_BUDGET, CullOptions
from ...core.culling.policies import LIGHT_PATHS, POLICIES, RULES
from ...core.error_budget.budget import SPREAD, Budget
from ...core.errors import InputError
from ...lipac_addon.batch.engines.choices import BLENDER_ENGINES, ENGINES
from .arguments import byte_count, crop_count, frame_range, number, path_count, resolution, seed_number, thread_count

_SETTINGS = tuple(policy.setting.name for policy in RULES.values() if policy.setting is not None and policy.listed)
# options that tell how to cull, and what for
HOW = (
    "cull",
    "max_error",
    "min_share",
    "paths",
    "memory",
    "bake",
    "shot",
    "warm",
    "no_parts",
    "levels",
    "no_mitigation",
    "blas_budget",
    "verify",
    "enforce",
    "ahead",
    *_SETTINGS,
)


class Parser(argparse.ArgumentParser):
    """Errors are one line, through `InputError`."""

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message}; {self.prog} --help tells the options")


class _SceneParser(Parser):
    """Adds `if_it_pays`, whether the command line says nothing of how to cull, and what `cull` is then."""

    def parse_args(self, args: Sequence[str] | None = None, namespace: Any = None) -> argparse.Namespace:  # type: ignore[override]
        found = super().parse_args(args, namespace)
        found.if_it_pays = all(getattr(found, name, None) == self.get_default(name) for name in HOW)
        found.cull = found.cull or LIGHT_PATHS
        return found


def scene_parser(command: str, description: str) -> Parser:
    """A parser with the options of `analyze`, of which `render` has more. What it reads is settled."""
    parser = _SceneParser(prog=f"lipac {command}", description=description)
    parser.set_defaults(command=command)
    parser.add_argument(
        "scene",
        nargs="?",
        type=Path,
        metavar="SCENE",
        help=".blend, .glb, .gltf, .usd*, .obj, .ply or .stl; inside Blender: the open file",
    )
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="DIR", help="folder for pictures, states and report.json"
    )
    parser.add_argument(
        "--frames",
        type=frame_range,
        metavar="A-B",
        help="frames to do; --frames=-5-3 from a negative one (default: the scene's current one)",
    )
    parser.add_argument(
        "--resolution", type=resolution, metavar="WxH", help="size of the picture (default: the scene's)"
    )
    parser.add_argument(
        "--camera", metavar="NAME", help="camera to use; 'auto' frames the whole scene (default: the scene's)"
    )
    culling = parser.add_argument_group("culling")
    listed = [name for name, policy in POLICIES.items() if policy.listed]
    decides = f"what decides which instances stay (default: {LIGHT_PATHS}"
    if command == "render":
        decides += "; only where it can save anything, unless an option of this group, of a shot, or --verify is given"
    culling.add_argument("--cull", choices=listed, help=f"{decides})")
    error = (
        "light-paths: the error budget: how much the 16 x 9 tiles of the picture may change, in the mean (E) and in "
        "the worst tile (T), for example 0.5%% or 0.005 (default: 1%%; T: five times E)"
    )
    culling.add_argument("--max-error", metavar="E[,T]", help=error)
    culling.add_argument(
        "--min-share",
        type=number,
        metavar="S",
        help="light-paths: instead of an error budget: keep what at least this share of the paths meets",
    )
    culling.add_argument(
        "--paths",
        type=path_count,
        metavar="N",
        help="light-paths: paths per pixel of the analysis (default: as many as the error budget needs)",
    )
    for policy in [policy for policy in RULES.values() if policy.listed]:
        own = policy.setting
        assert own is not None
        culling.add_argument(
            own.option,
            type=number,
            metavar=own.unit,
            help=f"{policy.name}: {own.description[0].lower()}{own.description[1:]}",
        )
    shot = parser.add_argument_group("frames of a shot")
    shot.add_argument(
        "--bake",
        choices=("frame", "shot"),
        default="frame",
        help="frame: what each frame needs; shot: one set for all frames, certified in each of them",
    )
    part = "with --bake shot: the frames that the set is for, where --frames is a part of them (to split a shot)"
    shot.add_argument("--shot", type=frame_range, metavar="A-B", help=part)
    shot.add_argument(
        "--resume", action="store_true", help="skip the frames that DIR has already, made by the same options"
    )
    shot.add_argument(
        "--warm",
        action="store_true",
        help="begin each frame with what the one before it needed, and cull what that kept only if it is clearly worth "
        "less (hysteresis)",
    )
    culling.add_argument(
        "--no-parts",
        action="store_true",
        help="light-paths: keep or cull meshes as a whole (default: large ones are culled by parts)",
    )
    culling.add_argument(
        "--levels",
        action="store_true",
        help="light-paths: of what stays, simplify meshes, and render fewer levels of subdivision and fewer points of "
        "curves, as far as --max-error allows",
    )
    shot.add_argument(
        "--no-mitigation",
        action="store_true",
        help="with --warm: what comes into view waits until light paths ask for it",
    )
    shot.add_argument(
        "--blas-budget",
        type=byte_count,
        metavar="SIZE",
        help="the most memory for the acceleration structures that the analysis builds, for example 2G",
    )
    memory = (
        "light-paths: the most memory of the process that renders (Cycles on the CPU), for example 8G; if --max-error "
        "does not save enough, more is culled, what changes the picture least per byte first; the change is reported"
    )
    culling.add_argument("--memory", type=byte_count, metavar="SIZE", help=memory)
    culling.add_argument("--process", type=byte_count, help=argparse.SUPPRESS)  # takes so much before it renders
    general = parser.add_argument_group("general")
    crops = (
        "measure the error with the render engine: N of 12 parts of the picture, picked at random, are rendered in "
        "full and culled (default: 2)"
    )
    general.add_argument("--verify", type=crop_count, nargs="?", const=2, default=0, metavar="N", help=crops)
    again = (
        "with --verify: while it finds more change than --max-error allows, analyse again with a tighter budget; in "
        "the end everything stays"
    )
    general.add_argument("--enforce", action="store_true", help=again)
    general.add_argument(
        "--seed",
        type=seed_number,
        default=0,
        metavar="S",
        help="of all random numbers: the same seed decides the same (default: 0)",
    )
    threads = "of the analysis and of the render (Blender evaluates scenes with its own); 0: all cores (default)"
    general.add_argument("--threads", type=thread_count, default=0, metavar="N", help=threads)
    general.add_argument("--quiet", action="store_true", help="no progress")
    return parser


def cull_options(args: argparse.Namespace) -> CullOptions:
    """The culling options of a command line; what it does not say has the defaults of `core`.

    Where a picture shows what is culled all the same, no tile of it need change by more than the mean may.
    """
    spread = 1.0 if _shows_culled(args) else SPREAD
    given = {name: getattr(args, name) for name in ("min_share", "paths")}
    own = POLICIES[args.cull].setting
    given["setting"] = None if own is None else getattr(args, own.name)
    given["max_error"] = Budget.parse(f"{DEFAULT_BUDGET.mean}" if args.max_error is None else args.max_error, spread)
    given["blas_budget_bytes"], given["memory"] = args.blas_budget, args.memory
    said = {name: value for name, value in given.items() if value is not None}
    return CullOptions(
        policy=args.cull,
        seed=args.seed,
        threads=args.threads,
        mitigation=not args.no_mitigation,
        parts=_by_parts(args),
        levels=args.levels,
        **said,
    )


def _by_parts(args: argparse.Namespace) -> bool:
    """Whether large meshes are culled by parts: where Blender renders them, and no frame begins with the last one's."""
    engine = getattr(args, "engine", "")
    ours = bool(engine) and engine not in BLENDER_ENGINES
    return not (args.no_parts or args.warm or ours or (not engine and args.verify))


def _shows_culled(args: argparse.Namespace) -> bool:
    """Whether the command renders by an engine whose pictures show what is culled all the same."""
    engine = getattr(args, "engine", "")
    return bool(engine) and ENGINES[engine].shows_culled


def check(args: argparse.Namespace) -> None:
    """Raise InputError for what can be told before Blender starts: no scene, bad numbers, an output folder that cannot
    be written."""
    from ...core.files.report import output_folder

    if args.scene is None and "bpy" not in sys.modules:
        raise InputError("SCENE is missing: name a .blend or another scene file")
    if args.no_mitigation and not args.warm:
        raise InputError(
            "--no-mitigation has a meaning with --warm alone: frames that decide by themselves have nothing that "
            "comes into view"
        )
    if args.shot is not None and (args.bake != "shot" or args.warm):
        raise InputError(
            "--shot is for --bake shot without --warm: other frames decide by themselves, or by all before them"
        )
    if args.shot is not None and not (args.frames and set(args.frames) <= set(args.shot)):
        raise InputError("--shot goes with --frames that are a part of it")
    if args.verify and (args.bake == "shot" or _shows_culled(args)):
        *some, last = (engine.name for engine in ENGINES.values() if not engine.shows_culled)
        raise InputError(f"--verify is for --bake frame, and for the engines {', '.join(some)} and {last}")
    if args.enforce and not args.verify:
        raise InputError("--enforce acts on what --verify measures: give both")
    if args.enforce and (args.cull != "light-paths" or args.min_share is not None or args.warm):
        raise InputError(
            "--enforce keeps to --max-error: it goes with --cull light-paths, without --min-share and --warm"
        )
    check_memory(args)
    check_levels(args)
    check_device(args)
    check_ahead(args)
    check_policy(args)
    if args.verify and args.cull == "none":
        raise InputError("--verify measures what culling changes: with --cull none nothing does")
    if args.scene is not None and not args.scene.exists():
        raise InputError(f"no such file: {args.scene}")
    cull_options(args)
    output_folder(args.output)


def check_policy(args: argparse.Namespace) -> None:
    """Raise InputError where an option is of another policy than that of the command line: it would do nothing, and
    say nothing."""
    for policy in RULES.values():
        own = policy.setting
        if own is not None and policy.listed and policy.name != args.cull and getattr(args, own.name) is not None:
            raise InputError(f"{own.option} is of --cull {policy.name}: give it with that, or leave it out")
    if args.max_error is not None and args.min_share is not None:
        raise InputError("--min-share takes the place of --max-error: give one of them")
    if args.min_share is not None and args.cull != LIGHT_PATHS:
        raise InputError(f"--min-share is of --cull {LIGHT_PATHS}: with --cull {args.cull} leave it out")
    if args.max_error is not None and args.cull not in {LIGHT_PATHS, "none"} and not args.verify:
        raise InputError(
            f"--cull {args.cull} keeps to no --max-error: leave one of them out, or have the error measured by --verify"
        )


def check_ahead(args: argparse.Namespace) -> None:
    """Raise InputError where frames are to be analysed ahead, and cannot be."""
    if getattr(args, "ahead", None) is not True:
        return
    if args.engine not in BLENDER_ENGINES:
        raise InputError("--ahead is of Blender's engines, which render meanwhile: --engine cycles or eevee")
    if args.cull != LIGHT_PATHS or args.enforce:
        raise InputError(f"--ahead is of --cull {LIGHT_PATHS}: leave --enforce out")
    if args.bake == "shot" and not renders_meanwhile(args):
        raise InputError(
            "--ahead goes with --bake shot where frames judge one set, of this command alone: leave --warm, --shot, "
            "--min-share and --blas-budget out"
        )
    if args.scene is None:
        raise InputError("--ahead has another process look at the scene: name its file as SCENE")


def renders_meanwhile(args: argparse.Namespace) -> bool:
    """Whether frames of a shot can be rendered before its set is certain: frames judge it, and all of them are this
    command's."""
    return not (args.warm or args.shot or args.min_share is not None or args.blas_budget)


def check_memory(args: argparse.Namespace) -> None:
    """Raise InputError where memory is limited together with what decides otherwise, or takes more."""
    if args.memory is None:
        return
    if args.scene is None:
        raise InputError("--memory has another process look at the scene: name its file as SCENE")
    if getattr(args, "engine", "cycles") not in ("", "cycles") or getattr(args, "as_scene", False):
        raise InputError("--memory is of renders by --engine cycles")
    if args.cull != LIGHT_PATHS or args.min_share is not None or args.blas_budget or args.warm:
        raise InputError("--memory goes on from --max-error: leave --cull, --min-share, --blas-budget and --warm out")
    if args.bake == "shot" or args.verify:
        raise InputError("--memory is for frames that decide by themselves: leave --bake shot and --verify out")


def check_levels(args: argparse.Namespace) -> None:
    """Raise InputError where meshes are to be exchanged for simplified ones, and cannot be."""
    if not args.levels:
        return
    engine = getattr(args, "engine", "")
    if args.cull != LIGHT_PATHS or args.min_share is not None or args.blas_budget or args.warm:
        raise InputError(
            "--levels keeps to --max-error: it goes with --cull light-paths, without --min-share, --blas-budget and "
            "--warm"
        )
    if (engine and engine not in BLENDER_ENGINES) or (not engine and args.verify):
        raise InputError("--levels is of Blender's engines: --engine cycles or eevee, and of them --verify")
    if find_spec("opengl_decimate") is None:
        raise InputError("--levels needs the package opengl_decimate, which is missing: pip install opengl_decimate")


def check_device(args: argparse.Namespace) -> None:
    """Raise InputError where a device is chosen for an engine that has no choice, or a texture cache for one that has
    none."""
    if getattr(args, "device", None) is not None and args.engine != "cycles":
        raise InputError(f"--device chooses where Cycles renders; {ENGINES[args.engine].hardware}")
    if getattr(args, "texture_cache", None) is not None and args.engine != "cycles":
        raise InputError(f"--texture-cache is of Cycles; {ENGINES[args.engine].hardware}")
