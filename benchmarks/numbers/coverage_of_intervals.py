"""Coverage of 95 % intervals, over benchmarks drawn from a world with known ground truth.

``python benchmarks coverage_of_intervals [--simulations 2000] [--write docs/numbers/statistics.md]`` prints the tables
of docs/numbers/statistics.md and, with ``--write``, updates them; two minutes on one idle core. Exit code 1: a cell
is below 90.

The world consists of scenes: their classes and sizes, and the difficulty of scenes, classes and
instances for two equally good methods. The true value is that of the metric over very many scenes. Values,
jackknife values and intervals come from the functions that score runs. The world's settings are round numbers
fixed before looking at any coverage; they make scenes differ more than the built-in rooms do.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from su3d_bench.core.types import Float64Array, Int64Array, Interval
from su3d_bench.human_eval.answers import krippendorff_alphas
from su3d_bench.metrics.instance import average_precision as instance_ap
from su3d_bench.metrics.instance.average_precision import InstanceCounts, resampled_ap
from su3d_bench.metrics.questions import score as asking
from su3d_bench.metrics.questions.score import ShareCounts, share_counts
from su3d_bench.metrics.semantic.confusion import SemanticCounts, resampled_semantic
from su3d_bench.numerics.statistics import (
    DIFFERENCE,
    MIN_ITEMS,
    SHARE,
    jackknife_interval,
    leave_one_out,
    mean_interval,
    pseudo_values,
    share_interval,
    t_quantile,
)
from su3d_bench.reports.tables.formats import aligned

BEGIN, END = "<!-- coverage: written by benchmarks/numbers/coverage_of_intervals.py -->", "<!-- end of coverage -->"
LOW, HIGH, MIN_COVERAGE = 93.0, 97.0, 90.0  # per cent: target range, and the minimum to show an interval
N_BOOTSTRAP, N_RESAMPLES, MAX_BOOTSTRAP = 500, 400, 20  # simulations, resamples, and maximum scenes for the bootstrap
N_TRUTH = 20_000  # scenes that represent the population
THRESHOLDS = (0.5, 0.75, 0.25)
QUALITY = np.array([0.5, -0.6, 1.3])  # added to an instance's quality, which decides at each threshold
Weights = Int64Array
Values = dict[str, Float64Array]


def sigmoid(value: Float64Array) -> Float64Array:
    return 1.0 / (1.0 + np.exp(-value))


class Semantic:
    """Confusion matrices of 30 classes: sizes and presence as uneven as in rooms, one class in ten is rare."""

    names = ("mAcc", "F-mIoU")
    n_classes = 30

    def __init__(self) -> None:
        rng = np.random.default_rng(1)
        self.presence = np.maximum(1 / np.arange(1, self.n_classes + 1) ** 0.6, 0.08)  # the first is in every scene
        self.difficulty = rng.normal(0, 0.8, self.n_classes)
        self.size = 2000 * rng.lognormal(0, 1.2, self.n_classes)

    def points(self, rng: np.random.Generator, n: int) -> tuple[Int64Array, list[tuple[Int64Array, Int64Array]]]:
        """Points of each class (n, C) and, for two methods, those predicted correctly and wrongly predicted as it."""
        shape = (n, self.n_classes)
        is_present = rng.random(shape) < self.presence
        n_true = np.where(is_present, self.size * rng.lognormal(0, 0.7, shape), 0).astype(np.int64)
        shared = 1.2 + self.difficulty + rng.normal(0, 0.6, (n, 1)) + rng.normal(0, 0.7, shape)
        methods = []
        for _ in range(2):
            recall = sigmoid(shared + rng.normal(0, 0.2, (n, 1)) + rng.normal(0, 0.7, shape))
            hit = (n_true * recall).astype(np.int64)
            wrong = rng.dirichlet(np.full(self.n_classes, 0.5), n) * is_present
            wrong /= np.maximum(wrong.sum(axis=1, keepdims=True), 1e-9)
            methods.append((hit, (0.7 * (n_true - hit).sum(axis=1, keepdims=True) * wrong).astype(np.int64)))
        return n_true, methods

    def draw(self, rng: np.random.Generator, n: int) -> list[list[SemanticCounts]]:
        n_true, methods = self.points(rng, n)
        return [[self._counts(*row) for row in zip(n_true, *of_method, strict=True)] for of_method in methods]

    def _counts(self, n_true: Int64Array, hit: Int64Array, wrong: Int64Array) -> SemanticCounts:
        """Rows and columns have the relevant sums; the pairs of confused classes do not matter."""
        confusion = np.zeros((self.n_classes + 1, self.n_classes + 1), np.int64)
        np.fill_diagonal(confusion, hit)
        confusion[: self.n_classes, -1] = n_true - hit
        for row, columns in ((0, slice(1, self.n_classes)), (1, slice(0, 1))):  # off the diagonal
            confusion[row, columns] += wrong[columns]
            confusion[row, -1] -= wrong[columns].sum()
        return SemanticCounts(confusion[: self.n_classes], n_true > 0)

    def values(self, counts: Sequence[SemanticCounts], weights: Weights) -> Values:
        return resampled_semantic(counts, weights, "conceptgraphs")

    def truth(self, rng: np.random.Generator) -> dict[str, float]:
        n_true, ((hit, wrong), _) = self.points(rng, 10 * N_TRUTH)
        totals = [part.sum(axis=0).astype(np.float64) for part in (n_true, hit, wrong)]
        iou = totals[1] / (totals[0] + totals[2])
        return {"mAcc": float((totals[1] / totals[0]).mean()), "F-mIoU": float(totals[0] @ iou / totals[0].sum())}


class SceneMeans(Semantic):
    """The mean over scenes of each scene's accuracy."""

    names = ("mean of scenes",)

    def draw(self, rng: np.random.Generator, n: int) -> Any:
        n_true, methods = self.points(rng, n)
        with np.errstate(invalid="ignore"):
            return [np.nanmean(np.where(n_true > 0, hit / n_true, np.nan), axis=1) for hit, _ in methods]

    def values(self, counts: Any, weights: Weights) -> Values:
        return {"mean of scenes": weights @ counts / weights.sum(axis=1)}

    def truth(self, rng: np.random.Generator) -> dict[str, float]:
        return {"mean of scenes": float(self.draw(rng, 10 * N_TRUTH)[0].mean())}


