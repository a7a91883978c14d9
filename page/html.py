"""Templates to HTML, and figures as people read them, each with the value that it stands for."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..core.files.figures import percent, size
from ..core.progress import clock

if TYPE_CHECKING:
    from jinja2 import Environment
    from markupsafe import Markup

TEMPLATES = Path(__file__).parent / "templates"
LIBRARIES = ("jinja2", "matplotlib", "PIL")


def missing() -> list[str]:
    """Libraries that pages are made with and that this Python lacks, as Blender's own does."""
    return [name for name in LIBRARIES if find_spec(name) is None]


def times(ratio: float) -> str:
    """How many times as much."""
    return f"{ratio:.3g} times" if ratio < 1000 else f"{ratio:,.0f} times"


def count(number: float) -> str:
    """A whole number."""
    return f"{number:,.0f}"


KINDS: dict[str, Callable[[float], str]] = {"percent": percent, "size": size, "clock": clock, "count": count}


class Figures:
    """Numbers of JSON data as HTML: `<data value=... data-of=PATH>text</data>`, so that each can be traced to where it
    stands."""

    def __init__(self, data: Mapping[str, Any]) -> None:
        self.data = data

    def value(self, path: str) -> Any:
        """What stands at a path such as `frames/0/active`; None where nothing does."""
        found: Any = self.data
        for name in path.split("/"):
            if isinstance(found, list):
                found = found[int(name)] if int(name) < len(found) else None
            else:
                found = found.get(name) if isinstance(found, Mapping) else None
        return found

    def __call__(self, path: str, kind: str) -> Markup:
        """The number at a path as text of a kind, one of KINDS; a dash where there is none."""
        from markupsafe import Markup

        value = self.value(path)
        if value is None:
            return Markup('<span title="not known">\N{EN DASH}</span>')
        return Markup('<data value="{}" data-of="{}">{}</data>').format(repr(value), path, KINDS[kind](value))

    def largest(self, name: str) -> str:
        """The path of a frame's figure that is the largest of all frames; of the first frame where none has it."""
        found = [(frame[name], -k) for k, frame in enumerate(self.data["frames"]) if frame.get(name) is not None]
        return f"frames/{-max(found)[1] if found else 0}/{name}"


@cache
def environment() -> Environment:
    """Jinja's, with our templates and filters; what is not a template's own markup is escaped."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    loader = FileSystemLoader(TEMPLATES)
    made = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    made.filters |= {**KINDS, "times": times}
    return made


def render(template: str, **values: object) -> str:
    """A template of our folder as text. Raises what Jinja raises where a value is missing."""
    return environment().get_template(template).render(**values) + "\n"
