"""docs/reference.md and docs/schemas, from the commands' parsers and the tables of `core.files.report_schema`."""

from __future__ import annotations

import argparse
import importlib
import inspect
import json
import re
import sys
import textwrap
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

from lipac.core.files import report_schema
from lipac.core.files.memory_table import COLUMNS, MemoryRow
from lipac.scripts.lipac import COMMANDS, ENVIRONMENT, STATUSES

DOCS = Path(__file__).resolve().parents[3] / "docs"
PAGE = DOCS / "reference.md"
SCHEMA = DOCS / "schemas" / "report.schema.json"
HEAD = """# Reference

<!-- written by scripts/dev/pages/reference_page.py -->

The command line, its exit statuses and environment, and what it reads and writes. From Python: [api.md](api.md).
"""
INPUT = """## Input

`SCENE` is a .blend, or a .glb, .gltf, .usd, .usda, .usdc, .usdz, .obj, .ply or .stl, which is imported into an empty
scene. Inside Blender's own program the open file is meant. The file is never written to. Colours are linear Rec. 709,
lengths are in metres."""
OUTPUT = """## Output

| file in `DIR` | what it is |
|---|---|
| `frame_0001.png` | the picture as displayed |
| `frame_0001.exr` | the picture, linear, 32-bit floats |
| `frame_0001_layers.exr` | `--engine hybrid`: its layers ([hybrid.md](hybrid.md)) |
| `states/frame_0001.npz` | what was decided for each instance: [below](#statesframe_0001npz) |
| `analysis/frame_0001*.npz` | `--bake shot`: what it brought into the set, and a check of that, in the same form |
| `report.json` | figures of each frame: [below](#reportjson) |
| `report.html` | the same as a page, with pictures: [user guide](user-guide.md#the-page-that-a-command-leaves) |
| `memory.csv` | what each object, mesh and image takes of a render by Cycles, what it is worth, and why it stays |
| `verified/` | `--verify`: the parts that were compared |
| `report_earlier_1.json` | a report that was there before, made by other options |

Files take their names once they are whole; several processes can write into one folder."""
REPORT = """## report.json

As JSON Schema: [report.schema.json](schemas/report.schema.json), against which tests hold the reports that they make.
Shares are shares of 1; bytes are bytes; a field that a run has nothing to say of is missing."""
STATES = """## states/frame_0001.npz

An uncompressed NumPy archive. N: instances; K: names; H: boxes; integers have the smallest type that holds them.
`lipac.core.files.report.load_states` reads it; the key of an instance finds it again in Blender
(`lipac_addon/keys.py`)."""


class _Found(Exception):
    def __init__(self, parser: argparse.ArgumentParser) -> None:
        self.parser = parser


@contextmanager
def _parsers_only() -> Iterator[None]:
    """Have commands raise their parser where they would parse."""

    def found(self: argparse.ArgumentParser, *_: Any, **__: Any) -> NoReturn:
        raise _Found(self)

    parse = argparse.ArgumentParser.parse_args
    argparse.ArgumentParser.parse_args = found  # type: ignore[method-assign,assignment]
    try:
        yield
    finally:
        argparse.ArgumentParser.parse_args = parse  # type: ignore[method-assign]


def parser_of(command: str) -> argparse.ArgumentParser:
    """What a command of `lipac` parses its arguments by."""
    with _parsers_only():
        try:
            importlib.import_module(f"lipac.scripts.{COMMANDS[command][0]}").main([])
        except _Found as found:
            return found.parser
    raise ValueError(f"{command} parses nothing")


def page() -> str:
    """The page as Markdown."""
    parts = [
        HEAD,
        "## Command line\n\n`lipac --version` prints the version; `--help` after a command, its options.",
        *map(command_text, COMMANDS),
        _statuses(),
        _environment(),
        "## The panel",
        *panel(),
        INPUT,
        OUTPUT,
        _report(),
        _memory(),
    ]
    parts += [STATES + "\n\n" + _table(("array", "type", "shape", "meaning"), _arrays())]
    return "\n\n".join(part.strip("\n") for part in parts) + "\n"


def command_text(name: str) -> str:
    """Of a command: what it does, and its options by group."""
    parser = parser_of(name)
    places = [a for a in parser._actions if not a.option_strings]
    usage = " ".join(["lipac", name, *(f"[{_shown(a)}]" if a.nargs == "?" else _shown(a) for a in places), "[options]"])
    parts = [f"### lipac {name}", f"```text\n{usage}\n```", parser.description or ""]
    for group in parser._action_groups:
        listed = (a for a in group._group_actions if a.help != argparse.SUPPRESS)
        actions = [a for a in listed if not isinstance(a, argparse._HelpAction)]
        if actions:
            plain = group.title in ("positional arguments", "options")
            title = "" if plain else f"**{(group.title or '').capitalize()}**\n\n"
            parts.append(
                title
                + _table(
                    ("argument" if group.title == "positional arguments" else "option", "meaning"), map(_row, actions)
                )
            )
    if parser.epilog:
        parts.append(textwrap.fill(_prose(parser.epilog), 120, break_on_hyphens=False))
    return "\n\n".join(parts)


def _shown(action: argparse.Action) -> str:
    return str(action.metavar or action.dest.upper())


