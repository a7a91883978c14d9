"""Speed against error for every policy: which sets the policies keep over their settings, what those cost, and how
wrong the picture gets."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ..arrays import F32
from ..culling.analysis import analyze
from ..culling.options import CullOptions
from ..culling.policies import RULES, Policy
from ..error_budget.budget import Budget
from ..files.atomic import replacing
from ..progress import Progress, part, silent
from ..scene.model import Scene
from .judge import Judge, error_of
from .oracle import search

BUDGETS = (0.005, 0.01, 0.02, 0.05)
SHARES = (1e-6, 1e-5, 3e-5, 1e-4, 3e-4, 1e-3, 3e-3)
PATHS, EVERY = (1, 2, 4, 8, 16), (2, 4, 8, 16)  # of the ray budget's study
LADDER = 5  # settings of a heuristic before it is refined
REFINEMENTS = 2  # further settings for each budget
ORACLE_PATHS = 4  # times the judge's
OURS, ORACLE, COUNTS, RANDOM = "light-paths", "oracle", "light-paths counts", "random"
VERDICTS = {"holding": "holds", "surely_holding": "surely", "broken": "broken"}
Row = dict[str, Any]


@dataclass(frozen=True)
class Settings:
    """samples: of the judge, paths per pixel; options: of the analysis, whose policy and budget are set here; threads:
    0 for all."""

    samples: int = 16
    options: CullOptions = field(default_factory=CullOptions)
    threads: int = 0


class Store:
    """Finished pieces of an evaluation in a folder, so that it can go on where it was stopped.

    A piece counts only for the scene and the code it was made with."""

    def __init__(self, folder: Path, scene: Scene, samples: int) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.folder = folder
        digest = hashlib.sha256(str(samples).encode())
        for path in sorted(Path(__file__).parents[1].rglob("*.py")):
            digest.update(path.read_bytes())
        _add(digest, scene)
        self.digest = digest.hexdigest()

    def get(
        self, name: str, compute: Callable[[], tuple[dict[str, Any], dict[str, np.ndarray]]]
    ) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """Figures and arrays called name: from the folder, or computed and put there."""
        path = self.folder / (hashlib.sha256((self.digest + name).encode()).hexdigest()[:20] + ".npz")
        if path.exists():
            with np.load(path) as data:
                return json.loads(str(data["figures"])), {key: data[key] for key in data.files if key != "figures"}
        figures, arrays = compute()
        with replacing(path) as partial:
            content: dict[str, Any] = {"figures": json.dumps(figures, default=float), **arrays}
            np.savez_compressed(partial, **content)
        return figures, arrays


def _add(digest: Any, value: Any) -> None:
    """All that a value consists of: structs, arrays, and what a sequence of meshes reads."""
    if isinstance(value, np.ndarray):
        digest.update(f"{value.dtype} {value.shape}".encode())
        digest.update(np.ascontiguousarray(value).tobytes())
    elif is_dataclass(value):
        for member in fields(value):
            digest.update(member.name.encode())
            _add(digest, getattr(value, member.name))
    elif isinstance(value, Mapping):
        for key, item in value.items():
            digest.update(repr(key).encode())
            _add(digest, item)
    elif isinstance(value, Sequence) and not isinstance(value, str | bytes):
        digest.update(f"[{len(value)}".encode())
        for index in range(len(value)):
            _add(digest, value[index])
    else:
        digest.update(repr(value).encode())


class Evaluation:
    """Rows of one scene. scene: at the size the judge is to see. store: finished pieces."""

    def __init__(
        self,
        scene: Scene,
        settings: Settings,
        folder: Path,
        progress: Progress = silent,
        cancelled: Callable[[], bool] | None = None,
    ) -> None:
        scene = replace(scene, coarser=None)  # which makes itself anew each time, and is of no use here
        self.scene, self.settings, self.cancelled = scene, settings, cancelled
        self.store = Store(folder, scene, settings.samples)
        self.judge = Judge(scene, settings.samples, settings.threads, progress, cancelled)
        self.rows: list[Row] = []
        self.keeps: list[np.ndarray] = []
        self.pictures: list[F32] = []

    def measure(self, policy: str, setting: float, keep: np.ndarray, **figures: float) -> Row:
        """Judge a set, as one more row; equal sets are judged once."""
        keep = keep & self.judge.loop.activation.exists
        measured, arrays = self._judged(keep)
        row: Row = {"policy": policy, "setting": float(setting), "instances": len(keep), **measured, **figures}
        self.rows.append(row)
        self.keeps.append(keep)
        self.pictures.append(arrays["picture"].astype(np.float32))
        return row

    @cached_property
    def referee(self) -> Judge:
        """A judge of pictures as large as those that are analysed: of a budget, blocks are pixels of these."""
        width, height = self.settings.options.picture_size(self.scene.film)
        scene = replace(self.scene, film=replace(self.scene.film, width=width, height=height))
        return Judge(scene, self.settings.samples, self.settings.threads, cancelled=self.cancelled)

    def changed(self, keep: np.ndarray, budget: Budget) -> Row:
        """Error of a set, and whether it holds a budget, by the measure that the budget is of; nothing else of it,
        which is much cheaper."""

        def compute() -> tuple[dict[str, Any], dict[str, np.ndarray]]:
            verdict = self.referee.verdict(keep, budget)
            change = verdict.change
            row = error_of(change) | {"holds": change.holds(budget)}
            return row | {"surely": verdict.surely, "broken": verdict.broken, "judged_by": verdict.samples}, {}

        return self.store.get(f"change by {_name_of(keep)} for {budget}", compute)[0]

    def _judged(self, keep: np.ndarray) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        def compute() -> tuple[dict[str, Any], dict[str, np.ndarray]]:
            measured, picture = self.judge.measure(keep)
            return measured, {"picture": picture[..., :3].astype(np.float16)}

        return self.store.get("set " + _name_of(keep), compute)

    def run(self, progress: Progress = silent) -> None:
        """All rows: the full scene, heuristics, ours by counts and by budget, random sets of equal count, the
        oracle."""
        self.measure("none", 0.0, np.ones(len(self.scene.instances), bool))
        for k, policy in enumerate(RULES.values()):
            self.rule(policy, part(progress, 0.4 * k / len(RULES), 0.4 * (k + 1) / len(RULES), f"{policy.name}, "))
        self.counts(part(progress, 0.4, 0.48, "light-paths by counts, "))
        self.budgets(part(progress, 0.48, 0.6, "light-paths by budget, "))
        self.random(part(progress, 0.6, 0.65, "random, "))
        self.oracles(part(progress, 0.65, 1.0))

    def rule(self, policy: Policy, progress: Progress = silent) -> None:
        """Rows of a rule: a ladder of settings, then between the last that fails a budget and the first that holds
        it."""
        assert policy.setting is not None and policy.keep is not None
        settings = policy.setting.ladder(self.scene)
        sets = [policy.keep(self.scene, x) for x in settings]
        counts = np.array([s.sum() for s in sets])
        wanted = np.geomspace(max(counts[0], 1), max(counts[-1], 1), LADDER)
        done: dict[int, Row] = {}

        def add(index: int) -> None:
            if index not in done and not any(
                counts[index] == counts[j] and (sets[index] == sets[j]).all() for j in done
            ):
                progress(min(len(done) / (LADDER + REFINEMENTS * len(BUDGETS)), 1.0), f"setting {settings[index]:.3g}")
                done[index] = self.measure(policy.name, settings[index], sets[index])

        for w in wanted:
            add(int(np.abs(counts - w).argmin()))
        for budget in budgets():
            for _ in range(REFINEMENTS):
                good = [j for j, row in done.items() if holds(row, budget)]
                high = min(good, key=lambda j: counts[j], default=len(sets) - 1)
                low = max((j for j in done if counts[j] < counts[high]), default=0)
                if counts[high] <= 1.2 * counts[low] or high - low < 2:
                    break
                middle = (counts[low] * counts[high]) ** 0.5
                add(low + 1 + int(np.abs(counts[low + 1 : high] - middle).argmin()))

    def analysis(
        self, options: CullOptions, progress: Progress = silent
    ) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """An analysis from nothing, from the store if it is there: its stats, and active and score."""

        def compute() -> tuple[dict[str, Any], dict[str, np.ndarray]]:
            result = analyze(self.scene, options, progress, self.cancelled)
            return result.stats, {"active": result.active, "score": result.score}

        return self.store.get(f"analysis {options}", compute)

    def counts(self, progress: Progress = silent) -> None:
        """Rows of light-paths by counts: one analysis, whose score every threshold uses."""
        options = replace(self.settings.options, min_share=0.0)
        stats, arrays = self.analysis(options, part(progress, 0.0, 0.3))
        for k, share in enumerate(SHARES):
            progress(0.3 + 0.7 * k / len(SHARES), f"share {share:.3g}")
            self.measure(
                COUNTS, share, arrays["score"] >= share, feedback_s=stats["feedback_s"], analysis_s=seconds(stats)
            )

    def budgets(self, progress: Progress = silent) -> None:
        """Rows of light-paths by budget, each an analysis of its own."""
        for k, budget in enumerate(budgets()):
            options = replace(self.settings.options, max_error=budget, min_share=None)
            stats, arrays = self.analysis(options, part(progress, k / 4, (k + 1) / 4, f"error {budget.mean:.3g}, "))
            predicted = {
                key: stats[key] for key in ("predicted_mean", "predicted_worst", "certified_mean", "certified_worst")
            }
            row = self.measure(
                OURS,
                budget.mean,
                arrays["active"],
                feedback_s=stats["feedback_s"],
                analysis_s=seconds(stats),
                **predicted,
            )
            row |= self.changed(arrays["active"], budget)

    def random(self, progress: Progress = silent) -> None:
        """Rows of random sets, each as large as ours for a budget."""
        rng = np.random.default_rng(0)
        sizes = [row["active"] for row in self.rows if row["policy"] == OURS]
        for k, size in enumerate(sizes):
            progress(k / len(sizes), f"{size:,} instances")
            keep = np.zeros(len(self.scene.instances), bool)
            keep[rng.permutation(len(keep))[:size]] = True
            self.measure(RANDOM, size, keep)

    def oracles(self, progress: Progress = silent) -> None:
        """Rows of the oracle, started from its own weights and from every set that holds a budget."""
        paths = ORACLE_PATHS * self.judge.samples

        def weigh() -> tuple[dict[str, Any], dict[str, np.ndarray]]:
            worth, ids = self.judge.exhaustive_weights(paths, part(progress, 0.0, 0.25, "oracle's weights, "))
            return {}, {"worth": worth, "ids": ids}

        weights: dict[str, np.ndarray] = {}
        for k, budget in enumerate(budgets()):
            low, high = 0.25 + 0.75 * k / 4, 0.25 + 0.75 * (k + 1) / 4

            def compute(
                budget: Budget = budget, low: float = low, high: float = high
            ) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
                if not weights:
                    weights.update(self.store.get("oracle's weights", weigh)[1])
                proposals = [keep for row, keep in zip(self.rows, self.keeps, strict=True) if holds(row, budget)]
                return {}, {
                    "keep": search(
                        self.judge, weights["worth"], weights["ids"], budget, proposals, part(progress, low, high)
                    )
                }

            _, arrays = self.store.get(f"oracle {budget}", compute)
            self.measure(ORACLE, budget.mean, arrays["keep"])


def _name_of(keep: np.ndarray) -> str:
    """For the store."""
    return hashlib.sha256(np.packbits(keep).tobytes()).hexdigest()


def budgets() -> Iterator[Budget]:
    """The budgets that are evaluated: mean E, worst tile 5 E."""
    return (Budget(e, 5 * e) for e in BUDGETS)


def holds(row: Row, budget: Budget) -> bool:
    """Whether the measured error of a row is within both bounds."""
    return bool(row["mean"] <= budget.mean and row["worst"] <= budget.worst)


def seconds(stats: dict[str, Any]) -> float:
    """What an analysis took."""
    return float(stats["build_s"] + stats["trace_s"] + stats["feedback_s"])


def at_equal_error(rows: list[Row]) -> list[Row]:
    """For each budget: what ours, the oracle and the best heuristic keep of instances and BLAS bytes, and how ours
    compares."""
    out = []
    for budget in budgets():
        ours, oracle = (
            next(r for r in rows if r["policy"] == p and r["setting"] == budget.mean) for p in (OURS, ORACLE)
        )
        able = [r for r in rows if r["policy"] in (*RULES, "none") and holds(r, budget)]
        entry: Row = {"error": budget.mean, "holds": ours["holds"], "mean": ours["mean"], "worst": ours["worst"]}
        for name in ("active", "blas_bytes"):
            best = min(able, key=lambda r: r[name])
            entry |= {
                name: ours[name],
                f"{name}_oracle": oracle[name],
                f"{name}_heuristic": best[name],
                f"{name}_heuristic_policy": best["policy"],
            }
        out.append(entry)
    return out


def budget_check(evaluation: Evaluation, seeds: int, progress: Progress = silent) -> Row:
    """Whether the measured error stays in the budgets, for analyses with other random numbers: cases, how many hold, do
    so surely, and surely do not, and each of them."""
    cases = []
    for seed in range(1, seeds + 1):
        for k, budget in enumerate(budgets()):
            progress((4 * (seed - 1) + k) / (4 * seeds), f"seed {seed}, error {budget.mean:.3g}")
            options = replace(
                evaluation.settings.options,
                max_error=budget,
                min_share=None,
                seed=seed,
                threads=evaluation.settings.threads,
            )
            stats, arrays = evaluation.analysis(options)
            case: Row = {"seed": seed, "error": budget.mean} | evaluation.changed(arrays["active"], budget)
            cases.append(
                case | {key: stats[key] for key in ("active", "blas_bytes", "certified_mean", "certified_worst")}
            )
    totals = {name: sum(c[key] for c in cases) for name, key in VERDICTS.items()}
    return {"seeds": seeds, "cases": len(cases), **totals, "each": cases}


def ray_budget(evaluation: Evaluation, progress: Progress = silent) -> list[Row]:
    """What fewer paths, and boxes counted on fewer of them, do to an analysis at E = 1 %."""
    out = []
    budget = Budget(0.01, 0.05)
    default = replace(evaluation.settings.options, max_error=budget, min_share=None).paths_per_pixel(
        evaluation.scene.film
    )
    studied = [(paths, 1) for paths in PATHS] + [(default, every) for every in EVERY]
    for k, (paths, every) in enumerate(studied):
        progress(k / len(studied), f"{paths} paths per pixel, boxes on one in {every}")
        options = replace(
            evaluation.settings.options, max_error=budget, min_share=None, paths=paths, hitbox_every=every, seed=1
        )
        stats, arrays = evaluation.analysis(options)
        row = evaluation.changed(arrays["active"], budget)
        out.append({"paths": paths, "hitbox_every": every, "analysis_s": seconds(stats)} | row)
        out[-1] |= {key: stats[key] for key in ("iterations", "rays", "active", "blas_bytes")}
    return out
