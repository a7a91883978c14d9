"""Errors that a user can act on."""

from __future__ import annotations

from collections.abc import Sequence


class InputError(Exception):
    """Unusable input: the message is one line that says what is wrong and what to do. Commands print it and exit with
    status 2."""


class NothingToAnalyse(InputError):
    """No visible object has faces. shown: a line for each thing that a renderer may show all the same; none: there is
    nothing to render."""

    def __init__(self, shown: Sequence[str] = ()) -> None:
        self.shown = tuple(shown)
        what = (
            f"nothing that light paths can be traced in: {'; '.join(self.shown[:3])}"
            if self.shown
            else "nothing to render"
        )
        super().__init__(f"{what}: no visible object of the scene has faces")


class Cancelled(Exception):
    """The user asked to stop; what was finished stays valid."""
