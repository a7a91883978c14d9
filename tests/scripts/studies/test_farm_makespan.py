"""The simulation of a shot against what can be worked out by hand."""

from __future__ import annotations

from dataclasses import replace

import pytest

from lipac.scripts.studies.farm.makespan import STEPS, Farm, Measured, chunk_of, in_full, scheduled, simulate

NOTHING = dict.fromkeys(STEPS, 0.0)
MEASURED = Measured(
    analyze=[3.0], judge=[1.0], render=[2.0], verify=[5.0], start=NOTHING,
    per_frame={"unite": 0.01, "look": 0.001, "certify": 0.0},
    bytes=dict.fromkeys(("scene", "culled", "analysis", "picture"), 0), ratio=4.0,
)  # fmt: skip
IDEAL = Farm(handing_out=0.0)


def test_one_machine_does_all_one_after_the_other() -> None:
    run = simulate(MEASURED, 100, 1, 4, IDEAL)
    assert run.steps == pytest.approx(
        {"analyze": 301.0, "unite": 0.2, "judge": 100.0, "render": 200.0, "verify": 20.0, "certify": 0.0}
    )
    assert run.total == pytest.approx(621.2)
    assert in_full(MEASURED, 100, 1, IDEAL) == pytest.approx(800.0)


def test_many_machines_leave_what_cannot_be_shared() -> None:
    """A frame each; the union grows with the frames, and, where machines unite chunks of them, with those."""
    run = simulate(MEASURED, 100, 1000, 4, IDEAL)
    assert run.steps == pytest.approx(
        {"analyze": 3.0, "unite": 1.1, "judge": 1.0, "render": 2.0, "verify": 5.0, "certify": 0.0}
    )
    assert simulate(MEASURED, 1000, 1000, 4, IDEAL).steps["unite"] == pytest.approx(11.0)
    assert simulate(MEASURED, 10_000, 1000, 4, IDEAL).steps["unite"] == pytest.approx(20.0)


def test_handing_out_and_starting_are_paid_by_each_task() -> None:
    slow = replace(MEASURED, start=NOTHING | {"analyze": 7.0})
    assert simulate(slow, 100, 1, 4, Farm(handing_out=2.0)).steps["analyze"] == pytest.approx(301.0 + 10 * (2.0 + 7.0))


def test_the_shared_folder_is_shared() -> None:
    """Ten tasks of a gigabyte at once take as long as the folder takes for ten; one takes what a machine's link
    does."""
    farm = Farm(handing_out=0.0, folder=2e9, link=1e9)
    assert scheduled([(0.0, 10**9)] * 10, 0.0, 10, farm) == pytest.approx(5.0)
    assert scheduled([(0.0, 10**9)], 0.0, 10, farm) == pytest.approx(1.0)


def test_tasks_go_to_the_machine_that_is_free_first() -> None:
    assert scheduled([(4.0, 0), (1.0, 0), (1.0, 0), (1.0, 0)], 0.0, 2, IDEAL) == pytest.approx(4.0)


@pytest.mark.parametrize(
    ("frames", "workers", "chunk"), [(250, 1, 10), (250, 100, 3), (250, 1000, 1), (10_000, 1000, 10), (5, 2, 3)]
)
def test_chunks(frames: int, workers: int, chunk: int) -> None:
    assert chunk_of(frames, workers) == chunk


def test_more_machines_never_take_longer_by_much() -> None:
    """Nor does the same seed give another plan."""
    uneven = replace(MEASURED, analyze=[1.0, 2.0, 9.0], render=[0.5, 4.0])
    totals = [simulate(uneven, 250, n, 10).total for n in (1, 2, 5, 10, 50, 250)]
    assert totals == sorted(totals, reverse=True)
    assert simulate(uneven, 250, 10, 10) == simulate(uneven, 250, 10, 10)
