"""Code blocks of README and docs run as they are written; commands in running text are commands."""

from __future__ import annotations

import argparse
import re
import shlex
from pathlib import Path
from typing import Any

import bpy
import pytest

from lipac.scripts.dev.pages.reference_page import parser_of
from lipac.scripts.lipac import COMMANDS, main

from .pages import PAGES, ROOT, Block, blocks, prose

BLOCKS = [block for page in PAGES for block in blocks(page)]
RUN = [block for block in BLOCKS if block.language in ("sh", "python") and block.mark != "elsewhere"]
pytestmark = pytest.mark.slow
OURS = ("lipac", ".venv/bin/lipac")
TEXT = ("text", "mermaid", "math")  # what nothing runs


def test_each_block_has_a_language_and_runs_somewhere() -> None:
    for block in BLOCKS:
        assert block.language in ("sh", "python", *TEXT), block.name
        assert not block.mark or len(block.reason) > 15, block.name
        if block.mark == "elsewhere":
            assert (ROOT / block.reason.split(":")[0]).is_file(), block.name
    assert len(RUN) > 8


def test_no_block_is_indented() -> None:
    """They would be code without a language, and no test would see them."""
    for page in PAGES:
        assert not re.search(r"(?:^|\n)\n {4}[a-z]+ ", prose(page)), page.name


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What commands of the pages name: scene.blend and shot.blend, a small scene of a few frames."""
    from ..lipac_addon.conftest import ground_and_boxes

    path = tmp_path_factory.mktemp("pages")
    ground_and_boxes()
    bpy.context.scene.render.filepath = str(path / "rendered")
    for name in ("scene", "shot"):
        bpy.ops.wm.save_as_mainfile(filepath=str(path / f"{name}.blend"))
    return path


@pytest.mark.parametrize("block", RUN, ids=lambda block: block.name)
def test_it_runs(
    block: Block, folder: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder)
    if block.language == "python":
        bpy.ops.wm.open_mainfile(filepath=str(folder / "scene.blend"))
        names: dict[str, Any] = {"__name__": "page"}
        exec(compile(block.text, block.name, "exec"), names)
        return
    for line in block.text.splitlines():
        words = shlex.split(line, comments=True)
        if words[:1] == ["blender"]:
            blender(words[1:])
            continue
        assert not words or words[0] in OURS, f"{block.name}: {line}"
        if words:
            assert main(words[1:]) == 0, f"{line}: {capfd.readouterr().err}"


def blender(words: list[str]) -> None:
    """What Blender's program does with these options, by the module. Raises AssertionError where a picture is
    missing."""
    parser = argparse.ArgumentParser()
    parser.add_argument("-b", dest="file", required=True)
    parser.add_argument("-o", dest="pictures", required=True)
    parser.add_argument("-s", dest="first", type=int, required=True)
    parser.add_argument("-e", dest="last", type=int, required=True)
    parser.add_argument("-a", action="store_true", required=True)
    wanted = parser.parse_args(words)
    bpy.ops.wm.open_mainfile(filepath=wanted.file)
    scene = bpy.context.scene
    scene.render.filepath, scene.frame_start, scene.frame_end = wanted.pictures, wanted.first, wanted.last
    bpy.ops.render.render(animation=True)
    for frame in range(wanted.first, wanted.last + 1):
        assert Path(scene.render.frame_path(frame=frame)).is_file(), frame


def commands() -> list[tuple[str, str]]:
    """Command lines of ours in running text, and in the blocks that other tests run, by page."""
    found = [(page.name, text) for page in PAGES for text in re.findall(r"`(lipac [^`\n]+)`", prose(page))]
    for block in BLOCKS:
        if block.language == "sh" and block not in RUN:
            lines = [shlex.split(line, comments=True) for line in block.text.splitlines()]
            found += [(block.name, shlex.join(["lipac", *words[1:]])) for words in lines if words and words[0] in OURS]
    return found


def test_commands_in_the_text_have_these_options() -> None:
    for page, text in commands():
        name, *words = text.split()[1:]
        if name.startswith("-") or "--cull height" in text:  # a policy that the page has the reader write
            continue
        assert name in COMMANDS, f"{page}: {text}"
        known = {option for action in parser_of(name)._actions for option in action.option_strings}
        said = {word.split("=")[0].rstrip(",.;:") for word in words if word.startswith("-")}
        assert said <= known | {"--"}, f"{page}: {text}: {said - known}"
