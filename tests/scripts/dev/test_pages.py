"""Pages that are written from the code are up to date, and say what the code does."""

from __future__ import annotations

import argparse
import re
from pathlib import Path

import bpy
import numpy as np
import pytest
import yaml

import lipac
from lipac.core.files.report_schema import STATES
from lipac.lipac_addon.open import IMPORTERS
from lipac.scripts.dev.pages import reference_page, supported_page
from lipac.scripts.lipac import COMMANDS, ENVIRONMENT, STATUSES, main

ROOT = Path(lipac.__file__).parent
SOURCES = [path for folder in ("core", "page", "lipac_addon", "scripts") for path in (ROOT / folder).rglob("*.py")]


def test_the_reference_is_up_to_date() -> None:
    """`make docs` writes it."""
    assert reference_page.PAGE.read_text() == reference_page.page()
    assert reference_page.SCHEMA.read_text() == reference_page.schema()


def test_supported_features_are_up_to_date() -> None:
    """`make docs` writes the tables. Another Blender has other nodes."""
    if bpy.app.version[:2] != (5, 2):
        pytest.skip("the page is of Blender 5.2")
    text = supported_page.PAGE.read_text()
    assert supported_page.page(text) == text


def test_all_that_is_reported_as_approximated_is_on_the_page() -> None:
    assert not supported_page.reported() - set(supported_page.approximations())


def test_each_feature_names_a_test() -> None:
    """Rows of the table of features: the test exists; a row without one says so in the report."""
    rows = [line.split(" | ") for line in supported_page.PAGE.read_text().split("## Shader nodes")[0].splitlines()]
    named = [cell for row in rows for cell in re.findall(r"`([\w/]+\.py(?:::\w+)?)`", row[-1])]
    assert len(named) > 25
    for name in named:
        file, _, function = name.partition("::")
        path = ROOT / "tests" / "lipac_addon" / file
        assert path.is_file(), name
        assert not function or f"def {function}(" in path.read_text(), name


def test_environment_variables_are_all_listed() -> None:
    found = {name for path in SOURCES for name in re.findall(r"\"(LIPAC_[A-Z]+(?:_DIR)?)\"", path.read_text())}
    assert found - {"LIPAC_EXTRACT"} == set(ENVIRONMENT)  # that is the name of a render engine


def test_input_formats_are_all_listed() -> None:
    text = reference_page.INPUT
    assert {".blend", *IMPORTERS} <= set(re.findall(r"\.\w+", text))


@pytest.mark.parametrize("command", COMMANDS)
def test_each_command_is_there_with_its_options(command: str) -> None:
    text = reference_page.command_text(command)
    for action in reference_page.parser_of(command)._actions:
        shown = action.help != argparse.SUPPRESS  # what help leaves out, the page does
        for option in set(action.option_strings) - {"-h", "--help"}:
            assert (f"`{option}" in text) == shown
    assert main([command, "--no-such-option"]) == 2  # parsers parse again
    assert 2 in STATUSES


def test_states_hold_what_the_page_says(boxes_states: Path) -> None:
    with np.load(boxes_states) as data:
        arrays = {name: data[name] for name in data.files}
    assert set(arrays) <= set(STATES)
    sometimes = "face", "level", "coarser", "note", "certified"
    assert {name for name in STATES if not name.startswith(sometimes)} <= set(arrays)
    for name, array in arrays.items():
        kinds, shape, _ = STATES[name]
        assert array.dtype.kind in kinds, name
        assert len(shape) == array.ndim, name
        assert all(want == have for want, have in zip(shape, array.shape, strict=True) if isinstance(want, int)), name


@pytest.fixture
def boxes_states(tmp_path: Path) -> Path:
    """The states of a cube's frame."""
    bpy.ops.wm.read_factory_settings(use_empty=False)
    bpy.context.scene.render.resolution_x, bpy.context.scene.render.resolution_y = 32, 18
    path = tmp_path / "cube.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    assert main(["analyze", str(path), "-o", str(tmp_path / "out"), "--quiet"]) == 0
    return tmp_path / "out" / "states" / "frame_0001.npz"


def test_the_citation_is_of_this_version() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == lipac.__version__
    assert {"cff-version", "message", "title", "authors", "license"} <= set(citation)
    assert citation["references"][0]["doi"] in (ROOT / "docs" / "method.md").read_text()


def test_names_of_the_glossary_are_in_the_code() -> None:
    code = "\n".join(path.read_text() for path in SOURCES)
    rows = [line for line in (ROOT / "docs" / "glossary.md").read_text().splitlines() if line.startswith("| ")][1:]
    words = [row.split(" | ")[0].strip("| ").lower() for row in rows]
    assert words == sorted(words)
    for row in rows:
        for name in re.findall(r"`([\w.]+)`", row.rsplit(" | ", 1)[-1]):
            assert re.search(rf"\b{name.rsplit('.', 1)[-1]}\b", code), f"{name}: {row}"
