"""report.html: what it says is what the files say, and all of it is in the one file."""

from __future__ import annotations

import base64
import io
import itertools
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from lipac.core.errors import InputError
from lipac.core.feedback.tiles import COLUMNS, ROWS, TILES
from lipac.core.files.memory_table import MemoryRow, write_rows
from lipac.page import html
from lipac.page.pictures import WIDEST, of_crops, tiles
from lipac.page.report_page import write
from lipac.page.verdict import BAD, FAIR, GOOD, verdict

from .folder import CULLED, FULL, SIZE, Page, frame, picture, rendered, report, verified

UNITS = {"%": 1e-2, "B": 1, "kB": 1e3, "MB": 1e6, "GB": 1e9, "s": 1, "": 1}


def page_of(folder: Path, full: Path | None = None) -> tuple[str, Page]:
    text = write(folder, full).read_text(encoding="utf-8")
    return text, Page.of(text)


def number_in(text: str) -> float:
    """The number that a text stands for, with its unit: 1,234; 0.61 %; 2:15; 1.08 GB."""
    if ":" in text:
        total = 0.0
        for part in text.split(":"):
            total = 60 * total + float(part)
        return total
    value, _, unit = text.partition(" ")
    return float(value.replace(",", "")) * UNITS[unit]


def looked_up(data: Any, path: str) -> Any:
    for name in path.split("/"):
        data = data[int(name)] if isinstance(data, list) else data[name]
    return data


def taker(kind: str, name: str, own: int, full: int, worth: float | None = 0.2, why: str = "met") -> MemoryRow:
    return MemoryRow(kind, name, own, full, own, 0, 0, 9, 4, worth, 1, 2, 3, 4, 5, 1, why)


def rich(tmp_path: Path) -> tuple[Path, Path]:
    """A shot of three frames, the second verified; and the same with nothing culled."""
    folder = tmp_path / "out"
    found = verified(folder, [[0, 0], [3, 2]], number=2)
    rendered(folder, frame(1), frame(2, certified_mean=0.0077, **found), frame(3, active=290))
    write_rows(folder, [taker("object", "tree", 30_000_000, 30_000_000), taker("object", "tower", 0, 70_000_000)])
    nothing = {"active": 4000, "culled": 0, "trace_s": 0.0, "render_s": 21.5, "device_bytes": 195_000_000}
    full = [{k: v for k, v in frame(n, **nothing).items() if not k.startswith(("certif", "conf"))} for n in (1, 3)]
    return folder, rendered(tmp_path / "full", *full, policy="none")


def test_every_figure_is_that_of_the_report(tmp_path: Path) -> None:
    folder, full = rich(tmp_path)
    _, page = page_of(folder, full)
    data = json.loads((folder / "report.json").read_text()) | {"full": json.loads((full / "report.json").read_text())}
    figures = page.all("data")
    assert len(figures) > 50
    for figure in figures:
        value = looked_up(data, figure.attributes["data-of"])
        assert float(figure.attributes["value"]) == value
        assert number_in(figure.text) == pytest.approx(value, rel=0.05, abs=0.05 if figure.text.endswith(" s") else 0)
    shown = {figure.attributes["data-of"] for figure in figures}
    assert {
        "totals/wall_s",
        "full/totals/render_s",
        "totals/peak_bytes",
        "full/frames/0/device_bytes",
        "frames/1/certified_mean",
    } <= shown
    assert {f"frames/{k}/{name}" for k in range(3) for name in ("active", "trace_s", "certified_worst")} <= shown


def test_nothing_is_loaded_from_elsewhere(tmp_path: Path) -> None:
    folder, full = rich(tmp_path)
    text, page = page_of(folder, full)
    for element in page.elements:
        for name in ("src", "href", "action", "data", "poster", "srcset", "xlink:href"):
            value = element.attributes.get(name)
            assert value is None or value.startswith(("data:", "#")), (element.tag, value)
    assert not re.search(r"@import|url\((?!#)", text)
    assert set(re.findall(r"https?://[^\s\"']+", text)) <= {
        "http://www.w3.org/2000/svg",
        "http://www.w3.org/1999/xlink",
    }
    policy = next(e.attributes["content"] for e in page.all("meta") if "Security" in e.attributes.get("http-equiv", ""))
    assert policy.startswith("default-src 'none'") and "http" not in policy