class Shares:
    """Shares of correctly answered questions, about 10 to 40 per scene."""

    names = ("correct answers",)

    def draw(self, rng: np.random.Generator, n: int) -> list[list[ShareCounts]]:
        n_asked, shared = rng.integers(10, 41, n), 0.8 + rng.normal(0, 0.6, n)
        right = [rng.binomial(n_asked, sigmoid(shared + rng.normal(0, 0.3, n))) for _ in range(2)]
        return [[share_counts([a], [r]) for a, r in zip(n_asked, of_method, strict=True)] for of_method in right]

    def values(self, counts: Sequence[ShareCounts], weights: Weights) -> Values:
        return {"correct answers": asking.resampled(counts, weights)[:, 0]}

    def truth(self, rng: np.random.Generator) -> dict[str, float]:
        counts = asking.ShareCounts.joined(self.draw(rng, 10 * N_TRUTH)[0])
        return {"correct answers": float(asking.shares(counts)[0])}


class Instances:
    """Precision-recall rows of 8 classes, from 4 instances per scene to one in four scenes."""

    names = ("pooled AP", "pooled AP50")
    rate = np.array([4, 3, 2, 1.5, 1, 0.6, 0.4, 0.25])

    def __init__(self) -> None:
        self.difficulty = np.random.default_rng(1).normal(0, 0.6, len(self.rate))

    def draw(self, rng: np.random.Generator, n: int) -> list[list[InstanceCounts]]:
        methods: list[list[InstanceCounts]] = [[], []]
        for _ in range(n):
            n_truth, of_scene = rng.poisson(self.rate), rng.normal(0, 0.5)
            of_class = np.repeat(np.arange(len(self.rate)), n_truth)
            shared = of_scene + self.difficulty[of_class] + rng.normal(0, 0.7, len(of_class))
            for method in methods:
                quality = shared + rng.normal(0, 0.2) + rng.normal(0, 0.7, len(of_class))
                method.append(self._counts(rng, n_truth, of_class, quality, of_scene))
        return methods

    def _counts(
        self,
        rng: np.random.Generator,
        n_truth: Int64Array,
        of_class: Int64Array,
        quality: Float64Array,
        of_scene: float,
    ) -> InstanceCounts:
        n_false = rng.poisson(0.6 * self.rate * np.exp(-0.5 * of_scene))
        classes = np.concatenate([of_class, np.repeat(np.arange(len(self.rate)), n_false)])
        sure = np.concatenate([0.5 + 0.7 * quality, np.full(int(n_false.sum()), -0.5)])
        score = sigmoid(sure + rng.normal(0, 0.8, len(sure)))
        is_true = np.zeros((len(THRESHOLDS), len(classes)), bool)
        is_true[:, : len(quality)] = quality + QUALITY[:, None] > 0
        n_found = np.array([np.bincount(of_class[row[: len(quality)]], minlength=len(self.rate)) for row in is_true])
        return InstanceCounts(
            class_index=np.tile(classes, len(THRESHOLDS)).astype(np.int32),
            threshold_index=np.repeat(np.arange(len(THRESHOLDS)), len(classes)).astype(np.int32),
            score=np.tile(score, len(THRESHOLDS)),
            is_true=is_true.ravel(),
            n_missed=n_truth[:, None] - n_found.T,
            n_truth=n_truth.astype(np.int64),
            n_small_truth=np.zeros(len(self.rate), np.int64),
            n_predictions=n_truth + n_false,
        )

    def values(self, counts: Sequence[InstanceCounts], weights: Weights) -> Values:
        found = resampled_ap(counts, weights, THRESHOLDS)
        return {"pooled AP": found["AP"], "pooled AP50": found["AP50"]}

    def truth(self, rng: np.random.Generator) -> dict[str, float]:
        found = self.values(self.draw(rng, N_TRUTH)[0], np.ones((1, N_TRUTH), np.int64))
        return {name: float(value[0]) for name, value in found.items()}


