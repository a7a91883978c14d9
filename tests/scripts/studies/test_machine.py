"""Pages say by themselves which code and which machine their figures are of."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from lipac.scripts.studies import break_even, machine
from lipac.version import __version__

from ...docs.pages import ROOT

STUDIES = {  # of a page, the module that writes it
    "accuracy": "scripts/dev/accuracy.py",
    "animation": "scripts/studies/animation/report.py",
    "benchmarks": "scripts/bench.py",
    "error": "scripts/studies/error_pictures.py",
    "family": "scripts/studies/family.py",
    "fuzz": "scripts/dev/fuzz.py",
    "farm": "scripts/studies/farm/page.py",
    "live": "scripts/studies/bench_live.py",
    "memory": "scripts/studies/memory/within.py",
    "results": "scripts/evaluate.py",
    "viewport": "scripts/studies/viewport/flight.py",
}


@pytest.mark.parametrize("page", STUDIES)
def test_pages_of_figures_say_what_they_are_of(page: str) -> None:
    """A version and a commit stand there, and what the page's study writes has them by itself."""
    text = (ROOT / "docs" / f"{page}.md").read_text()
    assert re.search(r"LiPaC \d+\.\d+\.\d+,\s(?:about\s)?commits?\s[0-9a-f]{7}", text), page
    source = (ROOT / STUDIES[page]).read_text()
    assert re.search(r"\b(?:stamp|made_by|measured_by)\(", source) or page == "animation", page


def test_a_stamp_names_command_code_and_machine() -> None:
    text = machine.stamp("lipac bench")
    assert text.startswith(f"`lipac bench`: LiPaC {__version__}, ") and "Blender " in text and " cores" in text


@pytest.mark.skipif(shutil.which("git") is None, reason="there is no git")
def test_code_is_known_by_its_commit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A change of code since is said, one of a page is not; code of no checkout says so."""
    monkeypatch.setattr(machine, "ROOT", tmp_path)
    assert machine.code() == f"LiPaC {__version__}, of no checkout"

    def git(*arguments: str) -> None:
        name = ["-c", "user.name=n", "-c", "user.email=e"]
        subprocess.run(["git", "-C", str(tmp_path), *name, *arguments], check=True, capture_output=True)

    git("init", "-q")
    for file in ("code.py", "page.md"):
        (tmp_path / file).write_text("1\n")
    git("add", ".")
    git("commit", "-qm", "first")
    assert re.fullmatch(rf"LiPaC {re.escape(__version__)}, commit [0-9a-f]{{7}}", machine.code())
    (tmp_path / "page.md").write_text("2\n")
    assert "changes" not in machine.code()
    (tmp_path / "code.py").write_text("2\n")
    assert machine.code().endswith(" and changes to it")


def test_old_figures_say_that_their_code_is_not_known() -> None:
    assert machine.measured_by({}) == "Measured by code that did not note its version."
    assert machine.measured_by({"made_by": "X"}) == "Measured by X."


def test_rows_of_the_break_even_table() -> None:
    full, culled = (
        {"command": s, "processor": 2 * s, "bytes": 1e9, "active": a} for s, a in ((4.0, 9), (5.0, 2))
    )
    head, row = break_even.rows_of({(20_000, 4): {"full": full, "culled": culled}})
    assert len(head) == len(row)
    assert row[2:7] == ("4.0 s", "5.0 s", "0.80: **costs more**", "8.0, 10.0", "0.80: **costs more**")