def test_it_can_be_read_without_eyes(tmp_path: Path) -> None:
    """Pictures and drawings say what they show, headings follow each other, the slider has a name, identifiers are
    unique."""
    folder, full = rich(tmp_path)
    _, page = page_of(folder, full)
    assert len(page.all("img")) >= 4
    assert all(len(image.attributes["alt"]) > 10 for image in page.all("img"))
    for drawing in page.all("svg", "tiles"):
        assert drawing.attributes["role"] == "img" and "%" in drawing.attributes["aria-label"]
    levels = [int(e.tag[1]) for e in page.elements if re.fullmatch(r"h\d", e.tag)]
    assert levels[0] == 1 and levels.count(1) == 1
    assert all(b <= a + 1 for a, b in itertools.pairwise(levels))
    assert page.all("html")[0].attributes["lang"] == "en"
    slider = page.all("input")[0]
    assert slider.attributes["type"] == "range" and slider.attributes["aria-label"]
    ids = [e.attributes["id"] for e in page.elements if "id" in e.attributes]
    assert len(ids) == len(set(ids))
    assert all(th.attributes.get("scope") or th.attributes.get("aria-hidden") for th in page.all("th"))


def test_the_same_files_give_the_same_page(tmp_path: Path) -> None:
    folder, full = rich(tmp_path)
    assert page_of(folder, full)[0] == page_of(folder, full)[0]


def embedded(page: Page, words: str) -> np.ndarray:
    """The picture whose description begins so, (H, W, 3)."""
    uri = next(e.attributes["src"] for e in page.all("img") if e.attributes["alt"].startswith(words))
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(uri.split(",")[1]))).convert("RGB"))


def test_before_and_after_are_the_two_renders(tmp_path: Path) -> None:
    folder, full = rendered(tmp_path / "out", frame()), tmp_path / "full"
    rendered(full, frame(culled=0), policy="none")
    picture(full / "frame_0001.png", FULL)
    text, page = page_of(folder, full)
    for words, path in (("The picture with everything", full), ("The same picture culled", folder)):
        np.testing.assert_array_equal(embedded(page, words), np.asarray(Image.open(path / "frame_0001.png")))
    assert embedded(page, "FLIP map").max() > 50
    assert "Left of the line" in text and not page.all("rect", "part")