WORLDS: tuple[Callable[[], Any], ...] = (Semantic, SceneMeans, Shares, Instances)
REASONS: Mapping[str, str] = {
    "mAcc": "a class in few scenes weighs as much as any other, and depends on one of them or is missing",
    "F-mIoU": "a few large classes dominate the sum, which is skewed: occasionally one scene outweighs the others",
    "pooled AP": "rare classes have few instances, and AP of few instances is biased upwards",
    "pooled AP50": "rare classes have few instances, and AP of few instances is biased upwards",
    "mean of scenes": "the scenes' values are skewed",
    "correct answers": "scenes with many questions outweigh the others",
}


@dataclass
class Tally:
    """Number of intervals and of those that contain the true value, by kind of interval."""

    covered: dict[str, int]
    n: dict[str, int]

    def add(self, kind: str, interval: Interval | None, truth: float) -> None:
        self.n[kind] = self.n.get(kind, 0) + 1
        self.covered[kind] = self.covered.get(kind, 0) + (interval is not None and interval[0] <= truth <= interval[1])

    def per_cent(self, kind: str) -> float | None:
        return 100.0 * self.covered[kind] / self.n[kind] if self.n.get(kind) else None


JACKKNIFE, PSEUDO, BOOTSTRAP = "jackknife", "around the mean of pseudo-values", "percentile bootstrap"


def add_intervals(
    tally: Tally, without_each: Float64Array, resampled: Float64Array | None, truth: float, bounds: Interval
) -> None:
    tally.add(JACKKNIFE, jackknife_interval(without_each, bounds=bounds), truth)
    pseudo = pseudo_values(without_each)
    half = t_quantile(0.975, len(pseudo) - 1) * pseudo.std(ddof=1) / np.sqrt(len(pseudo))
    tally.add(PSEUDO, (pseudo.mean() - half, pseudo.mean() + half), truth)
    if resampled is not None:
        low, high = np.nanquantile(resampled, [0.025, 0.975])
        tally.add(BOOTSTRAP, (low, high), truth)


