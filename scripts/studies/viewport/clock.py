"""Live mode by a clock of its own, so that what it does in a second does not depend on the machine."""

from __future__ import annotations

import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

RATE = 24.0  # frames a second
ROUNDS = 1  # of live mode in a frame
STARTED = 20  # seconds of the clock for the cold start


def look() -> None:
    """Have the viewport show Rendered shading, through the camera."""
    import bpy

    area = next(a for a in bpy.context.window_manager.windows[0].screen.areas if a.type == "VIEW_3D")
    area.spaces.active.shading.type, area.spaces.active.region_3d.view_perspective = "RENDERED", "CAMERA"


class Clock:
    """The clock that live culling goes by, and how often it changed something."""

    def __enter__(self) -> Clock:
        from ....lipac_addon.ui.jobs import viewport_culling, viewport_switches

        self.now, self.changes = 0.0, 0
        self._modules = viewport_culling, viewport_switches
        self._change = viewport_switches.Switches.change
        for module in self._modules:
            module.time = SimpleNamespace(monotonic=lambda: self.now)  # type: ignore[attr-defined]
        viewport_switches.Switches.change = self._counted()  # type: ignore[method-assign]
        return self

    def _counted(self) -> Callable[..., None]:
        def change(*args: Any) -> None:
            self.changes += 1
            self._change(*args)

        return change

    def go(self, seconds: float) -> None:
        """Time passes."""
        self.now += seconds

    def __exit__(self, *_: object) -> None:
        for module in self._modules:
            module.time = time  # type: ignore[attr-defined]
        self._modules[1].Switches.change = self._change  # type: ignore[method-assign]


def settle(clock: Clock) -> None:
    """Let live mode come to rest, and the viewport be culled."""
    from ....lipac_addon.ui.jobs import live

    for _ in range(int(STARTED * RATE)):
        rounds(ROUNDS)
        clock.go(1 / RATE)
        while live.current is not None and live.current.culling.is_deciding:
            live.tick()
            time.sleep(0.001)
        if live.current is not None and live.current.resting and live.current.culling.switches.out:
            return


def rounds(count: int) -> None:
    """Tick until so many rounds are done, or there is nothing to do; and once more, for what follows from them."""
    from ....lipac_addon.ui.jobs import live

    live.tick()
    current = live.current
    assert current is not None
    goal = current.rounds + count
    while current.rounds < goal and not current.resting:
        live.tick()
        time.sleep(0.001)
        if current.error:
            raise SystemExit(f"live mode: {current.error}")
    live.tick()