def _row(action: argparse.Action) -> tuple[str, str]:
    choices = f"{{{','.join(map(str, action.choices))}}}" if action.choices else ""
    value = "" if action.nargs == 0 else str(action.metavar or choices or action.dest.upper())
    value = f"[{value}]" if action.nargs == "?" and action.option_strings else value
    names = ", ".join(f"`{f'{option} {value}'.strip()}`" for option in action.option_strings) or f"`{value}`"
    known = {name: value for name, value in vars(action).items() if name in ("default", "dest")}
    known["choices"] = ", ".join(map(str, action.choices)) if action.choices else ""
    text = (action.help or "") % known
    need = " (required)" if action.required and action.option_strings else ""
    return names, (_prose(text) + need).strip()


def _prose(text: str) -> str:
    """Text in a cell: no column ends, options as code."""
    text = re.sub(r"\s+", " ", text).strip().replace("|", "\\|").replace("<", "&lt;")
    return re.sub(r"(?<![\w`-])(--[a-z][a-z-]*)", r"`\1`", text)


def _statuses() -> str:
    return "## Exit statuses\n\n" + _table(
        ("status", "meaning"), ((f"{status}", text) for status, text in STATUSES.items())
    )


def _environment() -> str:
    rows = ((f"`{name}`", text) for name, text in ENVIRONMENT.items())
    return "## Environment variables\n\n" + _table(("variable", "meaning"), rows)


def _report() -> str:
    r = report_schema
    parts = [
        REPORT,
        _table(("field", "type", "meaning"), _fields(r.TOP)),
        "### Entries of `frames`",
        _table(("field", "type", "meaning"), _fields(r.FRAME)),
    ]
    parts += ["### `totals`", _table(("field", "type", "meaning"), _fields(r.TOTALS))]
    return "\n\n".join(parts)


def _memory() -> str:
    """The columns of memory.csv, as the class that is a row of it says."""
    text = inspect.cleandoc(MemoryRow.__doc__ or "")
    columns = ", ".join(f"`{name}`" for name in COLUMNS)
    return f"## memory.csv\n\n{text}\n\n" + textwrap.fill(f"Columns: {columns}.", 120)


def panel() -> list[str]:
    """What the panel shows, by the add-on's own properties and operators: buttons, settings of a scene, preferences."""
    from lipac.lipac_addon.ui import operators, submit
    from lipac.lipac_addon.ui.state import preferences, props

    classes = [c for module in (operators, submit) for c in vars(module).values() if hasattr(c, "bl_label")]
    buttons = [
        (c.bl_label, inspect.cleandoc(c.__doc__ or "").split("\n\n")[0].replace("\n", " "))
        for c in classes
        if c.__module__.startswith("lipac") and c.__module__.endswith(("operators", "submit"))
    ]
    settings = _properties(props.LipacSettings, vars(props))
    own = _properties(preferences.LipacPreferences, vars(preferences))
    text = "Live mode, overlay and the rest are explained in the [user guide](user-guide.md)."
    return [
        text,
        "### Buttons\n\n" + _table(("button", "meaning"), buttons),
        "### Settings of a scene\n\n" + _table(("setting", "default", "meaning"), settings),
        "### Preferences\n\n" + _table(("preference", "default", "meaning"), own),
    ]


def _properties(owner: type, names: dict[str, Any]) -> list[tuple[str, str, str]]:
    """Label, default and description of Blender's properties of a class, less those that are hidden."""
    rows = []
    for annotation in owner.__annotations__.values():
        found = eval(annotation, names) if isinstance(annotation, str) else annotation
        given = getattr(found, "keywords", {})
        if "name" not in given or "HIDDEN" in given.get("options", ()):
            continue
        default = given.get("default", "off" if found.function.__name__ == "BoolProperty" else "")
        if isinstance(default, bool):
            default = "on" if default else "off"
        text = f"{default:g}" if isinstance(default, float) else str(default)
        rows.append((given["name"], text + " %" * (given.get("subtype") == "PERCENTAGE"), given["description"]))
    return rows


def _fields(table: dict[str, tuple[dict[str, Any], str]]) -> Iterator[tuple[str, str, str]]:
    for name, (kind, text) in table.items():
        found = kind.get("type", "")
        yield f"`{name}`", " or ".join(found) if isinstance(found, list) else found or json.dumps(kind["const"]), text


def _arrays() -> Iterator[tuple[str, str, str, str]]:
    kinds = {"u": "unsigned integer", "i": "integer", "f": "float", "U": "text"}
    for name, (kind, shape, text) in report_schema.STATES.items():
        yield f"`{name}`", kinds[kind[0]], f"({', '.join(map(str, shape))})", text


def _table(head: tuple[str, ...], rows: Any) -> str:
    lines = [head, tuple("---" for _ in head), *rows]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)


def schema() -> str:
    """The JSON Schema of report.json."""
    return json.dumps(report_schema.schema(), indent=1) + "\n"


def main() -> int:
    """Write page and schema."""
    SCHEMA.parent.mkdir(exist_ok=True)
    SCHEMA.write_text(schema())
    PAGE.write_text(page())
    return 0


if __name__ == "__main__":
    sys.exit(main())