def simulate(world: Any, truth: Mapping[str, float], n_scenes: int, n_simulations: int, seed: int) -> dict[str, Tally]:
    """Metric -> coverage of its intervals over ``n_simulations`` benchmarks of ``n_scenes``."""
    rng = np.random.default_rng([seed, n_scenes])
    weights = leave_one_out(n_scenes)
    names = [*world.names, *(f"{name}, difference" for name in world.names)]
    tallies = {name: Tally({}, {}) for name in names}
    for simulation in range(n_simulations):
        methods = world.draw(rng, n_scenes)
        values = [world.values(counts, weights) for counts in methods]
        resampled: list[Values] = []
        if simulation < N_BOOTSTRAP and n_scenes <= MAX_BOOTSTRAP:
            drawn = rng.multinomial(n_scenes, np.full(n_scenes, 1.0 / n_scenes), size=N_RESAMPLES)
            resampled = [world.values(counts, drawn) for counts in methods]
        for name in world.names:
            own = [of_method[name] for of_method in resampled]
            add_intervals(tallies[name], values[0][name], own[0] if own else None, truth[name], SHARE)
            change, drawn_change = values[1][name] - values[0][name], own[1] - own[0] if own else None
            add_intervals(tallies[f"{name}, difference"], change, drawn_change, 0.0, DIFFERENCE)
    return tallies


def over_scenes(sizes: Sequence[int], n_simulations: int, seed: int) -> Iterator[str]:
    """The table of intervals over scenes, and remarks on its cells."""
    table: dict[str, dict[int, Tally]] = {}
    for make in WORLDS:
        world = make()
        truth = world.truth(np.random.default_rng([seed, 0]))
        for n_scenes in sizes:
            print(f"{', '.join(world.names)}: {n_scenes} scenes", file=sys.stderr)
            for name, tally in simulate(world, truth, n_scenes, n_simulations, seed).items():
                table.setdefault(name, {})[n_scenes] = tally
    names = sorted(table, key=lambda name: name.endswith("difference"))
    yield from aligned(
        [
            ["coverage, %", *(f"{n} scenes" for n in sizes)],
            *([name, *(_marked(table[name][n].per_cent(JACKKNIFE)) for n in sizes)] for name in names),
        ]
    )
    yield f"\n{n_simulations} simulations per cell (standard error {100 * (0.0475 / n_simulations) ** 0.5:.1f})."
    missed = {name: [n for n in sizes if _is_missed(table[name][n].per_cent(JACKKNIFE))] for name in names}
    yield "In italics: outside 93 to 97." if any(missed.values()) else "All are within 93 to 97."
    for name, of_sizes in missed.items():
        if of_sizes:
            reason = REASONS[name.removesuffix(", difference")]
            yield f"\n- {name} at {', '.join(map(str, of_sizes))} scenes: {reason}."
    refused = [(n, n_) for n, of in table.items() for n_ in sizes if (of[n_].per_cent(JACKKNIFE) or 0) < MIN_COVERAGE]
    where = ", ".join(f"{name} at {n} scenes" for name, n in refused)
    yield (f"\nBelow 90: {where}.\n" if refused else "\nNone is below 90, so intervals are shown from 2 scenes on.\n")
    yield "The same simulations with two alternatives that are not used:\n"
    few = [n for n in sizes if n <= MAX_BOOTSTRAP]
    single = [name for name in names if not name.endswith("difference")]
    yield from aligned(
        [
            ["", *(f"{kind}, {n} scenes" for kind in (BOOTSTRAP, PSEUDO) for n in few[2::2])],  # 4 and 20 by default
            *([m, *(_cell(table[m][n].per_cent(k)) for k in (BOOTSTRAP, PSEUDO) for n in few[2::2])] for m in single),
        ]
    )
    yield f"\nThe bootstrap: {N_RESAMPLES} resamples, {min(N_BOOTSTRAP, n_simulations)} simulations per cell.\n"


