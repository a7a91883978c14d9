"""`--memory`: what it does not go with, a target that is too small, and one that is not."""

import json

import pytest

from lipac.core.files.memory_table import read_rows
from lipac.scripts.lipac import main

from .test_commands import SMALL, blend, command  # noqa: F401

MOST = 4_000_000_000


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--engine", "eevee"], "renders by --engine cycles"),
        (["--as-scene"], "renders by --engine cycles"),
        (["--cull", "none"], "leave --cull"),
        (["--min-share", "0.1"], "leave --cull"),
        (["--warm"], "leave --cull"),
        (["--blas-budget", "1G"], "leave --cull"),
        (["--bake", "shot"], "decide by themselves"),
        (["--verify"], "decide by themselves"),
    ],
)
def test_what_it_does_not_go_with(options, words, tmp_path, capsys):
    path = tmp_path / "scene.blend"
    path.touch()
    assert main(["render", str(path), "-o", str(tmp_path / "out"), "--memory", "1G", *options]) == 2
    assert words in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_too_little_is_refused_before_the_render(blend, tmp_path):  # noqa: F811
    done = command("render", blend, "-o", tmp_path, "--device", "cpu", "--memory", "50M", "--quiet", *SMALL)
    assert done.returncode == 2
    line = done.stderr.strip().splitlines()[-1]
    assert line.startswith("lipac render: a memory limit of 50 MB is too little: the render takes at least ")
    assert not list(tmp_path.glob("*.png"))


@pytest.mark.slow
def test_a_render_within_its_target(blend, tmp_path):  # noqa: F811
    done = command("render", blend, "-o", tmp_path, "--device", "cpu", "--memory", "4G", "--quiet", *SMALL)
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "report.json").read_text())
    frame, peak = report["frames"][0], report["totals"]["peak_bytes"]
    assert frame["memory_limit_bytes"] == MOST
    assert peak <= frame["memory_bytes"] + frame["memory_error_bytes"] <= MOST
    assert frame["certified_mean"] <= 0.01
    assert frame["analysis_peak_bytes"] > 0
    kept = {row.name: row.kept for row in read_rows(tmp_path) if row.kind == "object"}
    assert kept["box0"] == 1
    assert kept["box5"] == 0
