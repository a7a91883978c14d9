"""docs/pictures/panel.png: the panel's rows as Blender lays them out: `python -m lipac.scripts.dev.panel_picture`.

Blender as a module has no window to take a picture of, but it lays a panel out, and tells of it: which buttons, texts
and values, in which rows. These are drawn here, without Blender's icons and in plain colours.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

WIDTH, LINE, GAP, PAD = 340, 25, 4, 12  # of a panel, of its rows, and between them, in pixels
SCALE = 2  # pixels of the picture to one of these
LABEL, MENU, NUMBER, SPACE = 21, 5, 8, 45  # Blender's types of buttons
GROUND, HEAD, BUTTON, ON, FIELD, TEXT = "#303030", "#3d3d3d", "#545454", "#4772b3", "#1d1d1d", "#e6e6e6"
# What to draw, and how: place in pixels, kind, text
Item = tuple[float, float, float, float, str, str]


def main(argv: Sequence[str] | None = None) -> int:
    """Analyse the demo city, and draw the panel of it; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/pictures/panel.png"))
    parser.add_argument("--instances", type=int, default=6000)
    parser.add_argument("--layouts", action="store_true", help=argparse.SUPPRESS)  # print them: what a child does
    args = parser.parse_args(argv)
    if args.layouts:
        print(json.dumps(layouts(args.instances)))
        return 0
    # Blender complains of icons on stdout where there is no window: of another process only the last line is read
    command = [sys.executable, "-m", "lipac.scripts.dev.panel_picture", "--layouts", "--instances", str(args.instances)]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    columns = [Column(), Column()]
    for title, shown in json.loads(next(line for line in done.stdout.splitlines() if line.startswith("[["))):
        min(columns, key=lambda column: column.height if title != "LiPaC" else 0.0).add(title, shown)
    draw(columns, args.output)
    return 0


def layouts(instances: int) -> list[tuple[str, list[Any]]]:
    """Title and layout of each panel that is open by default, of the demo city after an analysis."""
    import bpy

    from ... import register
    from ...lipac_addon.demo import mirror_city
    from ...lipac_addon.ui import panel
    from ...lipac_addon.ui.memory_panel import LIPAC_PT_memory

    register()
    mirror_city.build(instances, 0)
    bpy.context.view_layer.objects.active = bpy.data.objects["City"]
    bpy.ops.lipac.analyze()
    out = []
    shown: tuple[Any, ...] = (*panel._CLASSES[:-1], LIPAC_PT_memory)
    for cls in shown:
        popup = bpy.context.window_manager.popmenu_begin__internal("panel", icon="NONE")
        cls.draw(SimpleNamespace(layout=popup.layout), bpy.context)
        items = popup.layout.introspect()[0]["items"][2:]  # less the title that a popup has
        out.append((cls.bl_label, [_with_values(item) for item in items]))
    return out


def _with_values(item: dict[str, Any]) -> dict[str, Any]:
    """A part of a layout, with whether its switches are on."""
    import bpy

    if "items" in item:
        return item | {"items": [_with_values(one) for one in item["items"]]}
    known = re.fullmatch(r"LipacSettings\.(\w+)\[\d+\]", item.get("rna", ""))
    value = getattr(bpy.context.scene.lipac, known[1]) if known else None
    return item | {"on": value} if isinstance(value, bool) else item


@dataclass
class Column:
    """Panels below one another; items are what to draw."""

    def __post_init__(self) -> None:
        self.items: list[Item] = []
        self.height = 0.0

    def add(self, title: str, items: list[dict[str, Any]]) -> None:
        """One panel more."""
        top = self.height
        place = len(self.items)
        self.items.append((0, top, WIDTH, LINE + 4, "head", f"\u2304  {title}"))
        y = top + LINE + 4 + GAP
        for item in items:
            y = self._lay(item, PAD, y, WIDTH - 2 * PAD)
        self.items.insert(place, (0, top, WIDTH, y + GAP - top, "ground", ""))
        self.height = y + 3 * GAP

    def _lay(self, item: dict[str, Any], x: float, y: float, width: float) -> float:
        """Lay out a part; returns where the next one begins."""
        parts = item.get("items")
        if parts is None:
            return self._button(item, x, y, width)
        if not parts:
            return y
        if item["type"] in ("LAYOUT_COLUMN", "LAYOUT_ROOT", "LAYOUT_BOX"):
            for part in parts:
                y = self._lay(part, x, y, width)
            return y
        if item["type"] == "LAYOUT_GRID_FLOW":
            for k in range(0, len(parts), 2):
                y = self._beside(parts[k : k + 2], x, y, width, 0.5)
            return y
        return self._beside(parts, x, y, width, 0.4 if item["type"] == "LAYOUT_SPLIT" and len(parts) == 2 else 0.0)

    def _beside(self, parts: list[dict[str, Any]], x: float, y: float, width: float, first: float) -> float:
        shares = [first, 1 - first] if first else [1 / len(parts)] * len(parts)
        ends = []
        for part, share in zip(parts, shares, strict=False):
            ends.append(self._lay(part, x, y, share * width - 2))
            x += share * width
        return max(ends)

    def _button(self, item: dict[str, Any], x: float, y: float, width: float) -> float:
        kind, text, on = item["type"], item["draw_string"], item.get("on")
        if kind == SPACE:
            return y + 2 * GAP
        if on is not None and not text:
            self.items.append((x, y, LINE - 5, LINE - 5, "on" if on else "field", "\u2713" if on else ""))
        else:
            names = {LABEL: "label", MENU: "field", NUMBER: "button"}
            self.items.append((x, y, width, LINE - 2, "on" if on else names.get(kind, "button"), text))
        return y + LINE


def draw(columns: Sequence[Column], path: Path) -> None:
    """Write the picture."""
    from matplotlib import font_manager
    from PIL import Image, ImageDraw, ImageFont

    size = (len(columns) * (WIDTH + 2 * PAD), int(max(column.height for column in columns)) + 2 * PAD)
    picture = Image.new("RGB", (SCALE * size[0], SCALE * size[1]), "#181818")
    pen = ImageDraw.Draw(picture)
    font = ImageFont.truetype(font_manager.findfont("DejaVu Sans"), int(SCALE * 11.5))
    fills = {"ground": GROUND, "head": HEAD, "button": BUTTON, "field": FIELD, "on": ON}
    for k, column in enumerate(columns):
        left = PAD + k * (WIDTH + 2 * PAD)
        for x, y, width, height, kind, text in column.items:
            box = [SCALE * v for v in (left + x, PAD + y, left + x + width, PAD + y + height)]
            if kind in fills:
                pen.rounded_rectangle(box, radius=SCALE * (0 if kind == "ground" else 4), fill=fills[kind])
            room = box[2] - box[0] - SCALE * 6
            fits = next(n for n in range(len(text), -1, -1) if pen.textlength(text[:n], font) <= room)
            said = text if fits == len(text) else text[: fits - 1] + "\u2026"
            centred = kind in ("button", "on")
            at = (box[0] + box[2]) / 2 if centred else box[0] + SCALE * (6 if kind != "label" else 2)
            pen.text((at, (box[1] + box[3]) / 2), said, fill=TEXT, font=font, anchor="mm" if centred else "lm")
    picture.quantize(64).save(path, optimize=True)


if __name__ == "__main__":
    sys.exit(main())