def _cell(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}"


def _is_missed(value: float | None) -> bool:
    return value is None or not LOW <= round(value, 1) <= HIGH


def _marked(value: float | None) -> str:
    return f"*{_cell(value)}*" if _is_missed(value) else _cell(value)


ITEMS = (10, 20, 50, 200)
RATES = (0.5, 0.7, 0.9, 0.98)


def over_items(n_simulations: int, seed: int) -> Iterator[str]:
    """The table of intervals over items: Wilson's, computed exactly; those of changes and agreement, simulated."""
    rng = np.random.default_rng([seed, 1])
    rows = [[f"true proportion {rate:g}", *(_marked(100 * wilson(rate, n)) for n in ITEMS)] for rate in RATES]
    for name, simulated in (("paired change", change), ("Krippendorff's alpha, 3 annotators", agreement)):
        rows.append([name, *(_marked(100 * simulated(rng, n, n_simulations)) for n in ITEMS)])
    yield "Intervals over items such as annotators' ratings (see below):\n"
    yield from aligned([["coverage, %", *(f"{n} items" for n in ITEMS)], *rows])
    few = [f"{100 * simulated(rng, 5, n_simulations):.1f}" for simulated in (change, agreement)]
    yield (
        "\nThe coverage of proportions deviates from 95 % (in italics) because counts are integers: it oscillates with "
        "the true proportion and the number of items (Brown, Cai and DasGupta). The other two rows are slightly below "
        f"95 % where the distribution over few items is skewed; below {MIN_ITEMS} items they have no interval (with 5, "
        f"coverage would be {few[0]} and {few[1]} %)."
    )


def wilson(rate: float, n: int) -> float:
    """Coverage of the interval of a share at ``rate``, over all possible observations."""
    from scipy.stats import binom

    covered = [(interval := share_interval(k / n, n)) and interval[0] <= rate <= interval[1] for k in range(n + 1)]
    return float(binom.pmf(np.arange(n + 1), n, rate) @ np.array(covered, np.float64))


def change(rng: np.random.Generator, n: int, n_simulations: int) -> float:
    """Items of which 25 % become correct and 15 % wrong."""
    values = rng.choice([1.0, -1.0, 0.0], (n_simulations, n), p=[0.25, 0.15, 0.6])
    intervals = [mean_interval(row, DIFFERENCE) for row in values]
    return float(np.mean([interval is not None and interval[0] <= 0.1 <= interval[1] for interval in intervals]))


def agreement(rng: np.random.Generator, n: int, n_simulations: int) -> float:
    """Three annotators, correct in 90 % of two equally frequent answers: alpha is 0.8 squared."""
    n_held = 0
    for _ in range(n_simulations):
        truth = rng.random(n) < 0.5
        yes = (truth[:, None] ^ (rng.random((n, 3)) < 0.1)).sum(axis=1)
        counts = np.stack([yes, 3 - yes], axis=1).astype(np.int64)
        interval = jackknife_interval(krippendorff_alphas(counts, leave_one_out(n)), bounds=DIFFERENCE)
        n_held += interval is not None and interval[0] <= 0.64 <= interval[1]
    return n_held / n_simulations


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--simulations", type=int, default=2000)
    parser.add_argument("--scenes", type=int, nargs="+", default=[2, 3, 4, 8, 20, 100])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--write", type=Path, metavar="FILE", help="update the tables between the markers in this page")
    given = parser.parse_args(arguments)
    instance_ap.MANY_ROWS = 0  # use the compiled loops of large runs, ten times as fast
    lines = [*over_scenes(given.scenes, given.simulations, given.seed), *over_items(given.simulations, given.seed)]
    text = "\n".join(lines)
    print(text)
    if given.write is not None:
        page = given.write.read_text(encoding="utf-8")
        before, _, rest = page.partition(BEGIN)
        given.write.write_text(f"{before}{BEGIN}\n{text}\n{END}{rest.partition(END)[2]}", encoding="utf-8")
    return int("\nBelow 90: " in text)


if __name__ == "__main__":
    sys.exit(main())
