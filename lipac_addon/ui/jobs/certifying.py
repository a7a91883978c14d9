"""A baked shot's set, judged in every frame by paths that chose nothing of it."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Protocol

import numpy as np

from ..state import results

if TYPE_CHECKING:
    from ....core.arrays import I64
    from ....core.culling.options import CullOptions
    from ....core.culling.shot import How
    from ...extract import Extraction

    Asked = Callable[[Extraction, I64], How]

FIGURES = ("certified_mean", "certified_worst", "confidence", "unknown_mean", "unknown_worst")
JUDGEMENTS = 3  # at most, each of a larger set


class Analyse(Protocol):
    """Extracts a frame, by its number and its place among those that are done, and does with it what is asked."""

    def __call__(
        self, number: int, k: int, how: Asked | None = None, doing: str = ""
    ) -> Generator[None, None, results.FrameResult]: ...


def certify(
    found: dict[int, results.FrameResult],
    frames: Sequence[int],
    options: CullOptions,
    analyse: Analyse,
) -> Generator[None, None, None]:
    """Judge what any of the frames keeps in each of them, and add to what was found. Where it does not hold, a frame is
    analysed again by half of the budget, then all that it shows stays; in the end its warnings say so.

    Does nothing where there is no error budget, or something else limits what is built.
    """
    from ....core.culling.union import decide_closer
    from ...batch.shots.uniting import by_budget_alone

    if not by_budget_alone(options):
        return
    for turn in range(JUDGEMENTS):
        failing = yield from _judged(found, frames, turn, analyse)
        if not failing:
            return
        if turn == JUDGEMENTS - 1:
            break
        for k, number in enumerate(failing):
            if not turn:
                found[number] = yield from analyse(number, k, lambda *_: decide_closer)
            else:
                all_stays = np.full_like(found[number].state, results.ACTIVE)
                found[number] = replace(found[number], state=all_stays, faces={}, levels={})
    few = ", ".join(map(str, failing[:5])) + (f" and {len(failing) - 5} more" if len(failing) > 5 else "")
    line = f"What is baked is not certified in frames {few}: Render Difference tells what is missing there"
    found |= {number: replace(found[number], warnings=(line, *found[number].warnings)) for number in failing}


def _judged(
    found: dict[int, results.FrameResult], frames: Sequence[int], turn: int, analyse: Analyse
) -> Generator[None, None, list[int]]:
    """Put into what was found what paths say of the set in each frame; returns those in which it does not hold. turn:
    how many sets they have judged before."""
    from ...batch.shots.uniting import judgement

    together, held = results.shot_set(found.values()), dict[int, list[bool]]()
    for k, number in enumerate(frames):

        def judging(extraction: Extraction, uids: I64, number: int = number) -> How:
            keys = results.tagged(extraction.keys, uids)
            return judgement(together, extraction.scene, keys, turn, held.setdefault(number, []), own=True)

        judged = yield from analyse(number, k, judging, "judging the shot's set")
        figures = {name: judged.stats[name] for name in FIGURES}
        found[number] = replace(found[number], stats=found[number].stats | figures, tiles=judged.tiles)
    return [number for number in frames if not all(held[number])]