def test_verified_parts_are_before_and_after(tmp_path: Path) -> None:
    """Crops are counted from the lower left corner. What was not rendered in full is the same on both sides."""
    folder = tmp_path / "out"
    rendered(folder, frame(**verified(folder, [[0, 0], [3, 2]])))
    _, page = page_of(folder)
    before, after = (
        embedded(page, words).astype(int) for words in ("The picture with everything", "The same picture culled")
    )
    differs = (np.abs(before - after).sum(axis=2) > 100).astype(int)
    width, height = SIZE
    assert differs[2 * height // 3 :, : width // 4].all() and differs[: height // 3, 3 * width // 4 :].all()
    assert differs.sum() == 2 * (width // 4) * (height // 3)
    assert [r.attributes["x"] for r in page.all("rect", "part")] == ["0.0", "75.0"]


def test_without_a_full_picture_the_page_says_how_to_get_one(tmp_path: Path) -> None:
    text, page = page_of(rendered(tmp_path, frame()))
    assert not page.all("input")
    np.testing.assert_array_equal(
        embedded(page, "The picture as it was rendered"), np.asarray(Image.open(tmp_path / "frame_0001.png"))
    )
    assert "--verify" in text and "--full" in text


def test_a_full_render_is_not_called_culled(tmp_path: Path) -> None:
    nothing = {k: v for k, v in frame(active=4000, culled=0).items() if not k.startswith(("certif", "conf", "unknown"))}
    text, page = page_of(rendered(tmp_path, nothing, policy="none"))
    assert page.all("h1")[0].text.strip() == "Nothing was left out"
    assert "culled" not in page.all("figcaption")[0].text and "--verify" not in text
    assert "culled" not in [e.text for e in page.all("th")]


def test_where_the_pictures_are_elsewhere_the_page_says_so(tmp_path: Path) -> None:
    report(frame()).write(tmp_path)
    assert "--as-scene" in page_of(tmp_path)[0]


def test_wide_pictures_are_made_smaller_and_that_is_said(tmp_path: Path) -> None:
    rendered(tmp_path, frame())
    Image.new("RGB", (2 * WIDEST, 400), FULL).save(tmp_path / "frame_0001.png")
    rendered(tmp_path / "full", frame(), policy="none")
    Image.new("RGB", (2 * WIDEST, 400), CULLED).save(tmp_path / "full" / "frame_0001.png")
    text, page = page_of(tmp_path, tmp_path / "full")
    assert embedded(page, "The same picture culled").shape == (200, WIDEST, 3)
    assert f"Shown at {WIDEST} of {2 * WIDEST} pixels" in text


def test_tiles_lie_where_they_are_in_the_picture() -> None:
    """Rows are counted from below, as in Blender."""
    changes = np.full((ROWS, COLUMNS), np.nan, np.float32)
    changes[0, 0], changes[ROWS - 1, 3] = 0.06, 0.001
    found = {(t.column, t.row): (t.change, t.step) for t in tiles(changes, 0.05)}
    assert found == {(0, ROWS - 1): (pytest.approx(0.06), 5), (3, 0): (pytest.approx(0.001), 0)}
    assert tiles(None, 0.05) == []


def test_crops_are_put_where_they_belong() -> None:
    out = of_crops([[0, 0], [3, 2]], [list(range(12)), [0.5] * 12], (4, 3))
    assert np.isfinite(out).sum() == 24
    np.testing.assert_array_equal(out[:3, :4], np.arange(12).reshape(3, 4))
    assert (out[6:, 12:] == 0.5).all()


def test_a_tile_above_its_bound_is_marked(tmp_path: Path) -> None:
    changes = np.full((1, 12), 0.004)
    changes[0, 5] = 0.08
    _, page = page_of(rendered(tmp_path, frame(**verified(tmp_path, [[1, 1]], changes))))
    marked = [r for r in page.all("rect", "s5") if "x" in r.attributes]
    assert [(r.attributes["x"], r.attributes["y"]) for r in marked] == [("125", "100")]
    assert len(page.all("svg", "tiles")) == 2


def test_what_nobody_met_is_counted(tmp_path: Path) -> None:
    text, _ = page_of(rendered(tmp_path, frame()))
    assert "12 instances stay although no light path met them" in text


def test_what_files_say_is_text_and_nothing_else(tmp_path: Path) -> None:
    folder = rendered(tmp_path, frame(), scene="/tmp/<script>alert(1)</script>.blend")
    data = json.loads((folder / "report.json").read_text())
    data["approximated"], data["warnings"] = ['material "<b>": & more'], ["</ul><script>x</script>"]
    (folder / "report.json").write_text(json.dumps(data))
    _, page = page_of(folder)
    assert len(page.all("script")) == 1
    assert {e.text for e in page.all("li")} >= {'material "<b>": & more', "</ul><script>x</script>"}


def test_memory_is_listed_by_who_takes_most(tmp_path: Path) -> None:
    folder = rendered(tmp_path, frame())
    tower = taker("object", "tower", 0, 70_000_000, None, "worth less than <others>")
    leaves = [taker("mesh", f"leaf {k}", 10 * k, 10 * k) for k in range(40)]
    bark = taker("image", "bark", 4_000_000, 8_000_000)
    write_rows(folder, [taker("object", "tree", 30_000_000, 30_000_000), tower, bark, *leaves])
    text, page = page_of(folder)
    heads = [e.text for e in page.all("th")]
    assert heads.index("tower") < heads.index("tree") < heads.index("bark (image)") < heads.index("leaf 39")
    assert "leaf 1" not in heads and "largest of 41" in text
    assert {"70 MB", "20 %", "worth less than <others>", "4 of 9"} <= {e.text for e in page.all("td")}
    assert "Objects: 30 MB, with everything 100 MB" in [e.text for e in page.all("h3")]
    (folder / "memory.csv").write_text("not,a\ntable")
    assert "What takes the memory" not in page_of(folder)[0]


@pytest.mark.parametrize("lost", ["frame_0001.png", "states/frame_0001.npz"])
def test_damaged_files_are_left_out(tmp_path: Path, lost: str) -> None:
    rendered(tmp_path, frame())
    (tmp_path / lost).write_bytes(b"PNG, but not really")
    text, _ = page_of(tmp_path)
    assert "317" in text


BARE = {"frame": 3}  # what a report fills in is all that is sure


@pytest.mark.parametrize("frames", [(), (frame(),), (frame(1), frame(2)), (BARE,), (BARE, frame(4)), (frame(2), BARE)])
@pytest.mark.parametrize("policy", ["light-paths", "distance", "none"])
def test_any_report_has_a_page(tmp_path: Path, frames: tuple[dict[str, Any], ...], policy: str) -> None:
    if policy != "light-paths":
        frames = tuple(
            {k: v for k, v in one.items() if not k.startswith(("certif", "unknown", "conf"))} for one in frames
        )
    report(*frames, policy=policy).write(tmp_path)
    _, page = page_of(tmp_path)
    assert len(page.all("h1")) == 1


def test_a_folder_without_a_report_is_bad_input(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no report\.json"):
        write(tmp_path)
    with pytest.raises(InputError, match="full"):
        write(rendered(tmp_path, frame()), tmp_path / "full")


@pytest.mark.parametrize(
    "change",
    [
        {"verified_crops": "x", "verified_tiles": [1]},
        {"verified_crops": [[0, 0]], "verified_tiles": [[1, 2]], "verified_grid": [4, 3]},
        {"certified_mean": "much"},
        {"render_s": "long"},
    ],
)
def test_figures_that_nobody_writes_are_bad_input(tmp_path: Path, change: dict[str, Any]) -> None:
    rendered(tmp_path, frame())
    data = json.loads((tmp_path / "report.json").read_text())
    data["frames"][0] |= change
    (tmp_path / "report.json").write_text(json.dumps(data))
    with pytest.raises(InputError, match=r"no report\.json|does not write"):
        write(tmp_path)


def test_totals_of_an_earlier_version_are_enough(tmp_path: Path) -> None:
    rendered(tmp_path, frame())
    data = json.loads((tmp_path / "report.json").read_text())
    data["totals"] = {"peak_bytes": 0}
    (tmp_path / "report.json").write_text(json.dumps(data))
    _, page = page_of(tmp_path, tmp_path)
    assert not [e for e in page.all("data") if e.attributes["data-of"] == "totals/wall_s"]


def test_a_page_of_the_users_is_kept_beside(tmp_path: Path) -> None:
    rendered(tmp_path, frame())
    (tmp_path / "report.html").write_text("<p>my own</p>")
    page_of(tmp_path)
    page_of(tmp_path)
    assert (tmp_path / "report_earlier_1.html").read_text() == "<p>my own</p>"
    assert not (tmp_path / "report_earlier_2.html").exists()


@pytest.mark.parametrize(
    ("figures", "options", "policy", "standing", "says"),
    [
        ({}, {}, "light-paths", GOOD, "Not checked by rendering"),
        ({"verified_mean": 0.004, "verified_worst": 0.02}, {}, "light-paths", GOOD, "less than was allowed"),
        ({"verified_mean": 0.02, "verified_worst": 0.02}, {}, "light-paths", GOOD, "noise alone may account"),
        (
            {"verified_mean": 0.02, "verified_worst": 0.02, "verified_least_mean": 0.015},
            {},
            "light-paths",
            BAD,
            "frame 1",
        ),
        ({"certified_worst": 0.08}, {}, "light-paths", BAD, "could not show"),
        (
            {"certified_worst": 0.08, "verified_mean": 0.0, "verified_worst": 0.0},
            {},
            "light-paths",
            FAIR,
            "could not show",
        ),
        ({}, {"max_error": None}, "light-paths", FAIR, ""),
        ({"culled": 0}, {}, "none", FAIR, "Everything is in the picture"),
        ({"culled": 0, "not_analysed": "nothing can be won"}, {}, "light-paths", FAIR, "Nothing can be won."),
        ({"needed": 3}, {}, "light-paths", GOOD, "set of the shot"),
    ],
)
def test_the_verdict(figures: dict[str, Any], options: dict[str, Any], policy: str, standing: str, says: str) -> None:
    found = verdict(report(frame(**figures), policy=policy, **options).as_dict())
    assert found.standing == standing
    assert says in " ".join(found.sentences)


def test_rules_certify_nothing() -> None:
    one = {k: v for k, v in frame().items() if not k.startswith("certif")}
    for made in (report(one, policy="distance"), report(one, min_share=0.001)):
        found = verdict(made.as_dict())
        assert (found.standing, found.certified) == (FAIR, False)
        assert "nothing is certified" in found.sentences[0]


def test_a_measured_frame_speaks_for_itself() -> None:
    one = report(frame()).as_dict()
    assert "less than was allowed" in verdict(one, (0.001, 0.01)).sentences[0]
    assert "may be noise" in verdict(one, (0.02, 0.01)).sentences[0]


def test_tiles_number_as_many_as_they_are(tmp_path: Path) -> None:
    _, page = page_of(rendered(tmp_path, frame()))
    assert len(page.all("rect", "tile")) == TILES + 6  # and those of the legend


def test_missing_libraries_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    assert html.missing() == []
    monkeypatch.setattr(html, "LIBRARIES", ("jinja2", "no_such_library"))
    assert html.missing() == ["no_such_library"]
